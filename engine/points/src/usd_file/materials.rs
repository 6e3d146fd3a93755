//! Bound materials to ours: `UsdPreviewSurface` with `UsdUVTexture`, as a diffuse surface that may glow and have holes; the colour
//! `displayColor` without one.

use super::files::Files;
use super::values::{Input, Values, number, vector, word};
use crate::cloud::srgb_from_linear;
use crate::error::PointsError;
use crate::material::{Material, Texture, TextureSlot, Wrap};
use crate::texture_file::decode;
use glam::{Affine2, Mat2, Vec2};
use openusd::sdf::Value;
use openusd::usd::Prim;
use std::collections::BTreeMap;
use std::path::Path;
use std::rc::Rc;

/// `UsdPreviewSurface`'s own colour, and that of surfaces that say nothing.
const GREY: [f32; 3] = [0.18; 3];
/// Opacity below which there is no surface, where the material blends.
const CUTOFF_DEFAULT: f32 = 0.5;
/// Longest chain of `UsdTransform2d`.
const TRANSFORMS_MAX: usize = 16;

/// What some faces are dressed in: a material's path, and whether their back is as their front.
#[derive(Clone, PartialEq)]
pub(super) struct Skin {
    pub(super) material: Option<String>,
    pub(super) double_sided: bool,
}

/// A material as one mesh uses it: its texture coordinates are numbers of sets.
pub(super) struct Dress {
    number: usize,
    material: Material,
    /// Whether its albedo is the colour of the mesh.
    takes_color: bool,
}

impl Dress {
    pub(super) fn takes_color(&self) -> bool {
        self.takes_color
    }
}

/// A surface as the file describes it.
#[derive(Default)]
struct Surface {
    albedo: [f32; 3],
    takes_color: bool,
    albedo_map: Option<Map>,
    /// `None` where the alpha of the albedo's map tells it.
    opacity_map: Option<Map>,
    emission: [f32; 3],
    emission_map: Option<Map>,
    alpha: f32,
    cutoff: Option<f32>,
}

/// A texture and how it lies on a surface.
#[derive(Clone)]
struct Map {
    texture: usize,
    primvar: String,
    transform: Option<Affine2>,
    wrap: [Wrap; 2],
}

/// A `UsdUVTexture` before its picture is read.
struct Picture {
    file: String,
    raw: bool,
    scale: [f32; 4],
    primvar: String,
    transform: Option<Affine2>,
    wrap: [Wrap; 2],
}

/// What a picture's pixels are made into.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord)]
enum Pixels {
    /// Colours, and whether they are raw, so that they have to be encoded.
    Color(String, bool),
    /// The opacity that this channel holds.
    Opacity(String, usize),
}

/// All materials and textures of a stage, each once.
pub(super) struct Materials {
    files: Files,
    pub(super) materials: Vec<Material>,
    pub(super) textures: Vec<Texture>,
    surfaces: BTreeMap<String, Rc<Surface>>,
    dresses: BTreeMap<(Option<String>, bool, Vec<String>), usize>,
    colored: BTreeMap<(usize, Option<[u32; 3]>), u32>,
    pixels: BTreeMap<Pixels, usize>,
}

impl Materials {
    pub(super) fn new(files: Files) -> Self {
        Self {
            files,
            materials: Vec::new(),
            textures: Vec::new(),
            surfaces: BTreeMap::new(),
            dresses: BTreeMap::new(),
            colored: BTreeMap::new(),
            pixels: BTreeMap::new(),
        }
    }

    /// Adds a material that no other surface has.
    pub(super) fn own(&mut self, material: Material) -> u32 {
        self.materials.push(material);
        (self.materials.len() - 1) as u32
    }

    /// Names of the texture coordinates that a material uses.
    pub(super) fn primvars_of(&mut self, values: &Values, skin: &Skin) -> Result<Vec<String>, PointsError> {
        let surface = self.surface(values, skin)?;
        let maps = [&surface.albedo_map, &surface.opacity_map, &surface.emission_map];
        Ok(maps.into_iter().flatten().map(|map| map.primvar.clone()).collect())
    }

    /// A material for a mesh whose sets of texture coordinates are these.
    pub(super) fn dress(&mut self, values: &Values, skin: &Skin, sets: &[String]) -> Result<Dress, PointsError> {
        let surface = self.surface(values, skin)?;
        let slot = |map: &Option<Map>| {
            map.as_ref().map(|map| TextureSlot {
                texture: map.texture,
                uv_set: sets.iter().position(|name| *name == map.primvar).unwrap_or(0),
                transform: map.transform,
                wrap: map.wrap,
            })
        };
        let next = self.dresses.len();
        let key = (skin.material.clone(), skin.double_sided, sets.to_vec());
        Ok(Dress {
            number: *self.dresses.entry(key).or_insert(next),
            material: Material {
                albedo: surface.albedo,
                alpha: surface.alpha,
                albedo_texture: slot(&surface.albedo_map),
                opacity_texture: slot(&surface.opacity_map),
                emission: surface.emission,
                emission_texture: slot(&surface.emission_map),
                cutoff: surface.cutoff,
                double_sided: skin.double_sided,
            },
            takes_color: surface.takes_color,
        })
    }

    /// The number of a material, in the colour of the mesh if it takes that.
    pub(super) fn colored(&mut self, dress: &Dress, color: Option<[f32; 3]>) -> u32 {
        let color = color.filter(|_| dress.takes_color);
        let key = (dress.number, color.map(|color| color.map(f32::to_bits)));
        if let Some(&known) = self.colored.get(&key) {
            return known;
        }
        let material = self.own(Material {
            albedo: color.unwrap_or(dress.material.albedo),
            ..dress.material.clone()
        });
        self.colored.insert(key, material);
        material
    }

    fn surface(&mut self, values: &Values, skin: &Skin) -> Result<Rc<Surface>, PointsError> {
        let path = skin.material.clone().unwrap_or_default();
        if let Some(known) = self.surfaces.get(&path) {
            return Ok(known.clone());
        }
        let shader = match &skin.material {
            Some(path) => surface_shader(values, path)?,
            None => None,
        };
        let surface = match shader {
            Some(shader) => self.read_surface(values, &shader)?,
            None => Surface {
                albedo: GREY,
                takes_color: true,
                alpha: 1.0,
                ..Surface::default()
            },
        };
        let surface = Rc::new(surface);
        self.surfaces.insert(path, surface.clone());
        Ok(surface)
    }

    fn read_surface(&mut self, values: &Values, shader: &Prim) -> Result<Surface, PointsError> {
        let mut surface = Surface {
            albedo: GREY,
            alpha: 1.0,
            ..Surface::default()
        };
        let mut colors = None;
        match values.input(shader, "inputs:diffuseColor")? {
            Input::None => {}
            Input::Value(value) => surface.albedo = color_of(values, shader, &value)?,
            Input::Shader(source, _) if id_of(values, &source)?.starts_with("UsdPrimvarReader") => {
                surface.takes_color = varname(values, &source)?.as_deref() == Some("displayColor");
            }
            Input::Shader(source, output) => {
                let picture = picture(values, &source)?;
                if output != "rgb" {
                    let what = format!("the output {output:?} of a texture as a colour");
                    return Err(values.unsupported(shader, what, "connect rgb"));
                }
                surface.albedo = [picture.scale[0], picture.scale[1], picture.scale[2]];
                colors = Some(picture);
            }
        }
        let mut opacity = None;
        match values.input(shader, "inputs:opacity")? {
            Input::None => {}
            Input::Value(value) => surface.alpha = number(&value).unwrap_or(1.0) as f32,
            Input::Shader(source, _) if id_of(values, &source)?.starts_with("UsdPrimvarReader") => {}
            Input::Shader(source, output) => {
                let channel = ["r", "g", "b", "a"].iter().position(|name| *name == output);
                let channel = channel.ok_or_else(|| {
                    let what = format!("the output {output:?} of a texture as an opacity");
                    values.unsupported(shader, what, "connect r, g, b or a")
                })?;
                let picture = picture(values, &source)?;
                surface.alpha = picture.scale[channel];
                opacity = Some((picture, channel));
            }
        }
        let threshold = match values.input(shader, "inputs:opacityThreshold")? {
            Input::Value(value) => number(&value).unwrap_or(0.0) as f32,
            _ => 0.0,
        };
        let cutoff = if threshold > 0.0 { threshold } else { CUTOFF_DEFAULT };
        // What no texture cuts out is all there or not at all.
        surface.cutoff = (opacity.is_some() || surface.alpha < cutoff).then_some(cutoff);
        if let Some((picture, channel)) = opacity.filter(|(picture, channel)| !is_alpha_of(picture, *channel, &colors))
        {
            let pixels = Pixels::Opacity(picture.file.clone(), channel);
            surface.opacity_map = Some(picture.map(self.texture(pixels)?));
        }
        if let Some(picture) = colors {
            surface.albedo_map = Some(picture.map(self.texture(picture.colors())?));
        }
        match values.input(shader, "inputs:emissiveColor")? {
            Input::None => {}
            Input::Value(value) => surface.emission = color_of(values, shader, &value)?,
            Input::Shader(source, _) if id_of(values, &source)?.starts_with("UsdPrimvarReader") => {}
            Input::Shader(source, _) => {
                let picture = picture(values, &source)?;
                surface.emission = [picture.scale[0], picture.scale[1], picture.scale[2]];
                surface.emission_map = Some(picture.map(self.texture(picture.colors())?));
            }
        }
        Ok(surface)
    }

    fn texture(&mut self, pixels: Pixels) -> Result<usize, PointsError> {
        if let Some(&known) = self.pixels.get(&pixels) {
            return Ok(known);
        }
        let (Pixels::Color(file, _) | Pixels::Opacity(file, _)) = &pixels;
        let mut texture = decode(Path::new(file), &self.files.picture(file)?)?;
        match pixels {
            Pixels::Color(_, false) => {}
            Pixels::Color(_, true) => {
                let table: Vec<u8> = (0..=u8::MAX).map(encoded).collect();
                for color in texture.texels.iter_mut().flat_map(|texel| &mut texel[..3]) {
                    *color = table[usize::from(*color)];
                }
            }
            Pixels::Opacity(_, channel) => texture.texels.iter_mut().for_each(|texel| texel[3] = texel[channel]),
        }
        self.textures.push(texture);
        self.pixels.insert(pixels, self.textures.len() - 1);
        Ok(self.textures.len() - 1)
    }
}

/// Whether the opacity in a picture's channel is the alpha of the colours.
fn is_alpha_of(picture: &Picture, channel: usize, colors: &Option<Picture>) -> bool {
    const ALPHA: usize = 3;
    let lies = |picture: &Picture| {
        (
            picture.file.clone(),
            picture.primvar.clone(),
            picture.transform,
            picture.wrap,
        )
    };
    channel == ALPHA && colors.as_ref().is_some_and(|colors| lies(colors) == lies(picture))
}

/// The sRGB level of a linear one.
fn encoded(level: u8) -> u8 {
    (srgb_from_linear(f64::from(level) / 255.0) * 255.0).round() as u8
}

impl Picture {
    fn colors(&self) -> Pixels {
        Pixels::Color(self.file.clone(), self.raw)
    }

    fn map(&self, texture: usize) -> Map {
        Map {
            texture,
            primvar: self.primvar.clone(),
            transform: self.transform,
            wrap: self.wrap,
        }
    }
}

/// The `UsdPreviewSurface` of a material, if that is what it is.
fn surface_shader(values: &Values, material: &str) -> Result<Option<Prim>, PointsError> {
    let material = values.stage.prim(material);
    match values.input(&material, "outputs:surface")? {
        Input::Shader(shader, _) if id_of(values, &shader)? == "UsdPreviewSurface" => Ok(Some(shader)),
        _ => Ok(None),
    }
}

fn id_of(values: &Values, shader: &Prim) -> Result<String, PointsError> {
    Ok(values.token(shader, "info:id")?.unwrap_or_default())
}

fn varname(values: &Values, reader: &Prim) -> Result<Option<String>, PointsError> {
    Ok(match values.input(reader, "inputs:varname")? {
        Input::Value(value) => word(&value),
        _ => None,
    })
}

fn color_of(values: &Values, shader: &Prim, value: &Value) -> Result<[f32; 3], PointsError> {
    let color = vector(value).ok_or_else(|| values.wrong(shader, "a colour is no three numbers"))?;
    values.checked_color(shader, "a colour", color)
}

/// A `UsdUVTexture` and where it lies.
fn picture(values: &Values, source: &Prim) -> Result<Picture, PointsError> {
    let id = id_of(values, source)?;
    if id != "UsdUVTexture" {
        return Err(values.unsupported(source, format!("a shader {id:?}"), "bake it to a texture"));
    }
    let file = match values.input(source, "inputs:file")? {
        Input::Value(Value::AssetPath(asset)) if !asset.is_empty() => asset,
        _ => return Err(values.wrong(source, "a texture names no file")),
    };
    let name = file.asset_path().to_owned();
    if name.contains("<UDIM>") {
        return Err(values.unsupported(source, format!("the tiled texture {name:?}"), "bake it to one picture"));
    }
    let resolved = file.resolved_path().map(str::to_owned).ok_or_else(|| {
        values.wrong(
            source,
            format!("texture {name:?} is named but cannot be read: copy it beside the scene"),
        )
    })?;
    if four(values, source, "inputs:bias", [0.0; 4])? != [0.0; 4] {
        return Err(values.unsupported(source, "the bias of a texture", "bake it into the picture"));
    }
    let scale = four(values, source, "inputs:scale", [1.0; 4])?;
    if !scale.iter().all(|factor| factor.is_finite() && *factor >= 0.0) {
        return Err(values.wrong(
            source,
            format!("inputs:scale is {scale:?}, must be finite and not negative"),
        ));
    }
    let raw = value_of(values, source, "inputs:sourceColorSpace")?
        .as_ref()
        .and_then(word)
        .as_deref()
        == Some("raw");
    let (primvar, transform) = coordinates(values, source)?;
    Ok(Picture {
        file: resolved,
        raw,
        scale,
        primvar,
        transform,
        wrap: [
            wrap(values, source, "inputs:wrapS")?,
            wrap(values, source, "inputs:wrapT")?,
        ],
    })
}

fn value_of(values: &Values, shader: &Prim, name: &str) -> Result<Option<Value>, PointsError> {
    Ok(match values.input(shader, name)? {
        Input::Value(value) => Some(value),
        _ => None,
    })
}

fn four(values: &Values, shader: &Prim, name: &str, missing: [f32; 4]) -> Result<[f32; 4], PointsError> {
    Ok(match value_of(values, shader, name)? {
        Some(Value::Vec4f(v)) => [v.x, v.y, v.z, v.w],
        _ => missing,
    })
}

fn two(values: &Values, shader: &Prim, name: &str, missing: Vec2) -> Result<Vec2, PointsError> {
    Ok(match value_of(values, shader, name)? {
        Some(Value::Vec2f(v)) => Vec2::new(v.x, v.y),
        _ => missing,
    })
}

fn wrap(values: &Values, texture: &Prim, name: &str) -> Result<Wrap, PointsError> {
    let mode = value_of(values, texture, name)?.as_ref().and_then(word);
    Ok(match mode.as_deref() {
        Some("clamp" | "black") => Wrap::Clamp,
        Some("mirror") => Wrap::Mirror,
        _ => Wrap::Repeat,
    })
}

/// The primvar that a texture is laid by, and what is done to it before.
fn coordinates(values: &Values, texture: &Prim) -> Result<(String, Option<Affine2>), PointsError> {
    let mut moved: Option<Affine2> = None;
    let (mut shader, mut input) = (texture.clone(), "inputs:st");
    for _ in 0..TRANSFORMS_MAX {
        let Input::Shader(source, _) = values.input(&shader, input)? else {
            break;
        };
        let id = id_of(values, &source)?;
        if id.starts_with("UsdPrimvarReader") {
            let name = varname(values, &source)?.unwrap_or_else(|| "st".to_owned());
            return Ok((name, moved.map(top_down)));
        }
        if id != "UsdTransform2d" {
            return Err(values.unsupported(
                &source,
                format!("a shader {id:?} for coordinates"),
                "use UsdTransform2d",
            ));
        }
        let turn = value_of(values, &source, "inputs:rotation")?
            .as_ref()
            .and_then(number)
            .unwrap_or(0.0);
        let scale = two(values, &source, "inputs:scale", Vec2::ONE)?;
        let shift = two(values, &source, "inputs:translation", Vec2::ZERO)?;
        let turned = Mat2::from_angle((turn as f32).to_radians()) * Mat2::from_diagonal(scale);
        let inner = Affine2::from_mat2_translation(turned, shift);
        if !inner.is_finite() {
            return Err(values.wrong(&source, "its transform is not finite"));
        }
        moved = Some(moved.map_or(inner, |outer| outer * inner));
        (shader, input) = (source, "inputs:in");
    }
    Ok(("st".to_owned(), moved.map(top_down)))
}

/// A transform of coordinates whose v points up, for ours, whose v points down.
fn top_down(transform: Affine2) -> Affine2 {
    let flip = Affine2::from_mat2_translation(Mat2::from_diagonal(Vec2::new(1.0, -1.0)), Vec2::Y);
    flip * transform * flip
}
