//! PNG and JPEG files to textures, within bounds.

use crate::error::PointsError;
use crate::limits;
use crate::material::Texture;
use image::{ImageReader, Limits};
use std::io::Cursor;
use std::path::Path;

/// Decodes the bytes of a picture; `path` is named in errors.
pub(crate) fn decode(path: &Path, bytes: &[u8]) -> Result<Texture, PointsError> {
    let damaged = |error: image::ImageError| {
        PointsError::invalid(
            path,
            format!("a texture cannot be decoded (PNG and JPEG are read): {error}"),
        )
    };
    let mut reader = ImageReader::new(Cursor::new(bytes))
        .with_guessed_format()
        .map_err(PointsError::io("read", path))?;
    let mut bounds = Limits::default();
    bounds.max_image_width = Some(limits::TEXTURE_EDGE_MAX);
    bounds.max_image_height = Some(limits::TEXTURE_EDGE_MAX);
    bounds.max_alloc = Some(limits::TEXTURE_BYTES_MAX);
    reader.limits(bounds);
    let picture = reader.decode().map_err(damaged)?.into_rgba8();
    if picture.width() == 0 || picture.height() == 0 {
        return Err(PointsError::invalid(path, "a texture has no pixels"));
    }
    Ok(Texture {
        width: picture.width(),
        height: picture.height(),
        texels: picture.into_raw().as_chunks::<4>().0.to_vec(),
    })
}
