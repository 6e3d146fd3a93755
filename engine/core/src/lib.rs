//! Mathematics and record layouts of point-based global illumination: what a point and a node are, how positions become
//! Morton codes, how points become clusters, and the words (indices, keys, settings, statistics) that every other crate shares.
//!
//! Start at [`PointRecord`] and [`NodeRecord`]. This crate does no I/O and starts no threads.
#![forbid(unsafe_code)]

pub mod bounds;
pub mod cluster;
pub mod coverage;
pub mod environment;
pub mod ids;
pub mod limits;
pub mod morton;
pub mod node;
pub mod octahedral;
pub mod pack;
pub mod point;
pub mod rgb9e5;
pub mod scene;
pub mod section;
pub mod settings;
pub mod sh;
pub mod statistics;
pub mod stream;
pub mod voxel;

pub use bounds::Bounds;
pub use cluster::ClusterAccumulator;
pub use environment::Environment;
pub use ids::{BuildId, MountId, NodeIndex, PageKey, PageKind, PageNo, PointIndex};
pub use morton::{MortonCode, Quantizer};
pub use node::{NodeKind, NodeRecord};
pub use point::{InvalidPoint, PointRecord};
pub use scene::SceneInfo;
pub use settings::{BuildSettings, HitSides, SettingsError, ShadeSettings};
pub use statistics::Statistics;
pub use stream::PointStream;
pub use voxel::Voxel;
