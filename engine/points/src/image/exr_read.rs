//! EXR to [`LayeredImage`]: scanlines or tiles, one part or several. Headers are checked against [`crate::limits`] before a
//! pixel is decoded, and only the channels asked for take memory.

use super::{Attributes, Channel, LayeredImage, Precision, Window};
use crate::error::PointsError;
use crate::limits;
use exr::block::UncompressedBlock;
use exr::block::chunk::TileCoordinates;
use exr::block::lines::LineRef;
use exr::block::reader::ChunksReader;
use exr::meta::MetaData;
use exr::meta::attribute::{IntegerBounds, SampleType};
use exr::meta::header::Header;
use exr::prelude::Vec2;
use glam::Mat4;
use half::f16;
use pbgi_core::limits::IMAGE_PIXELS_MAX;
use std::fs::File;
use std::io::{BufReader, Seek, SeekFrom};
use std::path::Path;

impl LayeredImage {
    /// Reads every channel of an EXR file.
    ///
    /// # Errors
    /// As [`Self::read_exr_channels`].
    pub fn read_exr(path: &Path) -> Result<Self, PointsError> {
        Self::read_exr_channels(path, |_| true)
    }

    /// Reads the channels whose full name (`part.channel` where a file has several parts) `keep` accepts. Parts of different
    /// data windows are put into the smallest one that holds all of them, with 0 where a part has no pixels.
    ///
    /// # Errors
    /// No or a damaged file, deep or subsampled data, more pixels or channels than the limits.
    pub fn read_exr_channels(path: &Path, keep: impl Fn(&str) -> bool) -> Result<Self, PointsError> {
        let file = File::open(path).map_err(PointsError::io("open", path))?;
        read(path, &file, None, keep)
    }
}

/// Reads channels of an open file, into `data_window` if there is one: pixels beyond it are left out.
pub(crate) fn read(
    path: &Path,
    file: &File,
    data_window: Option<Window>,
    keep: impl Fn(&str) -> bool,
) -> Result<LayeredImage, PointsError> {
    let reader = exr::block::read(from_start(path, file)?, false).map_err(damaged(path))?;
    check_limits(path, reader.headers())?;
    let plan = Plan::new(path, reader.headers(), keep, data_window)?;
    let mut image = describe(reader.headers(), plan.window);
    let pixels = plan.window.pixel_count();
    let mut values: Vec<Vec<f32>> = plan.names.iter().map(|_| vec![0.0; pixels]).collect();
    let largest_level = |_: &MetaData, _: TileCoordinates, block: exr::block::BlockIndex| {
        block.level == Vec2(0, 0) && plan.slots[block.layer].iter().any(Option::is_some)
    };
    reader
        .filter_chunks(false, largest_level)
        .and_then(|chunks| {
            chunks.decompress_sequential(false, |meta, block| {
                store_block(&plan, &meta.headers, &block, &mut values)
            })
        })
        .map_err(damaged(path))?;
    for ((name, precision), values) in plan.names.into_iter().zip(values) {
        image.channels.insert(name, Channel { precision, values });
    }
    Ok(image)
}

/// What an EXR file says of itself: its names of channels, and its texts.
pub(crate) struct Contents {
    pub(crate) channels: Vec<String>,
    pub(crate) metadata: std::collections::BTreeMap<String, String>,
}

/// Looks at an EXR file without reading its pixels.
pub(crate) fn contents(path: &Path, file: &File) -> Result<Contents, PointsError> {
    let reader = exr::block::read(from_start(path, file)?, false).map_err(damaged(path))?;
    let headers = reader.headers();
    check_limits(path, headers)?;
    let named = |header| channel_names(headers, header);
    Ok(Contents {
        channels: headers.iter().flat_map(named).collect(),
        metadata: Attributes::of(headers).1,
    })
}

fn from_start<'a>(path: &Path, mut file: &'a File) -> Result<BufReader<&'a File>, PointsError> {
    file.seek(SeekFrom::Start(0)).map_err(PointsError::io("read", path))?;
    Ok(BufReader::new(file))
}

/// Where each channel of each part goes.
struct Plan {
    window: Window,
    slots: Vec<Vec<Option<usize>>>,
    names: Vec<(String, Precision)>,
}

impl Plan {
    fn new(
        path: &Path,
        headers: &[Header],
        keep: impl Fn(&str) -> bool,
        window: Option<Window>,
    ) -> Result<Self, PointsError> {
        let mut plan = Self {
            window: Window::of_size(0, 0),
            slots: Vec::new(),
            names: Vec::new(),
        };
        let mut windows = Vec::new();
        for header in headers {
            let mut slots = Vec::new();
            for (channel, name) in header.channels.list.iter().zip(channel_names(headers, header)) {
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
            if slots.iter().any(Option::is_some) {
                if header.deep {
                    return Err(PointsError::unsupported(path, "deep data", "flatten the image first"));
                }
                windows.push(part_window(header));
            }
            plan.slots.push(slots);
        }
        plan.window = match window {
            Some(window) => window,
            None => union(&windows).unwrap_or_else(|| part_window(&headers[0])),
        };
        let pixels = u64::from(plan.window.width) * u64::from(plan.window.height);
        limit(path, "number of pixels of all parts together", pixels, IMAGE_PIXELS_MAX)?;
        let bytes = pixels * (plan.names.len() * size_of::<f32>()) as u64;
        limit(path, "size of the pixels in bytes", bytes, limits::EXR_BYTES_MAX)?;
        Ok(plan)
    }
}

/// The smallest window around all; `None` of none.
fn union(windows: &[Window]) -> Option<Window> {
    let end = |start: i32, length: u32| i64::from(start) + i64::from(length);
    let x = windows.iter().map(|window| window.x).min()?;
    let y = windows.iter().map(|window| window.y).min()?;
    let right = windows.iter().map(|window| end(window.x, window.width)).max()?;
    let bottom = windows.iter().map(|window| end(window.y, window.height)).max()?;
    Some(Window {
        x,
        y,
        width: (right - i64::from(x)) as u32,
        height: (bottom - i64::from(y)) as u32,
    })
}

/// Full names of a part's channels, in its order.
fn channel_names(headers: &[Header], header: &Header) -> Vec<String> {
    let full = |channel| full_name(headers, header, channel);
    header.channels.list.iter().map(full).collect()
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
    values: &mut [Vec<f32>],
) -> exr::error::UnitResult {
    let header = &headers[block.index.layer];
    let part = part_window(header);
    for line in block.lines(&header.channels) {
        let Some(slot) = plan.slots[block.index.layer][line.location.channel] else {
            continue;
        };
        let (x, y) = (line.location.position.x() as i64, line.location.position.y() as i64);
        let count = line.location.sample_count as i64;
        if x + count > i64::from(part.width) || y >= i64::from(part.height) {
            return Err(exr::error::Error::Invalid("block outside of the data window".into()));
        }
        let column = x + i64::from(part.x) - i64::from(plan.window.x);
        let row = y + i64::from(part.y) - i64::from(plan.window.y);
        let width = i64::from(plan.window.width);
        let (first, end) = (column.clamp(0, width), (column + count).clamp(0, width));
        if first == end || !(0..i64::from(plan.window.height)).contains(&row) {
            continue;
        }
        let start = row * width;
        let target = &mut values[slot][(start + first) as usize..(start + end) as usize];
        let skip = (first - column) as usize;
        match header.channels.list[line.location.channel].sample_type {
            SampleType::F16 => fill(line, skip, target, f16::to_f32)?,
            SampleType::F32 => fill(line, skip, target, |sample: f32| sample)?,
            SampleType::U32 => fill(line, skip, target, |sample: u32| sample as f32)?,
        }
    }
    Ok(())
}

fn fill<T: exr::io::Data>(
    line: LineRef<'_>,
    skip: usize,
    target: &mut [f32],
    convert: impl Fn(T) -> f32,
) -> exr::error::UnitResult {
    for (value, sample) in target.iter_mut().zip(line.read_samples::<T>().skip(skip)) {
        *value = convert(sample?);
    }
    Ok(())
}

fn describe(headers: &[Header], data_window: Window) -> LayeredImage {
    let mut image = LayeredImage::with_windows(data_window, window(&headers[0].shared_attributes.display_window));
    (image.attributes, image.metadata) = Attributes::of(headers);
    let mut own = headers.iter().map(|header| &header.own_attributes);
    let matrix = |array: [f32; 16]| Mat4::from_cols_array(&array);
    image.world_to_camera = own.clone().find_map(|own| own.world_to_camera).map(matrix);
    image.world_to_ndc = own.find_map(|own| own.world_to_normalized_device).map(matrix);
    image
}

/// Refuses what would take too much memory, from the headers alone.
fn check_limits(path: &Path, headers: &[Header]) -> Result<(), PointsError> {
    let parts = headers.len();
    limit(path, "number of parts", parts as u64, limits::EXR_PARTS_MAX as u64)?;
    let channels: usize = headers.iter().map(|header| header.channels.list.len()).sum();
    limit(
        path,
        "number of channels",
        channels as u64,
        limits::EXR_CHANNELS_MAX as u64,
    )?;
    for header in headers {
        let pixels = header.layer_size.width() as u64 * header.layer_size.height() as u64;
        limit(path, "number of pixels", pixels, IMAGE_PIXELS_MAX)?;
        let block = header.max_block_byte_size() as u64;
        limit(path, "size of a block in bytes", block, limits::EXR_BLOCK_BYTES_MAX)?;
    }
    if channels == 0 {
        return Err(PointsError::invalid(path, "the image has no channels"));
    }
    Ok(())
}

fn limit(path: &Path, what: &'static str, value: u64, limit: u64) -> Result<(), PointsError> {
    if value <= limit {
        return Ok(());
    }
    Err(PointsError::Limit {
        what,
        value,
        limit,
        path: path.to_owned(),
    })
}

fn part_window(header: &Header) -> Window {
    window(&IntegerBounds {
        position: header.own_attributes.layer_position,
        size: header.layer_size,
    })
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
