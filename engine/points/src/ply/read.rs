//! The reading side: [`PlyPoints`].

use super::header::{Element, Encoding, Header, PropertyKind, Scalar};
use crate::error::PointsError;
use crate::limits;
use pbgi_core::point::Sides;
use pbgi_core::{Bounds, PointRecord, PointStream};
use std::fs::File;
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// A PLY file as a stream of points.
pub struct PlyPoints {
    path: PathBuf,
    reader: BufReader<File>,
    encoding: Encoding,
    /// Elements that lie before the vertices.
    before: Vec<Element>,
    vertex: Element,
    columns: Columns,
    data_start: u64,
    /// Index of the next point.
    next: u64,
    /// Whether the reader stands at point `next`.
    positioned: bool,
    buffer: Vec<u8>,
    values: Vec<f64>,
}

/// Where the numbers of a point are among the properties of a vertex.
struct Columns {
    position: [usize; 3],
    normal: [usize; 3],
    radius: usize,
    front: Option<Colour>,
    back: Option<Colour>,
}

struct Colour {
    columns: [usize; 3],
    /// The value of white, where the numbers are sRGB.
    white: [Option<f64>; 3],
}

impl PlyPoints {
    /// Opens a file and checks its header, and for binary files its length.
    ///
    /// # Errors
    /// No or a damaged file, or one that lacks positions, normals or radii.
    pub fn open(path: &Path) -> Result<Self, PointsError> {
        let file = File::open(path).map_err(PointsError::io("open", path))?;
        let length = file.metadata().map_err(PointsError::io("read", path))?.len();
        let mut reader = BufReader::with_capacity(1 << 18, file);
        let header = Header::read(path, &mut reader)?;
        let place = header.elements.iter().position(|element| element.name == "vertex");
        let Some(place) = place else {
            return Err(PointsError::invalid(path, "the header has no element \"vertex\""));
        };
        check_length(path, &header, place, length)?;
        let mut before = header.elements;
        let after = before.split_off(place);
        let Some(vertex) = after.into_iter().next() else {
            return Err(PointsError::invalid(path, "the header has no element \"vertex\""));
        };
        if vertex.stride().is_none() && header.encoding != Encoding::Ascii {
            return Err(PointsError::unsupported(
                path,
                "a list in element \"vertex\"",
                "write single numbers",
            ));
        }
        Ok(Self {
            columns: Columns::find(path, &vertex)?,
            path: path.to_owned(),
            reader,
            encoding: header.encoding,
            before,
            vertex,
            data_start: header.bytes,
            next: 0,
            positioned: false,
            buffer: Vec::new(),
            values: Vec::new(),
        })
    }

    /// Number of points.
    pub fn point_count(&self) -> u64 {
        self.vertex.count
    }

    fn skip_to_vertices(&mut self) -> Result<(), PointsError> {
        for element in std::mem::take(&mut self.before) {
            for _ in 0..element.count {
                if self.encoding == Encoding::Ascii {
                    self.read_line()?;
                } else {
                    self.skip_binary(&element)?;
                }
            }
            self.before.push(element);
        }
        self.positioned = true;
        Ok(())
    }

    fn skip_binary(&mut self, element: &Element) -> Result<(), PointsError> {
        for property in &element.properties {
            let bytes = match property.kind {
                PropertyKind::Scalar(scalar) => scalar.size() as u64,
                PropertyKind::List { count, item } => {
                    let mut raw = [0u8; 8];
                    self.reader.read_exact(&mut raw[..count.size()]).map_err(self.short())?;
                    let count = count.decode(&raw, self.encoding);
                    if !(0.0..=limits::PLY_LIST_MAX as f64).contains(&count) {
                        let what = format!("a list of element {:?} announces {count} items", element.name);
                        return Err(PointsError::invalid(&self.path, what));
                    }
                    count as u64 * item.size() as u64
                }
            };
            let skipped = std::io::copy(&mut self.reader.by_ref().take(bytes), &mut std::io::sink());
            if skipped.map_err(self.short())? < bytes {
                return Err(self.ended());
            }
        }
        Ok(())
    }

    /// The next line that is not blank, into `buffer`.
    fn read_line(&mut self) -> Result<(), PointsError> {
        loop {
            self.buffer.clear();
            let most = limits::PLY_LINE_BYTES_MAX as u64;
            let mut limited = self.reader.by_ref().take(most);
            let read = limited.read_until(b'\n', &mut self.buffer);
            if read.map_err(PointsError::io("read", &self.path))? == 0 {
                return Err(self.ended());
            }
            if self.buffer.len() as u64 == most {
                return Err(PointsError::invalid(
                    &self.path,
                    format!("a line is longer than {most} bytes"),
                ));
            }
            if !self.buffer.trim_ascii().is_empty() {
                return Ok(());
            }
        }
    }

    fn next_ascii(&mut self, count: usize, batch: &mut Vec<PointRecord>) -> Result<(), PointsError> {
        for _ in 0..count {
            self.read_line()?;
            self.values.clear();
            let text = String::from_utf8_lossy(&self.buffer);
            let mut words = text.split_whitespace();
            for property in &self.vertex.properties {
                let word = words
                    .next()
                    .ok_or_else(|| self.bad_number(&property.name, "is missing"))?;
                let number: f64 = word.parse().map_err(|_| self.bad_number(&property.name, word))?;
                self.values.push(number);
                if let PropertyKind::List { .. } = property.kind {
                    let items = number.clamp(0.0, limits::PLY_LIST_MAX as f64) as usize;
                    words.by_ref().take(items).for_each(drop);
                }
            }
            let point = self.columns.point(&self.values).map_err(|error| self.invalid(error))?;
            batch.push(point);
            self.next += 1;
        }
        Ok(())
    }

    fn next_binary(&mut self, count: usize, batch: &mut Vec<PointRecord>) -> Result<(), PointsError> {
        let stride = self.vertex.stride().unwrap_or_default();
        self.buffer.resize(stride * count, 0);
        let mut buffer = std::mem::take(&mut self.buffer);
        self.reader.read_exact(&mut buffer).map_err(self.short())?;
        for bytes in buffer.chunks_exact(stride.max(1)) {
            self.values.clear();
            let mut rest = bytes;
            for property in &self.vertex.properties {
                if let PropertyKind::Scalar(scalar) = property.kind {
                    self.values.push(scalar.decode(rest, self.encoding));
                    rest = &rest[scalar.size()..];
                }
            }
            let point = self.columns.point(&self.values).map_err(|error| self.invalid(error))?;
            batch.push(point);
            self.next += 1;
        }
        self.buffer = buffer;
        Ok(())
    }

    fn invalid(&self, error: pbgi_core::InvalidPoint) -> PointsError {
        PointsError::point(&self.path, self.next, self.vertex.count, error)
    }

    fn bad_number(&self, property: &str, found: &str) -> PointsError {
        PointsError::InvalidPoint {
            index: self.next,
            count: self.vertex.count,
            reason: format!("property {property} is not a number: {found:?}"),
            path: self.path.clone(),
        }
    }

    fn ended(&self) -> PointsError {
        let (next, count) = (self.next, self.vertex.count);
        PointsError::invalid(
            &self.path,
            format!("file is truncated: expected {count} points, found {next}"),
        )
    }

    /// For `map_err`: a file that became shorter than it was when it was opened.
    fn short(&self) -> impl FnOnce(std::io::Error) -> PointsError + use<> {
        let (ended, path) = (self.ended(), self.path.clone());
        move |error| match error.kind() {
            std::io::ErrorKind::UnexpectedEof => ended,
            _ => PointsError::io("read", &path)(error),
        }
    }
}

impl PointStream for PlyPoints {
    type Error = PointsError;

    fn bounds(&self) -> Option<Bounds> {
        (self.vertex.count == 0).then_some(Bounds::EMPTY)
    }

    fn len_hint(&self) -> Option<u64> {
        Some(self.vertex.count)
    }

    fn next_batch(&mut self, batch: &mut Vec<PointRecord>) -> Result<bool, PointsError> {
        let left = self.vertex.count - self.next;
        if left == 0 {
            return Ok(false);
        }
        if !self.positioned {
            self.skip_to_vertices()?;
        }
        let count = left.min(limits::BATCH_POINTS as u64) as usize;
        match self.encoding {
            Encoding::Ascii => self.next_ascii(count, batch)?,
            Encoding::LittleEndian | Encoding::BigEndian => self.next_binary(count, batch)?,
        }
        Ok(true)
    }

    fn rewind(&mut self) -> Result<(), PointsError> {
        self.next = 0;
        self.positioned = false;
        let start = self.reader.seek(SeekFrom::Start(self.data_start));
        start.map(drop).map_err(PointsError::io("read", &self.path))
    }
}

/// Compares the length of a binary file with its header, as far as the header says.
fn check_length(path: &Path, header: &Header, vertex: usize, length: u64) -> Result<(), PointsError> {
    if header.encoding == Encoding::Ascii {
        return Ok(());
    }
    let mut expected = header.bytes;
    for (index, element) in header.elements.iter().enumerate() {
        let Some(stride) = element.stride() else {
            // Lists: the rest is as long as it is, but what is known must be there.
            let unknown = PointsError::Truncated {
                expected,
                actual: length,
                path: path.to_owned(),
            };
            return if length < expected { Err(unknown) } else { Ok(()) };
        };
        let bytes = element
            .count
            .checked_mul(stride as u64)
            .and_then(|bytes| bytes.checked_add(expected));
        expected = bytes.ok_or_else(|| {
            PointsError::invalid(
                path,
                format!("element {:?} announces {} items", element.name, element.count),
            )
        })?;
        if index >= vertex && length < expected {
            return Err(PointsError::Truncated {
                expected,
                actual: length,
                path: path.to_owned(),
            });
        }
    }
    if length > expected {
        let what = format!("the header announces {expected} bytes, the file has {length}: its count is wrong");
        return Err(PointsError::invalid(path, what));
    }
    Ok(())
}

impl Columns {
    fn find(path: &Path, vertex: &Element) -> Result<Self, PointsError> {
        let find = |name: &str| {
            vertex
                .properties
                .iter()
                .position(|p| p.name == name && matches!(p.kind, PropertyKind::Scalar(_)))
        };
        let need = |name: &str, remedy: &str| {
            find(name).ok_or_else(|| {
                let names: Vec<&str> = vertex.properties.iter().map(|p| p.name.as_str()).collect();
                let found = names.join(", ");
                PointsError::invalid(
                    path,
                    format!("property {name} is missing (there are: {found}): {remedy}"),
                )
            })
        };
        let axes = |names: [&str; 3], remedy: &str| -> Result<[usize; 3], PointsError> {
            Ok([
                need(names[0], remedy)?,
                need(names[1], remedy)?,
                need(names[2], remedy)?,
            ])
        };
        let colour = |names: [&str; 3]| -> Result<Option<Colour>, PointsError> {
            if names.iter().all(|name| find(name).is_none()) {
                return Ok(None);
            }
            let columns = axes(names, "a colour needs all three channels")?;
            let white = columns.map(|column| match vertex.properties[column].kind {
                PropertyKind::Scalar(scalar) => Scalar::white(scalar),
                PropertyKind::List { .. } => None,
            });
            Ok(Some(Colour { columns, white }))
        };
        Ok(Self {
            position: axes(["x", "y", "z"], "every point needs a position")?,
            normal: axes(
                ["nx", "ny", "nz"],
                "estimate normals first, for example with CloudCompare or MeshLab",
            )?,
            radius: need(
                "radius",
                "add the radius of each point's disc, about 0.56 of the distance between points",
            )?,
            front: colour(["red", "green", "blue"])?,
            back: colour(["back_red", "back_green", "back_blue"])?,
        })
    }

    fn point(&self, values: &[f64]) -> Result<PointRecord, pbgi_core::InvalidPoint> {
        let take = |columns: [usize; 3]| columns.map(|column| values[column] as f32);
        let colour = |colour: &Option<Colour>| colour.as_ref().map_or([0.0; 3], |colour| colour.decode(values));
        let sides = Sides {
            front: colour(&self.front),
            back: colour(&self.back),
        };
        PointRecord::new(
            take(self.position),
            take(self.normal),
            values[self.radius] as f32,
            sides,
        )
    }
}

impl Colour {
    fn decode(&self, values: &[f64]) -> [f32; 3] {
        std::array::from_fn(|channel| {
            let value = values[self.columns[channel]];
            match self.white[channel] {
                Some(white) => linear_from_srgb(value / white) as f32,
                None => value as f32,
            }
        })
    }
}

fn linear_from_srgb(encoded: f64) -> f64 {
    if encoded <= 0.040_45 {
        encoded / 12.92
    } else {
        ((encoded + 0.055) / 1.055).powf(2.4)
    }
}
