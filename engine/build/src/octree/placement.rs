//! [`Placement`]: gives finished nodes their places and writes them, in one order whoever made them (paper section 4.2).

use crate::error::BuildError;
use crate::octree::subtree::{Subtree, SubtreeNodes, Tallies, finalize};
use crate::octree::write_out::WriteOutQueue;
use bytemuck::Zeroable;
use pbgi_core::limits::MORTON_BITS;
use pbgi_core::{BuildSettings, ClusterAccumulator, NodeIndex, NodeKind, NodeRecord, PointRecord, Quantizer, Voxel};
use pbgi_store::SceneWriter;

/// The writing end of a construction.
pub struct Placement<'a> {
    writer: &'a mut SceneWriter,
    quantizer: &'a Quantizer,
    chunk_levels: u32,
    /// One for each level that owns chunks; the open path of the tree has at most one node of each.
    queues: Vec<WriteOutQueue>,
    /// For each level, where the children of its nodes went whose parents have yet to be handed over, in order: at most
    /// eight.
    placed: Vec<Vec<NodeIndex>>,
    /// Finished nodes whose parents are still open.
    open: Vec<Subtree>,
    records_max: u64,
    /// Counted for nodes that were finalized here.
    tallies: Tallies,
    queue_peak_bytes: u64,
}

/// What was written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Placed {
    /// The root; `None` if there were no points.
    pub root: Option<NodeIndex>,
    /// Counted on the way.
    pub tallies: Tallies,
    /// Most bytes that all write-out queues held at once.
    pub queue_peak_bytes: u64,
}

impl<'a> Placement<'a> {
    /// Starts an empty tree; `records_max` bounds node slots.
    pub fn new(
        writer: &'a mut SceneWriter,
        quantizer: &'a Quantizer,
        settings: &BuildSettings,
        records_max: u64,
    ) -> Self {
        let queue_count = MORTON_BITS
            .checked_div(settings.chunk_levels)
            .map_or(0, |count| count + 1);
        Self {
            writer,
            quantizer,
            chunk_levels: settings.chunk_levels,
            queues: (0..queue_count)
                .map(|_| WriteOutQueue::new(settings.chunk_levels))
                .collect(),
            placed: vec![Vec::new(); MORTON_BITS as usize + 1],
            open: Vec::new(),
            records_max,
            tallies: Tallies::default(),
            queue_peak_bytes: 0,
        }
    }

    /// Appends the next points.
    ///
    /// # Errors
    /// Those of the writer.
    pub fn points(&mut self, points: &[PointRecord]) -> Result<(), BuildError> {
        self.writer.append_points(points)?;
        Ok(())
    }

    /// Takes the nodes below the next subtree: `groups` groups from `from` on. Returns where the next one starts.
    ///
    /// # Errors
    /// [`BuildError::Limit`] before an index would wrap; those of the writer.
    pub fn nodes(
        &mut self,
        made: &mut SubtreeNodes,
        groups: std::ops::Range<usize>,
        from: usize,
    ) -> Result<usize, BuildError> {
        let mut start = from;
        for group in groups {
            let siblings = made.groups[group];
            let end = start + usize::from(siblings.count);
            self.hand_over(u32::from(siblings.level), &mut made.nodes[start..end])?;
            start = end;
        }
        Ok(start)
    }

    /// Takes a node whose parent is still open.
    pub fn push(&mut self, subtree: Subtree) {
        self.open.push(subtree);
    }

    /// Counts what others finalized.
    pub fn count(&mut self, tallies: &Tallies) {
        self.tallies.add(tallies);
    }

    /// Makes the node of `voxel`, whose children are the last ones pushed, one for each bit of `mask`.
    ///
    /// # Errors
    /// As [`Self::nodes`].
    pub fn close(&mut self, voxel: Voxel, mask: u8) -> Result<(), BuildError> {
        let count = mask.count_ones() as usize;
        let children = self.open.split_off(self.open.len() - count);
        let mut siblings = [NodeRecord::zeroed(); 8];
        let mut sum = ClusterAccumulator::default();
        let octants = (0..8).filter(|octant| mask >> octant & 1 == 1);
        for ((sibling, child), octant) in siblings.iter_mut().zip(&children).zip(octants) {
            sum.merge(octant, &child.sum);
            *sibling = child.record;
        }
        self.hand_over(voxel.level, &mut siblings[..count])?;
        let first = NodeIndex(0);
        let node = finalize(
            voxel,
            NodeKind::Inner { first, mask },
            sum,
            self.quantizer,
            &mut self.tallies,
        );
        self.open.push(node);
        Ok(())
    }

    /// Writes the root.
    ///
    /// # Errors
    /// As [`Self::nodes`].
    pub fn finish(mut self) -> Result<Placed, BuildError> {
        debug_assert!(self.open.len() <= 1, "every node but the root has its parent");
        let root = match self.open.pop() {
            Some(root) => {
                let mut root = [root.record];
                self.adopt(&mut root, 0);
                Some(self.write_siblings(&root)?)
            }
            None => None,
        };
        Ok(Placed {
            root,
            tallies: self.tallies,
            queue_peak_bytes: self.queue_peak_bytes,
        })
    }

    /// Tells nodes of `level` where their children are, as far as that is known: the rest is told by the queue.
    fn adopt(&mut self, nodes: &mut [NodeRecord], level: u32) {
        let known = &mut self.placed[level as usize];
        if known.is_empty() {
            return;
        }
        let inner = nodes
            .iter_mut()
            .filter(|node| matches!(node.kind(), NodeKind::Inner { .. }));
        let mut places = known.drain(..);
        for node in inner {
            if let Some(place) = places.next() {
                node.set_first_child(place);
            }
        }
        debug_assert!(places.next().is_none(), "every place has its parent");
    }

    /// Puts the children of a node of `level` where they belong.
    fn hand_over(&mut self, level: u32, siblings: &mut [NodeRecord]) -> Result<(), BuildError> {
        if level < MORTON_BITS {
            self.adopt(siblings, level + 1);
        }
        let place = match level.checked_rem(self.chunk_levels) {
            None => self.write_siblings(siblings)?,
            Some(below_owner) => {
                let queue = (level / self.chunk_levels) as usize;
                self.queues[queue].push(below_owner as usize, siblings);
                if below_owner > 0 {
                    return Ok(());
                }
                self.write_chunk(queue)?
            }
        };
        self.placed[level as usize].push(place);
        Ok(())
    }

    /// Writes a queue; returns the place of its owner's children.
    fn write_chunk(&mut self, queue: usize) -> Result<NodeIndex, BuildError> {
        let held: u64 = self.queues.iter().map(WriteOutQueue::bytes).sum();
        self.queue_peak_bytes = self.queue_peak_bytes.max(held);
        let queue = &mut self.queues[queue];
        let (first, end) = queue.place(self.writer.node_layout(), self.writer.node_slots());
        check_limit(end, self.records_max)?;
        for group in queue.groups() {
            self.writer.append_siblings(group)?;
        }
        debug_assert_eq!(self.writer.node_slots(), end, "the file is as it was placed");
        queue.clear();
        Ok(NodeIndex(first as u32))
    }

    fn write_siblings(&mut self, siblings: &[NodeRecord]) -> Result<NodeIndex, BuildError> {
        let layout = self.writer.node_layout();
        let first = layout.group_slot(self.writer.node_slots(), siblings.len());
        check_limit(first + siblings.len() as u64, self.records_max)?;
        Ok(self.writer.append_siblings(siblings)?)
    }
}

fn check_limit(slots: u64, max: u64) -> Result<(), BuildError> {
    if slots > max {
        return Err(BuildError::Limit { what: "nodes", max });
    }
    Ok(())
}
