//! PLY headers: which numbers a vertex has, and where they lie.

use super::BOUNDS_COMMENT;
use crate::error::PointsError;
use crate::limits;
use pbgi_core::Bounds;
use std::io::{BufRead, Read};
use std::path::Path;

/// How the numbers are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Encoding {
    Ascii,
    LittleEndian,
    BigEndian,
}

/// Type of a number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

/// One property of an element.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Property {
    pub(super) name: String,
    pub(super) kind: PropertyKind,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum PropertyKind {
    Scalar(Scalar),
    List { count: Scalar, item: Scalar },
}

#[derive(Clone, Debug)]
pub(super) struct Element {
    pub(super) name: String,
    pub(super) count: u64,
    pub(super) properties: Vec<Property>,
}

#[derive(Clone, Debug)]
pub(super) struct Header {
    pub(super) encoding: Encoding,
    pub(super) elements: Vec<Element>,
    /// Bytes of the header, where the data start.
    pub(super) bytes: u64,
    /// The lines as they are.
    pub(super) text: String,
    /// The box that a file of ours declares in a comment.
    pub(super) bounds: Option<Bounds>,
}

impl Encoding {
    fn parse(path: &Path, name: &str) -> Result<Self, PointsError> {
        match name {
            "ascii" => Ok(Self::Ascii),
            "binary_little_endian" => Ok(Self::LittleEndian),
            "binary_big_endian" => Ok(Self::BigEndian),
            other => {
                let what = format!("PLY format {other:?}");
                Err(PointsError::unsupported(
                    path,
                    what,
                    "write ascii or binary_little_endian",
                ))
            }
        }
    }
}

impl Scalar {
    pub(super) fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    pub(super) fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// The largest value of a whole number, at which a colour is white.
    pub(super) fn white(self) -> Option<f64> {
        match self {
            Self::U8 => Some(f64::from(u8::MAX)),
            Self::U16 => Some(f64::from(u16::MAX)),
            Self::I8 => Some(f64::from(i8::MAX)),
            Self::I16 => Some(f64::from(i16::MAX)),
            Self::I32 => Some(f64::from(i32::MAX)),
            Self::U32 => Some(f64::from(u32::MAX)),
            Self::F32 | Self::F64 => None,
        }
    }

    /// The value of the first `size()` bytes.
    pub(super) fn decode(self, bytes: &[u8], encoding: Encoding) -> f64 {
        let mut le = [0u8; 8];
        let size = self.size();
        le[..size].copy_from_slice(&bytes[..size]);
        if encoding == Encoding::BigEndian {
            le[..size].reverse();
        }
        let [a, b, c, d, ..] = le;
        match self {
            Self::I8 => f64::from(a as i8),
            Self::U8 => f64::from(a),
            Self::I16 => f64::from(i16::from_le_bytes([a, b])),
            Self::U16 => f64::from(u16::from_le_bytes([a, b])),
            Self::I32 => f64::from(i32::from_le_bytes([a, b, c, d])),
            Self::U32 => f64::from(u32::from_le_bytes([a, b, c, d])),
            Self::F32 => f64::from(f32::from_le_bytes([a, b, c, d])),
            Self::F64 => f64::from_le_bytes(le),
        }
    }
}

impl Element {
    /// Bytes of one element, if all are alike.
    pub(super) fn stride(&self) -> Option<usize> {
        self.properties.iter().try_fold(0, |sum, property| match property.kind {
            PropertyKind::Scalar(scalar) => Some(sum + scalar.size()),
            PropertyKind::List { .. } => None,
        })
    }
}

impl Header {
    /// Reads up to and with the line `end_header`.
    pub(super) fn read(path: &Path, reader: &mut impl BufRead) -> Result<Self, PointsError> {
        let mut header = Self {
            encoding: Encoding::Ascii,
            elements: Vec::new(),
            bytes: 0,
            text: String::new(),
            bounds: None,
        };
        let mut limited = reader.take(limits::PLY_HEADER_BYTES_MAX);
        let mut has_format = false;
        for number in 1.. {
            let mut line = Vec::new();
            let read = limited
                .read_until(b'\n', &mut line)
                .map_err(PointsError::io("read", path))?;
            header.bytes += read as u64;
            if line.last() != Some(&b'\n') {
                let most = limits::PLY_HEADER_BYTES_MAX;
                let what =
                    format!("no end_header within the file's first {most} bytes: it is no PLY file, or truncated");
                return Err(PointsError::invalid(path, what));
            }
            let line = String::from_utf8_lossy(&line);
            header.text.push_str(&line);
            let words: Vec<&str> = line.split_whitespace().collect();
            if number == 1 && words != ["ply"] {
                return Err(PointsError::invalid(
                    path,
                    "the first line is not \"ply\": it is no PLY file",
                ));
            }
            match words.as_slice() {
                ["end_header"] if has_format => return Ok(header),
                ["ply"] if number == 1 => {}
                ["comment", BOUNDS_COMMENT, numbers @ ..] => header.bounds = parse_bounds(numbers),
                ["comment" | "obj_info", ..] | [] => {}
                ["format", name, "1.0"] => {
                    has_format = true;
                    header.encoding = Encoding::parse(path, name)?;
                }
                ["element", name, count] => header.elements.push(Element {
                    name: (*name).to_owned(),
                    count: count.parse().map_err(|_| bad_line(path, number, &line))?,
                    properties: Vec::new(),
                }),
                ["property", rest @ ..] => {
                    let property = Property::parse(rest).ok_or_else(|| bad_line(path, number, &line))?;
                    let element = header
                        .elements
                        .last_mut()
                        .ok_or_else(|| bad_line(path, number, &line))?;
                    if element.properties.len() >= limits::PLY_PROPERTIES_MAX {
                        let what = format!(
                            "element {:?} has more than {} properties",
                            element.name,
                            limits::PLY_PROPERTIES_MAX
                        );
                        return Err(PointsError::invalid(path, what));
                    }
                    element.properties.push(property);
                }
                _ => return Err(bad_line(path, number, &line)),
            }
        }
        Err(PointsError::invalid(path, "the header has no end"))
    }
}

impl Property {
    fn parse(words: &[&str]) -> Option<Self> {
        let (kind, name) = match words {
            ["list", count, item, name] => {
                let (count, item) = (Scalar::parse(count)?, Scalar::parse(item)?);
                (PropertyKind::List { count, item }, name)
            }
            [scalar, name] => (PropertyKind::Scalar(Scalar::parse(scalar)?), name),
            _ => return None,
        };
        Some(Self {
            name: name.to_ascii_lowercase(),
            kind,
        })
    }
}

/// Six numbers and nothing else.
fn parse_bounds(words: &[&str]) -> Option<Bounds> {
    let numbers: Result<Vec<f32>, _> = words.iter().map(|word| word.parse()).collect();
    let [a, b, c, d, e, f] = numbers.ok()?.try_into().ok()?;
    Some(Bounds {
        min: [a, b, c],
        max: [d, e, f],
    })
}

fn bad_line(path: &Path, number: usize, line: &str) -> PointsError {
    PointsError::invalid(
        path,
        format!("header line {number} is not understood: {:?}", line.trim_end()),
    )
}
