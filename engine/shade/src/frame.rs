//! The receiver's own space: z along its normal.

use glam::Vec3;

/// A right-handed orthonormal frame whose z axis is the receiver's normal.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Frame {
    pub(crate) x: Vec3,
    pub(crate) y: Vec3,
    pub(crate) z: Vec3,
}

/// Cosine and sine of a turn about the normal that keeps raster rows off the axes of the world, along which people build:
/// an edge parallel to the rows is off by half a row along its whole length.
const TURN: (f32, f32) = (0.893_96, 0.448_14);

impl Frame {
    pub(crate) fn from_normal(normal: Vec3) -> Self {
        let (u, v) = normal.any_orthonormal_pair();
        Self {
            x: u * TURN.0 + v * TURN.1,
            y: v * TURN.0 - u * TURN.1,
            z: normal,
        }
    }

    /// Rotates a direction of the frame into the world.
    #[inline(always)]
    pub(crate) fn world_from_local(&self, v: Vec3) -> Vec3 {
        self.x * v.x + self.y * v.y + self.z * v.z
    }
}
