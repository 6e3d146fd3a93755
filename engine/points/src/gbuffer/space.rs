//! World space or camera space: finds out which one positions are in, and brings them into the world.

use super::GBuffer;
use crate::error::PointsError;
use glam::{DMat4, DVec3, Vec3};
use std::path::Path;

/// What space positions and normals are in.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Space {
    /// World space; positions that are plainly those of a camera's space are refused.
    #[default]
    Checked,
    /// World space, whatever it looks like.
    World,
    /// The space of the camera that the attribute `worldToCamera` describes, z along the view or, if the positions say so,
    /// against it: converted.
    Camera,
}

/// Pixels looked at.
const SAMPLES_MAX: usize = 4_096;
/// Fewer pixels tell nothing.
const SAMPLES_MIN: usize = 64;
/// Share of them that must agree: edges of objects are blended.
const AGREEING: f64 = 0.9;
/// How far from its pixel a position may appear, pixels: filters and lenses move it.
const PIXELS_OFF: f64 = 2.0;
/// Farthest over nearest depth, at least: any evenly sampled plane across the z axis looks like a camera's.
const DEPTH_RATIO_MIN: f64 = 1.01;

impl GBuffer {
    /// Refuses what is not in the space it should be in, or converts it.
    pub(super) fn into_world(mut self, path: &Path, space: Space) -> Result<Self, PointsError> {
        match space {
            Space::World => Ok(self),
            Space::Checked if self.looks_like_camera_space() => Err(PointsError::invalid(path, self.refusal())),
            Space::Checked => Ok(self),
            Space::Camera => {
                let matrix = self.world_to_camera.ok_or_else(|| {
                    let what = "the file has no attribute worldToCamera, so that its positions cannot be converted from camera \
                                space: render a world-space position pass";
                    PointsError::invalid(path, what)
                })?;
                let camera_from_world = matrix.as_dmat4();
                if camera_from_world.determinant().abs() < f64::MIN_POSITIVE || !camera_from_world.is_finite() {
                    let what = "the attribute worldToCamera has no inverse: render a world-space position pass";
                    return Err(PointsError::invalid(path, what));
                }
                self.convert(&camera_from_world);
                Ok(self)
            }
        }
    }

    fn convert(&mut self, camera_from_world: &DMat4) {
        let depths = self.samples();
        let against = depths.iter().filter(|sample| sample.point.z < 0.0).count() * 2 > depths.len();
        let flip = DVec3::new(1.0, 1.0, if against { -1.0 } else { 1.0 });
        let world_from_camera = camera_from_world.inverse();
        for position in &mut self.position {
            let point = Vec3::from(*position).as_dvec3() * flip;
            *position = world_from_camera.transform_point3(point).as_vec3().to_array();
        }
        // Normals go with the inverse transpose of what moves points.
        let normal_matrix = glam::DMat3::from_mat4(*camera_from_world).transpose();
        for normal in &mut self.normal {
            let turned = normal_matrix * (Vec3::from(*normal).as_dvec3() * flip);
            *normal = turned.normalize_or_zero().as_vec3().to_array();
        }
    }

    fn looks_like_camera_space(&self) -> bool {
        let samples = self.samples();
        let seen_by = |matrix: DMat4| {
            samples
                .iter()
                .map(move |sample| sample.moved(&matrix))
                .collect::<Vec<_>>()
        };
        let against = DMat4::from_scale(DVec3::new(1.0, 1.0, -1.0));
        let fits = |matrix: DMat4| seen_from_origin(&seen_by(matrix)) || seen_from_origin(&seen_by(against * matrix));
        let as_world = |matrix: glam::Mat4| fits(matrix.as_dmat4());
        fits(DMat4::IDENTITY) && !self.world_to_camera.is_some_and(as_world)
    }

    fn refusal(&self) -> String {
        let seen = "the positions are in camera space: they lie where a camera at the origin sees their pixels";
        match self.world_to_camera {
            Some(_) => format!(
                "{seen}, and not where worldToCamera would have them; give --space camera to convert them, or render a world-space \
                 position pass"
            ),
            None => format!(
                "{seen}; render a world-space position pass, or give --space world if a camera does stand at the world's origin"
            ),
        }
    }

    /// Evenly chosen pixels that are no holes.
    fn samples(&self) -> Vec<Sample> {
        let step = self.pixel_count().div_ceil(SAMPLES_MAX).max(1);
        // An odd step does not look at the same few columns over and over.
        let pixels = (0..self.pixel_count()).step_by(step | 1);
        let width = self.data_window.width.max(1) as usize;
        let sample = |pixel: usize| Sample {
            column: (pixel % width) as f64,
            row: (pixel / width) as f64,
            point: Vec3::from(self.position[pixel]).as_dvec3(),
        };
        pixels.filter(|&pixel| !self.is_hole(pixel)).map(sample).collect()
    }
}

/// A pixel and what it shows.
struct Sample {
    column: f64,
    row: f64,
    point: DVec3,
}

impl Sample {
    fn moved(&self, matrix: &DMat4) -> Self {
        Self {
            point: matrix.transform_point3(self.point),
            ..*self
        }
    }
}

/// Whether points lie on the rays of a pinhole at the origin that looks along +z, x to the right, y up: x / z then grows
/// evenly with the column, and y / z falls evenly with the row.
fn seen_from_origin(samples: &[Sample]) -> bool {
    let ahead: Vec<&Sample> = samples.iter().filter(|sample| sample.point.z > 0.0).collect();
    if ahead.len() < SAMPLES_MIN || (ahead.len() as f64) < AGREEING * samples.len() as f64 {
        return false;
    }
    let depths = || ahead.iter().map(|sample| sample.point.z);
    let ratio = depths().fold(0.0, f64::max) / depths().fold(f64::INFINITY, f64::min);
    let across: Vec<[f64; 2]> = ahead.iter().map(|s| [s.column, s.point.x / s.point.z]).collect();
    let down: Vec<[f64; 2]> = ahead.iter().map(|s| [s.row, s.point.y / s.point.z]).collect();
    let (Some(x), Some(y)) = (Line::through(&across), Line::through(&down)) else {
        return false;
    };
    let agrees =
        |&&[across, down]: &&[[f64; 2]; 2]| x.pixels_off(across) < PIXELS_OFF && y.pixels_off(down) < PIXELS_OFF;
    let pairs: Vec<[[f64; 2]; 2]> = across.iter().zip(&down).map(|(a, b)| [*a, *b]).collect();
    let agreeing = pairs.iter().filter(agrees).count() as f64;
    ratio > DEPTH_RATIO_MIN && x.slope > 0.0 && y.slope < 0.0 && agreeing >= AGREEING * samples.len() as f64
}

/// A straight line: value = slope pixel + start.
struct Line {
    slope: f64,
    start: f64,
}

impl Line {
    /// With the least squares of its errors; `None` if all pixels or all values are the same.
    fn through(samples: &[[f64; 2]]) -> Option<Self> {
        let count = samples.len() as f64;
        let mean = |axis: usize| samples.iter().map(|sample| sample[axis]).sum::<f64>() / count;
        let (pixel, value) = (mean(0), mean(1));
        let spread: f64 = samples.iter().map(|sample| (sample[0] - pixel).powi(2)).sum();
        let joint: f64 = samples
            .iter()
            .map(|sample| (sample[0] - pixel) * (sample[1] - value))
            .sum();
        let slope = joint / spread;
        (slope.is_finite() && slope != 0.0).then_some(Self {
            slope,
            start: value - slope * pixel,
        })
    }

    fn pixels_off(&self, [pixel, value]: [f64; 2]) -> f64 {
        ((value - self.start) / self.slope - pixel).abs()
    }
}
