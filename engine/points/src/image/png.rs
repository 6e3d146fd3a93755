//! Pictures for looking at: exposure, tone curve, 8-bit sRGB; a heat map of differences.

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
    /// The same curve, with radiance 1 brought just below white after it was brightened by so many stops: the same for every
    /// frame of a sequence.
    Stops(f32),
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
    write_bytes(path, width, height, &tone_mapped(pixels, tone_map))
}

/// Three sRGB bytes a pixel.
pub fn tone_mapped(pixels: &[[f32; 3]], tone_map: ToneMap) -> Vec<u8> {
    let exposure = match tone_map {
        ToneMap::Filmic => automatic_exposure(pixels),
        ToneMap::Stops(stops) => WHITE_LEVEL * stops.exp2(),
        ToneMap::Exposure(factor) => factor,
    };
    let shown = |&value: &f32| {
        let exposed = if value.is_finite() {
            (value * exposure).max(0.0)
        } else {
            0.0
        };
        srgb_byte(match tone_map {
            ToneMap::Filmic | ToneMap::Stops(_) => filmic(exposed),
            ToneMap::Exposure(_) => exposed,
        })
    };
    pixels.iter().flatten().map(shown).collect()
}

/// Writes values (row-major) as a PNG file of colours that go evenly from black over red to pale yellow, from 0 to `most`; what
/// is infinite is cyan.
///
/// # Errors
/// As [`write_png`].
pub fn write_heat_png(path: &Path, width: u32, height: u32, values: &[f32], most: f32) -> Result<(), PointsError> {
    let bytes: Vec<u8> = values.iter().flat_map(|&value| heat(value / most)).collect();
    write_bytes(path, width, height, &bytes)
}

fn write_bytes(path: &Path, width: u32, height: u32, bytes: &[u8]) -> Result<(), PointsError> {
    let count = bytes.len() / 3;
    if count != Window::of_size(width, height).pixel_count() || count == 0 {
        let what = format!("{width} x {height} pixels asked, {count} given");
        return Err(PointsError::invalid(path, what));
    }
    write_file(path, |file| {
        image::codecs::png::PngEncoder::new(file).write_image(bytes, width, height, ExtendedColorType::Rgb8)
    })
}

/// The ramp "inferno": its lightness rises evenly, so that equal steps look equal, in grey and to the colour-blind as well.
const RAMP: [[u8; 3]; 10] = [
    [0, 0, 4],
    [27, 12, 65],
    [74, 12, 107],
    [120, 28, 109],
    [165, 44, 96],
    [207, 68, 70],
    [237, 105, 37],
    [251, 155, 6],
    [247, 209, 61],
    [252, 255, 164],
];
/// No colour of the ramp.
const NOT_COMPARABLE: [u8; 3] = [0, 255, 255];

fn heat(share: f32) -> [u8; 3] {
    if !share.is_finite() {
        return NOT_COMPARABLE;
    }
    let place = share.clamp(0.0, 1.0) * (RAMP.len() - 1) as f32;
    let below = (place as usize).min(RAMP.len() - 2);
    let part = place - below as f32;
    let (a, b) = (RAMP[below], RAMP[below + 1]);
    std::array::from_fn(|c| (f32::from(a[c]) * (1.0 - part) + f32::from(b[c]) * part).round() as u8)
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
    fn a_stop_is_a_factor_of_two() {
        let grey = |value: f32, stops| tone_mapped(&[[value; 3]], ToneMap::Stops(stops));
        assert_eq!(grey(0.5, 1.0), grey(1.0, 0.0));
        assert_eq!(grey(4.0, -2.0), grey(1.0, 0.0));
        assert!((225..250).contains(&grey(1.0, 0.0)[0]), "{:?}", grey(1.0, 0.0));
    }

    #[test]
    fn the_ramp_gets_lighter_all_along() {
        let lightness = |share: f32| {
            heat(share)
                .iter()
                .zip([2126, 7152, 722])
                .map(|(&c, w)| u32::from(c) * w)
                .sum::<u32>()
        };
        let levels: Vec<u32> = (0..=90).map(|i| lightness(i as f32 / 90.0)).collect();
        assert!(levels.windows(2).all(|pair| pair[0] < pair[1]), "{levels:?}");
        assert_eq!((heat(0.0), heat(1.0), heat(7.0)), (RAMP[0], RAMP[9], RAMP[9]));
        assert_eq!(heat(f32::INFINITY), NOT_COMPARABLE);
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
