//! From points to an octree on disk: external sort along the Z-curve and streaming construction in bounded memory
//! (paper section 4).
//!
//! Start at [`build()`]. The points are read once (twice where their bounds are unknown and they do not fit), sorted in
//! memory or in runs on scratch, and streamed through [`octree`], which holds `leaf_max + 1` of them and the open path
//! of the tree. The same points and settings give the same files for any memory limit and any order of input, ties by
//! input index aside. This crate does not know where points come from, nor how a scene is shaded.
#![forbid(unsafe_code)]

pub mod budget;
pub mod build;
pub mod content_hash;
pub mod error;
mod intake;
pub mod limits;
pub mod octree;
pub mod report;
pub mod sort;

pub use build::{BuildHost, build, build_on};
pub use error::BuildError;
pub use report::{BuildProgress, BuildReport, BuildRequest, Stage, StageSeconds};
