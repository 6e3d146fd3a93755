//! PLY meshes: vertices with normals and colours, and faces, read whole. Texture coordinates are not looked at.

use super::header::{Element, Encoding, Header, PropertyKind, Scalar};
use crate::error::PointsError;
use crate::geometry::{Geometry, Instance};
use crate::limits;
use crate::material::{LINEAR_FROM_SRGB, Material};
use crate::scene::SceneParts;
use glam::DAffine3;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

/// Albedo of a file that tells none.
const GREY: [f32; 3] = [0.8; 3];
/// Longest number of an ASCII file.
const WORD_BYTES_MAX: usize = 64;

/// Whether a file has faces, so that it is a mesh and no cloud.
pub(crate) fn has_faces(path: &Path) -> Result<bool, PointsError> {
    let file = File::open(path).map_err(PointsError::io("open", path))?;
    let header = Header::read(path, &mut BufReader::new(file))?;
    Ok(header
        .elements
        .iter()
        .any(|element| element.name == "face" && element.count > 0))
}

/// Reads a file.
pub(crate) fn read(path: &Path) -> Result<SceneParts, PointsError> {
    let file = File::open(path).map_err(PointsError::io("open", path))?;
    let mut reader = BufReader::with_capacity(1 << 18, file);
    let header = Header::read(path, &mut reader)?;
    let mut numbers = Numbers {
        path,
        reader,
        encoding: header.encoding,
    };
    let mut mesh = Geometry::default();
    for element in &header.elements {
        if element.count > limits::TRIANGLES_MAX as u64 {
            return Err(PointsError::Limit {
                what: "number of vertices or faces",
                value: element.count,
                limit: limits::TRIANGLES_MAX as u64,
                path: path.to_owned(),
            });
        }
        match element.name.as_str() {
            "vertex" => read_vertices(&mut numbers, element, &mut mesh)?,
            "face" => read_faces(&mut numbers, element, &mut mesh)?,
            _ => (0..element.count).try_for_each(|_| numbers.row(element, &mut Vec::new()).map(drop))?,
        }
    }
    let count = mesh.positions.len();
    if let Some(index) = mesh.triangles.iter().flatten().find(|&&index| index as usize >= count) {
        return Err(PointsError::invalid(
            path,
            format!("a face has vertex {index}, there are {count}"),
        ));
    }
    mesh.materials = vec![0; mesh.triangles.len()];
    let mut world = Geometry::default();
    world.append(path, &mesh, &DAffine3::IDENTITY)?;
    Ok(SceneParts {
        geometries: vec![world],
        instances: vec![Instance::new(0, &DAffine3::IDENTITY)],
        materials: vec![Material {
            albedo: if mesh.colors.is_empty() { GREY } else { [1.0; 3] },
            ..Material::default()
        }],
        ..SceneParts::default()
    })
}

fn read_vertices(numbers: &mut Numbers<'_>, element: &Element, mesh: &mut Geometry) -> Result<(), PointsError> {
    let column = |name: &str| element.properties.iter().position(|property| property.name == name);
    let columns = |names: [&str; 3]| {
        let [a, b, c] = names.map(column);
        Some([a?, b?, c?])
    };
    let position = columns(["x", "y", "z"])
        .ok_or_else(|| PointsError::invalid(numbers.path, "element \"vertex\" lacks x, y or z"))?;
    let normal = columns(["nx", "ny", "nz"]);
    // Bytes, as scanners and editors write them; other kinds of colour have no agreed meaning.
    let bytes = |columns: &[usize; 3]| {
        let is_byte = |&column: &usize| matches!(element.properties[column].kind, PropertyKind::Scalar(Scalar::U8));
        columns.iter().all(is_byte)
    };
    let color = columns(["red", "green", "blue"]).filter(bytes);
    let mut row = Vec::new();
    for index in 0..element.count {
        numbers.row(element, &mut row)?;
        let triple = |columns: [usize; 3]| columns.map(|column| row[column] as f32);
        let place = triple(position);
        if !place.iter().all(|value| value.is_finite()) {
            let what = format!("vertex {index} is not finite: {place:?}");
            return Err(PointsError::invalid(numbers.path, what));
        }
        mesh.positions.push(place);
        mesh.normals.extend(normal.map(triple));
        let linear =
            |columns: [usize; 3]| columns.map(|column| LINEAR_FROM_SRGB[row[column].clamp(0.0, 255.0) as usize]);
        mesh.colors.extend(color.map(linear));
    }
    Ok(())
}

fn read_faces(numbers: &mut Numbers<'_>, element: &Element, mesh: &mut Geometry) -> Result<(), PointsError> {
    let named = ["vertex_indices", "vertex_index"];
    if !element
        .properties
        .iter()
        .any(|property| named.contains(&property.name.as_str()))
    {
        let what = "element \"face\" has no list vertex_indices: export polygons or triangles";
        return Err(PointsError::invalid(numbers.path, what));
    }
    let mut corners = Vec::new();
    for _ in 0..element.count {
        for property in &element.properties {
            match property.kind {
                PropertyKind::List { count, item } => {
                    numbers.list(count, item, &mut corners)?;
                    if named.contains(&property.name.as_str()) {
                        fan(numbers.path, &corners, &mut mesh.triangles)?;
                    }
                }
                PropertyKind::Scalar(scalar) => drop(numbers.next(scalar)?),
            }
        }
    }
    Ok(())
}

/// A polygon as triangles.
fn fan(path: &Path, corners: &[f64], triangles: &mut Vec<[u32; 3]>) -> Result<(), PointsError> {
    let index = |&corner: &f64| (corner >= 0.0 && corner <= f64::from(u32::MAX)).then_some(corner as u32);
    let indices: Option<Vec<u32>> = corners.iter().map(index).collect();
    let indices = indices.ok_or_else(|| PointsError::invalid(path, format!("a face has the vertices {corners:?}")))?;
    if let [first, rim @ ..] = indices.as_slice() {
        triangles.extend(rim.windows(2).map(|pair| [*first, pair[0], pair[1]]));
    }
    Ok(())
}

/// The numbers of a file, one after the other.
struct Numbers<'a> {
    path: &'a Path,
    reader: BufReader<File>,
    encoding: Encoding,
}

impl Numbers<'_> {
    /// The numbers of an element, one for each property: of a list, its length.
    fn row(&mut self, element: &Element, row: &mut Vec<f64>) -> Result<(), PointsError> {
        row.clear();
        let mut items = Vec::new();
        for property in &element.properties {
            match property.kind {
                PropertyKind::Scalar(scalar) => row.push(self.next(scalar)?),
                PropertyKind::List { count, item } => {
                    self.list(count, item, &mut items)?;
                    row.push(items.len() as f64);
                }
            }
        }
        Ok(())
    }

    fn list(&mut self, count: Scalar, item: Scalar, items: &mut Vec<f64>) -> Result<(), PointsError> {
        items.clear();
        let length = self.next(count)?;
        if !(0.0..=limits::PLY_LIST_MAX as f64).contains(&length) {
            return Err(PointsError::invalid(
                self.path,
                format!("a list announces {length} items"),
            ));
        }
        for _ in 0..length as usize {
            items.push(self.next(item)?);
        }
        Ok(())
    }

    fn next(&mut self, scalar: Scalar) -> Result<f64, PointsError> {
        if self.encoding == Encoding::Ascii {
            return self.word();
        }
        let mut raw = [0u8; 8];
        let read = self.reader.read_exact(&mut raw[..scalar.size()]);
        read.map_err(|error| self.ended(error))?;
        Ok(scalar.decode(&raw, self.encoding))
    }

    fn word(&mut self) -> Result<f64, PointsError> {
        let mut word = [0u8; WORD_BYTES_MAX];
        let mut length = 0;
        loop {
            let mut byte = [0u8];
            let count = self
                .reader
                .read(&mut byte)
                .map_err(PointsError::io("read", self.path))?;
            match byte[0] {
                _ if count == 0 && length == 0 => return Err(self.ended(std::io::ErrorKind::UnexpectedEof.into())),
                _ if count == 0 => break,
                blank if blank.is_ascii_whitespace() && length == 0 => {}
                blank if blank.is_ascii_whitespace() || length == WORD_BYTES_MAX => break,
                other => {
                    word[length] = other;
                    length += 1;
                }
            }
        }
        let text = String::from_utf8_lossy(&word[..length]);
        text.parse()
            .map_err(|_| PointsError::invalid(self.path, format!("{text:?} is no number")))
    }

    fn ended(&self, error: std::io::Error) -> PointsError {
        match error.kind() {
            std::io::ErrorKind::UnexpectedEof => PointsError::invalid(self.path, "the file is truncated"),
            _ => PointsError::io("read", self.path)(error),
        }
    }
}
