//! USD in a program that was built without the feature `usd`: refused, with what to do.

use crate::error::PointsError;
use crate::scene::{Room, SceneParts};
use std::path::{Path, PathBuf};

/// Refuses a file.
pub(crate) fn read(path: &Path, _room: Room) -> Result<SceneParts, PointsError> {
    Err(refusal(path))
}

/// The files that a USD file composes and names.
///
/// # Errors
/// This program was built without the feature `usd`.
pub fn usd_files(path: &Path) -> Result<Vec<PathBuf>, PointsError> {
    Err(refusal(path))
}

fn refusal(path: &Path) -> PointsError {
    PointsError::unsupported(
        path,
        "USD, which this program was built without,",
        "build it with `cargo build --release --features usd`, or convert the scene to .glb",
    )
}
