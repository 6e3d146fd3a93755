//! `UsdGeomCamera`: perspective ones, by focal length and apertures. Offsets of the apertures are not read: our pictures have their
//! centre where the camera looks.

use super::values::{Values, name_of};
use crate::camera::Camera;
use crate::error::PointsError;
use glam::Mat4;
use openusd::usd::Prim;

/// The schema's lens, in tenths of a unit.
const FOCAL_LENGTH: f64 = 50.0;
const HORIZONTAL_APERTURE: f64 = 20.955;
const VERTICAL_APERTURE: f64 = 15.2908;

/// A camera in its own space; `None` for one without perspective.
pub(super) fn read(values: &Values, prim: &Prim) -> Result<Option<Camera>, PointsError> {
    if values.token(prim, "projection")?.as_deref() == Some("orthographic") {
        return Ok(None);
    }
    let focal = values.number(prim, "focalLength", FOCAL_LENGTH)?;
    let wide = values.number(prim, "horizontalAperture", HORIZONTAL_APERTURE)?;
    let high = values.number(prim, "verticalAperture", VERTICAL_APERTURE)?;
    if !(focal > 0.0 && wide > 0.0 && high > 0.0) {
        let what = format!("focalLength is {focal}, the apertures are {wide} and {high}: they must be above 0");
        return Err(values.wrong(prim, what));
    }
    Ok(Some(Camera {
        name: Some(name_of(prim.path())),
        world_from_camera: Mat4::IDENTITY,
        fov_y: (2.0 * (high / 2.0 / focal).atan()) as f32,
        aspect_ratio: Some((wide / high) as f32),
    }))
}
