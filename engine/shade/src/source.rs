//! Where the shading code gets nodes and points from: an index in, a slice of a page out.

use pbgi_core::{NodeIndex, NodeKind, NodeRecord, PointIndex, PointRecord};
use std::ops::ControlFlow;

/// Pages of a scene, behind whatever caches there are. Slices are valid until the next call, so that a cache of a single
/// page is enough.
pub trait SceneSource {
    /// The node at an index, for some receivers of the pack that is being shaded, one bit each. `upcoming` is asked if its page has
    /// to be fetched.
    ///
    /// # Errors
    /// The index is out of range, or its page cannot be had.
    fn node(&mut self, index: NodeIndex, receivers: u8, upcoming: &impl Upcoming) -> Result<&NodeRecord, SourceError>;

    /// The points from `first` on, for some receivers: at least one, at most `count`, cut where their page ends. `upcoming` as for
    /// [`Self::node`].
    ///
    /// # Errors
    /// The range is out of bounds, or its page cannot be had.
    fn points(
        &mut self,
        first: PointIndex,
        count: u32,
        receivers: u8,
        upcoming: &impl Upcoming,
    ) -> Result<&[PointRecord], SourceError>;

    /// Another pack of receivers begins: what is counted per receiver starts anew.
    fn begin_pack(&mut self) {}
}

/// What a walk will probably look at next: a source that has to fetch a page asks, and fetches others with it. `()` tells
/// nothing.
pub trait Upcoming {
    /// Tells `want`, soonest first, until that breaks off. Of a node that `peek` has at hand, what it leads to is told.
    fn tell<'a>(
        &self,
        peek: impl Fn(NodeIndex) -> Option<&'a NodeRecord>,
        want: impl FnMut(Wanted) -> ControlFlow<()>,
    ) -> ControlFlow<()>;
}

/// What a walk wants to look at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wanted {
    /// A node, the first of its siblings.
    Node(NodeIndex),
    /// Points of a leaf, the first of them.
    Points(PointIndex),
}

impl Wanted {
    /// Where an opened node leads; `None` at the bottom.
    pub(crate) fn below(node: &NodeRecord) -> Option<Self> {
        match node.kind() {
            NodeKind::Inner { first, .. } => Some(Self::Node(first)),
            NodeKind::Leaf { first, .. } => Some(Self::Points(first)),
            NodeKind::Overflow { .. } => None,
        }
    }
}

impl Upcoming for () {
    fn tell<'a>(
        &self,
        _peek: impl Fn(NodeIndex) -> Option<&'a NodeRecord>,
        _want: impl FnMut(Wanted) -> ControlFlow<()>,
    ) -> ControlFlow<()> {
        ControlFlow::Continue(())
    }
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

/// A scene that lies in memory as plain arrays, its own or borrowed.
#[derive(Clone, Debug, Default)]
pub struct ArraySource<N = Vec<NodeRecord>, P = Vec<PointRecord>> {
    /// Nodes by index.
    pub nodes: N,
    /// Points by index.
    pub points: P,
}

impl<N: AsRef<[NodeRecord]>, P: AsRef<[PointRecord]>> SceneSource for ArraySource<N, P> {
    #[inline]
    fn node(&mut self, index: NodeIndex, _: u8, _: &impl Upcoming) -> Result<&NodeRecord, SourceError> {
        let nodes = self.nodes.as_ref();
        let missing = || SourceError::Corrupt(format!("node {} of {}", index.0, nodes.len()));
        nodes.get(index.0 as usize).ok_or_else(missing)
    }

    #[inline]
    fn points(
        &mut self,
        first: PointIndex,
        count: u32,
        _: u8,
        _: &impl Upcoming,
    ) -> Result<&[PointRecord], SourceError> {
        let points = self.points.as_ref();
        let missing = || SourceError::Corrupt(format!("points {} + {count} of {}", first.0, points.len()));
        let start = first.0 as usize;
        points
            .get(start..start + count as usize)
            .filter(|slice| !slice.is_empty())
            .ok_or_else(missing)
    }
}
