//! Cameras: where primary rays start.

use glam::{DMat4, DVec3, DVec4, Mat4, Vec3};
use pbgi_core::Bounds;

/// Distance at which the depth of `worldToNDC` begins, world units: our cameras have no near plane, but the matrix wants one.
const NDC_NEAR: f64 = 0.01;

/// A perspective camera in glTF's convention: it looks along its own -z, y up.
#[derive(Clone, Debug, PartialEq)]
pub struct Camera {
    /// Its name in the file.
    pub name: Option<String>,
    /// Camera space to world space; rotation and translation only.
    pub world_from_camera: Mat4,
    /// Vertical field of view, radians. It holds for every picture; the horizontal one follows from the picture's shape.
    pub fov_y: f32,
    /// Width over height that the file suggests.
    pub aspect_ratio: Option<f32>,
}

impl Camera {
    /// A camera at `eye` that looks at `target` with y up.
    pub fn look_at(eye: Vec3, target: Vec3, fov_y: f32) -> Self {
        Self::look_at_upright(eye, target, Vec3::Y, fov_y)
    }

    /// As [`Self::look_at`], with `up` up; with any direction up where the camera looks along it.
    pub fn look_at_upright(eye: Vec3, target: Vec3, up: Vec3, fov_y: f32) -> Self {
        let up = up.normalize_or(Vec3::Y);
        let up = if (target - eye).normalize_or_zero().dot(up).abs() > 0.999 {
            up.any_orthogonal_vector()
        } else {
            up
        };
        Self {
            name: None,
            world_from_camera: Mat4::from_translation(eye) * rotation_to(target - eye, up),
            fov_y,
            aspect_ratio: None,
        }
    }

    /// A camera outside of `bounds` that sees all of it from the front, a little from above and from the right: for files
    /// without a camera.
    pub fn framing(bounds: &Bounds) -> Self {
        const FOV_Y: f32 = 0.7;
        let centre = (Vec3::from(bounds.min) + Vec3::from(bounds.max)) / 2.0;
        let radius = (bounds.diagonal() / 2.0).max(f32::MIN_POSITIVE);
        let distance = radius / (FOV_Y / 2.0).sin();
        let from = Vec3::new(0.5, 0.35, 1.0).normalize();
        Self::look_at(centre + from * distance, centre, FOV_Y)
    }

    /// A camera that sees all of a scan in a picture of this width over height, closely: from the front and from above, the
    /// more so the flatter the scan is.
    pub fn overview(bounds: &Bounds, aspect: f32) -> Self {
        const FOV_Y: f32 = 0.6;
        const MARGIN: f32 = 1.03;
        let (low, high) = (Vec3::from(bounds.min), Vec3::from(bounds.max));
        let (centre, size) = ((low + high) / 2.0, high - low);
        let flat = 1.0 - (size.y / size.x.max(size.z).max(f32::MIN_POSITIVE)).min(1.0);
        let from = Vec3::new(0.45, 0.25 + 0.6 * flat, 0.9).normalize();
        let camera = Self::look_at(centre + from, centre, FOV_Y);
        let [right, up, back] = [0, 1, 2].map(|axis| camera.world_from_camera.col(axis).truncate());
        let tangent = (FOV_Y / 2.0).tan() / MARGIN;
        let corner = |corner: usize| {
            let side = |axis: usize| if corner >> axis & 1 == 1 { high[axis] } else { low[axis] };
            Vec3::new(side(0), side(1), side(2)) - centre
        };
        // The planes of the pyramid that touch the box on either side meet where the eye is, seen along the other axis.
        let touching = |across: Vec3, tangent: f32| {
            let reach = |sign: f32| {
                let of = |index| sign * corner(index).dot(across) + tangent * corner(index).dot(back);
                (0..8).map(of).fold(f32::NEG_INFINITY, f32::max)
            };
            let (one, other) = (reach(1.0), reach(-1.0));
            ((one - other) / 2.0, (one + other) / (2.0 * tangent))
        };
        let ((x, wide), (y, tall)) = (touching(right, tangent * aspect), touching(up, tangent));
        let eye = centre + right * x + up * y + back * wide.max(tall).max(f32::MIN_POSITIVE);
        Self::look_at(eye, eye - back, FOV_Y)
    }

    /// World position of the eye.
    pub fn eye(&self) -> Vec3 {
        self.world_from_camera.w_axis.truncate()
    }

    /// Unit direction of the ray through the centre of a pixel, world space; row 0 is at the top.
    pub fn direction(&self, column: u32, row: u32, width: u32, height: u32) -> Vec3 {
        let tangent = f64::from(self.fov_y / 2.0).tan();
        let (width, height) = (f64::from(width), f64::from(height));
        let x = (2.0 * (f64::from(column) + 0.5) - width) / height * tangent;
        let y = (height - 2.0 * (f64::from(row) + 0.5)) / height * tangent;
        let direction = self
            .world_from_camera
            .as_dmat4()
            .transform_vector3(DVec3::new(x, y, -1.0));
        direction.normalize().as_vec3()
    }

    /// The EXR attribute `worldToNDC` (column vectors) of a picture of `width` by `height` pixels: after the division by w, x
    /// and y are 0 at the upper left and 1 at the lower right corner; z is 0 at a distance of 0.01 and 1 infinitely far.
    pub fn exr_world_to_ndc(&self, width: u32, height: u32) -> Mat4 {
        let across = 2.0 * f64::from(self.fov_y / 2.0).tan();
        let aspect = f64::from(width) / f64::from(height);
        let ndc_from_camera = DMat4::from_cols(
            DVec4::new(1.0 / (across * aspect), 0.0, 0.0, 0.0),
            DVec4::new(0.0, -1.0 / across, 0.0, 0.0),
            DVec4::new(0.5, 0.5, 1.0, 1.0),
            DVec4::new(0.0, 0.0, -NDC_NEAR, 0.0),
        );
        (ndc_from_camera * self.left_handed()).as_mat4()
    }

    /// The EXR attribute `worldToCamera` (column vectors): left-handed, +z along the view.
    pub fn exr_world_to_camera(&self) -> Mat4 {
        self.left_handed().as_mat4()
    }

    fn left_handed(&self) -> DMat4 {
        let camera_from_world = self.world_from_camera.as_dmat4().inverse();
        DMat4::from_scale(DVec3::new(1.0, 1.0, -1.0)) * camera_from_world
    }
}

/// Rotation that turns -z to `forward`.
fn rotation_to(forward: Vec3, up: Vec3) -> Mat4 {
    let back = -forward.normalize_or(Vec3::NEG_Z);
    let right = up.cross(back).normalize_or(Vec3::X);
    let up = back.cross(right);
    Mat4::from_cols(right.extend(0.0), up.extend(0.0), back.extend(0.0), glam::Vec4::W)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_middle_of_the_picture_is_the_view_direction() {
        let camera = Camera::look_at(Vec3::new(1.0, 2.0, 3.0), Vec3::new(-4.0, 0.0, 1.0), 0.8);
        let direction = camera.direction(50, 50, 101, 101);
        assert!(direction.distance(Vec3::new(-5.0, -2.0, -2.0).normalize()) < 1e-6);
        let above = camera.direction(50, 0, 101, 101);
        assert!(above.y > direction.y, "row 0 is at the top");
    }

    #[test]
    fn ndc_runs_from_the_upper_left_to_the_lower_right_corner() {
        let camera = Camera::look_at(Vec3::new(1.0, 2.0, 3.0), Vec3::new(-4.0, 0.0, 1.0), 0.8);
        let matrix = camera.exr_world_to_ndc(64, 48);
        for (column, row) in [(0, 0), (63, 0), (0, 47), (31, 23), (63, 47)] {
            let seen = camera.eye() + camera.direction(column, row, 64, 48) * 7.0;
            let ndc = matrix.project_point3(seen);
            let expected = [(column as f32 + 0.5) / 64.0, (row as f32 + 0.5) / 48.0];
            assert!(
                (ndc.x - expected[0]).abs() < 1e-5 && (ndc.y - expected[1]).abs() < 1e-5,
                "{ndc}"
            );
            assert!(ndc.z > 0.0 && ndc.z < 1.0, "{ndc}");
        }
        let behind = matrix * (camera.eye() * 2.0 - Vec3::new(-4.0, 0.0, 1.0)).extend(1.0);
        assert!(behind.w < 0.0, "what lies behind has no place");
    }

    #[test]
    fn an_overview_holds_every_corner_and_wastes_little() {
        for (max, aspect) in [([100.0, 3.0, 70.0], 1.5), ([1.0, 5.0, 1.0], 1.0), ([4.0; 3], 2.0)] {
            let bounds = Bounds { min: [0.0; 3], max };
            let camera = Camera::overview(&bounds, aspect);
            let camera_from_world = camera.world_from_camera.inverse();
            let tangent = (camera.fov_y / 2.0).tan();
            let mut widest = 0f32;
            for corner in 0..8 {
                let side = |axis: usize| if corner >> axis & 1 == 1 { max[axis] } else { 0.0 };
                let seen = camera_from_world.transform_point3(Vec3::new(side(0), side(1), side(2)));
                assert!(seen.z < 0.0);
                let place = (seen.x / aspect).abs().max(seen.y.abs()) / (-seen.z * tangent);
                assert!(place <= 1.0, "{max:?} {place}");
                widest = widest.max(place);
            }
            assert!(widest > 0.9, "{max:?} {widest}");
        }
    }

    #[test]
    fn the_exr_camera_is_left_handed_with_z_along_the_view() {
        let camera = Camera::look_at(Vec3::ZERO, Vec3::NEG_Z, 0.8);
        let matrix = camera.exr_world_to_camera();
        assert!(matrix.determinant() < 0.0);
        assert!(
            matrix
                .transform_point3(Vec3::new(0.0, 0.0, -5.0))
                .distance(Vec3::new(0.0, 0.0, 5.0))
                < 1e-6
        );
        assert!(
            matrix
                .transform_point3(Vec3::new(1.0, 2.0, -5.0))
                .distance(Vec3::new(1.0, 2.0, 5.0))
                < 1e-6
        );
    }
}
