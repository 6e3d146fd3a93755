//! A light probe: radiance from infinitely far, as a latitude-longitude picture.

use crate::limits::IMAGE_PIXELS_MAX;

/// Radiance arriving from every direction, W/(m2 sr), y up. Row 0 is the zenith; column 0 looks along -x, the middle along
/// +x, a quarter along -z (the convention of OpenEXR's latitude-longitude maps seen from inside).
#[derive(Clone, Debug, PartialEq)]
pub struct Environment {
    width: u32,
    height: u32,
    pixels: Vec<[f32; 3]>,
}

/// A picture that is no light probe.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum EnvironmentError {
    /// Width, height and number of pixels do not fit together, or are out of range.
    #[error("environment of {width} x {height} with {pixels} pixels")]
    Size {
        /// Pixels a row.
        width: u32,
        /// Rows.
        height: u32,
        /// Pixels given.
        pixels: usize,
    },
    /// A pixel is NaN, infinite or negative.
    #[error("environment pixel {0} is not a finite positive radiance")]
    Pixel(usize),
}

impl Environment {
    /// Checks and takes a picture, row-major.
    ///
    /// # Errors
    /// Wrong size, or the first pixel that is no radiance.
    pub fn new(width: u32, height: u32, pixels: Vec<[f32; 3]>) -> Result<Self, EnvironmentError> {
        let expected = u64::from(width) * u64::from(height);
        if expected == 0 || expected > IMAGE_PIXELS_MAX || pixels.len() as u64 != expected {
            return Err(EnvironmentError::Size {
                width,
                height,
                pixels: pixels.len(),
            });
        }
        let bad = |pixel: &[f32; 3]| pixel.iter().any(|value| !(value.is_finite() && *value >= 0.0));
        match pixels.iter().position(bad) {
            Some(index) => Err(EnvironmentError::Pixel(index)),
            None => Ok(Self { width, height, pixels }),
        }
    }

    /// Pixels a row.
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> u32 {
        self.height
    }

    /// All pixels, row-major.
    pub fn pixels(&self) -> &[[f32; 3]] {
        &self.pixels
    }
}
