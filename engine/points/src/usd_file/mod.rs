//! USD: the composed stage of a `.usda`, `.usdc` or `.usdz` file becomes [`SceneParts`]. docs/inputs.md says what is read.

mod cameras;
mod contain;
mod crate_check;
mod files;
mod lights;
mod materials;
mod meshes;
mod polygon;
mod primvars;
mod shapes;
mod skies;
mod stage;
mod values;
mod walk;

use crate::error::PointsError;
use crate::scene::{Room, SceneParts};
use std::path::{Path, PathBuf};

/// Reads a file, the layers that it composes and the textures that it names.
pub(crate) fn read(path: &Path, room: Room) -> Result<SceneParts, PointsError> {
    let file = path.to_owned();
    contain::contained(path, move |pulse| stage::read(&file, room, pulse)).map(|read| read.parts)
}

/// The files that a USD file composes and names, itself among them. It is read for this as a whole.
///
/// # Errors
/// It cannot be read, or this program was built without the feature `usd`.
pub fn usd_files(path: &Path) -> Result<Vec<PathBuf>, PointsError> {
    let file = path.to_owned();
    let room = Room::new(u64::MAX);
    contain::contained(path, move |pulse| stage::read(&file, room, pulse)).map(|read| read.files)
}
