//! What a scene file may say, key by key, and whether it makes sense.

use super::place::Transform;
use serde::Deserialize;
use toml::Spanned;

/// A whole file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Description {
    #[serde(default)]
    pub(super) mesh: Vec<Spanned<Mesh>>,
    #[serde(default)]
    pub(super) light: Lights,
    #[serde(default)]
    pub(super) camera: Vec<Spanned<View>>,
    pub(super) environment: Option<Spanned<Surroundings>>,
}

/// A file with triangles, placed once or many times.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Mesh {
    pub(super) file: Spanned<String>,
    translate: Option<[f64; 3]>,
    rotate: Option<[f64; 3]>,
    scale: Option<super::place::Scale>,
    matrix: Option<[f64; 16]>,
    #[serde(default)]
    pub(super) instances: Vec<Spanned<Transform>>,
    /// In place of the file's materials.
    pub(super) albedo: Option<[f32; 3]>,
    #[serde(default = "yes")]
    pub(super) lights: bool,
    #[serde(default = "yes")]
    pub(super) cameras: bool,
}

fn yes() -> bool {
    true
}

/// Lights by their form.
#[derive(Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Lights {
    #[serde(default)]
    pub(super) point: Vec<Spanned<PointLight>>,
    #[serde(default)]
    pub(super) spot: Vec<Spanned<SpotLight>>,
    #[serde(default)]
    pub(super) directional: Vec<Spanned<DirectionalLight>>,
    #[serde(default)]
    pub(super) rectangle: Vec<Spanned<RectangleLight>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct PointLight {
    pub(super) position: [f32; 3],
    /// W/sr.
    pub(super) intensity: f32,
    #[serde(default = "white")]
    pub(super) color: [f32; 3],
    pub(super) range: Option<f32>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct SpotLight {
    pub(super) position: [f32; 3],
    pub(super) target: [f32; 3],
    /// W/sr.
    pub(super) intensity: f32,
    #[serde(default = "white")]
    pub(super) color: [f32; 3],
    /// Half angles from the axis, degrees.
    #[serde(default)]
    pub(super) inner_angle: f32,
    #[serde(default = "half_right")]
    pub(super) outer_angle: f32,
    pub(super) range: Option<f32>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct DirectionalLight {
    /// That the light travels in.
    pub(super) direction: [f32; 3],
    /// Of a surface that faces it, W/m2.
    pub(super) irradiance: f32,
    #[serde(default = "white")]
    pub(super) color: [f32; 3],
}

/// A parallelogram that shines along `edge_u` cross `edge_v`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RectangleLight {
    pub(super) corner: [f32; 3],
    pub(super) edge_u: [f32; 3],
    pub(super) edge_v: [f32; 3],
    /// W/(m2 sr).
    pub(super) radiance: f32,
    #[serde(default = "white")]
    pub(super) color: [f32; 3],
    #[serde(default)]
    pub(super) both_sides: bool,
}

/// A camera.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct View {
    pub(super) name: Option<String>,
    pub(super) position: [f32; 3],
    pub(super) target: [f32; 3],
    #[serde(default = "up")]
    pub(super) up: [f32; 3],
    /// Vertical, degrees.
    pub(super) fov: f32,
    /// Width over height.
    pub(super) aspect: Option<f32>,
}

/// Light from far away.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Surroundings {
    pub(super) file: Spanned<String>,
}

fn white() -> [f32; 3] {
    [1.0; 3]
}

fn up() -> [f32; 3] {
    [0.0, 1.0, 0.0]
}

fn half_right() -> f32 {
    45.0
}

impl Mesh {
    /// The transform of the file itself, before those of the instances.
    pub(super) fn own(&self) -> Transform {
        Transform {
            translate: self.translate,
            rotate: self.rotate,
            scale: self.scale,
            matrix: self.matrix,
        }
    }
}
