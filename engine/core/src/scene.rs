//! What a reader must know of a built octree before its first page.

use crate::bounds::Bounds;
use crate::ids::{BuildId, NodeIndex, PageKind};
use crate::morton::Quantizer;
use crate::node::NodeRecord;
use crate::point::PointRecord;
use crate::settings::BuildSettings;
use serde::{Deserialize, Serialize};

/// Description of a built octree: counts, lattice and page layout.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SceneInfo {
    /// Identity of the content.
    pub build_id: BuildId,
    /// Points.
    pub point_count: u64,
    /// Nodes, padding slots not counted.
    pub node_count: u64,
    /// Record slots in the node file, padding included; the number of pages follows from it.
    pub node_slots: u64,
    /// The root; `None` for a scene without points.
    pub root: Option<NodeIndex>,
    /// Tight box around the points; `None` for a scene without points.
    pub bounds: Option<Bounds>,
    /// Lattice of the Morton codes; `None` for a scene without points.
    pub quantizer: Option<Quantizer>,
    /// Largest point radius, world units.
    pub radius_max: f32,
    /// What was subtracted from the coordinates of the files, in their own axes, to make positions.
    pub origin: [f64; 3],
    /// Layout and construction settings.
    pub settings: BuildSettings,
}

impl SceneInfo {
    /// Bytes of one page.
    pub fn page_bytes(&self, kind: PageKind) -> usize {
        match kind {
            PageKind::Node => self.settings.nodes_per_page as usize * size_of::<NodeRecord>(),
            PageKind::Point => self.settings.points_per_page as usize * size_of::<PointRecord>(),
        }
    }

    /// Pages of one file.
    pub fn page_count(&self, kind: PageKind) -> u64 {
        match kind {
            PageKind::Node => self.node_slots.div_ceil(u64::from(self.settings.nodes_per_page)),
            PageKind::Point => self.point_count.div_ceil(u64::from(self.settings.points_per_page)),
        }
    }

    /// Bytes of all pages of both files: the paper's "out-of-core data".
    pub fn out_of_core_bytes(&self) -> u64 {
        [PageKind::Node, PageKind::Point]
            .iter()
            .map(|&kind| self.page_count(kind) * self.page_bytes(kind) as u64)
            .sum()
    }
}
