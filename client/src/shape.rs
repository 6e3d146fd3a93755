//! What a tree looks like, as the daemon tells it.

use pbgi_proto::v1;
use serde::Serialize;

/// Counts over all nodes of a scene.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct SceneShape {
    /// One for each level from the root to the deepest node.
    pub levels: Vec<LevelShape>,
    /// Leaves by how full they are, in equal steps up to the most points of a leaf; overflow leaves are not among them.
    pub occupancy: Vec<u64>,
}

/// The nodes of one level.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct LevelShape {
    /// Nodes with children.
    pub inner: u64,
    /// Nodes with points.
    pub leaves: u64,
    /// Points in them.
    pub points: u64,
}

impl From<v1::SceneShape> for SceneShape {
    fn from(shape: v1::SceneShape) -> Self {
        let level = |level: v1::LevelShape| LevelShape {
            inner: level.inner,
            leaves: level.leaves,
            points: level.points,
        };
        Self {
            levels: shape.levels.into_iter().map(level).collect(),
            occupancy: shape.occupancy,
        }
    }
}
