//! A PLY file once more, with further numbers for every vertex: [`copy_ply`].

use super::header::{Encoding, PropertyKind, Scalar};
use super::read::PlyPoints;
use crate::cloud::{CloudOptions, InvalidPoints};
use crate::error::PointsError;
use crate::output::OutputFile;
use std::fmt::Write as _;
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::Path;

/// Where a new number goes.
#[derive(Clone, Copy)]
enum Slot {
    /// Behind all that the vertex has.
    Behind,
    /// In the place of a number of the same name, by column and by byte.
    At { column: usize, offset: usize },
}

/// Writes `input` to `output` with the float properties `names` for every vertex, which `next` appends to its argument;
/// properties that have these names already are replaced. Everything else stays as it is.
///
/// # Errors
/// A file that cannot be read, a property of a name that is no float, those of `next`, a failing disk.
pub(crate) fn copy_ply(
    input: &Path,
    output: &Path,
    names: &[&str],
    next: &mut dyn FnMut(&mut Vec<f32>) -> Result<(), PointsError>,
) -> Result<(), PointsError> {
    let options = CloudOptions {
        invalid_points: InvalidPoints::Skip,
        ..CloudOptions::default()
    };
    let mut points = PlyPoints::open(input, [0.0; 3], &options)?;
    let slots = slots(&points, input, names)?;
    let start = points.vertices_start()?;
    let mut file = OutputFile::create(output)?;
    let (reading, writing) = (PointsError::io("read", input), PointsError::io("write", output));
    let header = header(&points, names, &slots);
    file.write_all(header.as_bytes()).map_err(writing)?;
    points
        .reader
        .seek(SeekFrom::Start(points.data_start))
        .map_err(reading)?;
    let before = start - points.data_start;
    copy(&mut points.reader.by_ref().take(before), &mut file, [input, output])?;
    let mut numbers = Vec::with_capacity(names.len());
    for _ in 0..points.vertex.count {
        numbers.clear();
        next(&mut numbers)?;
        match points.encoding {
            Encoding::Ascii => {
                points.read_line()?;
                put_text(&mut points.buffer, &slots, &numbers);
            }
            encoding => {
                let stride = points.vertex.stride().unwrap_or_default();
                points.buffer.resize(stride, 0);
                let read = points.reader.read_exact(&mut points.buffer);
                read.map_err(PointsError::io("read", input))?;
                put_bytes(&mut points.buffer, &slots, &numbers, encoding);
            }
        }
        file.write_all(&points.buffer)
            .map_err(PointsError::io("write", output))?;
    }
    copy(&mut points.reader, &mut file, [input, output])?;
    file.publish()
}

fn slots(points: &PlyPoints, path: &Path, names: &[&str]) -> Result<Vec<Slot>, PointsError> {
    let mut slots = Vec::with_capacity(names.len());
    for name in names {
        let (mut slot, mut offset) = (Slot::Behind, 0);
        for (column, property) in points.vertex.properties.iter().enumerate() {
            let is_float = property.kind == PropertyKind::Scalar(Scalar::F32);
            match property.kind {
                _ if property.name == *name && is_float && points.vertex.stride().is_some() => {
                    slot = Slot::At { column, offset };
                }
                _ if property.name == *name => {
                    let what = format!("a property {name} that is no float, or beside lists");
                    return Err(PointsError::unsupported(path, what, "rename it"));
                }
                PropertyKind::Scalar(scalar) => offset += scalar.size(),
                PropertyKind::List { .. } => {}
            }
        }
        slots.push(slot);
    }
    Ok(slots)
}

/// The header with the new properties behind those of the vertex.
fn header(points: &PlyPoints, names: &[&str], slots: &[Slot]) -> String {
    let end = if points.header_text.lines().next() == Some("ply") && points.header_text.starts_with("ply\r") {
        "\r\n"
    } else {
        "\n"
    };
    let mut new = String::new();
    for (name, slot) in names.iter().zip(slots) {
        if matches!(slot, Slot::Behind) {
            // A String takes every text.
            let _ = write!(new, "property float {name}{end}");
        }
    }
    let (mut text, mut in_vertex) = (String::new(), false);
    for line in points.header_text.split_inclusive('\n') {
        let mut words = line.split_whitespace();
        let word = words.next();
        if in_vertex && matches!(word, Some("element" | "end_header")) {
            text += &new;
            in_vertex = false;
        }
        in_vertex |= word == Some("element") && words.next() == Some("vertex");
        text += line;
    }
    text
}

fn put_text(line: &mut Vec<u8>, slots: &[Slot], numbers: &[f32]) {
    let text = String::from_utf8_lossy(line).into_owned();
    let body = text.trim_end_matches(['\n', '\r']);
    let end = &text[body.len()..];
    let mut words: Vec<String> = Vec::new();
    if slots.iter().any(|slot| matches!(slot, Slot::At { .. })) {
        words.extend(body.split_whitespace().map(str::to_owned));
    } else {
        // Spelled as it is.
        words.push(body.trim_end().to_owned());
    }
    for (slot, number) in slots.iter().zip(numbers) {
        match slot {
            Slot::Behind => words.push(number.to_string()),
            Slot::At { column, .. } => words[*column] = number.to_string(),
        }
    }
    *line = (words.join(" ") + if end.is_empty() { "\n" } else { end }).into_bytes();
}

fn put_bytes(vertex: &mut Vec<u8>, slots: &[Slot], numbers: &[f32], encoding: Encoding) {
    for (slot, number) in slots.iter().zip(numbers) {
        let mut bytes = number.to_le_bytes();
        if encoding == Encoding::BigEndian {
            bytes.reverse();
        }
        match *slot {
            Slot::Behind => vertex.extend(bytes),
            Slot::At { offset, .. } => vertex[offset..offset + bytes.len()].copy_from_slice(&bytes),
        }
    }
}

/// Copies all that is left of `from`; tells which of the two files failed.
fn copy(from: &mut impl Read, to: &mut OutputFile, [input, output]: [&Path; 2]) -> Result<(), PointsError> {
    let mut bytes = [0; 1 << 13];
    loop {
        let read = match from.read(&mut bytes) {
            Ok(read) => read,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
            Err(error) => return Err(PointsError::io("read", input)(error)),
        };
        if read == 0 {
            return Ok(());
        }
        to.write_all(&bytes[..read]).map_err(PointsError::io("write", output))?;
    }
}
