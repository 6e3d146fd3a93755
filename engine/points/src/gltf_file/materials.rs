//! Materials and the textures that they use.

use super::buffers::{Buffers, read_uri, resolve};
use crate::error::PointsError;
use crate::material::{Material, Texture, TextureSlot, Wrap};
use crate::texture_file::decode;
use glam::{Affine2, Vec2};
use gltf::material::AlphaMode;
use gltf::texture::{Info, WrappingMode};
use std::collections::BTreeMap;
use std::path::Path;

/// Cutoff of a mask that names none, and the opacity at which `BLEND` is taken as surface.
const CUTOFF_DEFAULT: f32 = 0.5;

/// All materials of the file, the default one last, and the textures they use.
pub(super) fn load(
    path: &Path,
    document: &gltf::Document,
    buffers: &Buffers,
) -> Result<(Vec<Material>, Vec<Texture>), PointsError> {
    let mut loader = Loader {
        path,
        document,
        buffers,
        textures: Vec::new(),
        texture_of_image: BTreeMap::new(),
    };
    let mut materials = Vec::new();
    for (index, material) in document.materials().enumerate() {
        materials.push(loader.material(index, &material)?);
    }
    materials.push(Material {
        double_sided: false,
        ..Material::default()
    });
    Ok((materials, loader.textures))
}

struct Loader<'a> {
    path: &'a Path,
    document: &'a gltf::Document,
    buffers: &'a Buffers,
    textures: Vec<Texture>,
    texture_of_image: BTreeMap<usize, usize>,
}

impl Loader<'_> {
    fn material(&mut self, index: usize, material: &gltf::Material<'_>) -> Result<Material, PointsError> {
        let surface = material.pbr_metallic_roughness();
        let [r, g, b, alpha] = surface.base_color_factor();
        let strength = material.emissive_strength().unwrap_or(1.0);
        let emission = material.emissive_factor().map(|factor| factor * strength);
        let sound = [r, g, b, alpha]
            .iter()
            .chain(&emission)
            .all(|value| value.is_finite() && *value >= 0.0);
        if !sound {
            let what = format!("material {index} has a negative or infinite colour");
            return Err(PointsError::invalid(self.path, what));
        }
        let cutoff = match material.alpha_mode() {
            AlphaMode::Opaque => None,
            AlphaMode::Mask => Some(material.alpha_cutoff().unwrap_or(CUTOFF_DEFAULT)),
            AlphaMode::Blend => Some(CUTOFF_DEFAULT),
        };
        Ok(Material {
            albedo: [r, g, b],
            alpha,
            albedo_texture: self.slot(surface.base_color_texture())?,
            opacity_texture: None,
            emission,
            emission_texture: self.slot(material.emissive_texture())?,
            cutoff,
            double_sided: material.double_sided(),
        })
    }

    fn slot(&mut self, info: Option<Info<'_>>) -> Result<Option<TextureSlot>, PointsError> {
        let Some(info) = info else { return Ok(None) };
        let moved = info.texture_transform();
        let uv_set = moved
            .as_ref()
            .and_then(|moved| moved.tex_coord())
            .unwrap_or(info.tex_coord());
        if uv_set > 1 {
            let what = format!("set {uv_set} of texture coordinates");
            return Err(PointsError::unsupported(self.path, what, "use set 0 or 1"));
        }
        let sampler = info.texture().sampler();
        Ok(Some(TextureSlot {
            texture: self.texture(info.texture().source().index())?,
            uv_set: uv_set as usize,
            transform: moved.map(|moved| {
                let (offset, scale) = (Vec2::from(moved.offset()), Vec2::from(moved.scale()));
                // Counter-clockwise as one sees it: v points down. (The sample code of the extension turns the other way;
                // viewers do it like this.)
                Affine2::from_translation(offset) * Affine2::from_angle(-moved.rotation()) * Affine2::from_scale(scale)
            }),
            wrap: [wrap(sampler.wrap_s()), wrap(sampler.wrap_t())],
        }))
    }

    fn texture(&mut self, image: usize) -> Result<usize, PointsError> {
        if let Some(&known) = self.texture_of_image.get(&image) {
            return Ok(known);
        }
        let json = self.document.as_json().images.get(image);
        let texture = match json.map(|json| (&json.uri, json.buffer_view)) {
            Some((Some(uri), _)) => {
                let source = if uri.starts_with("data:") {
                    self.path.to_owned()
                } else {
                    resolve(self.path, uri)?
                };
                decode(&source, &read_uri(self.path, uri)?)?
            }
            Some((None, Some(view))) => {
                let view = self.buffers.view(self.document, view.value()).ok_or_else(|| {
                    PointsError::invalid(self.path, format!("image {image} reaches beyond its buffer"))
                })?;
                decode(self.path, &view.read(0..view.len())?)?
            }
            _ => {
                return Err(PointsError::invalid(
                    self.path,
                    format!("image {image} has neither a uri nor a buffer"),
                ));
            }
        };
        self.textures.push(texture);
        self.texture_of_image.insert(image, self.textures.len() - 1);
        Ok(self.textures.len() - 1)
    }
}

fn wrap(mode: WrappingMode) -> Wrap {
    match mode {
        WrappingMode::ClampToEdge => Wrap::Clamp,
        WrappingMode::MirroredRepeat => Wrap::Mirror,
        WrappingMode::Repeat => Wrap::Repeat,
    }
}
