//! Octree cells: a prefix of a Morton code and a level.

use crate::limits::MORTON_BITS;
use crate::morton::{MortonCode, Quantizer};

/// An octree cell. `prefix` has `3 * level` bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Voxel {
    /// Path from the root, three bits a level.
    pub prefix: u64,
    /// 0 for the root, [`MORTON_BITS`] for the finest cells.
    pub level: u32,
}

impl Voxel {
    /// The cell that holds everything.
    pub const ROOT: Self = Self { prefix: 0, level: 0 };

    /// Whether the position coded by `code` lies inside. Integers only: no point on a border is lost or counted twice.
    #[inline]
    pub fn contains(self, code: MortonCode) -> bool {
        code.prefix(self.level) == self.prefix
    }

    /// The child in `octant` (z << 2 | y << 1 | x).
    #[inline]
    pub fn child(self, octant: u32) -> Self {
        debug_assert!(self.level < MORTON_BITS && octant < 8);
        Self {
            prefix: self.prefix << 3 | u64::from(octant),
            level: self.level + 1,
        }
    }

    /// Edge of the cell, world units.
    #[inline]
    pub fn edge(self, quantizer: &Quantizer) -> f64 {
        quantizer.edge / (1u64 << self.level) as f64
    }

    /// Smallest corner of the cell, world space.
    #[inline]
    pub fn min_corner(self, quantizer: &Quantizer) -> [f64; 3] {
        let edge = self.edge(quantizer);
        let cell = MortonCode(self.prefix).cell();
        [0, 1, 2].map(|axis| quantizer.origin[axis] + f64::from(cell[axis]) * edge)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bounds::Bounds;

    #[test]
    fn children_halve_the_cell_and_hold_their_codes() {
        let quantizer = Quantizer::from_bounds(&Bounds {
            min: [-2.0; 3],
            max: [2.0; 3],
        })
        .unwrap();
        let code = quantizer.code([1.5, -1.5, 0.5]);
        let child = Voxel::ROOT.child(0b101);
        assert!(child.contains(code));
        assert!(!Voxel::ROOT.child(0b111).contains(code));
        assert_eq!(child.edge(&quantizer), 2.0);
        assert_eq!(child.min_corner(&quantizer), [0.0, -2.0, 0.0]);
    }
}
