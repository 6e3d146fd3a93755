//! PLY point clouds, ASCII and binary, in and out, a batch at a time.
//!
//! Properties of `vertex`: `x y z`, `nx ny nz`, `radius`, `red green blue` for the radiance of the front and
//! `back_red back_green back_blue` for the back. Floating-point colours are linear radiance; whole numbers are sRGB, decoded
//! and taken as radiance. Points without colour are black: they block light and send none. Others are skipped.

mod header;
mod read;
mod write;

pub use read::PlyPoints;
pub use write::{PlyWriter, write_point_ply};
