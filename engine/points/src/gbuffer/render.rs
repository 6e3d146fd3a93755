//! Primary hits of a mesh.

use super::GBuffer;
use crate::camera::Camera;
use crate::error::PointsError;
use crate::geometry::area_vector;
use crate::image::Window;
use crate::limits;
use crate::scene::{MeshScene, SurfaceId};
use crate::trace::Ray;
use glam::{DMat3, Vec3};
use pbgi_core::limits::IMAGE_PIXELS_MAX;
use std::sync::{Mutex, PoisonError};

/// How far an interpolated normal may lean from the surface to be used, as a cosine (30 degrees): beyond, vertex normals
/// are damaged or shared across an edge, and light would leak through the surface.
const SHADING_COS_MIN: f32 = 0.866;

/// What one pixel sees.
#[derive(Clone, Copy, Default)]
struct Pixel {
    position: Vec3,
    normal: Vec3,
    albedo: Vec3,
    direct: Vec3,
    emission: Vec3,
    coverage: f32,
}

impl GBuffer {
    /// Traces a ray through the centre of every pixel.
    ///
    /// N is on the camera's side: the interpolated vertex normal where the mesh has one that leans at most 30 degrees from
    /// the surface, so that curved surfaces do not show their triangles, and the geometric normal elsewhere. `direct` is
    /// the irradiance of that side from the punctual lights with shadow rays. Pixels that see nothing are 0 everywhere.
    ///
    /// # Errors
    /// A size of 0 or beyond the limits.
    pub fn render(scene: &MeshScene, camera: &Camera, width: u32, height: u32) -> Result<Self, PointsError> {
        let pixel_count = u64::from(width) * u64::from(height);
        if pixel_count == 0 || pixel_count > IMAGE_PIXELS_MAX {
            return Err(PointsError::Request(format!(
                "a picture of {width} x {height} pixels is asked for, must have 1 to {IMAGE_PIXELS_MAX}"
            )));
        }
        let mut pixels = vec![Pixel::default(); pixel_count as usize];
        let rows = pixels.chunks_mut(width as usize).enumerate();
        // Guards the queue of rows: each thread takes the next one.
        let queue = Mutex::new(rows);
        let work = || {
            loop {
                let next = queue.lock().unwrap_or_else(PoisonError::into_inner).next();
                let Some((row, pixels)) = next else { break };
                for (column, pixel) in pixels.iter_mut().enumerate() {
                    *pixel = scene.see(camera, column as u32, row as u32, width, height);
                }
            }
        };
        std::thread::scope(|scope| {
            for _ in 1..limits::THREADS_DEFAULT {
                scope.spawn(work);
            }
            work();
        });
        let window = Window::of_size(width, height);
        let layer = |take: fn(&Pixel) -> Vec3| pixels.iter().map(|pixel| take(pixel).to_array()).collect();
        Ok(Self {
            data_window: window,
            display_window: window,
            world_to_camera: Some(camera.exr_world_to_camera()),
            world_to_ndc: Some(camera.exr_world_to_ndc(width, height)),
            position: layer(|pixel| pixel.position),
            normal: layer(|pixel| pixel.normal),
            coverage: pixels.iter().map(|pixel| pixel.coverage).collect(),
            albedo: Some(layer(|pixel| pixel.albedo)),
            direct: Some(layer(|pixel| pixel.direct)),
            emission: Some(layer(|pixel| pixel.emission)),
        })
    }
}

impl MeshScene {
    fn see(&self, camera: &Camera, column: u32, row: u32, width: u32, height: u32) -> Pixel {
        let ray = Ray {
            origin: camera.eye(),
            direction: camera.direction(column, row, width, height),
        };
        let Some((surface, _)) = self.closest(&ray) else {
            return Pixel::default();
        };
        let instance = &self.instances[surface.instance as usize];
        let geometry = &self.geometries[instance.geometry()];
        let corners = instance.corners(geometry, surface.triangle as usize);
        let [v, w] = surface.barycentric.map(f64::from);
        let position = (corners[0] * (1.0 - v - w) + corners[1] * v + corners[2] * w).as_vec3();
        let winding = area_vector(&corners).normalize_or_zero().as_vec3();
        let front = if instance.mirrors() { -winding } else { winding };
        let seen_from_front = front.dot(ray.direction) < 0.0;
        let geometric = if seen_from_front { front } else { -front };
        let shading = self.shading_normal(&surface, geometric);
        let look = self.appearance(instance.geometry(), surface.triangle as usize, surface.barycentric);
        Pixel {
            position,
            normal: shading,
            albedo: look.albedo,
            direct: self.direct_one_side(position, geometric, shading),
            emission: if seen_from_front || look.double_sided {
                look.emission
            } else {
                Vec3::ZERO
            },
            coverage: 1.0,
        }
    }

    /// The interpolated normal on the side of `geometric`, or `geometric` itself where there is none to be trusted.
    fn shading_normal(&self, surface: &SurfaceId, geometric: Vec3) -> Vec3 {
        let instance = &self.instances[surface.instance as usize];
        let geometry = &self.geometries[instance.geometry()];
        let local = geometry.vertex_normal(surface.triangle as usize, surface.barycentric);
        let world = local.and_then(|local| {
            let matrix = instance.world_from_local().matrix3;
            let turned = if matrix == DMat3::IDENTITY {
                local.as_dvec3()
            } else {
                matrix.inverse().transpose() * local.as_dvec3()
            };
            turned.as_vec3().try_normalize()
        });
        let sided = world.map(|normal| if normal.dot(geometric) < 0.0 { -normal } else { normal });
        sided
            .filter(|normal| normal.dot(geometric) >= SHADING_COS_MIN)
            .unwrap_or(geometric)
    }
}
