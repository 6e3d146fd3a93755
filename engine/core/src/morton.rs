//! Positions on the Z-curve: 21 bits an axis, interleaved (paper section 3.2).

use crate::bounds::Bounds;
use crate::limits::MORTON_BITS;
use serde::{Deserialize, Serialize};

/// Cells along each axis of the finest lattice.
const CELLS: f64 = (1u32 << MORTON_BITS) as f64;

/// Maps world positions to the lattice of 2^21 cells an axis. The lattice is a cube: a tight box would make voxels oblong
/// and leave gaps between aggregated footprints.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Quantizer {
    /// Smallest corner of the cube, world space.
    pub origin: [f64; 3],
    /// Edge of the cube, world units, positive.
    pub edge: f64,
}

/// A code of 63 bits, `.. z1 y1 x1 z0 y0 x0`: order along it is depth-first order in the octree.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct MortonCode(pub u64);

impl Quantizer {
    /// The smallest cube at the box's lower corner that holds it; a unit cube where the box has no extent.
    ///
    /// Returns `None` if the box is empty or not finite.
    pub fn from_bounds(bounds: &Bounds) -> Option<Self> {
        if bounds.is_empty() || bounds.min.iter().chain(&bounds.max).any(|value| !value.is_finite()) {
            return None;
        }
        let origin = bounds.min.map(f64::from);
        let extent = (0..3)
            .map(|axis| f64::from(bounds.max[axis]) - origin[axis])
            .fold(0.0, f64::max);
        Some(Self {
            origin,
            edge: if extent > 0.0 { extent } else { 1.0 },
        })
    }

    /// Lattice cell of a position; positions outside are clamped to the border, those on the maximum face to its last cell.
    #[inline]
    pub fn cell(&self, position: [f32; 3]) -> [u32; 3] {
        let scale = CELLS / self.edge;
        let mut cell = [0u32; 3];
        for axis in 0..3 {
            let scaled = (f64::from(position[axis]) - self.origin[axis]) * scale;
            cell[axis] = floor(scaled.clamp(0.0, CELLS - 1.0));
        }
        cell
    }

    /// Morton code of a position.
    #[inline]
    pub fn code(&self, position: [f32; 3]) -> MortonCode {
        MortonCode::from_cell(self.cell(position))
    }
}

impl MortonCode {
    /// Interleaves a lattice cell.
    #[inline]
    pub fn from_cell(cell: [u32; 3]) -> Self {
        Self(spread(cell[0]) | spread(cell[1]) << 1 | spread(cell[2]) << 2)
    }

    /// The lattice cell.
    #[inline]
    pub fn cell(self) -> [u32; 3] {
        [gather(self.0), gather(self.0 >> 1), gather(self.0 >> 2)]
    }

    /// The leading `level` octal digits: the path from the root to the voxel of that level.
    #[inline]
    pub fn prefix(self, level: u32) -> u64 {
        self.0 >> (3 * (MORTON_BITS - level))
    }
}

/// The whole part of a number from 0 to 2^31, without the checks of a cast: a build takes three of them for every look at a
/// point.
#[inline]
fn floor(value: f64) -> u32 {
    // Beside 2^52 a double has no fraction: the sum is rounded to nearest, and its low bits are the number.
    const SHIFT: f64 = (1u64 << 52) as f64;
    let shifted = value + SHIFT;
    (shifted.to_bits() as u32).wrapping_sub(u32::from(shifted - SHIFT > value))
}

/// Bits that [`SPREAD`] spreads at once.
const SPREAD_BITS: u32 = 11;

/// For every number of [`SPREAD_BITS`] bits the same with two zero bits after each.
static SPREAD: [u32; 1 << SPREAD_BITS] = {
    let mut table = [0; 1 << SPREAD_BITS];
    let mut value = 0;
    while value < table.len() {
        let mut bit = 0;
        while bit < SPREAD_BITS {
            table[value] |= ((value as u32 >> bit) & 1) << (3 * bit);
            bit += 1;
        }
        value += 1;
    }
    table
};

/// Puts two zero bits after each of the low 22 bits.
#[inline]
fn spread(value: u32) -> u64 {
    let part = |shift: u32| u64::from(SPREAD[(value >> shift) as usize % SPREAD.len()]);
    part(0) | part(SPREAD_BITS) << (3 * SPREAD_BITS)
}

/// The inverse of [`spread`].
#[inline]
fn gather(value: u64) -> u32 {
    let mut v = value & 0x1249_2492_4924_9249;
    v = (v | v >> 2) & 0x10c3_0c30_c30c_30c3;
    v = (v | v >> 4) & 0x100f_00f0_0f00_f00f;
    v = (v | v >> 8) & 0x001f_0000_ff00_00ff;
    v = (v | v >> 16) & 0x001f_0000_0000_ffff;
    ((v | v >> 32) & 0x1f_ffff) as u32
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn unit_cube() -> Quantizer {
        Quantizer::from_bounds(&Bounds {
            min: [0.0; 3],
            max: [1.0; 3],
        })
        .unwrap()
    }

    #[test]
    fn bits_interleave_as_the_paper_says() {
        assert_eq!(MortonCode::from_cell([0b01, 0b10, 0b11]).0, 0b110_101);
    }

    #[test]
    fn the_maximum_face_belongs_to_the_last_cell() {
        let last = (1 << MORTON_BITS) - 1;
        for corner in 0..8u32 {
            let position = [0, 1, 2].map(|axis| if corner >> axis & 1 == 1 { 1.0 } else { 0.0 });
            let expected = [0, 1, 2].map(|axis| if corner >> axis & 1 == 1 { last } else { 0 });
            assert_eq!(unit_cube().cell(position), expected);
        }
    }

    #[test]
    fn bounds_without_extent_become_a_unit_cell() {
        let quantizer = Quantizer::from_bounds(&Bounds {
            min: [3.0; 3],
            max: [3.0; 3],
        })
        .unwrap();
        assert_eq!(quantizer.edge, 1.0);
        assert_eq!(quantizer.code([3.0; 3]), MortonCode(0));
        assert_eq!(Quantizer::from_bounds(&Bounds::EMPTY), None);
    }

    #[test]
    fn floor_is_the_cast() {
        for whole in (0..1u32 << MORTON_BITS).step_by(997).chain([1, (1 << MORTON_BITS) - 1]) {
            let value = f64::from(whole);
            for value in [
                value,
                value.next_up(),
                value + 0.5,
                value.next_down().max(0.0),
                value + 0.499_999,
            ] {
                assert_eq!(floor(value), value as u32, "{value}");
            }
        }
    }

    proptest! {
        #[test]
        fn cells_survive_interleaving(x in 0u32..1 << 21, y in 0u32..1 << 21, z in 0u32..1 << 21) {
            prop_assert_eq!(MortonCode::from_cell([x, y, z]).cell(), [x, y, z]);
        }

        #[test]
        fn cells_are_monotone_at_any_scale(a in 0.0f32..1.0, b in 0.0f32..1.0, exponent in -30i32..30) {
            let scale = 10f32.powi(exponent);
            let quantizer = Quantizer::from_bounds(&Bounds { min: [0.0; 3], max: [scale; 3] }).unwrap();
            let (low, high) = (a.min(b) * scale, a.max(b) * scale);
            prop_assert!(quantizer.cell([low; 3])[0] <= quantizer.cell([high; 3])[0]);
        }
    }
}
