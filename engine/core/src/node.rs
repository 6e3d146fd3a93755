//! The node: a voxel's cluster as it lies in files and pages, 128 bytes.

use crate::ids::{NodeIndex, PointIndex};
use crate::limits::MORTON_BITS;
use crate::octahedral;
use crate::sh::SH_TERMS;
use bytemuck::{Pod, Zeroable};
use glam::Vec3;
use half::f16;
use half::slice::HalfFloatSliceExt;
use std::sync::LazyLock;

/// One octree node with its cluster.
///
/// ```text
/// byte 0         12      16     20       24       25     26     27    28
///      | centroid | first | span | normal | level  |radius|spread| fill |
///      | 3 x f32  | u32   | u32  | 2 x i16| + kind | code | code | code |
///
/// byte 28          40                        112         113       116         128
///      | covariance | sh                      | variation | visible | folds     |
///      | 6 x f16    | 9 x (area, r, g, b) f16 | code      | 3 codes | 3 x 5 in u32
/// ```
///
/// Siblings are contiguous and never cross a page, so a first child and a mask replace the paper's eight indices; the room
/// goes to the footprint (covariance, mean normal, spread, fill, visible share, folds).
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct NodeRecord {
    /// Area-weighted mean position of the points, world space.
    pub centroid: [f32; 3],
    first: u32,
    span: u32,
    /// Axis that the discs face on average (octahedral): the principal axis of the area-weighted normals.
    pub axis_code: [i16; 2],
    level_and_kind: u8,
    radius_code: u8,
    spread_code: u8,
    fill_code: u8,
    /// Covariance of the covered surface over the square of the voxel's edge: xx, yy, zz, xy, xz, yz.
    pub covariance: [f16; 6],
    /// Spherical harmonics, per term: projected front area and power in R, G, B, each divided by
    /// [`crate::pack::area_normaliser`] of the level.
    pub sh: [[f16; 4]; SH_TERMS],
    variation_code: u8,
    visible_codes: [u8; 3],
    fold_codes: [u32; 3],
}

const _: () = assert!(size_of::<NodeRecord>() == 128);

/// What lies below a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NodeKind {
    /// Children: the first one, and a bit for every octant that has one. They lie in octant order.
    Inner {
        /// First child.
        first: NodeIndex,
        /// Octants present; octant = z << 2 | y << 1 | x.
        mask: u8,
    },
    /// Points.
    Leaf {
        /// First point.
        first: PointIndex,
        /// How many follow.
        count: u32,
    },
    /// A leaf of the deepest level with more points than `leaf_max`: shaded as a cluster, never expanded.
    Overflow {
        /// First point.
        first: PointIndex,
        /// How many follow.
        count: u32,
    },
}

/// The cluster attributes of a node in plain numbers; [`NodeRecord::new`] packs them.
#[derive(Clone, Copy, Debug)]
pub struct NodeAttributes {
    /// See [`NodeRecord::centroid`].
    pub centroid: Vec3,
    /// See [`NodeRecord::axis_code`].
    pub axis: Vec3,
    /// Largest point radius over the voxel's edge.
    pub radius_ratio: f32,
    /// See [`NodeRecord::spread`].
    pub spread: f32,
    /// See [`NodeRecord::fill`].
    pub fill: f32,
    /// See [`NodeRecord::covariance`].
    pub covariance: [f32; 6],
    /// See [`NodeRecord::variation`].
    pub variation: f32,
    /// See [`NodeRecord::visible`].
    pub visible: Vec3,
    /// See [`NodeRecord::folds`].
    pub folds: [[f32; FOLD_TERMS]; 3],
    /// See [`NodeRecord::sh`], already normalised.
    pub sh: [[f16; 4]; SH_TERMS],
}

const LEVEL_MASK: u8 = 0x1f;
const LEAF_BIT: u8 = 0x20;
const OVERFLOW_BIT: u8 = 0x40;
/// Radius codes are eighths of an octave around 2^-16 .. 2^16.
const RADIUS_STEPS: f32 = 8.0;
const RADIUS_ONE: f32 = 128.0;
/// By code; looked up, because every node that is looked at asks.
static RADIUS_RATIOS: LazyLock<[f32; 256]> = LazyLock::new(|| {
    std::array::from_fn(|code| match code {
        0 => 0.0,
        code => ((code as f32 - RADIUS_ONE) / RADIUS_STEPS).exp2(),
    })
});
const FILL_STEPS: f32 = 64.0;
/// Of shares from 0 to 1.
const SHARE_STEPS: f32 = 255.0;

/// Numbers of one component of [`NodeRecord::folds`].
pub const FOLD_TERMS: usize = 5;
/// Bits of one of them: five fit a word.
const FOLD_BITS: u32 = 6;
/// The largest code stands for a quarter, which is more than folded sheets reach.
const FOLD_STEPS: f32 = 124.0;

fn pack_fold(terms: [f32; FOLD_TERMS]) -> u32 {
    let most = ((1 << (FOLD_BITS - 1)) - 1) as f32;
    let code = |term: f32| (term * FOLD_STEPS).round().clamp(-most, most) as i32 as u32 & ((1 << FOLD_BITS) - 1);
    terms.iter().rev().fold(0, |word, term| word << FOLD_BITS | code(*term))
}

#[inline]
fn unpack_fold(word: u32) -> [f32; FOLD_TERMS] {
    std::array::from_fn(|term| {
        // Shifted up and down again for its sign.
        let up = word << (u32::BITS - FOLD_BITS * (term as u32 + 1));
        (up as i32 >> (u32::BITS - FOLD_BITS)) as f32 * (1.0 / FOLD_STEPS)
    })
}

fn share_code(share: f32) -> u8 {
    (share.clamp(0.0, 1.0) * SHARE_STEPS).round() as u8
}

impl NodeRecord {
    /// Packs a node at `level`.
    ///
    /// # Panics
    /// If `level` exceeds [`MORTON_BITS`]: a mistake of the caller.
    pub fn new(level: u32, kind: NodeKind, attributes: &NodeAttributes) -> Self {
        assert!(level <= MORTON_BITS, "level {level} does not fit the record");
        let (first, span, bits) = match kind {
            NodeKind::Inner { first, mask } => (first.0, u32::from(mask), 0),
            NodeKind::Leaf { first, count } => (first.0, count, LEAF_BIT),
            NodeKind::Overflow { first, count } => (first.0, count, LEAF_BIT | OVERFLOW_BIT),
        };
        let radius_code = (attributes.radius_ratio.log2() * RADIUS_STEPS + RADIUS_ONE)
            .ceil()
            .clamp(0.0, 255.0) as u8;
        let mut covariance = [f16::ZERO; 6];
        covariance.convert_from_f32_slice(&attributes.covariance);
        Self {
            centroid: attributes.centroid.to_array(),
            first,
            span,
            axis_code: octahedral::encode(attributes.axis),
            level_and_kind: level as u8 | bits,
            radius_code,
            spread_code: share_code(attributes.spread),
            fill_code: (attributes.fill * FILL_STEPS).round().clamp(0.0, 255.0) as u8,
            covariance,
            sh: attributes.sh,
            variation_code: (attributes.variation * SHARE_STEPS).ceil() as u8,
            visible_codes: attributes.visible.to_array().map(share_code),
            fold_codes: attributes.folds.map(pack_fold),
        }
    }

    /// Level of the voxel, 0 for the root.
    #[inline]
    pub fn level(&self) -> u32 {
        u32::from(self.level_and_kind & LEVEL_MASK)
    }

    /// What lies below.
    #[inline]
    pub fn kind(&self) -> NodeKind {
        if self.level_and_kind & LEAF_BIT == 0 {
            NodeKind::Inner {
                first: NodeIndex(self.first),
                mask: self.span as u8,
            }
        } else if self.level_and_kind & OVERFLOW_BIT == 0 {
            NodeKind::Leaf {
                first: PointIndex(self.first),
                count: self.span,
            }
        } else {
            NodeKind::Overflow {
                first: PointIndex(self.first),
                count: self.span,
            }
        }
    }

    /// How normals go with places: the mean over the discs' areas of `(xx, yy, xy, xz, yz)` of a normal's outer product with
    /// itself, times x, y and z of the place relative to the centroid, over the voxel's edge. `zz` is minus the sum of `xx` and `yy`.
    #[inline]
    pub fn folds(&self) -> [[f32; FOLD_TERMS]; 3] {
        self.fold_codes.map(unpack_fold)
    }

    /// Replaces the first child of an inner node, when its children find their final place.
    pub fn set_first_child(&mut self, first: NodeIndex) {
        debug_assert!(self.level_and_kind & LEAF_BIT == 0, "a leaf has no children");
        self.first = first.0;
    }

    /// Axis that the discs face on average, unit.
    #[inline]
    pub fn axis(&self) -> Vec3 {
        octahedral::decode(self.axis_code)
    }

    /// Upper bound of the largest point radius over the voxel's edge: how far discs may stick out of the voxel.
    #[inline]
    pub fn radius_ratio(&self) -> f32 {
        RADIUS_RATIOS[usize::from(self.radius_code)]
    }

    /// Root mean square of the sine between the discs' normals and the axis: 0 for a flat cluster, 0.8 for a round one.
    #[inline]
    pub fn spread(&self) -> f32 {
        f32::from(self.spread_code) / SHARE_STEPS
    }

    /// Area of the discs over the area in which the cluster's plane cuts the voxel; 4 and more are 4, unknown is 0.
    #[inline]
    pub fn fill(&self) -> f32 {
        f32::from(self.fill_code) / FILL_STEPS
    }

    /// Share of the discs' projected area that no other disc of the cluster hides, seen along x, y and z.
    #[inline]
    pub fn visible(&self) -> Vec3 {
        Vec3::from(self.visible_codes.map(f32::from)) / SHARE_STEPS
    }

    /// Standard deviation of the radiance of a side, over all channels, over the mean of the brighter one, rounded up; 1 and
    /// more are 1.
    #[inline]
    pub fn variation(&self) -> f32 {
        f32::from(self.variation_code) / SHARE_STEPS
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn folds_come_back_to_half_a_step_and_large_ones_as_the_largest() {
        let folds = [0.125, -0.25, 0.0, 0.004, -0.1];
        for (given, found) in folds.iter().zip(unpack_fold(pack_fold(folds))) {
            assert!((given - found).abs() <= 0.5 / FOLD_STEPS, "{given} {found}");
        }
        assert_eq!(
            unpack_fold(pack_fold([9.0, -9.0, 0.25, 0.0, -0.25])),
            [0.25, -0.25, 0.25, 0.0, -0.25]
        );
    }
}
