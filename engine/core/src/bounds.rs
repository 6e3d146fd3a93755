//! Axis-aligned boxes in world space.

use glam::Vec3;
use serde::{Deserialize, Serialize};

/// An axis-aligned box, closed on all sides, in world units. Empty when `min > max` on any axis.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Bounds {
    /// Smallest corner.
    pub min: [f32; 3],
    /// Largest corner.
    pub max: [f32; 3],
}

impl Bounds {
    /// The box that holds nothing.
    pub const EMPTY: Self = Self {
        min: [f32::INFINITY; 3],
        max: [f32::NEG_INFINITY; 3],
    };

    /// Whether the box holds nothing.
    pub fn is_empty(&self) -> bool {
        (0..3).any(|axis| self.min[axis] > self.max[axis])
    }

    /// Grows to hold `position`.
    pub fn include(&mut self, position: [f32; 3]) {
        for (axis, &value) in position.iter().enumerate() {
            self.min[axis] = self.min[axis].min(value);
            self.max[axis] = self.max[axis].max(value);
        }
    }

    /// Grows to hold `other`.
    pub fn merge(&mut self, other: &Self) {
        for axis in 0..3 {
            self.min[axis] = self.min[axis].min(other.min[axis]);
            self.max[axis] = self.max[axis].max(other.max[axis]);
        }
    }

    /// Whether `position` lies inside or on the border.
    pub fn contains(&self, position: [f32; 3]) -> bool {
        (0..3).all(|axis| self.min[axis] <= position[axis] && position[axis] <= self.max[axis])
    }

    /// Length of the diagonal; 0 when empty.
    pub fn diagonal(&self) -> f32 {
        if self.is_empty() {
            0.0
        } else {
            (Vec3::from(self.max) - Vec3::from(self.min)).length()
        }
    }
}
