//! The G-buffer: what the camera sees in each pixel, rendered from a mesh, put together from what rays
//! met in a scene, or read from another renderer's passes.

mod hits;
mod pass_through;
mod read;
mod render;
mod space;

pub use hits::{HitBuffer, RayHit};
pub use pass_through::PassThrough;
pub use read::GBufferOptions;
pub use space::Space;

use crate::error::PointsError;
use crate::image::{LayeredImage, Precision, Window};
use glam::Mat4;
use std::path::Path;

/// Positions, normals and, where known, the other ingredients of a picture, row-major over the data window.
#[derive(Clone, Debug, PartialEq)]
pub struct GBuffer {
    /// The pixels that there are.
    pub data_window: Window,
    /// The picture they are part of.
    pub display_window: Window,
    /// The standard EXR attribute (see [`crate::Camera::exr_world_to_camera`]).
    pub world_to_camera: Option<Mat4>,
    /// The standard EXR attribute (see [`crate::Camera::exr_world_to_ndc`]).
    pub world_to_ndc: Option<Mat4>,
    /// World position.
    pub position: Vec<[f32; 3]>,
    /// World normal on the camera's side, unit length when rendered here, used as stored when read.
    pub normal: Vec<[f32; 3]>,
    /// 1 where the camera sees a surface.
    pub coverage: Vec<f32>,
    /// Diffuse albedo.
    pub albedo: Option<Vec<[f32; 3]>>,
    /// Irradiance straight from the punctual lights, shadowed, W/m2.
    pub direct: Option<Vec<[f32; 3]>>,
    /// Radiance that the surface itself emits towards the camera, W/(m2 sr).
    pub emission: Option<Vec<[f32; 3]>>,
}

impl GBuffer {
    /// Pixels.
    pub fn pixel_count(&self) -> usize {
        self.position.len()
    }

    /// Whether there is nothing to shade at a pixel: coverage 0 or NaN, a position or normal that is not finite, a zero
    /// normal.
    pub fn is_hole(&self, pixel: usize) -> bool {
        let finite = |v: &[f32; 3]| v.iter().all(|x| x.is_finite());
        let (position, normal) = (&self.position[pixel], &self.normal[pixel]);
        let covered = self.coverage[pixel] > 0.0;
        !(covered && finite(position) && finite(normal) && normal.iter().any(|&x| x != 0.0))
    }

    /// Number of holes.
    pub fn hole_count(&self) -> u64 {
        (0..self.pixel_count()).filter(|&pixel| self.is_hole(pixel)).count() as u64
    }

    /// As a picture: `P.XYZ` and `N.XYZ` in 32 bits, `albedo`, `direct`, `emission` (where known) and `A` in 16.
    pub fn to_image(&self) -> LayeredImage {
        let mut image = LayeredImage::with_windows(self.data_window, self.display_window);
        image.world_to_camera = self.world_to_camera;
        image.world_to_ndc = self.world_to_ndc;
        image.add_xyz("P", Precision::Float, &self.position);
        image.add_xyz("N", Precision::Float, &self.normal);
        for (layer, pixels) in [
            ("albedo", &self.albedo),
            ("direct", &self.direct),
            ("emission", &self.emission),
        ] {
            if let Some(pixels) = pixels {
                image.add_rgb(layer, Precision::Half, pixels);
            }
        }
        image.add("A", Precision::Half, self.coverage.clone());
        image
    }

    /// Writes an EXR file; see [`Self::to_image`].
    ///
    /// # Errors
    /// A failing disk.
    pub fn write(&self, path: &Path) -> Result<(), PointsError> {
        self.to_image().write_exr(path)
    }
}
