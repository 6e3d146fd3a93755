//! Wavefront OBJ: faces, `Kd` and `map_Kd`, `Ke`, dissolve below one half as a hole. No lights and no cameras.

use crate::error::PointsError;
use crate::material::{Material, Texture, TextureSlot, Wrap};
use crate::named_file::beside;
use crate::scene::{Geometry, Instance, SceneParts};
use crate::texture_file::decode;
use glam::DAffine3;
use std::cell::Cell;
use std::collections::BTreeMap;
use std::io::BufReader;
use std::path::Path;

/// Albedo of faces without a material.
const GREY: [f32; 3] = [0.8; 3];

/// Reads a file and the materials and textures that it names.
pub(crate) fn read(path: &Path) -> Result<SceneParts, PointsError> {
    // Opened here for the system's own words: tobj says only that it failed.
    let file = std::fs::File::open(path).map_err(PointsError::io("open", path))?;
    let options = tobj::LoadOptions {
        single_index: true,
        triangulate: true,
        ignore_points: true,
        ignore_lines: true,
    };
    let damaged = |error: tobj::LoadError| PointsError::invalid(path, format!("not a usable OBJ file: {error}"));
    let outside = Cell::new(None);
    let library = |name: &Path| match beside(path, &name.to_string_lossy()) {
        Ok(library) => tobj::load_mtl(library),
        Err(error) => {
            outside.set(Some(error));
            Err(tobj::LoadError::OpenFileFailed)
        }
    };
    let loaded = tobj::load_obj_buf(&mut BufReader::new(file), &options, library);
    if let Some(error) = outside.take() {
        return Err(error);
    }
    let (models, materials) = loaded.map_err(damaged)?;
    let materials = materials.map_err(|error| {
        let what = format!("its material library cannot be read ({error}): copy it beside, or delete the line mtllib");
        PointsError::invalid(path, what)
    })?;
    let mut parts = SceneParts::default();
    let mut textures = BTreeMap::new();
    for material in &materials {
        let read = read_material(path, material, &mut parts.textures, &mut textures)?;
        parts.materials.push(read);
    }
    parts.materials.push(Material {
        albedo: GREY,
        ..Material::default()
    });
    let mut world = Geometry::default();
    for model in &models {
        let mesh = &model.mesh;
        let material = mesh
            .material_id
            .filter(|&id| id < materials.len())
            .unwrap_or(materials.len());
        let triangles = mesh.indices.as_chunks::<3>().0.to_vec();
        let positions = mesh.positions.as_chunks::<3>().0.to_vec();
        if let Some(index) = positions.iter().position(|p| !p.iter().all(|x| x.is_finite())) {
            let what = format!(
                "object {:?}: vertex {index} is not finite: {:?}",
                model.name, positions[index]
            );
            return Err(PointsError::invalid(path, what));
        }
        // Textures have their origin at the bottom here, at the top in our readers.
        let uvs = mesh.texcoords.as_chunks::<2>().0.iter().map(|&[u, v]| [u, 1.0 - v]);
        let piece = Geometry {
            normals: mesh.normals.as_chunks::<3>().0.to_vec(),
            uvs: [uvs.collect(), Vec::new()],
            materials: vec![material as u32; triangles.len()],
            positions,
            triangles,
            ..Geometry::default()
        };
        world.append(path, &piece, &DAffine3::IDENTITY)?;
    }
    parts.geometries.push(world);
    parts.instances.push(Instance::new(0, &DAffine3::IDENTITY));
    Ok(parts)
}

fn read_material(
    path: &Path,
    material: &tobj::Material,
    textures: &mut Vec<Texture>,
    known: &mut BTreeMap<String, usize>,
) -> Result<Material, PointsError> {
    let albedo_texture = match &material.diffuse_texture {
        Some(name) => Some(TextureSlot {
            texture: texture(path, name, textures, known)?,
            uv_set: 0,
            transform: None,
            wrap: [Wrap::Repeat; 2],
        }),
        None => None,
    };
    let diffuse = material.diffuse.unwrap_or(GREY);
    let emission = material.emissive.unwrap_or_default();
    if !diffuse
        .iter()
        .chain(&emission)
        .all(|value| value.is_finite() && *value >= 0.0)
    {
        let what = format!("material {:?} has a negative or infinite colour", material.name);
        return Err(PointsError::invalid(path, what));
    }
    Ok(Material {
        // Exporters leave Kd black under a texture.
        albedo: if albedo_texture.is_some() && diffuse == [0.0; 3] {
            [1.0; 3]
        } else {
            diffuse
        },
        alpha: material.dissolve.unwrap_or(1.0),
        albedo_texture,
        emission,
        emission_texture: None,
        cutoff: Some(0.5),
        double_sided: true,
    })
}

fn texture(
    path: &Path,
    name: &str,
    textures: &mut Vec<Texture>,
    known: &mut BTreeMap<String, usize>,
) -> Result<usize, PointsError> {
    if let Some(&index) = known.get(name) {
        return Ok(index);
    }
    // Options before the name, and Windows' separators.
    let last = name.trim().replace('\\', "/");
    let file = beside(path, &last)?;
    let bytes = std::fs::read(&file).map_err(|error| {
        let what = format!("texture {file:?} is named but cannot be read ({error}): copy it beside the scene");
        PointsError::invalid(path, what)
    })?;
    textures.push(decode(&file, &bytes)?);
    known.insert(name.to_owned(), textures.len() - 1);
    Ok(textures.len() - 1)
}
