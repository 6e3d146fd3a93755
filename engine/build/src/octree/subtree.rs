//! [`SubtreeBuilder`]: the nodes of whole subtrees from sorted points in memory, depth first along the Z-curve (paper
//! section 4.1). Many of them run at once, each on its own stretch of the curve.

use bytemuck::Zeroable;
use pbgi_core::limits::MORTON_BITS;
use pbgi_core::{BuildSettings, Quantizer};
use pbgi_core::{ClusterAccumulator, MortonCode, NodeIndex, NodeKind, NodeRecord, PointIndex, PointRecord, Voxel};

/// A finalized node that its parent has yet to place, and its sums.
#[derive(Clone, Debug)]
pub struct Subtree {
    /// The node. The place of its children, where it has any, is 0 until it is written.
    pub record: NodeRecord,
    /// What it sums up.
    pub sum: ClusterAccumulator,
}

/// What is counted while nodes are made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tallies {
    /// Nodes.
    pub nodes: u64,
    /// Harmonics that were clamped.
    pub harmonics_clamped: u64,
    /// Points in overflow leaves.
    pub overflow_points: u64,
}

impl Tallies {
    /// Adds those of another stretch.
    pub fn add(&mut self, other: &Self) {
        self.nodes += other.nodes;
        self.harmonics_clamped += other.harmonics_clamped;
        self.overflow_points += other.overflow_points;
    }
}

/// The children of one node.
#[derive(Clone, Copy, Debug)]
pub struct Siblings {
    /// Level of their parent.
    pub level: u8,
    /// How many.
    pub count: u8,
}

/// Nodes in the order in which their parents are finalized: what a write-out queue takes, whoever made it.
#[derive(Debug, Default)]
pub struct SubtreeNodes {
    /// Groups of siblings, one after the other.
    pub nodes: Vec<NodeRecord>,
    /// The groups that `nodes` consists of.
    pub groups: Vec<Siblings>,
    /// Counted on the way.
    pub tallies: Tallies,
}

impl SubtreeNodes {
    /// Forgets the nodes, keeps the memory.
    pub fn clear(&mut self) {
        self.nodes.clear();
        self.groups.clear();
        self.tallies = Tallies::default();
    }
}

/// Makes nodes of one stretch of sorted points.
pub struct SubtreeBuilder<'a> {
    /// Morton codes, never falling.
    pub codes: &'a [u64],
    /// The points that they belong to.
    pub points: &'a [PointRecord],
    /// Index of the first of them in the scene.
    pub first_point: u64,
    /// The lattice.
    pub quantizer: &'a Quantizer,
    /// Most points in a leaf above the deepest level.
    pub leaf_max: usize,
    /// Where the nodes go.
    pub out: &'a mut SubtreeNodes,
}

impl SubtreeBuilder<'_> {
    /// Makes the node of `voxel`, which holds exactly the points `from..to`, at least one, and everything below it.
    pub fn subtree(&mut self, voxel: Voxel, from: usize, to: usize) -> Subtree {
        if to - from <= self.leaf_max || voxel.level == MORTON_BITS {
            self.leaf(voxel, from, to)
        } else {
            self.inner(voxel, from, to)
        }
    }

    fn inner(&mut self, voxel: Voxel, from: usize, to: usize) -> Subtree {
        let mut siblings = [NodeRecord::zeroed(); 8];
        let (mut count, mut mask, mut start) = (0, 0u8, from);
        let mut sum = ClusterAccumulator::default();
        for octant in 0..8 {
            let child = voxel.child(octant);
            let end = start + count_in(&self.codes[start..to], child);
            if end > start {
                let made = self.subtree(child, start, end);
                sum.merge(octant, &made.sum);
                siblings[count] = made.record;
                count += 1;
                mask |= 1 << octant;
                start = end;
            }
        }
        debug_assert_eq!(start, to, "every point has its child");
        self.out.nodes.extend_from_slice(&siblings[..count]);
        self.out.groups.push(Siblings {
            level: voxel.level as u8,
            count: count as u8,
        });
        let first = NodeIndex(0);
        finalize(
            voxel,
            NodeKind::Inner { first, mask },
            sum,
            self.quantizer,
            &mut self.out.tallies,
        )
    }

    fn leaf(&mut self, voxel: Voxel, from: usize, to: usize) -> Subtree {
        let mut sum = ClusterAccumulator::default();
        for point in &self.points[from..to] {
            sum.add(point, self.quantizer);
        }
        let first = PointIndex((self.first_point + from as u64) as u32);
        finalize_leaf(voxel, first, sum, self.leaf_max, self.quantizer, &mut self.out.tallies)
    }
}

/// How many of the sorted codes lie in `voxel`, counted from the front.
#[inline]
pub(crate) fn count_in(codes: &[u64], voxel: Voxel) -> usize {
    let inside = |code: &u64| voxel.contains(MortonCode(*code));
    // Children are short or share the range about evenly: double up to the end, then halve.
    let mut reach = 1;
    while reach < codes.len() && inside(&codes[reach]) {
        reach *= 2;
    }
    let reach = (reach + 1).min(codes.len());
    let sure = reach / 2;
    match codes.first() {
        Some(first) if inside(first) => sure + codes[sure..reach].partition_point(inside),
        _ => 0,
    }
}

/// Ends a leaf: an overflow leaf if it holds more than `leaf_max`.
pub(crate) fn finalize_leaf(
    voxel: Voxel,
    first: PointIndex,
    sum: ClusterAccumulator,
    leaf_max: usize,
    quantizer: &Quantizer,
    tallies: &mut Tallies,
) -> Subtree {
    let count = sum.point_count();
    let kind = if count > leaf_max as u64 {
        tallies.overflow_points += count;
        NodeKind::Overflow {
            first,
            count: count as u32,
        }
    } else {
        NodeKind::Leaf {
            first,
            count: count as u32,
        }
    };
    finalize(voxel, kind, sum, quantizer, tallies)
}

/// Turns sums into a node (the paper's finalizing).
pub(crate) fn finalize(
    voxel: Voxel,
    kind: NodeKind,
    mut sum: ClusterAccumulator,
    quantizer: &Quantizer,
    tallies: &mut Tallies,
) -> Subtree {
    let cluster = sum.finalize(voxel, quantizer);
    tallies.nodes += 1;
    tallies.harmonics_clamped += u64::from(cluster.clamped);
    Subtree {
        record: NodeRecord::new(voxel.level, kind, &cluster.attributes),
        sum,
    }
}

/// Most nodes that `points` points can make, whatever their places: on each level every inner node holds more than
/// `leaf_max` of them, and every leaf at least one.
pub(crate) fn nodes_max(points: usize, settings: &BuildSettings) -> usize {
    MORTON_BITS as usize * (points / (settings.leaf_max as usize + 1)) + points
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_in_a_voxel_are_counted_for_any_length() {
        let voxel = Voxel::ROOT.child(0).child(3);
        let last = 4 << (3 * (MORTON_BITS - 2));
        for inside in 0..70u64 {
            for outside in 0..3 {
                let mut codes: Vec<u64> = (0..inside).map(|i| last - 70 + i).collect();
                codes.extend((0..outside).map(|i| last + i));
                assert_eq!(count_in(&codes, voxel), inside as usize, "{inside} of {}", codes.len());
            }
        }
    }
}
