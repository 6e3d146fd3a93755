//! Light probes from latitude-longitude pictures: `.hdr` and `.exr`.

use super::LayeredImage;
use crate::error::PointsError;
use image::ImageDecoder;
use pbgi_core::Environment;
use pbgi_core::limits::IMAGE_PIXELS_MAX;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

/// Reads a latitude-longitude picture, `.hdr` (Radiance) or `.exr` (channels R, G, B at the root or in the only layer),
/// as radiance. The row at the top is up; negative values, which filters leave around suns, become 0.
///
/// # Errors
/// No or a damaged file, another format, no colour channels, too many pixels, or a pixel that is not finite.
pub fn read_environment(path: &Path) -> Result<Environment, PointsError> {
    let mut magic = [0; 4];
    let opened = File::open(path).map_err(PointsError::io("open", path))?;
    // A file that is shorter is neither.
    let known = opened.take(4).read_exact(&mut magic).map(|()| magic);
    let (width, height, mut pixels) = match known {
        Ok([b'#', b'?', ..]) => read_hdr(path)?,
        Ok([0x76, 0x2f, 0x31, 0x01]) => read_exr(path)?,
        _ => {
            let what = "an environment of an unknown kind".to_owned();
            return Err(PointsError::unsupported(path, what, "convert it to .hdr or .exr"));
        }
    };
    for (index, pixel) in pixels.iter_mut().enumerate() {
        if !pixel.iter().all(|value| value.is_finite()) {
            let (x, y) = (index % width as usize, index / width as usize);
            let what = format!("environment pixel ({x}, {y}) is not finite: repair it with a median filter");
            return Err(PointsError::invalid(path, what));
        }
        *pixel = pixel.map(|value| value.max(0.0));
    }
    Environment::new(width, height, pixels).map_err(|error| PointsError::invalid(path, error.to_string()))
}

type Pixels = (u32, u32, Vec<[f32; 3]>);

fn read_hdr(path: &Path) -> Result<Pixels, PointsError> {
    let file = File::open(path).map_err(PointsError::io("open", path))?;
    let damaged = |error: image::ImageError| PointsError::invalid(path, format!("not a usable HDR file: {error}"));
    let decoder = image::codecs::hdr::HdrDecoder::new(BufReader::new(file)).map_err(damaged)?;
    let (width, height) = decoder.dimensions();
    check_size(path, width, height)?;
    let picture = image::DynamicImage::from_decoder(decoder).map_err(damaged)?;
    let pixels = picture.into_rgb32f().pixels().map(|pixel| pixel.0).collect();
    Ok((width, height, pixels))
}

fn read_exr(path: &Path) -> Result<Pixels, PointsError> {
    let colour = |name: &str| matches!(name.rsplit('.').next(), Some("R" | "G" | "B"));
    let image = LayeredImage::read_exr_channels(path, colour)?;
    let layers = image.channels.keys().filter_map(|name| name.strip_suffix(".R"));
    let layer = std::iter::once("").chain(layers).find_map(|layer| image.triple(layer));
    let pixels = layer.ok_or_else(|| {
        PointsError::invalid(
            path,
            "the image has no channels R, G and B: save the light probe as RGB",
        )
    })?;
    Ok((image.data_window.width, image.data_window.height, pixels))
}

fn check_size(path: &Path, width: u32, height: u32) -> Result<(), PointsError> {
    let pixels = u64::from(width) * u64::from(height);
    if pixels > IMAGE_PIXELS_MAX {
        return Err(PointsError::Limit {
            what: "number of pixels",
            value: pixels,
            limit: IMAGE_PIXELS_MAX,
            path: path.to_owned(),
        });
    }
    Ok(())
}
