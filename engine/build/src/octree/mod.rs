//! Streaming construction: sorted points in, nodes and points out, depth first along the Z-curve (paper section 4).
//!
//! [`plan`] cuts the curve into jobs, any number of threads make the nodes of a job with [`subtree`], and [`placement`]
//! puts them together and writes them in the order of the curve. [`construction`] runs the three side by side. The
//! bytes do not depend on where the cuts are: every sum is made in the order of the tree.

pub mod construction;
pub mod placement;
pub mod plan;
pub mod subtree;
pub mod write_out;
