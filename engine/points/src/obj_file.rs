//! Wavefront OBJ: faces, `Kd` and `map_Kd`, `Ke` and `map_Ke`, dissolve (`d`, or 1 - `Tr`, and `map_d`) below one half as a
//! hole. No lights and no cameras.

use crate::error::PointsError;
use crate::geometry::Geometry;
use crate::material::{Material, Texture, TextureSlot, Wrap};
use crate::named_file::beside;
use crate::scene::SceneParts;
use crate::texture_file::decode;
use glam::{Affine2, DAffine3, Vec2};
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
    parts.place_once(world);
    Ok(parts)
}

fn read_material(
    path: &Path,
    material: &tobj::Material,
    textures: &mut Vec<Texture>,
    known: &mut BTreeMap<(String, Use), usize>,
) -> Result<Material, PointsError> {
    let mut slot = |map: Option<&String>, purpose| map.map(|map| slot(path, map, purpose, textures, known)).transpose();
    let albedo_texture = slot(material.diffuse_texture.as_ref(), Use::Color)?;
    let opacity_texture = slot(material.dissolve_texture.as_ref(), Use::Opacity)?;
    let emission_texture = slot(material.unknown_param.get("map_Ke"), Use::Color)?;
    let diffuse = material.diffuse.unwrap_or(GREY);
    let emission = match material.emissive {
        None if emission_texture.is_some() => [1.0; 3],
        emission => emission.unwrap_or_default(),
    };
    let see_through = material
        .unknown_param
        .get("Tr")
        .and_then(|text| text.parse::<f32>().ok());
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
        alpha: material.dissolve.unwrap_or(1.0 - see_through.unwrap_or(0.0)),
        albedo_texture,
        opacity_texture,
        emission,
        emission_texture,
        cutoff: Some(0.5),
        double_sided: true,
    })
}

/// What stands behind `map_Kd`: options, then the name of a picture.
#[derive(Debug, PartialEq)]
struct Map<'a> {
    name: &'a str,
    scale: Vec2,
    offset: Vec2,
    clamped: bool,
}

impl<'a> Map<'a> {
    /// `None` without a name.
    fn parse(text: &'a str) -> Option<Self> {
        let mut map = Self {
            name: text.trim(),
            scale: Vec2::ONE,
            offset: Vec2::ZERO,
            clamped: false,
        };
        while let Some((option, rest)) = split_word(map.name).filter(|(word, _)| word.starts_with('-')) {
            // Vectors may lack their last numbers; the rest have as many words as they have.
            let vector = matches!(option, "-s" | "-o" | "-t");
            let most = if vector {
                3
            } else if option == "-mm" {
                2
            } else {
                1
            };
            let mut words = Vec::new();
            map.name = rest;
            while let Some((word, rest)) = split_word(map.name).filter(|_| words.len() < most) {
                if vector && word.parse::<f32>().is_err() {
                    break;
                }
                words.push(word);
                map.name = rest;
            }
            let number = |index: usize, missing: f32| words.get(index).map_or(Some(missing), |word| word.parse().ok());
            match option {
                "-s" => map.scale = Vec2::new(number(0, 1.0)?, number(1, 1.0)?),
                "-o" => map.offset = Vec2::new(number(0, 0.0)?, number(1, 0.0)?),
                "-clamp" => map.clamped = words == ["on"],
                _ => {}
            }
        }
        (!map.name.is_empty()).then_some(map)
    }
}

fn split_word(text: &str) -> Option<(&str, &str)> {
    let text = text.trim();
    (!text.is_empty())
        .then(|| text.split_once(char::is_whitespace).unwrap_or((text, "")))
        .map(|(word, rest)| (word, rest.trim()))
}

/// What a picture is read for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Use {
    Color,
    Opacity,
}

fn slot(
    path: &Path,
    text: &str,
    purpose: Use,
    textures: &mut Vec<Texture>,
    known: &mut BTreeMap<(String, Use), usize>,
) -> Result<TextureSlot, PointsError> {
    let map = Map::parse(text).filter(|map| map.scale.is_finite() && map.offset.is_finite());
    let map = map.ok_or_else(|| PointsError::invalid(path, format!("a material's map is not understood: {text:?}")))?;
    // The file's v points up, ours down.
    let offset = Vec2::new(map.offset.x, 1.0 - map.scale.y - map.offset.y);
    let moved = map.scale != Vec2::ONE || map.offset != Vec2::ZERO;
    Ok(TextureSlot {
        texture: texture(path, map.name, purpose, textures, known)?,
        uv_set: 0,
        transform: moved.then(|| Affine2::from_translation(offset) * Affine2::from_scale(map.scale)),
        wrap: [if map.clamped { Wrap::Clamp } else { Wrap::Repeat }; 2],
    })
}

fn texture(
    path: &Path,
    name: &str,
    purpose: Use,
    textures: &mut Vec<Texture>,
    known: &mut BTreeMap<(String, Use), usize>,
) -> Result<usize, PointsError> {
    if let Some(&index) = known.get(&(name.to_owned(), purpose)) {
        return Ok(index);
    }
    // Windows' separators.
    let file = beside(path, &name.replace('\\', "/"))?;
    let bytes = std::fs::read(&file).map_err(|error| {
        let what = format!("texture {file:?} is named but cannot be read ({error}): copy it beside the scene");
        PointsError::invalid(path, what)
    })?;
    let picture = decode(&file, &bytes)?;
    textures.push(match purpose {
        Use::Color => picture,
        Use::Opacity => picture.into_opacity(),
    });
    known.insert((name.to_owned(), purpose), textures.len() - 1);
    Ok(textures.len() - 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_stand_before_the_name_of_a_map() {
        let map = |name, scale, offset, clamped| {
            Some(Map {
                name,
                scale,
                offset,
                clamped,
            })
        };
        let plain = |name| map(name, Vec2::ONE, Vec2::ZERO, false);
        assert_eq!(Map::parse(" wood grain.png "), plain("wood grain.png"));
        assert_eq!(Map::parse("-bm 0.5 -mm 0 1 wood.png"), plain("wood.png"));
        assert_eq!(Map::parse("-t 0.1 0.1 wood.png"), plain("wood.png"));
        assert_eq!(
            Map::parse("-s 2 3 1 -o 0.5 maps\\wood.png"),
            map("maps\\wood.png", Vec2::new(2.0, 3.0), Vec2::new(0.5, 0.0), false)
        );
        assert_eq!(Map::parse("-clamp on 1.png"), map("1.png", Vec2::ONE, Vec2::ZERO, true));
        assert_eq!(Map::parse("-s 2 2 2"), None);
    }
}
