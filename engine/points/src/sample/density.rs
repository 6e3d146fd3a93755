//! [`Sizes`]: how large the points of a surface are, the same everywhere or as a camera needs them.

use super::layout::Face;
use crate::camera::Camera;
use crate::error::PointsError;
use crate::geometry::{Geometry, Instance, area_vector};
use crate::open::ViewDensity;
use crate::scene::MeshScene;
use glam::DVec3;
use std::f64::consts::SQRT_2;

/// Faces of fewer points than this are not cut: their points are as large as the smallest of them should be.
const CUT_POINTS_MIN: f64 = 12.0;

/// How much further apart points are that the camera does not see.
const UNSEEN_SPREAD: f64 = 4.0;

/// Share of the half angle of view that is added on each side: what lies just outside is seen as light.
const VIEW_MARGIN: f64 = 0.25;

/// Areas of points.
#[derive(Clone, Copy, Debug)]
pub(super) enum Sizes {
    /// The same for all, square world units.
    Even(f64),
    /// By distance from an eye.
    View(View),
}

/// What a camera sees, and how finely.
#[derive(Clone, Copy, Debug)]
pub(super) struct View {
    eye: DVec3,
    forward: DVec3,
    /// Half of the opening of the cone around the picture, margin included.
    half_angle: f64,
    /// Spacing at a distance of one.
    spread: f64,
    floor: f64,
    ceiling: f64,
}

/// The points of a face.
pub(super) enum Fit {
    /// Are alike, of this area.
    Alike(f64),
    /// Differ too much: cut it.
    Cut,
}

/// The points of an instance that are all of one size.
#[derive(Clone, Copy, Debug)]
pub(super) struct Alike {
    /// Of a point, square world units.
    pub(super) area: f64,
    /// Points a square unit of the geometry's own space.
    pub(super) density: f64,
}

impl View {
    /// # Errors
    /// A number that makes no sense.
    pub(super) fn new(density: &ViewDensity, camera: &Camera, diagonal: f64) -> Result<Self, PointsError> {
        /// Shares of the scene's diagonal where nothing is asked for.
        const FLOOR_SHARE: f64 = 1.0 / 20_000.0;
        const CEILING_SHARE: f64 = 1.0 / 200.0;
        let (floor, ceiling) = (
            density.floor.map_or(diagonal * FLOOR_SHARE, f64::from),
            density.ceiling.map_or(diagonal * CEILING_SHARE, f64::from),
        );
        let sound = density.pixels > 0.0 && density.pixels.is_finite() && density.size.iter().all(|&size| size > 0);
        if !(sound && floor > 0.0 && ceiling >= floor && ceiling.is_finite()) {
            return Err(PointsError::Request(format!(
                "points {} pixels apart, at least {floor} and at most {ceiling}, make no sense: give lengths above 0, \
                 the smaller one first",
                density.pixels
            )));
        }
        let [width, height] = density.size.map(f64::from);
        let tangent = f64::from(camera.fov_y / 2.0).tan();
        let corner = (tangent * tangent * (1.0 + (width / height).powi(2))).sqrt();
        let forward = camera.world_from_camera.z_axis.truncate().as_dvec3();
        Ok(Self {
            eye: camera.eye().as_dvec3(),
            forward: -forward.normalize_or(DVec3::Z),
            half_angle: corner.atan() * (1.0 + VIEW_MARGIN),
            spread: f64::from(density.pixels) * 2.0 * tangent / height,
            floor,
            ceiling,
        })
    }

    /// The smallest and the largest spacing on a face.
    fn range(&self, corners: &[DVec3; 3]) -> [f64; 2] {
        let centre = (corners[0] + corners[1] + corners[2]) / 3.0;
        let reach = corners.iter().map(|corner| corner.distance(centre)).fold(0.0, f64::max);
        self.range_in(centre, reach)
    }

    /// The smallest and the largest spacing in a ball.
    fn range_in(&self, centre: DVec3, reach: f64) -> [f64; 2] {
        let offset = centre - self.eye;
        let distance = offset.length();
        let (near, far) = ((distance - reach).max(0.0), distance + reach);
        // Angles that the ball spans, seen from the eye.
        let span = if reach < distance {
            (reach / distance).asin()
        } else {
            std::f64::consts::PI
        };
        let angle = (offset.dot(self.forward) / distance.max(f64::MIN_POSITIVE))
            .clamp(-1.0, 1.0)
            .acos();
        let unseen = |angle: f64| if angle > self.half_angle { UNSEEN_SPREAD } else { 1.0 };
        let spacing = |distance: f64, unseen: f64| (distance * self.spread * unseen).clamp(self.floor, self.ceiling);
        [spacing(near, unseen(angle - span)), spacing(far, unseen(angle + span))]
    }

    /// The area of points that may be this near to and this far from each other.
    fn area_between(&self, [fine, coarse]: [f64; 2]) -> f64 {
        // In steps of the root of two, so that neighbouring faces mostly have the same.
        let steps = ((fine * coarse).sqrt() / self.floor).log2() * 2.0;
        let spacing = self.floor * SQRT_2.powi(steps.round() as i32);
        spacing * spacing
    }
}

impl Sizes {
    /// Whether the points of a face are alike.
    pub(super) fn fit(&self, face: &Face) -> Fit {
        let view = match self {
            Self::Even(area) => return Fit::Alike(*area),
            Self::View(view) => view,
        };
        let [fine, coarse] = view.range(&face.corners);
        if coarse > fine * SQRT_2 && face.area > CUT_POINTS_MIN * fine * fine {
            return Fit::Cut;
        }
        Fit::Alike(view.area_between([fine, coarse]))
    }

    /// The points of a whole instance, if they are alike and its triangles keep their shape.
    pub(super) fn alike(&self, instance: &Instance, geometry: &Geometry) -> Option<Alike> {
        let scale = instance.area_scale()?;
        let area = match self {
            Self::Even(area) => *area,
            Self::View(view) => {
                let reach = f64::from(geometry.bounds.diagonal()) / 2.0 * scale.sqrt();
                let [fine, coarse] = view.range_in(instance.middle(geometry), reach);
                if coarse > fine * SQRT_2 {
                    return None;
                }
                view.area_between([fine, coarse])
            }
        };
        Some(Alike {
            area,
            density: scale / area,
        })
    }

    /// About how many points a scene has.
    pub(super) fn points_in(&self, scene: &MeshScene) -> f64 {
        let points = |instance: &Instance| {
            let geometry = &scene.geometries[instance.geometry()];
            match self.alike(instance, geometry) {
                Some(alike) => geometry.area() * alike.density,
                None => instance
                    .triangles(geometry)
                    .map(|corners| self.points_on(&corners))
                    .sum(),
            }
        };
        scene.instances.iter().map(points).sum()
    }

    /// About how many points a triangle has.
    pub(super) fn points_on(&self, corners: &[DVec3; 3]) -> f64 {
        let area = area_vector(corners).length();
        match self {
            Self::Even(size) => area / size,
            Self::View(view) => {
                let [fine, coarse] = view.range(corners);
                area / (fine * coarse)
            }
        }
    }

    /// Area of the smallest points.
    pub(super) fn smallest(&self) -> f64 {
        match self {
            Self::Even(area) => *area,
            Self::View(view) => view.floor * view.floor,
        }
    }
}
