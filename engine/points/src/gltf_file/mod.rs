//! glTF and GLB: nodes, meshes, materials, lights and cameras become [`SceneParts`].
//!
//! Read: triangles, strips and fans; base colour, alpha mask, emission with strength; KHR_texture_transform,
//! KHR_lights_punctual, KHR_materials_emissive_strength, EXT_mesh_gpu_instancing. Materials are diffuse: metalness and roughness are not looked at.
//! `BLEND` is taken as a mask at an opacity of one half. Skins, morph targets and animations are not applied.

mod accessor;
mod buffers;
mod instancing;
mod materials;
mod nodes;

use crate::error::PointsError;
use crate::geometry::Geometry;
use crate::limits;
use crate::scene::{Room, SceneParts};
use accessor::Accessors;
use glam::{DAffine3, Vec3};
use instancing::Places;
use nodes::Uses;
use std::path::Path;

/// Reads a file and all that it names, if there is room for it.
pub(crate) fn read(path: &Path, room: Room) -> Result<SceneParts, PointsError> {
    let (document, blob) = buffers::open(path)?;
    room.fits((document.nodes().len() * limits::NODE_BYTES) as u64)?;
    let buffers = buffers::load(path, &document, blob)?;
    let visited = nodes::visit(path, &document)?;
    let (materials, textures) = materials::load(path, &document, &buffers)?;
    let mut parts = SceneParts {
        materials,
        textures,
        lights: visited.lights,
        cameras: visited.cameras,
        ..SceneParts::default()
    };
    let mut uses = visited.uses;
    let mut world = Geometry::default();
    let accessors = Accessors::new(path, &document, &buffers);
    for mesh in document.meshes() {
        let Some(Uses { places, instanced }) = uses.remove(&mesh.index()) else {
            continue;
        };
        let local = read_mesh(path, &accessors, &mesh, parts.materials.len())?;
        let instanced = instanced.iter().map(|node| node.places(path, &accessors));
        let instanced = instanced.collect::<Result<Vec<_>, _>>()?;
        let count = places.len() + instanced.iter().map(Places::count).sum::<usize>();
        let places = places.into_iter().chain(instanced.iter().flat_map(Places::transforms));
        parts.place(path, &mut world, local, count, places)?;
        room.fits(parts.memory_bytes() + world.memory_bytes() as u64)?;
    }
    parts.place_once(world);
    Ok(parts)
}

fn read_mesh(
    path: &Path,
    accessors: &Accessors<'_>,
    mesh: &gltf::Mesh<'_>,
    material_count: usize,
) -> Result<Geometry, PointsError> {
    let mut geometry = Geometry::default();
    for primitive in mesh.primitives() {
        let place = format!("mesh {} primitive {}", mesh.index(), primitive.index());
        let Some(positions) = primitive.get(&gltf::Semantic::Positions) else {
            continue;
        };
        let positions = accessors.vectors::<3>(&positions, &place)?;
        if let Some(index) = positions.iter().position(|p| !Vec3::from(*p).is_finite()) {
            let what = format!("{place}: vertex {index} is not finite: {:?}", positions[index]);
            return Err(PointsError::invalid(path, what));
        }
        let indices = match primitive.indices() {
            Some(indices) => accessors.indices(&indices, &place)?,
            None => (0..positions.len() as u32).collect(),
        };
        if let Some(index) = indices.iter().find(|&&index| index as usize >= positions.len()) {
            let count = positions.len();
            let what = format!("{place}: index {index} is beyond its {count} vertices");
            return Err(PointsError::invalid(path, what));
        }
        let attribute = |semantic: gltf::Semantic| primitive.get(&semantic);
        let mut piece = Geometry {
            triangles: triangles_of(primitive.mode(), &indices),
            ..Geometry::default()
        };
        if let Some(normals) = attribute(gltf::Semantic::Normals) {
            piece.normals = accessors.vectors::<3>(&normals, &place)?;
        }
        for (set, uvs) in piece.uvs.iter_mut().enumerate() {
            if let Some(accessor) = attribute(gltf::Semantic::TexCoords(set as u32)) {
                *uvs = accessors.vectors::<2>(&accessor, &place)?;
            }
        }
        // The last material is the default one.
        let material = primitive.material().index().unwrap_or(material_count - 1);
        piece.materials = vec![material as u32; piece.triangles.len()];
        piece.positions = positions;
        geometry.append(path, &piece, &DAffine3::IDENTITY)?;
    }
    Ok(geometry)
}

fn triangles_of(mode: gltf::mesh::Mode, indices: &[u32]) -> Vec<[u32; 3]> {
    use gltf::mesh::Mode;
    match mode {
        Mode::Triangles => indices.as_chunks::<3>().0.to_vec(),
        Mode::TriangleStrip => {
            let turned = |(i, w): (usize, &[u32])| {
                if i % 2 == 0 {
                    [w[0], w[1], w[2]]
                } else {
                    [w[1], w[0], w[2]]
                }
            };
            indices.windows(3).enumerate().map(turned).collect()
        }
        Mode::TriangleFan => {
            let rim = indices.get(1..).unwrap_or_default();
            rim.windows(2).map(|pair| [indices[0], pair[0], pair[1]]).collect()
        }
        Mode::Points | Mode::Lines | Mode::LineLoop | Mode::LineStrip => Vec::new(),
    }
}
