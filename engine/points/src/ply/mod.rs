//! PLY point clouds, ASCII and binary, in and out, a batch at a time; PLY meshes, whole.
//!
//! Properties of `vertex`: `x y z`, `nx ny nz`, `radius`, `red green blue` for the radiance of the front and
//! `back_red back_green back_blue` for the back. Floating-point colours are linear radiance; whole numbers are sRGB, decoded
//! and taken as radiance. Points without colour are black: they block light and send none. `albedo_red albedo_green albedo_blue`,
//! numbers of the same kinds, say how much of the light of other surfaces is reflected, and `reflecting_sides` (1: the front, 2:
//! both, the default) by which sides. Others are skipped.
//!
//! Files of ours name the exact box of their points in a comment (`pbgi-bounds`, six numbers), so that a build reads them
//! once. They come in two forms: floats that any tool understands, and [`PlyForm::Records`], which a build takes as they are.

mod copy;
mod header;
pub(crate) mod mesh;
mod read;
mod write;

pub(crate) use copy::copy_ply;
pub use read::PlyPoints;
pub use write::{PlyForm, PlyWriter, write_point_ply};

/// First word of the comment with the box.
const BOUNDS_COMMENT: &str = "pbgi-bounds";

/// A `PointRecord`, byte for byte.
const RECORD_PROPERTIES: [(&str, &str); 9] = [
    ("float", "x"),
    ("float", "y"),
    ("float", "z"),
    ("float", "radius"),
    ("short", "normal_code_u"),
    ("short", "normal_code_v"),
    ("uint", "front_rgb9e5"),
    ("uint", "back_rgb9e5"),
    ("uint", "albedo_code"),
];
