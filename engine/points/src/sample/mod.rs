//! Meshes as streams of lit points: laid out evenly ([`layout`]), lit batch by batch, never all in memory.

mod density;
mod layout;

use crate::error::PointsError;
use crate::limits;
use crate::open::{Density, SampleOptions};
use crate::scene::MeshScene;
use density::{Sizes, View};
use glam::Vec3;
use layout::{Layout, Surfel};
use pbgi_core::point::{Reflectance, Sides};
use pbgi_core::{Bounds, InvalidPoint, PointRecord, PointStream};
use std::f32::consts::PI;
use std::sync::{Mutex, PoisonError};

/// The points of a mesh scene.
///
/// Each stands for the same area (on curved surfaces up to 5 % more), or for one that a camera asks for, and carries, for either side, the radiance
/// `albedo E / pi + emission` that leaves it: E from the punctual lights, shadowed; emission on the front, and on the back of
/// double-sided materials. Both sides of every surface receive and block direct light, whatever the material says; light of other
/// surfaces is reflected by the backs of double-sided materials only, as nobody sees the others. Normals are geometric. Where a texture cuts the surface out there are no points.
pub struct MeshPoints {
    scene: MeshScene,
    sizes: Sizes,
    /// About how many there are.
    points: f64,
    threads: usize,
    layout: Layout,
    surfels: Vec<Surfel>,
}

impl MeshPoints {
    /// Samples `scene`.
    ///
    /// # Errors
    /// A spacing or a number of points out of range.
    pub fn new(scene: MeshScene, options: &SampleOptions) -> Result<Self, PointsError> {
        let total = scene.area();
        let (sizes, points) = match options.density {
            Density::Spacing(spacing) => {
                if !(spacing > 0.0 && spacing.is_finite()) {
                    return Err(PointsError::Request(format!(
                        "spacing is {spacing}, must be a length above 0"
                    )));
                }
                let area = f64::from(spacing) * f64::from(spacing);
                (Sizes::Even(area), total / area)
            }
            Density::Points(points) => (Sizes::Even(total / points as f64), points as f64),
            Density::View(density) => {
                let camera = scene.camera(density.camera)?;
                let diagonal = f64::from(scene.bounds().diagonal());
                let sizes = Sizes::View(View::new(&density, &camera, diagonal)?);
                (sizes, sizes.points_in(&scene))
            }
        };
        let area = sizes.smallest();
        if !(points <= limits::POINTS_MAX as f64 && area.is_finite() && area > 0.0) {
            let most = limits::POINTS_MAX;
            return Err(PointsError::Request(format!(
                "{points:.0} points are asked of a mesh, must be 1 to {most}: choose another number or spacing"
            )));
        }
        Ok(Self {
            scene,
            sizes,
            points,
            threads: options.threads.max(1),
            layout: Layout::new(sizes),
            surfels: Vec::new(),
        })
    }

    /// The scene that is sampled.
    pub fn scene(&self) -> &MeshScene {
        &self.scene
    }

    /// Distance between neighbouring points where they are densest, world units: the root of their area.
    pub fn spacing(&self) -> f64 {
        self.sizes.smallest().sqrt()
    }

    fn light(&self, surfel: &Surfel) -> Result<Option<PointRecord>, InvalidPoint> {
        let scene = &self.scene;
        let surface = &surfel.surface;
        let geometry = scene.instances[surface.instance as usize].geometry();
        let (triangle, barycentric) = (surface.triangle as usize, surface.barycentric);
        if !scene.is_opaque(geometry, triangle, barycentric) {
            return Ok(None);
        }
        let look = scene.appearance(geometry, triangle, barycentric);
        let irradiance = scene.direct_both_sides(surfel.position, surfel.normal);
        // A light that touches the surface would make it infinitely bright.
        let radiance = |irradiance: Vec3, emission: Vec3| (look.albedo * irradiance / PI + emission).min(Vec3::MAX);
        let back_emission = if look.double_sided { look.emission } else { Vec3::ZERO };
        let sides = Sides {
            front: radiance(irradiance.front, look.emission).to_array(),
            back: radiance(irradiance.back, back_emission).to_array(),
        };
        let bounds = scene.bounds();
        // Rounding may put a point a hair outside of the box that promises to hold it.
        let position = surfel.position.clamp(bounds.min.into(), bounds.max.into());
        let reflectance = Reflectance {
            albedo: look.albedo.to_array(),
            both_sides: look.double_sided,
        };
        let point = PointRecord::new(position.to_array(), surfel.normal.to_array(), surfel.radius, sides)?;
        Ok(Some(point.with_reflectance(reflectance)))
    }

    /// Lights all surfels; the order is theirs.
    fn light_all(&self, batch: &mut Vec<PointRecord>) -> Result<(), PointsError> {
        let mut lit: Vec<Result<Option<PointRecord>, InvalidPoint>> = vec![Ok(None); self.surfels.len()];
        let chunks = self.surfels.chunks(limits::LIGHT_CHUNK_POINTS);
        // Guards the queue of chunks: each thread takes the next one.
        let queue = Mutex::new(chunks.zip(lit.chunks_mut(limits::LIGHT_CHUNK_POINTS)));
        let work = || {
            loop {
                let next = queue.lock().unwrap_or_else(PoisonError::into_inner).next();
                let Some((surfels, lit)) = next else { break };
                for (surfel, lit) in surfels.iter().zip(lit) {
                    *lit = self.light(surfel);
                }
            }
        };
        std::thread::scope(|scope| {
            for _ in 1..self.threads {
                scope.spawn(work);
            }
            work();
        });
        for point in lit {
            let invalid = |error: InvalidPoint| PointsError::Request(format!("a sampled point is unusable: {error}"));
            batch.extend(point.map_err(invalid)?);
        }
        Ok(())
    }
}

impl PointStream for MeshPoints {
    type Error = PointsError;

    fn bounds(&self) -> Option<Bounds> {
        Some(self.scene.bounds())
    }

    fn len_hint(&self) -> Option<u64> {
        Some(self.points.round() as u64)
    }

    fn next_batch(&mut self, batch: &mut Vec<PointRecord>) -> Result<bool, PointsError> {
        let before = batch.len();
        // A batch that was cut out entirely is no reason to return.
        while batch.len() == before {
            self.surfels.clear();
            if !self.layout.fill(&self.scene, limits::BATCH_POINTS, &mut self.surfels) {
                return Ok(false);
            }
            self.light_all(batch)?;
        }
        Ok(true)
    }

    fn rewind(&mut self) -> Result<(), PointsError> {
        self.layout = Layout::new(self.sizes);
        Ok(())
    }
}
