//! A picture for looking at: exposure, tone curve, 8-bit sRGB.

use super::Window;
use crate::error::PointsError;
use crate::output::write_file;
use image::{ExtendedColorType, ImageEncoder};
use std::path::Path;

/// How linear radiance becomes a picture for a screen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ToneMap {
    /// Exposed so that the 98th percentile of the luminance lies just below white, then a filmic curve that rolls off
    /// what is brighter (Hable's, as in Uncharted 2), then the sRGB curve. For beauty pictures.
    Filmic,
    /// Multiplied by the factor, clipped, then the sRGB curve. For comparing pictures.
    Exposure(f32),
}

/// Writes linear pixels (row-major) as an 8-bit sRGB PNG file. Pixels that are not finite become black.
///
/// # Errors
/// A failing disk, or a number of pixels that is not width times height.
pub fn write_png(
    path: &Path,
    width: u32,
    height: u32,
    pixels: &[[f32; 3]],
    tone_map: ToneMap,
) -> Result<(), PointsError> {
    if pixels.len() != Window::of_size(width, height).pixel_count() || pixels.is_empty() {
        let what = format!("{width} x {height} pixels asked, {} given", pixels.len());
        return Err(PointsError::invalid(path, what));
    }
    let exposure = match tone_map {
        ToneMap::Filmic => automatic_exposure(pixels),
        ToneMap::Exposure(factor) => factor,
    };
    let bytes: Vec<u8> = pixels
        .iter()
        .flatten()
        .map(|&value| {
            let exposed = if value.is_finite() {
                (value * exposure).max(0.0)
            } else {
                0.0
            };
            let toned = match tone_map {
                ToneMap::Filmic => filmic(exposed),
                ToneMap::Exposure(_) => exposed,
            };
            srgb_byte(toned)
        })
        .collect();
    write_file(path, |file| {
        image::codecs::png::PngEncoder::new(file).write_image(&bytes, width, height, ExtendedColorType::Rgb8)
    })
}

/// Share of the pixels that are darker than what is shown just below white.
const WHITE_PERCENTILE: f64 = 0.98;

/// Where that percentile is put, in units of the filmic curve's input: 0.8 of white after the curve.
const WHITE_LEVEL: f32 = 1.6;

fn automatic_exposure(pixels: &[[f32; 3]]) -> f32 {
    let mut luminances: Vec<f32> = pixels
        .iter()
        .map(|[r, g, b]| 0.2126 * r + 0.7152 * g + 0.0722 * b)
        .filter(|luminance| luminance.is_finite() && *luminance > 0.0)
        .collect();
    if luminances.is_empty() {
        return 1.0;
    }
    let rank = ((luminances.len() - 1) as f64 * WHITE_PERCENTILE) as usize;
    let (_, white, _) = luminances.select_nth_unstable_by(rank, f32::total_cmp);
    WHITE_LEVEL / *white
}

/// Hable's curve, scaled so that 11.2 is white.
fn filmic(value: f32) -> f32 {
    const WHITE: f32 = 11.2;
    fn curve(x: f32) -> f32 {
        const SHOULDER: f32 = 0.22;
        const LINEAR: f32 = 0.30;
        const ANGLE: f32 = 0.10;
        const TOE: f32 = 0.20;
        const TOE_NUMERATOR: f32 = 0.01;
        const TOE_DENOMINATOR: f32 = 0.30;
        (x * (SHOULDER * x + ANGLE * LINEAR) + TOE * TOE_NUMERATOR)
            / (x * (SHOULDER * x + LINEAR) + TOE * TOE_DENOMINATOR)
            - TOE_NUMERATOR / TOE_DENOMINATOR
    }
    // The curve darkens the middle; doubling its input is Hable's own exposure bias.
    curve(2.0 * value) / curve(WHITE)
}

fn srgb_byte(linear: f32) -> u8 {
    let encoded = if linear <= 0.003_130_8 {
        12.92 * linear
    } else {
        1.055 * linear.min(1.0).powf(1.0 / 2.4) - 0.055
    };
    (encoded * 255.0 + 0.5) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tone_curves_keep_black_black_and_rise() {
        assert_eq!(srgb_byte(filmic(0.0)), 0);
        assert_eq!(srgb_byte(1.0), 255);
        assert_eq!(srgb_byte(0.5), 188);
        let levels: Vec<u8> = (0..100).map(|i| srgb_byte(filmic(i as f32 * 0.05))).collect();
        assert!(levels.windows(2).all(|pair| pair[0] <= pair[1]));
    }

    #[test]
    fn a_bad_pixel_is_black_and_spoils_no_other() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let mut pixels = vec![[0.5f32; 3]; 16];
        pixels[3] = [f32::NAN, f32::INFINITY, -1.0];
        write_png(&path, 4, 4, &pixels, ToneMap::Filmic).unwrap();
        let read = image::open(&path).unwrap().to_rgb8();
        assert_eq!(read.get_pixel(3, 0).0, [0, 0, 0]);
        assert!(read.get_pixel(0, 0).0[0] > 150);
        assert!(write_png(&path, 4, 5, &pixels, ToneMap::Filmic).is_err());
    }
}
