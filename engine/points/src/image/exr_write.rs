//! [`LayeredImage`] to EXR: one part, tiled, ZIP. Blocks are made from the channels as they are; nothing is copied whole.

use super::{Channel, LayeredImage, Precision, Window};
use crate::error::PointsError;
use crate::limits;
use crate::output::write_file;
use exr::block::lines::LineRefMut;
use exr::block::{BlockIndex, UncompressedBlock};
use exr::image::write::channels::{ChannelsWriter, WritableChannels};
use exr::math::RoundingMode;
use exr::meta::attribute::{AttributeValue, ChannelDescription, ChannelList, IntegerBounds, LevelMode, Text};
use exr::meta::header::Header;
use exr::prelude::{
    Blocks, Compression, Encoding, Image, Layer, LayerAttributes, LineOrder, SampleType, Vec2, WritableImage,
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

    fn to_exr(&self, path: &Path) -> Result<Image<Layer<Planes<'_>>>, PointsError> {
        let text = |value: &str| {
            Text::new_or_none(value).ok_or_else(|| {
                PointsError::invalid(path, format!("{value:?} has characters that an EXR text cannot hold"))
            })
        };
        let mut planes = Vec::with_capacity(self.channels.len());
        for (name, channel) in &self.channels {
            planes.push((text(name)?, channel));
        }
        let planes = Planes {
            width: self.data_window.width as usize,
            planes,
        };
        let (image, kept) = self.attributes.for_file(bounds(self.display_window));
        let mut attributes = LayerAttributes {
            layer_position: Vec2(self.data_window.x, self.data_window.y),
            software_name: Text::new_or_none(concat!("pbgi ", env!("CARGO_PKG_VERSION"))),
            world_to_camera: self.world_to_camera.map(|matrix| matrix.to_cols_array()),
            world_to_normalized_device: self.world_to_ndc.map(|matrix| matrix.to_cols_array()),
            ..kept
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
        Ok(Image::new(image, Layer::new(size, attributes, encoding, planes)))
    }
}

/// The channels in the order of their names, which the format asks for.
struct Planes<'a> {
    width: usize,
    planes: Vec<(Text, &'a Channel)>,
}

impl<'a, 'channels: 'a> WritableChannels<'a> for Planes<'channels> {
    type Writer = &'a Self;

    fn infer_channel_list(&self) -> ChannelList {
        let describe = |(name, channel): &(Text, &Channel)| {
            let sample_type = match channel.precision {
                Precision::Half => SampleType::F16,
                Precision::Float => SampleType::F32,
            };
            ChannelDescription::named(name.clone(), sample_type)
        };
        ChannelList::new(self.planes.iter().map(describe).collect())
    }

    fn infer_level_modes(&self) -> (LevelMode, RoundingMode) {
        (LevelMode::Singular, RoundingMode::Down)
    }

    fn create_writer(&'a self, _: &Header) -> Self::Writer {
        self
    }
}

impl ChannelsWriter for &Planes<'_> {
    fn extract_uncompressed_block(&self, header: &Header, block: BlockIndex) -> Vec<u8> {
        UncompressedBlock::collect_block_data_from_lines(&header.channels, block, |line| self.extract_line(line))
    }
}

impl Planes<'_> {
    fn extract_line(&self, line: LineRefMut<'_>) {
        let (_, channel) = &self.planes[line.location.channel];
        let start = line.location.position.y() * self.width + line.location.position.x();
        let row = &channel.values[start..start + line.location.sample_count];
        let written = match channel.precision {
            Precision::Half => line.write_samples(|index| f16::from_f32(row[index])),
            Precision::Float => line.write_samples_from_slice(row),
        };
        debug_assert!(written.is_ok(), "a line holds its samples");
    }
}

fn bounds(window: Window) -> IntegerBounds {
    IntegerBounds {
        position: Vec2(window.x, window.y),
        size: Vec2(window.width as usize, window.height as usize),
    }
}
