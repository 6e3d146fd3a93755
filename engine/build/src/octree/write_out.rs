//! [`WriteOutQueue`]: the nodes of one chunk, kept until the node that owns it is finalized, then written level by
//! level.

use pbgi_core::{NodeIndex, NodeKind, NodeRecord};
use pbgi_store::PageLayout;

/// Sibling groups of the levels below the owner, each level in the order of the Z-curve.
#[derive(Debug, Default)]
pub struct WriteOutQueue {
    levels: Vec<QueueLevel>,
}

#[derive(Debug, Default)]
struct QueueLevel {
    nodes: Vec<NodeRecord>,
    /// Sizes of the sibling groups that `nodes` consists of.
    groups: Vec<u8>,
}

impl QueueLevel {
    fn groups(&self) -> impl Iterator<Item = &[NodeRecord]> {
        let mut rest = self.nodes.as_slice();
        self.groups.iter().map(move |&size| {
            let (group, tail) = rest.split_at(usize::from(size));
            rest = tail;
            group
        })
    }
}

impl WriteOutQueue {
    /// A queue for `levels` levels below its owner.
    pub fn new(levels: u32) -> Self {
        Self {
            levels: (0..levels).map(|_| QueueLevel::default()).collect(),
        }
    }

    /// Takes the children of one node, `level` levels below the owner, counted from 0 for its own children. Parents are
    /// pushed in the same order, so the k-th group of a level belongs to the k-th inner node of the level above.
    pub fn push(&mut self, level: usize, group: &[NodeRecord]) {
        let level = &mut self.levels[level];
        level.nodes.extend_from_slice(group);
        level.groups.push(group.len() as u8);
    }

    /// Gives every group its place in a file that holds `slots` slots so far, and every node the place of its children.
    /// Children of the last level have been written before and keep theirs. Returns the place of the owner's children,
    /// and the slots then taken.
    pub fn place(&mut self, layout: &PageLayout, slots: u64) -> (u64, u64) {
        let mut end = slots;
        let mut owner_children = slots;
        for index in 0..self.levels.len() {
            let (above, below) = self.levels.split_at_mut(index);
            let mut parents = above
                .last_mut()
                .into_iter()
                .flat_map(|level| inner_nodes(&mut level.nodes));
            for &size in &below[0].groups {
                let first = layout.group_slot(end, usize::from(size));
                end = first + u64::from(size);
                if index == 0 {
                    owner_children = first;
                } else if let Some(parent) = parents.next() {
                    // Whoever places checks that `end` is an index.
                    parent.set_first_child(NodeIndex(first as u32));
                }
            }
            debug_assert!(parents.next().is_none(), "every inner node has its group");
        }
        (owner_children, end)
    }

    /// The groups in the order of the file.
    pub fn groups(&self) -> impl Iterator<Item = &[NodeRecord]> {
        self.levels.iter().flat_map(QueueLevel::groups)
    }

    /// Bytes of the nodes in it.
    pub fn bytes(&self) -> u64 {
        let nodes: usize = self.levels.iter().map(|level| level.nodes.len()).sum();
        (nodes * size_of::<NodeRecord>()) as u64
    }

    /// Forgets the nodes, keeps the memory.
    pub fn clear(&mut self) {
        for level in &mut self.levels {
            level.nodes.clear();
            level.groups.clear();
        }
    }
}

fn inner_nodes(nodes: &mut [NodeRecord]) -> impl Iterator<Item = &mut NodeRecord> {
    nodes
        .iter_mut()
        .filter(|node| matches!(node.kind(), NodeKind::Inner { .. }))
}
