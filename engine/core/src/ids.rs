//! Newtypes for every index and key, so that a page number and a node index cannot be mixed up.

use serde::{Deserialize, Serialize};
use std::fmt;

/// Position of a node in the node file, counted in records from its first page (padding slots included).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct NodeIndex(pub u32);

/// Position of a point in the point file, counted in records.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct PointIndex(pub u32);

/// Number of a page within its file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct PageNo(pub u32);

impl NodeIndex {
    /// The page that holds this node, and the node's slot there.
    #[inline]
    pub fn page(self, nodes_per_page: u32) -> (PageNo, usize) {
        (PageNo(self.0 / nodes_per_page), (self.0 % nodes_per_page) as usize)
    }
}

impl PointIndex {
    /// The page that holds this point, and the point's slot there.
    #[inline]
    pub fn page(self, points_per_page: u32) -> (PageNo, usize) {
        (PageNo(self.0 / points_per_page), (self.0 % points_per_page) as usize)
    }
}

/// Which of a scene's two files a page belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum PageKind {
    /// A page of octree nodes.
    Node,
    /// A page of points.
    Point,
}

impl fmt::Display for PageKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Node => "node",
            Self::Point => "point",
        })
    }
}

/// Identity of an octree's content: equal inputs and settings give equal ids.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct BuildId(pub u128);

impl fmt::Display for BuildId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:032x}", self.0)
    }
}

impl From<BuildId> for String {
    fn from(id: BuildId) -> Self {
        id.to_string()
    }
}

impl TryFrom<String> for BuildId {
    type Error = std::num::ParseIntError;

    fn try_from(text: String) -> Result<Self, Self::Error> {
        u128::from_str_radix(&text, 16).map(Self)
    }
}

/// An open, verified scene in the daemon: a seat, and a generation that changes whenever the seat is taken anew, so that a
/// page of a scene that was closed never passes for a page of its successor.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct MountId {
    /// Seat, below [`crate::limits::MOUNTS_MAX`].
    pub slot: u8,
    /// How often the seat was taken.
    pub generation: u16,
}

/// What the page cache is keyed by.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct PageKey {
    /// The scene.
    pub mount: MountId,
    /// Which of its files.
    pub kind: PageKind,
    /// Which page of that file.
    pub page: PageNo,
}
