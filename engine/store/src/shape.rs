//! [`SceneShape`]: how deep a tree is and how full its leaves are.

use crate::error::StoreError;
use crate::scene::Scene;
use bytemuck::Zeroable;
use pbgi_core::limits::MORTON_BITS;
use pbgi_core::{NodeKind, NodeRecord, PageKind, PageNo};

/// Bins of [`SceneShape::occupancy`].
pub const OCCUPANCY_BINS: usize = 8;

/// What a tree looks like, counted over all its nodes.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SceneShape {
    /// One for each level from the root to the deepest node.
    pub levels: Vec<LevelShape>,
    /// Leaves by how full they are, in eighths of `leaf_max`; overflow leaves are not among them.
    pub occupancy: [u64; OCCUPANCY_BINS],
}

/// The nodes of one level.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LevelShape {
    /// Nodes with children.
    pub inner: u64,
    /// Nodes with points, overflow leaves included.
    pub leaves: u64,
    /// Points in them.
    pub points: u64,
}

impl Scene {
    /// Looks at every node.
    ///
    /// # Errors
    /// As [`Self::read_page`]; [`StoreError::Corrupt`] for a node of an impossible level.
    pub fn shape(&self) -> Result<SceneShape, StoreError> {
        let info = self.info();
        let mut shape = SceneShape::default();
        let mut page = vec![NodeRecord::zeroed(); info.settings.nodes_per_page as usize];
        for number in 0..info.page_count(PageKind::Node) {
            self.read_page(
                PageKind::Node,
                PageNo(number as u32),
                bytemuck::cast_slice_mut(&mut page),
            )?;
            for node in &page {
                shape.add(node, info.settings.leaf_max).map_err(|level| {
                    let place = format!("node page {number}");
                    StoreError::corrupt(self.path(), place, format!("levels up to {MORTON_BITS}"), level)
                })?;
            }
        }
        Ok(shape)
    }
}

impl SceneShape {
    /// Counts a node; its level, if there is none such.
    fn add(&mut self, node: &NodeRecord, leaf_max: u32) -> Result<(), u32> {
        let level = node.level();
        if level > MORTON_BITS {
            return Err(level);
        }
        // Slots between groups and behind the root are empty.
        if matches!(node.kind(), NodeKind::Inner { mask: 0, .. }) {
            return Ok(());
        }
        if self.levels.len() <= level as usize {
            self.levels.resize(level as usize + 1, LevelShape::default());
        }
        let place = &mut self.levels[level as usize];
        match node.kind() {
            NodeKind::Inner { .. } => place.inner += 1,
            NodeKind::Leaf { count, .. } => {
                place.leaves += 1;
                place.points += u64::from(count);
                let full = u64::from(count.saturating_sub(1)) * OCCUPANCY_BINS as u64 / u64::from(leaf_max.max(1));
                self.occupancy[(full as usize).min(OCCUPANCY_BINS - 1)] += 1;
            }
            NodeKind::Overflow { count, .. } => {
                place.leaves += 1;
                place.points += u64::from(count);
            }
        }
        Ok(())
    }
}
