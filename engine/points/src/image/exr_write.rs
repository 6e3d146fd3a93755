//! [`LayeredImage`] to EXR: one part, tiled, ZIP.

use super::{LayeredImage, Precision, Window};
use crate::error::PointsError;
use crate::limits;
use crate::output::write_file;
use exr::meta::attribute::{AttributeValue, IntegerBounds, Text};
use exr::prelude::{
    AnyChannel, AnyChannels, Blocks, Compression, Encoding, FlatSamples, Image, ImageAttributes, Layer,
    LayerAttributes, LineOrder, Vec2, WritableImage,
};
use half::f16;
use std::path::Path;

impl LayeredImage {
    /// Writes an EXR file (one part, tiles of the work queue's size, ZIP), replacing `path` only when it is complete.
    ///
    /// # Errors
    /// A failing disk, or a name or text that EXR cannot hold.
    pub fn write_exr(&self, path: &Path) -> Result<(), PointsError> {
        let image = self.to_exr(path)?;
        // One thread: a daemon writes few pictures, and the pool's threads keep memory.
        write_file(path, |file| image.write().non_parallel().to_buffered(file))
    }

    fn to_exr(&self, path: &Path) -> Result<Image<Layer<AnyChannels<FlatSamples>>>, PointsError> {
        let text = |value: &str| {
            Text::new_or_none(value).ok_or_else(|| {
                PointsError::invalid(path, format!("{value:?} has characters that an EXR text cannot hold"))
            })
        };
        let mut channels = Vec::with_capacity(self.channels.len());
        for (name, channel) in &self.channels {
            let samples = match channel.precision {
                Precision::Half => FlatSamples::F16(channel.values.iter().copied().map(f16::from_f32).collect()),
                Precision::Float => FlatSamples::F32(channel.values.clone()),
            };
            channels.push(AnyChannel::new(text(name)?, samples));
        }
        let mut attributes = LayerAttributes {
            layer_position: Vec2(self.data_window.x, self.data_window.y),
            software_name: Text::new_or_none(concat!("pbgi ", env!("CARGO_PKG_VERSION"))),
            world_to_camera: self.world_to_camera.map(|matrix| matrix.to_cols_array()),
            ..LayerAttributes::default()
        };
        for (key, value) in &self.metadata {
            attributes.other.insert(text(key)?, AttributeValue::Text(text(value)?));
        }
        let size = Vec2(self.data_window.width as usize, self.data_window.height as usize);
        let encoding = Encoding {
            compression: Compression::ZIP16,
            blocks: Blocks::Tiles(Vec2(limits::EXR_TILE_EDGE, limits::EXR_TILE_EDGE)),
            line_order: LineOrder::Increasing,
        };
        let layer = Layer::new(size, attributes, encoding, AnyChannels::sort(channels.into()));
        Ok(Image::new(ImageAttributes::new(bounds(self.display_window)), layer))
    }
}

fn bounds(window: Window) -> IntegerBounds {
    IntegerBounds {
        position: Vec2(window.x, window.y),
        size: Vec2(window.width as usize, window.height as usize),
    }
}
