//! [`construct`]: the depth-first traversal that makes nodes of sorted points (algorithm of paper sections 4.1 and
//! 4.2).

use crate::error::BuildError;
use crate::octree::window::{BatchSource, PointWindow};
use crate::octree::write_out::WriteOutQueue;
use bytemuck::Zeroable;
use pbgi_core::limits::MORTON_BITS;
use pbgi_core::{BuildSettings, ClusterAccumulator, NodeIndex, NodeKind, NodeRecord, PointIndex, Quantizer, Voxel};
use pbgi_store::SceneWriter;

/// What construction made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Constructed {
    /// The root; `None` if there were no points.
    pub root: Option<NodeIndex>,
    /// Nodes.
    pub node_count: u64,
    /// Harmonics that were clamped.
    pub harmonics_clamped: u64,
    /// Points in overflow leaves.
    pub overflow_points: u64,
}

/// Makes the octree of all points of `source` and writes it; `records_max` bounds points and node slots.
///
/// # Errors
/// Those of `source` and of the writer; [`BuildError::Limit`] before an index would wrap.
pub fn construct(
    source: &mut BatchSource<'_>,
    writer: &mut SceneWriter,
    quantizer: &Quantizer,
    settings: &BuildSettings,
    records_max: u64,
) -> Result<Constructed, BuildError> {
    let queue_count = MORTON_BITS
        .checked_div(settings.chunk_levels)
        .map_or(0, |count| count + 1);
    let mut construction = Construction {
        window: PointWindow::new(source, settings.leaf_max)?,
        writer,
        quantizer,
        leaf_max: u64::from(settings.leaf_max),
        chunk_levels: settings.chunk_levels,
        queues: (0..queue_count)
            .map(|_| WriteOutQueue::new(settings.chunk_levels))
            .collect(),
        records_max,
        made: Constructed::default(),
    };
    if let Some(root) = construction.subtree(Voxel::ROOT)? {
        construction.made.root = Some(construction.write_siblings(&[root.record])?);
    }
    Ok(construction.made)
}

struct Construction<'a> {
    window: PointWindow<'a>,
    writer: &'a mut SceneWriter,
    quantizer: &'a Quantizer,
    leaf_max: u64,
    chunk_levels: u32,
    /// One for each level that owns chunks; the open path of the tree has at most one node of each.
    queues: Vec<WriteOutQueue>,
    records_max: u64,
    made: Constructed,
}

/// A finalized node that its parent has yet to place, and its sums.
struct Subtree {
    record: NodeRecord,
    sum: ClusterAccumulator,
}

impl Construction<'_> {
    /// Makes the node of `voxel` and everything below it; `None` if it holds no points.
    fn subtree(&mut self, voxel: Voxel) -> Result<Option<Subtree>, BuildError> {
        if !self.window.front_in(voxel) {
            return Ok(None);
        }
        if voxel.level < MORTON_BITS && self.window.overflows(voxel) {
            self.inner(voxel).map(Some)
        } else {
            self.leaf(voxel).map(Some)
        }
    }

    fn inner(&mut self, voxel: Voxel) -> Result<Subtree, BuildError> {
        let mut siblings = [NodeRecord::zeroed(); 8];
        let (mut count, mut mask) = (0, 0u8);
        let mut sum = ClusterAccumulator::default();
        for octant in 0..8 {
            if let Some(child) = self.subtree(voxel.child(octant))? {
                sum.merge(&child.sum);
                siblings[count] = child.record;
                count += 1;
                mask |= 1 << octant;
            }
        }
        let first = self.hand_over(voxel.level, &siblings[..count])?;
        Ok(self.finalize(voxel, NodeKind::Inner { first, mask }, sum))
    }

    /// Puts the children of a node of `level` where they belong. A place that is not known yet is 0.
    fn hand_over(&mut self, level: u32, siblings: &[NodeRecord]) -> Result<NodeIndex, BuildError> {
        if self.chunk_levels == 0 {
            return self.write_siblings(siblings);
        }
        let (queue, below_owner) = (level / self.chunk_levels, level % self.chunk_levels);
        self.queues[queue as usize].push(below_owner as usize, siblings);
        if below_owner == 0 {
            self.write_chunk(queue as usize)
        } else {
            Ok(NodeIndex(0))
        }
    }

    /// Writes a queue; returns the place of its owner's children.
    fn write_chunk(&mut self, queue: usize) -> Result<NodeIndex, BuildError> {
        let queue = &mut self.queues[queue];
        let (first, end) = queue.place(self.writer.node_layout(), self.writer.node_slots());
        check_limit("nodes", end, self.records_max)?;
        for group in queue.groups() {
            self.writer.append_siblings(group)?;
        }
        debug_assert_eq!(self.writer.node_slots(), end, "the file is as it was placed");
        queue.clear();
        Ok(NodeIndex(first as u32))
    }

    fn write_siblings(&mut self, siblings: &[NodeRecord]) -> Result<NodeIndex, BuildError> {
        let first = self
            .writer
            .node_layout()
            .group_slot(self.writer.node_slots(), siblings.len());
        check_limit("nodes", first + siblings.len() as u64, self.records_max)?;
        Ok(self.writer.append_siblings(siblings)?)
    }

    /// A leaf; at the deepest level it takes any number of points, streaming.
    fn leaf(&mut self, voxel: Voxel) -> Result<Subtree, BuildError> {
        let first = PointIndex(self.writer.point_count() as u32);
        let mut sum = ClusterAccumulator::default();
        loop {
            let points = self.window.leaf(voxel);
            let count = points.len();
            for point in points {
                sum.add(point, self.quantizer);
            }
            check_limit("points", self.writer.point_count() + count as u64, self.records_max)?;
            self.writer.append_points(points)?;
            self.window.advance(count)?;
            if !self.window.front_in(voxel) {
                break;
            }
        }
        let count = sum.point_count();
        let kind = if count > self.leaf_max {
            self.made.overflow_points += count;
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
        Ok(self.finalize(voxel, kind, sum))
    }

    fn finalize(&mut self, voxel: Voxel, kind: NodeKind, sum: ClusterAccumulator) -> Subtree {
        let cluster = sum.finalize(voxel, self.quantizer);
        self.made.node_count += 1;
        self.made.harmonics_clamped += u64::from(cluster.clamped);
        Subtree {
            record: NodeRecord::new(voxel.level, kind, &cluster.attributes),
            sum,
        }
    }
}

fn check_limit(what: &'static str, count: u64, max: u64) -> Result<(), BuildError> {
    if count > max {
        return Err(BuildError::Limit { what, max });
    }
    Ok(())
}
