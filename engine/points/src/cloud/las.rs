//! LAS, LAZ and COPC: [`LasPoints`]. Heights are z there; here y is up, so (x, y, z) becomes (x, z, -y).
//!
//! Colours are sRGB, 16 bits a channel (8 where no value of the file's first points is above 255), and are taken as
//! radiance. Points without colour are black. Every point of the file is taken, whatever its class and return number.

use super::{Cloud, CloudOptions, Door, Missing, NORMAL_PLACEHOLDER, RADIUS_PLACEHOLDER, linear_from_srgb, relative};
use crate::error::PointsError;
use crate::limits;
use las::{PointData, Reader};
use pbgi_core::point::Sides;
use pbgi_core::{Bounds, PointRecord, PointStream};
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, sync_channel};

/// A file of the LAS family as a stream of points.
pub(crate) struct LasPoints {
    path: PathBuf,
    count: u64,
    /// What the decoding thread has made; `None` before the first batch.
    decoded: Option<Receiver<Result<PointData, las::Error>>>,
    door: Door,
    origin: [f64; 3],
    bounds: Option<Bounds>,
    /// Linear radiance of each level of a channel.
    linear: Vec<f32>,
}

/// What the header of a file says of its coordinates, in the file's own axes.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Extent {
    min: [f64; 3],
    max: [f64; 3],
    step: [f64; 3],
}

impl LasPoints {
    pub(crate) fn open(path: &Path, origin: [f64; 3], options: &CloudOptions) -> Result<Self, PointsError> {
        let mut reader = open(path)?;
        let count = reader.header().number_of_points();
        let batch = limits::BATCH_POINTS as u64;
        let first = reader.read_points(batch).map_err(|error| damaged(path, error))?;
        let extent = Extent::of(path, &reader)?;
        // A header may be rounded to fewer digits than its points.
        let corner = |values: [f64; 3], sign: f64| {
            let wide = std::array::from_fn(|axis| values[axis] + sign * extent.step[axis]);
            upright(relative(wide, origin))
        };
        let mut bounds = Bounds::EMPTY;
        if count > 0 {
            bounds.include(corner(extent.min, -1.0));
            bounds.include(corner(extent.max, 1.0));
        }
        Ok(Self {
            linear: linear_table(&first),
            door: Door::new(path, count, options),
            bounds: (!options.recompute_bounds).then_some(bounds),
            path: path.to_owned(),
            decoded: None,
            origin,
            count,
        })
    }
}

/// A lower corner for clouds whose coordinates are too large for `f32`, in whole thousands; zero on the other axes.
pub(crate) fn common_origin(paths: &[&Path]) -> Result<[f64; 3], PointsError> {
    const ROUND: f64 = 1000.0;
    let mut origin = [0.0; 3];
    let mut extents = Vec::new();
    for path in paths {
        extents.push(Extent::of(path, &open(path)?)?);
    }
    for (axis, origin) in origin.iter_mut().enumerate() {
        let low = extents
            .iter()
            .map(|extent| extent.min[axis])
            .fold(f64::INFINITY, f64::min);
        let largest = extents
            .iter()
            .map(|extent| extent.min[axis].abs().max(extent.max[axis].abs()));
        let step = extents
            .iter()
            .map(|extent| extent.step[axis])
            .fold(f64::INFINITY, f64::min);
        if largest.fold(0.0, f64::max) * f64::from(f32::EPSILON) > step && low.is_finite() {
            *origin = (low / ROUND).floor() * ROUND;
        }
    }
    Ok(origin)
}

impl Extent {
    fn of(path: &Path, reader: &Reader) -> Result<Self, PointsError> {
        let (bounds, transforms) = (reader.header().bounds(), reader.header().transforms());
        let extent = Self {
            min: [bounds.min.x, bounds.min.y, bounds.min.z],
            max: [bounds.max.x, bounds.max.y, bounds.max.z],
            step: [transforms.x.scale, transforms.y.scale, transforms.z.scale].map(f64::abs),
        };
        let numbers = [extent.min, extent.max, extent.step];
        if numbers.iter().flatten().all(|number| number.is_finite()) {
            Ok(extent)
        } else {
            Err(PointsError::invalid(
                path,
                "the header has a box or a scale that is not finite",
            ))
        }
    }
}

fn upright([x, y, z]: [f32; 3]) -> [f32; 3] {
    [x, z, -y]
}

pub(crate) fn open(path: &Path) -> Result<Reader, PointsError> {
    const BUFFER_BYTES: usize = 1 << 18;
    let file = File::open(path).map_err(PointsError::io("open", path))?;
    let length = file.metadata().map_err(PointsError::io("read", path))?.len();
    let reader = Reader::new(BufReader::with_capacity(BUFFER_BYTES, file)).map_err(|error| damaged(path, error))?;
    let header = reader.header();
    let format = header.point_format();
    if !format.is_compressed {
        // More than the records: the header comes before them.
        let expected = header.number_of_points().saturating_mul(u64::from(format.len()));
        if expected > length {
            return Err(PointsError::Truncated {
                expected,
                actual: length,
                path: path.to_owned(),
            });
        }
    }
    Ok(reader)
}

pub(crate) fn damaged(path: &Path, error: las::Error) -> PointsError {
    match error {
        las::Error::Io(source) if source.kind() != std::io::ErrorKind::UnexpectedEof => {
            PointsError::io("read", path)(source)
        }
        error => PointsError::invalid(path, format!("not a whole LAS file: {error}")),
    }
}

/// Decodes a file on a thread of its own, some batches ahead; the thread ends with the receiver.
fn decode(path: &Path) -> Result<Receiver<Result<PointData, las::Error>>, PointsError> {
    const BATCHES_AHEAD: usize = 4;
    let (send, receive) = sync_channel(BATCHES_AHEAD);
    let mine = path.to_owned();
    let work = move || {
        let mut reader = match Reader::from_path(&mine) {
            Ok(reader) => reader,
            // Whoever listens reports it.
            Err(error) => return drop(send.send(Err(error))),
        };
        loop {
            let batch = reader.read_points(limits::BATCH_POINTS as u64);
            let ended = batch.as_ref().map_or(true, PointData::is_empty);
            if send.send(batch).is_err() || ended {
                return;
            }
        }
    };
    let thread = std::thread::Builder::new().name("pbgi-las".to_owned()).spawn(work);
    thread
        .map(|_| receive)
        .map_err(PointsError::io("start a thread to read", path))
}

/// The level of white: 8 or 16 bits, told by the brightest colour of a file's first points.
pub(crate) fn white_of(first: &PointData) -> u16 {
    let brightest = first.rgb().into_iter().flatten().map(|(r, g, b)| r.max(g).max(b)).max();
    if brightest.unwrap_or(u16::MAX) > u16::from(u8::MAX) {
        u16::MAX
    } else {
        u16::from(u8::MAX)
    }
}

fn linear_table(first: &PointData) -> Vec<f32> {
    let white = white_of(first);
    let level = |level: u16| linear_from_srgb(f64::from(level) / f64::from(white)) as f32;
    (0..=u16::MAX).map(level).collect()
}

impl PointStream for LasPoints {
    type Error = PointsError;

    fn bounds(&self) -> Option<Bounds> {
        self.bounds
    }

    fn len_hint(&self) -> Option<u64> {
        Some(self.count)
    }

    fn next_batch(&mut self, batch: &mut Vec<PointRecord>) -> Result<bool, PointsError> {
        let left = self.count - self.door.seen();
        if left == 0 {
            self.door.close()?;
            return Ok(false);
        }
        let decoded = match &mut self.decoded {
            Some(decoded) => decoded,
            none => none.insert(decode(&self.path)?),
        };
        let data = match decoded.recv() {
            Ok(data) => data.map_err(|error| damaged(&self.path, error))?,
            // The decoder stopped dead.
            Err(_) => {
                return Err(PointsError::invalid(
                    &self.path,
                    "not a whole LAS file: its data make no sense",
                ));
            }
        };
        if data.is_empty() {
            let (seen, count) = (self.door.seen(), self.count);
            let what = format!("file is truncated: expected {count} points, found {seen}");
            return Err(PointsError::invalid(&self.path, what));
        }
        let mut colours = data.rgb();
        for ((x, y), z) in data.x().zip(data.y()).zip(data.z()).take(left as usize) {
            let colour = colours.as_mut().and_then(Iterator::next).unwrap_or_default();
            let radiance = [colour.0, colour.1, colour.2].map(|level| self.linear[usize::from(level)]);
            let position = upright(relative([x, y, z], self.origin));
            // Which side is lit is not known.
            let sides = Sides {
                front: radiance,
                back: radiance,
            };
            let point = PointRecord::new(position, NORMAL_PLACEHOLDER, RADIUS_PLACEHOLDER, sides);
            self.door.take(point, batch);
        }
        Ok(true)
    }

    fn rewind(&mut self) -> Result<(), PointsError> {
        self.decoded = None;
        self.door.rewind();
        Ok(())
    }
}

impl Cloud for LasPoints {
    fn missing(&self) -> Missing {
        Missing {
            normals: true,
            radii: true,
        }
    }

    fn skipped(&self) -> u64 {
        self.door.skipped()
    }

    fn number(&mut self) {
        self.door.number();
    }

    fn is_aerial(&self) -> bool {
        true
    }
}
