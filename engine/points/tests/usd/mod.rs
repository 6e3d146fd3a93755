//! The suite of the feature `usd`, by what it looks at.

mod compose;
mod hostile;
mod lights;
mod materials;
mod meshes;

use crate::common;
use pbgi_core::PointRecord;
use pbgi_points::{Density, MeshScene, PointsError};
use std::fs;
use std::path::{Path, PathBuf};

/// A square of one unit on the floor, facing up; to be put into a prim's braces.
const SQUARE: &str = "
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    point3f[] points = [(0, 0, 0), (0, 0, 1), (1, 0, 1), (1, 0, 0)]
";

/// Light from above that makes radiance the albedo.
const SUN: &str = "
    def DistantLight \"Sun\" {
        float inputs:angle = 0
        float inputs:intensity = 3.1415927
        float xformOp:rotateX = -90
        uniform token[] xformOpOrder = [\"xformOp:rotateX\"]
    }
";

/// Writes a layer without metadata.
fn write(folder: &Path, name: &str, text: &str) -> PathBuf {
    let path = folder.join(name);
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    fs::write(&path, format!("#usda 1.0\n{text}")).unwrap();
    path
}

fn try_load(text: &str) -> Result<MeshScene, PointsError> {
    let folder = tempfile::tempdir().unwrap();
    MeshScene::load(&write(folder.path(), "scene.usda", text))
}

fn load(text: &str) -> MeshScene {
    try_load(text).unwrap()
}

/// Points of a stage under [`SUN`].
fn lit(text: &str) -> Vec<PointRecord> {
    common::sample(load(&format!("{SUN}{text}")), Density::Points(200))
}

#[track_caller]
fn assert_near(found: [f32; 3], expected: [f32; 3], tolerance: f32) {
    let far = found.iter().zip(&expected).any(|(a, b)| (a - b).abs() > tolerance);
    assert!(!far, "{found:?} is not {expected:?}");
}
