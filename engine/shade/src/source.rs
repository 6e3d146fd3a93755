//! Where the shading code gets nodes and points from: an index in, a slice of a page out.

use pbgi_core::{NodeIndex, NodeRecord, PointIndex, PointRecord};

/// Pages of a scene, behind whatever caches there are. Slices are valid until the next call, so that a cache of a single
/// page is enough.
pub trait SceneSource {
    /// The node at an index, for some receivers of the pack that is being shaded, one bit each.
    ///
    /// # Errors
    /// The index is out of range, or its page cannot be had.
    fn node(&mut self, index: NodeIndex, receivers: u8) -> Result<&NodeRecord, SourceError>;

    /// The points from `first` on, for some receivers: at least one, at most `count`, cut where their page ends.
    ///
    /// # Errors
    /// The range is out of bounds, or its page cannot be had.
    fn points(&mut self, first: PointIndex, count: u32, receivers: u8) -> Result<&[PointRecord], SourceError>;

    /// A walk is about to look at the siblings from `first` on, one for each bit of `mask`: a hint, for a source that has
    /// to fetch pages.
    #[inline]
    fn expect(&mut self, first: NodeIndex, mask: u8) {
        let _ = (first, mask);
    }

    /// Another pack of receivers begins: what is counted per receiver starts anew.
    fn begin_pack(&mut self) {}
}

/// Why a page did not come.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum SourceError {
    /// The scene contradicts itself or its checksums.
    #[error("scene is corrupt: {0}")]
    Corrupt(String),
    /// The page could not be read.
    #[error("page cannot be read: {0}")]
    Io(String),
}

/// A scene that lies in memory as plain arrays.
#[derive(Clone, Debug, Default)]
pub struct ArraySource {
    /// Nodes by index.
    pub nodes: Vec<NodeRecord>,
    /// Points by index.
    pub points: Vec<PointRecord>,
}

impl SceneSource for ArraySource {
    #[inline]
    fn node(&mut self, index: NodeIndex, _receivers: u8) -> Result<&NodeRecord, SourceError> {
        let missing = || SourceError::Corrupt(format!("node {} of {}", index.0, self.nodes.len()));
        self.nodes.get(index.0 as usize).ok_or_else(missing)
    }

    #[inline]
    fn points(&mut self, first: PointIndex, count: u32, _receivers: u8) -> Result<&[PointRecord], SourceError> {
        let missing = || SourceError::Corrupt(format!("points {} + {count} of {}", first.0, self.points.len()));
        let start = first.0 as usize;
        self.points
            .get(start..start + count as usize)
            .filter(|slice| !slice.is_empty())
            .ok_or_else(missing)
    }
}
