//! Scenes from a seed, in the spirit of the paper's (section 5): a tree, a head of hair, a city, a forest; of any size.
//!
//! [`ProceduralScene`] is a stream of points that needs no memory for them. Its points carry sun and sky without shadows;
//! small scenes can be had as triangles too ([`ProceduralScene::write_glb`]), to be traced or lit properly.

mod shapes;

use crate::camera::Camera;
use crate::error::PointsError;
use crate::glb::{GlbMesh, GlbScene};
use crate::limits;
use crate::output::write_file;
use glam::Vec3;
use pbgi_core::point::{Reflectance, Sides};
use pbgi_core::{Bounds, PointRecord, PointStream};
use serde_json::json;
use shapes::{Material, Patch, Random};
use std::f32::consts::PI;
use std::io::Write;
use std::path::Path;
use std::str::FromStr;

/// Which scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// One tree, leaf by leaf.
    Tree,
    /// A head with hair that stands up.
    Tighten,
    /// Blocks of houses and towers along streets.
    City,
    /// Trees on a plain, no two alike.
    Forest,
}

impl FromStr for Kind {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        match name {
            "tree" => Ok(Self::Tree),
            "tighten" => Ok(Self::Tighten),
            "city" => Ok(Self::City),
            "forest" => Ok(Self::Forest),
            _ => Err(format!("{name:?} is no scene: choose tree, tighten, city or forest")),
        }
    }
}

/// Irradiance of a surface that faces the sun, W/m2.
const SUN: [f32; 3] = [3.2, 2.9, 2.5];
/// Irradiance from the whole sky, W/m2; a surface that faces down gets none.
const SKY: [f32; 3] = [0.5, 0.65, 0.9];
const TO_SUN: Vec3 = Vec3::new(0.48, 0.8, 0.36);

/// A scene as a stream of points, always the same for the same kind, number and seed.
pub struct ProceduralScene {
    kind: Kind,
    seed: u64,
    units: u64,
    /// Of all patches, square units.
    area: f64,
    bounds: Bounds,
    /// Points asked for.
    points: u64,
    next_unit: u64,
    patches: Vec<Patch>,
    next_patch: usize,
    random: Random,
}

impl ProceduralScene {
    /// A scene of about `points` points (to a percent). Its extent grows with them, its density does not. Looks at every
    /// patch once.
    ///
    /// # Errors
    /// No points, or too many.
    pub fn new(kind: Kind, points: u64, seed: u64) -> Result<Self, PointsError> {
        if !(1..=limits::POINTS_MAX).contains(&points) {
            let most = limits::POINTS_MAX;
            return Err(PointsError::Request(format!(
                "{points} points are asked for, must be 1 to {most}"
            )));
        }
        let mut scene = Self {
            kind,
            seed,
            units: (points / kind.points_per_unit()).max(2),
            area: 0.0,
            bounds: Bounds::EMPTY,
            points,
            next_unit: 0,
            patches: Vec::new(),
            next_patch: 0,
            random: Random::new(seed, u64::MAX),
        };
        for unit in 0..scene.units {
            scene.patches.clear();
            kind.unit(unit, scene.units, seed, &mut scene.patches);
            for patch in &scene.patches {
                scene.area += f64::from(patch.u.cross(patch.v).length());
                for corner in [Vec3::ZERO, patch.u, patch.v, patch.u + patch.v] {
                    scene.bounds.include((patch.corner + corner).to_array());
                }
            }
        }
        scene.patches.clear();
        Ok(scene)
    }

    /// Writes the scene's triangles, materials, sun and cameras as a GLB file: one that sees all of it, and for a city and a
    /// forest one at the height of a walker's eyes.
    ///
    /// # Errors
    /// A scene too large for that, a failing disk.
    pub fn write_glb(&self, path: &Path) -> Result<(), PointsError> {
        let mut meshes: Vec<(Material, GlbMesh)> = Material::ALL.map(|material| (material, GlbMesh::default())).into();
        let (mut patches, mut count) = (Vec::new(), 0);
        for unit in 0..self.units {
            patches.clear();
            self.kind.unit(unit, self.units, self.seed, &mut patches);
            count += patches.len() as u64;
            if count > limits::GLB_PATCHES_MAX {
                return Err(PointsError::Limit {
                    what: "number of patches that a GLB file takes",
                    value: count,
                    limit: limits::GLB_PATCHES_MAX,
                    path: path.to_owned(),
                });
            }
            for patch in &patches {
                if let Some((_, mesh)) = meshes.iter_mut().find(|(material, _)| *material == patch.material) {
                    // As the points' normals have it: the front is on the side of u cross v.
                    mesh.rectangle(patch.corner, patch.u, patch.v);
                }
            }
        }
        let mut scene = GlbScene::default();
        for (material, mesh) in meshes {
            if !mesh.is_empty() {
                let [r, g, b] = material.albedo();
                let json = json!({
                    "name": material.name(),
                    "doubleSided": true,
                    "pbrMetallicRoughness": {
                        "baseColorFactor": [r, g, b, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0,
                    },
                });
                scene.mesh(json, &mesh);
            }
        }
        scene.sun(SUN, -TO_SUN);
        scene.camera(&Camera::framing(&self.bounds));
        if let Some(camera) = self.kind.walker(self.units) {
            scene.camera(&camera);
        }
        let bytes = scene.finish("pbgi generate");
        write_file(path, |file| file.write_all(&bytes))
    }

    /// The points of a patch: rows of evenly many, each point moved a little within its share.
    fn sample(&mut self, patch: &Patch, batch: &mut Vec<PointRecord>) -> Result<(), PointsError> {
        let cross = patch.u.cross(patch.v);
        let area = cross.length();
        let expected = f64::from(area) / self.area * self.points as f64;
        // Rounded up or down by chance, so that their number is right over many.
        let count = (expected + f64::from(self.random.unit())) as u64;
        if count == 0 {
            return Ok(());
        }
        let normal = cross / area;
        let shape = patch.v.length() / patch.u.length();
        let rows = ((count as f32 * shape).sqrt().round() as u64).clamp(1, count);
        let radius = (area / count as f32 / PI).sqrt();
        let sides = Sides {
            front: radiance(patch.material, normal),
            back: radiance(patch.material, -normal),
        };
        let reflectance = Reflectance {
            albedo: patch.material.albedo(),
            both_sides: true,
        };
        let (low, high) = (Vec3::from(self.bounds.min), Vec3::from(self.bounds.max));
        for row in 0..rows {
            let columns = (row + 1) * count / rows - row * count / rows;
            for column in 0..columns {
                let mut place = |index: u64, of: u64| (index as f32 + 0.25 + 0.5 * self.random.unit()) / of as f32;
                let (u, v) = (place(column, columns), place(row, rows));
                let position = (patch.corner + patch.u * u + patch.v * v).clamp(low, high);
                let point = PointRecord::new(position.to_array(), normal.to_array(), radius, sides);
                let unusable = |error| PointsError::Request(format!("a generated point is unusable: {error}"));
                batch.push(point.map_err(unusable)?.with_reflectance(reflectance));
            }
        }
        Ok(())
    }
}

/// Radiance of a side with this normal, without shadows.
fn radiance(material: Material, normal: Vec3) -> [f32; 3] {
    let (sun, sky) = (normal.dot(TO_SUN).max(0.0), 0.5 + 0.5 * normal.y);
    let albedo = material.albedo();
    std::array::from_fn(|channel| albedo[channel] / PI * (SUN[channel] * sun + SKY[channel] * sky))
}

impl PointStream for ProceduralScene {
    type Error = PointsError;

    fn bounds(&self) -> Option<Bounds> {
        Some(self.bounds)
    }

    fn len_hint(&self) -> Option<u64> {
        Some(self.points)
    }

    fn next_batch(&mut self, batch: &mut Vec<PointRecord>) -> Result<bool, PointsError> {
        let before = batch.len();
        while batch.len() < before + limits::BATCH_POINTS {
            if let Some(&patch) = self.patches.get(self.next_patch) {
                self.next_patch += 1;
                self.sample(&patch, batch)?;
            } else if self.next_unit < self.units {
                self.patches.clear();
                self.next_patch = 0;
                self.kind.unit(self.next_unit, self.units, self.seed, &mut self.patches);
                self.next_unit += 1;
            } else {
                break;
            }
        }
        Ok(batch.len() > before)
    }

    fn rewind(&mut self) -> Result<(), PointsError> {
        (self.next_unit, self.next_patch) = (0, 0);
        self.patches.clear();
        self.random = Random::new(self.seed, u64::MAX);
        Ok(())
    }
}
