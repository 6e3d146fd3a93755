//! RenderMan point clouds (`.ptc`, little-endian, as Partio reads and writes them): [`PtcPoints`].
//!
//! `_area` is the area of the disc where the file has it, else the radius counts. `_radiosity` is pi times the radiance of
//! the front; without it a point is black.

use super::{Cloud, CloudOptions, Door, Missing, NORMAL_PLACEHOLDER, relative};
use crate::error::PointsError;
use crate::limits;
use pbgi_core::point::Sides;
use pbgi_core::{Bounds, InvalidPoint, PointRecord, PointStream};
use std::f32::consts::{PI, TAU};
use std::fs::File;
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

const MAGIC: [u8; 4] = *b"pptc";
const VERSION_MAX: i32 = 2;
/// Position, normal code and radius before the channels of a point.
const FIXED_BYTES: usize = 20;

/// A PTC file as a stream of points.
pub(crate) struct PtcPoints {
    path: PathBuf,
    reader: BufReader<File>,
    layout: Layout,
    count: u64,
    door: Door,
    origin: [f64; 3],
    takes_normals: bool,
    buffer: Vec<u8>,
}

/// Where the numbers of a point are.
#[derive(Clone, Copy, Debug, Default)]
struct Layout {
    data_start: u64,
    stride: usize,
    /// Byte offsets within a point.
    area: Option<usize>,
    radiosity: Option<usize>,
}

impl PtcPoints {
    pub(crate) fn open(path: &Path, origin: [f64; 3], options: &CloudOptions) -> Result<Self, PointsError> {
        let file = File::open(path).map_err(PointsError::io("open", path))?;
        let length = file.metadata().map_err(PointsError::io("read", path))?.len();
        let mut reader = BufReader::with_capacity(1 << 18, file);
        let (count, layout) = Header {
            path,
            reader: &mut reader,
        }
        .read()?;
        let expected = count
            .saturating_mul(layout.stride as u64)
            .saturating_add(layout.data_start);
        if length < expected {
            return Err(PointsError::Truncated {
                expected,
                actual: length,
                path: path.to_owned(),
            });
        }
        if length > expected {
            let what = format!("the header announces {expected} bytes, the file has {length}: its count is wrong");
            return Err(PointsError::invalid(path, what));
        }
        Ok(Self {
            path: path.to_owned(),
            reader,
            layout,
            count,
            door: Door::new(path, count, options),
            origin,
            takes_normals: options.estimate_normals.is_none(),
            buffer: Vec::new(),
        })
    }
}

/// The header, read from front to back.
struct Header<'a> {
    path: &'a Path,
    reader: &'a mut BufReader<File>,
}

impl Header<'_> {
    fn read(mut self) -> Result<(u64, Layout), PointsError> {
        if self.bytes()? != MAGIC {
            return Err(PointsError::invalid(
                self.path,
                "the first bytes are not \"pptc\": it is no PTC file",
            ));
        }
        let version = i32::from_le_bytes(self.bytes()?);
        if !(0..=VERSION_MAX).contains(&version) {
            let what = format!("PTC version {version}");
            return Err(PointsError::unsupported(self.path, what, "write version 2 or less"));
        }
        let count = f64::from_le_bytes(self.bytes()?);
        if !(count >= 0.0 && count <= limits::POINTS_MAX as f64 && count.fract() == 0.0) {
            return Err(PointsError::invalid(
                self.path,
                format!("the header announces {count} points"),
            ));
        }
        let box_words = 6;
        let words_1 = if version >= 1 { 4 } else { 0 };
        let words_2 = if version >= 2 { 1 + 32 } else { 0 };
        let matrices_and_format = 2 * 16 + 3;
        self.skip(box_words + words_1 + words_2 + matrices_and_format)?;
        let (channels, floats) = (i32::from_le_bytes(self.bytes()?), i32::from_le_bytes(self.bytes()?));
        if !(0..=limits::PTC_CHANNELS_MAX).contains(&channels) {
            return Err(PointsError::invalid(
                self.path,
                format!("the header announces {channels} channels"),
            ));
        }
        let mut layout = Layout {
            stride: FIXED_BYTES,
            ..Layout::default()
        };
        for _ in 0..channels {
            let line = self.line()?;
            let (kind, name) = line.trim_end().split_once(' ').unwrap_or((line.trim_end(), ""));
            let words = match kind {
                "float" => 1,
                "color" | "point" | "vector" | "normal" => 3,
                "matrix" => 16,
                _ => {
                    return Err(PointsError::invalid(
                        self.path,
                        format!("channel {line:?} is of no known type"),
                    ));
                }
            };
            match (name.trim(), words) {
                ("_area", 1) => layout.area = Some(layout.stride),
                ("_radiosity", 3) => layout.radiosity = Some(layout.stride),
                _ => {}
            }
            layout.stride += words * size_of::<f32>();
        }
        let described = (layout.stride - FIXED_BYTES) / size_of::<f32>();
        if floats != described as i32 {
            let what = format!("the header announces {floats} numbers a point, its channels have {described}");
            return Err(PointsError::invalid(self.path, what));
        }
        if version >= 1 {
            self.skip(2)?;
        }
        layout.data_start = self
            .reader
            .stream_position()
            .map_err(PointsError::io("read", self.path))?;
        Ok((count as u64, layout))
    }

    fn bytes<const N: usize>(&mut self) -> Result<[u8; N], PointsError> {
        let mut bytes = [0; N];
        let read = self.reader.read_exact(&mut bytes);
        read.map_err(|_| PointsError::invalid(self.path, "the file ends within its header"))?;
        Ok(bytes)
    }

    fn skip(&mut self, words: usize) -> Result<(), PointsError> {
        (0..words).try_for_each(|_| self.bytes::<4>().map(drop))
    }

    fn line(&mut self) -> Result<String, PointsError> {
        let mut line = Vec::new();
        let read = self
            .reader
            .by_ref()
            .take(limits::PTC_LINE_BYTES_MAX)
            .read_until(b'\n', &mut line);
        read.map_err(PointsError::io("read", self.path))?;
        match line.pop() {
            Some(b'\n') => Ok(String::from_utf8_lossy(&line).into_owned()),
            _ => Err(PointsError::invalid(self.path, "a channel's line has no end")),
        }
    }
}

fn normal(phi: u16, z: u16) -> [f32; 3] {
    let scale = f32::from(u16::MAX);
    if (phi, z) == (u16::MAX, u16::MAX) {
        return [0.0; 3];
    }
    let (z, phi) = (2.0 * f32::from(z) / scale - 1.0, TAU * (f32::from(phi) / scale - 0.5));
    let across = (1.0 - z * z).max(0.0).sqrt();
    [across * phi.sin(), across * phi.cos(), z]
}

impl Layout {
    fn point(&self, bytes: &[u8], origin: [f64; 3], takes_normals: bool) -> Result<PointRecord, InvalidPoint> {
        let float = |at: usize| {
            let mut word = [0; 4];
            word.copy_from_slice(&bytes[at..at + 4]);
            f32::from_le_bytes(word)
        };
        let triple = |at: usize| [float(at), float(at + 4), float(at + 8)];
        let code = |at: usize| u16::from_le_bytes([bytes[at], bytes[at + 1]]);
        let radius = match self.area.map(float) {
            Some(area) => (area / PI).sqrt(),
            None => float(16),
        };
        let sides = Sides {
            front: self.radiosity.map_or([0.0; 3], |at| triple(at).map(|value| value / PI)),
            back: [0.0; 3],
        };
        let position = relative(triple(0).map(f64::from), origin);
        let normal = if takes_normals {
            normal(code(12), code(14))
        } else {
            NORMAL_PLACEHOLDER
        };
        PointRecord::new(position, normal, radius, sides)
    }
}

impl PointStream for PtcPoints {
    type Error = PointsError;

    fn bounds(&self) -> Option<Bounds> {
        // The header's box may have been made of discs, or of other points before a filter.
        (self.count == 0).then_some(Bounds::EMPTY)
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
        let count = left.min(limits::BATCH_POINTS as u64) as usize;
        self.buffer.resize(count * self.layout.stride, 0);
        let read = self.reader.read_exact(&mut self.buffer);
        read.map_err(PointsError::io("read", &self.path))?;
        for bytes in self.buffer.chunks_exact(self.layout.stride) {
            self.door
                .take(self.layout.point(bytes, self.origin, self.takes_normals), batch);
        }
        Ok(true)
    }

    fn rewind(&mut self) -> Result<(), PointsError> {
        self.door.rewind();
        let start = self.reader.seek(SeekFrom::Start(self.layout.data_start));
        start.map(drop).map_err(PointsError::io("read", &self.path))
    }
}

impl Cloud for PtcPoints {
    fn missing(&self) -> Missing {
        Missing::default()
    }

    fn skipped(&self) -> u64 {
        self.door.skipped()
    }

    fn number(&mut self) {
        self.door.number();
    }
}
