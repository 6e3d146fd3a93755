//! `UsdGeomMesh`: polygons, with normals, texture coordinates and materials by face, to triangles.

use super::materials::{Materials, Skin};
use super::polygon;
use super::primvars::{At, Counts, Per, Primvar};
use super::values::Values;
use super::walk::Context;
use crate::error::PointsError;
use crate::geometry::Geometry;
use crate::limits;
use glam::{DAffine3, Vec3};
use openusd::usd::Prim;
use std::collections::HashMap;

/// Faces of a mesh, all indices in range.
struct Faces {
    /// Where the corners of each begin, and after them where the last one's end.
    starts: Vec<usize>,
    /// The point of each corner.
    corners: Vec<usize>,
    /// Which are no surface.
    holes: Vec<bool>,
}

/// Reads a mesh in its own space.
pub(super) fn read(
    values: &Values,
    prim: &Prim,
    context: &Context,
    materials: &mut Materials,
) -> Result<Geometry, PointsError> {
    let points = values.vectors(prim, "points")?.unwrap_or_default();
    if let Some(index) = points.iter().position(|point| !Vec3::from(*point).is_finite()) {
        return Err(values.wrong(prim, format!("point {index} is not finite: {:?}", points[index])));
    }
    let faces = faces(values, prim, points.len())?;
    let counts = Counts {
        faces: faces.holes.len(),
        points: points.len(),
        corners: faces.corners.len(),
    };
    let normals = match values.vector_primvar(prim, "primvars:normals", Per::Point, counts)? {
        None => values.vector_primvar(prim, "normals", Per::Point, counts)?,
        found => found,
    };
    let colors = values.vector_primvar(prim, "primvars:displayColor", Per::Mesh, counts)?;
    let skins = skins(values, prim, context, counts.faces)?;
    let mut dressed = Vec::new();
    let wanted = skins.kinds.iter().map(|skin| materials.primvars_of(values, skin));
    let names = uv_names(
        values,
        prim,
        wanted.collect::<Result<Vec<_>, _>>()?.into_iter().flatten(),
    )?;
    for skin in &skins.kinds {
        dressed.push(materials.dress(values, skin, &names)?);
    }
    let mut uvs = [None, None];
    for (uv, name) in uvs.iter_mut().zip(&names) {
        *uv = values.pair_primvar(prim, &format!("primvars:{name}"), counts)?;
    }
    let left_handed = values.token(prim, "orientation")?.as_deref() == Some("leftHanded");
    let mut piece = Vertices::new(&points, normals.as_ref(), [uvs[0].as_ref(), uvs[1].as_ref()]);
    for face in 0..counts.faces {
        let (start, end) = (faces.starts[face], faces.starts[face + 1]);
        if faces.holes[face] || end - start < 3 {
            continue;
        }
        let corners: Vec<At> = (start..end)
            .map(|corner| At {
                face,
                point: faces.corners[corner],
                corner,
            })
            .collect();
        let dress = &dressed[skins.of[face]];
        let material = match &colors {
            Some(colors) if dress.takes_color() => {
                let sum: Vec3 = corners.iter().map(|at| Vec3::from(colors.at(*at))).sum();
                let color = (sum / corners.len() as f32).to_array();
                let color = values.checked_color(prim, "primvars:displayColor", color)?;
                materials.colored(dress, Some(color))
            }
            _ => materials.colored(dress, context.color),
        };
        let vertices: Vec<u32> = corners.iter().map(|at| piece.vertex(*at)).collect();
        let positions: Vec<Vec3> = corners.iter().map(|at| Vec3::from(points[at.point])).collect();
        for [a, b, c] in polygon::triangles(&positions) {
            let (b, c) = if left_handed { (c, b) } else { (b, c) };
            piece.geometry.triangles.push([vertices[a], vertices[b], vertices[c]]);
            piece.geometry.materials.push(material);
        }
    }
    let mut geometry = Geometry::default();
    geometry.append(values.file(), &piece.geometry, &DAffine3::IDENTITY)?;
    Ok(geometry)
}

fn faces(values: &Values, prim: &Prim, points: usize) -> Result<Faces, PointsError> {
    let counts = values.integers(prim, "faceVertexCounts")?.unwrap_or_default();
    let indices = values.integers(prim, "faceVertexIndices")?.unwrap_or_default();
    let mut starts = vec![0];
    let mut end = 0usize;
    for (face, count) in counts.iter().enumerate() {
        end = usize::try_from(*count)
            .ok()
            .and_then(|count| end.checked_add(count))
            .ok_or_else(|| values.wrong(prim, format!("face {face} has {count} corners")))?;
        starts.push(end);
    }
    if end != indices.len() {
        let what = format!(
            "faceVertexCounts has {end} corners in all, faceVertexIndices has {}",
            indices.len()
        );
        return Err(values.wrong(prim, what));
    }
    if end > limits::TRIANGLES_MAX {
        return Err(values.wrong(
            prim,
            format!("it has {end} corners, at most {} are read", limits::TRIANGLES_MAX),
        ));
    }
    let within = |index: &i32| {
        let place = usize::try_from(*index).ok().filter(|index| *index < points);
        place.ok_or_else(|| {
            values.wrong(
                prim,
                format!("faceVertexIndices has {index}, which is beyond its {points} points"),
            )
        })
    };
    let corners = indices.iter().map(within).collect::<Result<_, _>>()?;
    let mut holes = vec![false; counts.len()];
    for hole in values.integers(prim, "holeIndices")?.unwrap_or_default() {
        let hole = usize::try_from(hole).ok().and_then(|hole| holes.get_mut(hole));
        *hole.ok_or_else(|| values.wrong(prim, "holeIndices names a face that is not there"))? = true;
    }
    Ok(Faces { starts, corners, holes })
}

/// What the faces of a mesh are dressed in.
struct Skins {
    kinds: Vec<Skin>,
    /// The number in `kinds` of each face.
    of: Vec<usize>,
}

/// The mesh's own material, and those of its subsets.
fn skins(values: &Values, prim: &Prim, context: &Context, faces: usize) -> Result<Skins, PointsError> {
    let double_sided = values.flag(prim, "doubleSided")?;
    let skin = |material: Option<String>| Skin { material, double_sided };
    let mut skins = Skins {
        kinds: vec![skin(context.bound())],
        of: vec![0; faces],
    };
    for child in values.said(prim.children())? {
        if values.type_of(&child)? != "GeomSubset" {
            continue;
        }
        let of_faces = matches!(values.token(&child, "elementType")?.as_deref(), None | Some("face"));
        let bound = context.rebound(values, &child)?;
        if !of_faces || bound == context.bound() {
            continue;
        }
        for index in values.integers(&child, "indices")?.unwrap_or_default() {
            let place = usize::try_from(index).ok().and_then(|index| skins.of.get_mut(index));
            let place = place
                .ok_or_else(|| values.wrong(&child, format!("indices has {index}, the mesh has {faces} faces")))?;
            *place = skins.kinds.len();
        }
        skins.kinds.push(skin(bound));
    }
    Ok(skins)
}

/// The texture coordinates that the materials of a mesh use: two sets at most.
fn uv_names(values: &Values, prim: &Prim, wanted: impl Iterator<Item = String>) -> Result<Vec<String>, PointsError> {
    let mut names = Vec::new();
    for name in wanted {
        if !names.contains(&name) {
            names.push(name);
        }
    }
    match names.len() {
        0..=2 => Ok(names),
        _ => Err(values.unsupported(
            prim,
            format!("a third set of texture coordinates ({})", names.join(", ")),
            "let its materials use two",
        )),
    }
}

/// Vertices as they are needed: one a point where nothing varies otherwise, else one for each mixture of attributes.
struct Vertices<'a> {
    points: &'a [[f32; 3]],
    normals: Option<&'a Primvar<[f32; 3]>>,
    uvs: [Option<&'a Primvar<[f32; 2]>>; 2],
    by_point: bool,
    known: HashMap<[usize; 4], u32>,
    geometry: Geometry,
}

impl<'a> Vertices<'a> {
    fn new(
        points: &'a [[f32; 3]],
        normals: Option<&'a Primvar<[f32; 3]>>,
        uvs: [Option<&'a Primvar<[f32; 2]>>; 2],
    ) -> Self {
        let pointwise = |per: Per| matches!(per, Per::Mesh | Per::Point);
        let by_point =
            normals.is_none_or(|normals| pointwise(normals.per)) && uvs.iter().flatten().all(|uvs| pointwise(uvs.per));
        let mut vertices = Self {
            points,
            normals,
            uvs,
            by_point,
            known: HashMap::new(),
            geometry: Geometry::default(),
        };
        if by_point {
            for point in 0..points.len() {
                vertices.add(At {
                    face: 0,
                    point,
                    corner: 0,
                });
            }
        }
        vertices
    }

    /// The number of the vertex there.
    fn vertex(&mut self, at: At) -> u32 {
        if self.by_point {
            return at.point as u32;
        }
        let [u, v] = self.uvs.map(|uvs| uvs.map_or(0, |uvs| uvs.index(at)));
        let key = [at.point, self.normals.map_or(0, |normals| normals.index(at)), u, v];
        if let Some(&known) = self.known.get(&key) {
            return known;
        }
        let vertex = self.geometry.positions.len() as u32;
        self.known.insert(key, vertex);
        self.add(at);
        vertex
    }

    fn add(&mut self, at: At) {
        self.geometry.positions.push(self.points[at.point]);
        if let Some(normals) = self.normals {
            self.geometry.normals.push(normals.at(at));
        }
        for (set, uvs) in self.geometry.uvs.iter_mut().zip(&self.uvs) {
            if let Some(uvs) = uvs {
                // Textures have their origin at the bottom here, at the top in our readers.
                let [u, v] = uvs.at(at);
                set.push([u, 1.0 - v]);
            }
        }
    }
}
