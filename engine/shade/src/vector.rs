//! Vectors and frames of eight receivers.

use crate::frame::Frame;
use crate::simd::{Floats, LANES};
use glam::Vec3;
use std::ops::{Add, Mul, Neg, Sub};

/// A vector in each lane.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Vector<F> {
    pub(crate) x: F,
    pub(crate) y: F,
    pub(crate) z: F,
}

impl<F: Floats> Vector<F> {
    #[inline(always)]
    pub(crate) fn splat(v: Vec3) -> Self {
        Self {
            x: F::splat(v.x),
            y: F::splat(v.y),
            z: F::splat(v.z),
        }
    }

    #[inline(always)]
    pub(crate) fn from_array(v: [Vec3; LANES]) -> Self {
        Self {
            x: F::from_array(v.map(|v| v.x)),
            y: F::from_array(v.map(|v| v.y)),
            z: F::from_array(v.map(|v| v.z)),
        }
    }

    #[inline(always)]
    pub(crate) fn dot(self, other: Self) -> F {
        self.x.mul_add(other.x, self.y.mul_add(other.y, self.z * other.z))
    }

    /// `self * scale + other`, rounded once.
    #[inline(always)]
    pub(crate) fn mul_add(self, scale: F, other: Self) -> Self {
        Self {
            x: self.x.mul_add(scale, other.x),
            y: self.y.mul_add(scale, other.y),
            z: self.z.mul_add(scale, other.z),
        }
    }

    #[inline(always)]
    pub(crate) fn length_squared(self) -> F {
        self.dot(self)
    }

    /// The largest component, without signs.
    #[inline(always)]
    pub(crate) fn max_abs(self) -> F {
        self.x.abs().max(self.y.abs()).max(self.z.abs())
    }

    #[inline(always)]
    pub(crate) fn min(self, other: Self) -> Self {
        Self {
            x: self.x.min(other.x),
            y: self.y.min(other.y),
            z: self.z.min(other.z),
        }
    }

    #[inline(always)]
    pub(crate) fn max(self, other: Self) -> Self {
        Self {
            x: self.x.max(other.x),
            y: self.y.max(other.y),
            z: self.z.max(other.z),
        }
    }
}

impl<F: Floats> Add for Vector<F> {
    type Output = Self;
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Self {
            x: self.x + other.x,
            y: self.y + other.y,
            z: self.z + other.z,
        }
    }
}

impl<F: Floats> Sub for Vector<F> {
    type Output = Self;
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        Self {
            x: self.x - other.x,
            y: self.y - other.y,
            z: self.z - other.z,
        }
    }
}

impl<F: Floats> Mul<F> for Vector<F> {
    type Output = Self;
    #[inline(always)]
    fn mul(self, scale: F) -> Self {
        Self {
            x: self.x * scale,
            y: self.y * scale,
            z: self.z * scale,
        }
    }
}

impl<F: Floats> Neg for Vector<F> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Self {
            x: -self.x,
            y: -self.y,
            z: -self.z,
        }
    }
}

/// The frames of eight receivers: rows are their axes.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Frames<F> {
    pub(crate) x: Vector<F>,
    pub(crate) y: Vector<F>,
    /// The receivers' normals.
    pub(crate) z: Vector<F>,
}

impl<F: Floats> Frames<F> {
    #[inline(always)]
    pub(crate) fn new(frames: &[Frame; LANES]) -> Self {
        Self {
            x: Vector::from_array(frames.map(|frame| frame.x)),
            y: Vector::from_array(frames.map(|frame| frame.y)),
            z: Vector::from_array(frames.map(|frame| frame.z)),
        }
    }

    /// Rotates world directions into the frames.
    #[inline(always)]
    pub(crate) fn local_from_world(&self, v: Vector<F>) -> Vector<F> {
        Vector {
            x: self.x.dot(v),
            y: self.y.dot(v),
            z: self.z.dot(v),
        }
    }

    /// The world's axes seen from the frames.
    #[inline(always)]
    pub(crate) fn axes(&self) -> [Vector<F>; 3] {
        let (x, y, z) = (self.x, self.y, self.z);
        let along_x = Vector { x: x.x, y: y.x, z: z.x };
        let along_y = Vector { x: x.y, y: y.y, z: z.y };
        let along_z = Vector { x: x.z, y: y.z, z: z.z };
        [along_x, along_y, along_z]
    }
}
