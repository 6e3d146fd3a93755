//! Streaming construction: sorted points in, nodes and points out, depth first along the Z-curve (paper section 4).

pub mod construction;
pub mod window;
pub mod write_out;
