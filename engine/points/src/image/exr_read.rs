//! EXR to [`LayeredImage`]: scanlines or tiles, one part or several with the same data window. Headers are checked against
//! [`crate::limits`] before a pixel is decoded, and only the channels asked for take memory.

use super::{Channel, LayeredImage, Precision, Window};
use crate::error::PointsError;
use crate::limits;
use exr::block::UncompressedBlock;
use exr::block::chunk::TileCoordinates;
use exr::block::reader::ChunksReader;
use exr::meta::MetaData;
use exr::meta::attribute::{AttributeValue, IntegerBounds, SampleType};
use exr::meta::header::Header;
use exr::prelude::Vec2;
use half::f16;
use pbgi_core::limits::IMAGE_PIXELS_MAX;
use std::fs::File;
use std::io::BufReader;
use std::path::Path;

impl LayeredImage {
    /// Reads every channel of an EXR file.
    ///
    /// # Errors
    /// As [`Self::read_exr_channels`].
    pub fn read_exr(path: &Path) -> Result<Self, PointsError> {
        Self::read_exr_channels(path, |_| true)
    }

    /// Reads the channels whose full name (`part.channel` where a file has several parts) `keep` accepts.
    ///
    /// # Errors
    /// No or a damaged file, deep or subsampled data, parts of different sizes, more pixels or channels than the limits.
    pub fn read_exr_channels(path: &Path, keep: impl Fn(&str) -> bool) -> Result<Self, PointsError> {
        let file = File::open(path).map_err(PointsError::io("open", path))?;
        let reader = exr::block::read(BufReader::new(file), false).map_err(damaged(path))?;
        let mut image = describe(path, reader.headers())?;
        let plan = Plan::new(path, reader.headers(), keep)?;
        let mut values: Vec<Vec<f32>> = plan
            .names
            .iter()
            .map(|_| vec![0.0; image.data_window.pixel_count()])
            .collect();
        let width = image.data_window.width as usize;
        let largest_level = |_: &MetaData, _: TileCoordinates, block: exr::block::BlockIndex| {
            block.level == Vec2(0, 0) && plan.slots[block.layer].iter().any(Option::is_some)
        };
        reader
            .filter_chunks(false, largest_level)
            .and_then(|chunks| {
                chunks.decompress_sequential(false, |meta, block| {
                    store_block(&plan, &meta.headers, &block, width, &mut values)
                })
            })
            .map_err(damaged(path))?;
        for ((name, precision), values) in plan.names.into_iter().zip(values) {
            image.channels.insert(name, Channel { precision, values });
        }
        Ok(image)
    }
}

/// The names of all channels of an EXR file, without reading its pixels.
pub(crate) fn channel_names(path: &Path) -> Result<Vec<String>, PointsError> {
    let file = File::open(path).map_err(PointsError::io("open", path))?;
    let reader = exr::block::read(BufReader::new(file), false).map_err(damaged(path))?;
    check_limits(path, reader.headers())?;
    let mut names = Vec::new();
    for header in reader.headers() {
        names.extend(
            header
                .channels
                .list
                .iter()
                .map(|c| full_name(reader.headers(), header, c)),
        );
    }
    Ok(names)
}

/// Where each channel of each part goes.
struct Plan {
    slots: Vec<Vec<Option<usize>>>,
    names: Vec<(String, Precision)>,
}

impl Plan {
    fn new(path: &Path, headers: &[Header], keep: impl Fn(&str) -> bool) -> Result<Self, PointsError> {
        let mut plan = Self {
            slots: Vec::new(),
            names: Vec::new(),
        };
        for header in headers {
            let mut slots = Vec::new();
            for channel in &header.channels.list {
                let name = full_name(headers, header, channel);
                let known = plan.names.iter().any(|(other, _)| *other == name);
                if known || !keep(&name) {
                    slots.push(None);
                    continue;
                }
                if channel.sampling != Vec2(1, 1) {
                    let what = format!("channel {name:?} with subsampling");
                    return Err(PointsError::unsupported(path, what, "write it at full resolution"));
                }
                slots.push(Some(plan.names.len()));
                let precision = match channel.sample_type {
                    SampleType::F16 => Precision::Half,
                    SampleType::F32 | SampleType::U32 => Precision::Float,
                };
                plan.names.push((name, precision));
            }
            plan.slots.push(slots);
        }
        Ok(plan)
    }
}

fn full_name(headers: &[Header], header: &Header, channel: &exr::meta::attribute::ChannelDescription) -> String {
    let name = channel.name.to_string();
    match &header.own_attributes.layer_name {
        Some(part) if headers.len() > 1 && !name.starts_with(&format!("{part}.")) => format!("{part}.{name}"),
        _ => name,
    }
}

fn store_block(
    plan: &Plan,
    headers: &[Header],
    block: &UncompressedBlock,
    width: usize,
    values: &mut [Vec<f32>],
) -> exr::error::UnitResult {
    let layer = block.index.layer;
    for line in block.lines(&headers[layer].channels) {
        let Some(slot) = plan.slots[layer][line.location.channel] else {
            continue;
        };
        let start = line.location.position.y() * width + line.location.position.x();
        let row = values[slot].get_mut(start..start + line.location.sample_count);
        let row = row.ok_or_else(|| exr::error::Error::Invalid("block outside of the data window".into()))?;
        match headers[layer].channels.list[line.location.channel].sample_type {
            SampleType::F16 => {
                for (value, sample) in row.iter_mut().zip(line.read_samples::<f16>()) {
                    *value = sample?.to_f32();
                }
            }
            SampleType::F32 => line.read_samples_into_slice(row)?,
            SampleType::U32 => {
                for (value, sample) in row.iter_mut().zip(line.read_samples::<u32>()) {
                    *value = sample? as f32;
                }
            }
        }
    }
    Ok(())
}

fn describe(path: &Path, headers: &[Header]) -> Result<LayeredImage, PointsError> {
    check_limits(path, headers)?;
    let first = &headers[0];
    let data_window = window(&IntegerBounds {
        position: first.own_attributes.layer_position,
        size: first.layer_size,
    });
    let mut image = LayeredImage::with_windows(data_window, window(&first.shared_attributes.display_window));
    for header in headers {
        if header.layer_size != first.layer_size
            || header.own_attributes.layer_position != first.own_attributes.layer_position
        {
            let what = "a file whose parts have different data windows";
            return Err(PointsError::unsupported(
                path,
                what,
                "write all passes with one data window",
            ));
        }
        if header.deep {
            return Err(PointsError::unsupported(path, "deep data", "flatten the image first"));
        }
        image.world_to_camera = image.world_to_camera.or(header
            .own_attributes
            .world_to_camera
            .map(|m| glam::Mat4::from_cols_array(&m)));
        let attributes = header
            .own_attributes
            .other
            .iter()
            .chain(&header.shared_attributes.other);
        for (key, value) in attributes {
            if let AttributeValue::Text(text) = value {
                image.metadata.insert(key.to_string(), text.to_string());
            }
        }
    }
    Ok(image)
}

/// Refuses what would take too much memory, from the headers alone.
fn check_limits(path: &Path, headers: &[Header]) -> Result<(), PointsError> {
    let limit = |what, value: u64, limit: u64| {
        if value <= limit {
            return Ok(());
        }
        Err(PointsError::Limit {
            what,
            value,
            limit,
            path: path.to_owned(),
        })
    };
    limit("number of parts", headers.len() as u64, limits::EXR_PARTS_MAX as u64)?;
    let channels: usize = headers.iter().map(|header| header.channels.list.len()).sum();
    limit("number of channels", channels as u64, limits::EXR_CHANNELS_MAX as u64)?;
    let mut bytes = 0u64;
    for header in headers {
        let pixels = header.layer_size.width() as u64 * header.layer_size.height() as u64;
        limit("number of pixels", pixels, IMAGE_PIXELS_MAX)?;
        bytes += pixels * header.channels.bytes_per_pixel as u64;
        limit("size of the pixels in bytes", bytes, limits::EXR_BYTES_MAX)?;
        let block = header.max_block_byte_size() as u64;
        limit("size of a block in bytes", block, limits::EXR_BLOCK_BYTES_MAX)?;
    }
    if headers.is_empty() || channels == 0 {
        return Err(PointsError::invalid(path, "the image has no channels"));
    }
    Ok(())
}

fn window(bounds: &IntegerBounds) -> Window {
    Window {
        x: bounds.position.x(),
        y: bounds.position.y(),
        width: bounds.size.width() as u32,
        height: bounds.size.height() as u32,
    }
}

fn damaged(path: &Path) -> impl FnOnce(exr::error::Error) -> PointsError {
    let path = path.to_owned();
    move |error| match error {
        exr::error::Error::Io(error) if error.kind() == std::io::ErrorKind::UnexpectedEof => {
            PointsError::invalid(&path, "the EXR file is truncated")
        }
        exr::error::Error::Io(error) => PointsError::io("read", &path)(error),
        exr::error::Error::NotSupported(what) => {
            PointsError::unsupported(&path, what.to_string(), "write it as plain tiles or scanlines")
        }
        other => PointsError::invalid(&path, format!("not a usable EXR file: {other}")),
    }
}
