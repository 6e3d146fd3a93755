//! The reading side: [`PlyPoints`].

use super::RECORD_PROPERTIES;
use super::header::{Element, Encoding, Header, Property, PropertyKind, Scalar};
use crate::cloud::{
    Cloud, CloudOptions, Door, Missing, NORMAL_PLACEHOLDER, RADIUS_PLACEHOLDER, linear_from_srgb, relative,
};
use crate::error::PointsError;
use crate::limits;
use crate::read_once::ReadOnce;
use pbgi_core::point::{Reflectance, Sides};
use pbgi_core::{Bounds, InvalidPoint, PointRecord, PointStream};
use std::fs::File;
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// A PLY file as a stream of points.
pub struct PlyPoints {
    path: PathBuf,
    pub(super) reader: BufReader<ReadOnce>,
    pub(super) encoding: Encoding,
    /// Elements that lie before the vertices.
    before: Vec<Element>,
    pub(super) vertex: Element,
    form: Form,
    pub(super) data_start: u64,
    pub(super) header_text: String,
    /// The box that our own writer declares.
    declared: Option<Bounds>,
    origin: [f64; 3],
    /// Whether the reader stands at the next point.
    positioned: bool,
    door: Door,
    pub(super) buffer: Vec<u8>,
    values: Vec<f64>,
}

/// What a vertex looks like.
enum Form {
    /// Our own record, byte for byte.
    Records,
    Fields(Box<Fields>),
}

/// Where the numbers of a point are among the properties of a vertex.
struct Fields {
    position: [Field; 3],
    normal: Option<[Field; 3]>,
    radius: Option<Field>,
    front: Option<Colour>,
    back: Option<Colour>,
    albedo: Option<Colour>,
    reflecting_sides: Option<Field>,
    encoding: Encoding,
}

/// One property.
#[derive(Clone, Copy)]
struct Field {
    column: usize,
    /// In bytes, where vertices are binary.
    offset: usize,
    scalar: Scalar,
}

struct Colour {
    fields: [Field; 3],
    /// The value of white, where the numbers are sRGB.
    white: Option<f64>,
}

impl PlyPoints {
    /// Opens a file and checks its header, and for binary files its length. Positions are taken relative to `origin`.
    ///
    /// # Errors
    /// No or a damaged file, or one that lacks positions.
    pub fn open(path: &Path, origin: [f64; 3], options: &CloudOptions) -> Result<Self, PointsError> {
        let file = File::open(path).map_err(PointsError::io("open", path))?;
        let length = file.metadata().map_err(PointsError::io("read", path))?.len();
        let mut reader = BufReader::with_capacity(1 << 18, ReadOnce::new(file));
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
        let form = if header.encoding == Encoding::LittleEndian && is_record(&vertex.properties) {
            Form::Records
        } else {
            let mut fields = Fields::find(path, &vertex, header.encoding)?;
            if options.estimate_normals.is_some() {
                fields.normal = None;
            }
            Form::Fields(Box::new(fields))
        };
        let moved = |bounds: Bounds| Bounds {
            min: relative(bounds.min.map(f64::from), origin),
            max: relative(bounds.max.map(f64::from), origin),
        };
        let declared = header.bounds.filter(|_| !options.recompute_bounds).map(moved);
        if declared.is_some() {
            // With known bounds a build takes one pass.
            reader.get_mut().for_the_last_time();
        }
        Ok(Self {
            form,
            path: path.to_owned(),
            reader,
            encoding: header.encoding,
            before,
            data_start: header.bytes,
            header_text: header.text,
            declared,
            origin,
            positioned: false,
            door: Door::new(path, vertex.count, options),
            vertex,
            buffer: Vec::new(),
            values: Vec::new(),
        })
    }

    /// Number of points.
    pub fn point_count(&self) -> u64 {
        self.vertex.count
    }

    /// Whether they are records of ours, byte for byte.
    pub(crate) fn holds_records(&self) -> bool {
        matches!(self.form, Form::Records)
    }

    /// Goes to the first point; which byte of the file it starts at.
    pub(super) fn vertices_start(&mut self) -> Result<u64, PointsError> {
        self.skip_to_vertices()?;
        self.reader
            .stream_position()
            .map_err(PointsError::io("read", &self.path))
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
    pub(super) fn read_line(&mut self) -> Result<(), PointsError> {
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
            if let Form::Fields(fields) = &self.form {
                let point = fields.point(self.origin, |field| self.values[field.column]);
                self.door.take(point, batch);
            }
        }
        Ok(())
    }

    fn next_binary(&mut self, count: usize, batch: &mut Vec<PointRecord>) -> Result<(), PointsError> {
        let stride = self.vertex.stride().unwrap_or_default().max(1);
        self.buffer.resize(stride * count, 0);
        let mut buffer = std::mem::take(&mut self.buffer);
        self.reader.read_exact(&mut buffer).map_err(self.short())?;
        let (vertices, origin) = (buffer.chunks_exact(stride), self.origin);
        match &self.form {
            Form::Records => {
                for vertex in vertices {
                    let mut point: PointRecord = bytemuck::pod_read_unaligned(vertex);
                    point.position = relative(point.position.map(f64::from), origin);
                    self.door.take(point.validate().map(|()| point), batch);
                }
            }
            Form::Fields(fields) if fields.are_little_floats() => {
                for vertex in vertices {
                    let float = |field: &Field| f64::from(little_float(&vertex[field.offset..]));
                    self.door.take(fields.point(origin, float), batch);
                }
            }
            Form::Fields(fields) => {
                for vertex in vertices {
                    let number = |field: &Field| field.scalar.decode(&vertex[field.offset..], fields.encoding);
                    self.door.take(fields.point(origin, number), batch);
                }
            }
        }
        self.buffer = buffer;
        Ok(())
    }

    fn bad_number(&self, property: &str, found: &str) -> PointsError {
        PointsError::InvalidPoint {
            index: self.door.seen(),
            count: self.vertex.count,
            reason: format!("property {property} is not a number: {found:?}"),
            invalid: 1,
            path: self.path.clone(),
        }
    }

    fn ended(&self) -> PointsError {
        let (next, count) = (self.door.seen(), self.vertex.count);
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
        match self.vertex.count {
            0 => Some(Bounds::EMPTY),
            _ => self.declared,
        }
    }

    fn len_hint(&self) -> Option<u64> {
        Some(self.vertex.count)
    }

    fn next_batch(&mut self, batch: &mut Vec<PointRecord>) -> Result<bool, PointsError> {
        let left = self.vertex.count - self.door.seen();
        if left == 0 {
            self.door.close()?;
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
        self.door.rewind();
        self.positioned = false;
        self.reader.get_mut().for_the_last_time();
        let start = self.reader.seek(SeekFrom::Start(self.data_start));
        start.map(drop).map_err(PointsError::io("read", &self.path))
    }
}

impl Cloud for PlyPoints {
    fn missing(&self) -> Missing {
        match &self.form {
            Form::Records => Missing::default(),
            Form::Fields(fields) => Missing {
                normals: fields.normal.is_none(),
                radii: fields.radius.is_none(),
            },
        }
    }

    fn skipped(&self) -> u64 {
        self.door.skipped()
    }

    fn number(&mut self) {
        self.door.number();
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

impl Fields {
    fn find(path: &Path, vertex: &Element, encoding: Encoding) -> Result<Self, PointsError> {
        let find = |name: &str| {
            let mut offset = 0;
            for (column, property) in vertex.properties.iter().enumerate() {
                // Vertices with lists are read as text, where offsets do not matter.
                if let PropertyKind::Scalar(scalar) = property.kind {
                    if property.name == name {
                        return Some(Field { column, offset, scalar });
                    }
                    offset += scalar.size();
                }
            }
            None
        };
        // All three of a kind or none.
        let triple = |names: [&str; 3]| -> Result<Option<[Field; 3]>, PointsError> {
            match names.map(find) {
                [Some(a), Some(b), Some(c)] => Ok(Some([a, b, c])),
                [None, None, None] => Ok(None),
                some => {
                    let missing = names.iter().zip(&some).find(|(_, field)| field.is_none());
                    let names: Vec<&str> = vertex.properties.iter().map(|p| p.name.as_str()).collect();
                    let what = format!(
                        "property {} is missing (there are: {}): a position, normal or colour has all three numbers",
                        missing.map_or("", |(name, _)| name),
                        names.join(", ")
                    );
                    Err(PointsError::invalid(path, what))
                }
            }
        };
        let colour = |names: [&str; 3]| -> Result<Option<Colour>, PointsError> {
            Ok(triple(names)?.map(|fields| Colour {
                fields,
                white: fields[0].scalar.white(),
            }))
        };
        let position = triple(["x", "y", "z"])?;
        Ok(Self {
            position: position
                .ok_or_else(|| PointsError::invalid(path, "property x is missing: every point needs a position"))?,
            normal: triple(["nx", "ny", "nz"])?,
            radius: find("radius"),
            front: colour(["red", "green", "blue"])?,
            back: colour(["back_red", "back_green", "back_blue"])?,
            albedo: colour(["albedo_red", "albedo_green", "albedo_blue"])?,
            reflecting_sides: find("reflecting_sides"),
            encoding,
        })
    }

    fn are_little_floats(&self) -> bool {
        let triples = [Some(self.position), self.normal];
        let colours = [&self.front, &self.back, &self.albedo]
            .into_iter()
            .flatten()
            .map(|colour| colour.fields);
        let mut fields = triples
            .into_iter()
            .flatten()
            .chain(colours)
            .flatten()
            .chain(self.radius)
            .chain(self.reflecting_sides);
        self.encoding == Encoding::LittleEndian && fields.all(|field| field.scalar == Scalar::F32)
    }

    #[inline]
    fn point(&self, origin: [f64; 3], number: impl Fn(&Field) -> f64) -> Result<PointRecord, InvalidPoint> {
        let position = relative([0, 1, 2].map(|axis| number(&self.position[axis])), origin);
        let normal = match &self.normal {
            Some(fields) => [0, 1, 2].map(|axis| number(&fields[axis]) as f32),
            None => NORMAL_PLACEHOLDER,
        };
        let radius = self
            .radius
            .as_ref()
            .map_or(RADIUS_PLACEHOLDER, |field| number(field) as f32);
        let colour = |colour: &Option<Colour>| {
            colour.as_ref().map_or([0.0; 3], |Colour { fields, white }| {
                [0, 1, 2].map(|channel| match white {
                    Some(white) => linear_from_srgb(number(&fields[channel]) / white) as f32,
                    None => number(&fields[channel]) as f32,
                })
            })
        };
        let front = colour(&self.front);
        // Which side of a point without a normal is lit is not known.
        let back = match (&self.back, &self.normal) {
            (None, None) => front,
            (back, _) => colour(back),
        };
        let reflectance = Reflectance {
            albedo: colour(&self.albedo),
            both_sides: self.reflecting_sides.as_ref().is_none_or(|field| number(field) != 1.0),
        };
        let point = PointRecord::new(position, normal, radius, Sides { front, back })?;
        Ok(point.with_reflectance(reflectance))
    }
}

#[inline]
fn little_float(bytes: &[u8]) -> f32 {
    let mut word = [0; size_of::<f32>()];
    word.copy_from_slice(&bytes[..size_of::<f32>()]);
    f32::from_le_bytes(word)
}

fn is_record(properties: &[Property]) -> bool {
    let names = properties
        .iter()
        .map(|property| (property.name.as_str(), property.kind));
    names.eq(RECORD_PROPERTIES.map(|(kind, name)| {
        // Every type of the table has a name.
        let scalar = Scalar::parse(kind).unwrap_or(Scalar::F64);
        (name, PropertyKind::Scalar(scalar))
    }))
}
