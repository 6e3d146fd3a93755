//! What a camera sees: picks camera and size, renders the G-buffer.

use super::args::{CameraArgs, Size};
use super::failure::Failure;
use pbgi_points::{Camera, GBuffer, MeshScene, Surroundings};
use std::path::{Path, PathBuf};

/// Rows of a picture whose size nobody asked for.
const ROWS_DEFAULT: u32 = 540;
/// Width over height where neither the user nor the camera says.
const ASPECT_DEFAULT: f32 = 16.0 / 9.0;
/// Shapes that a camera may ask for; others are mistakes.
const ASPECT_RANGE: std::ops::RangeInclusive<f32> = 0.1..=10.0;

/// What is known of a picture before it is shaded.
pub(crate) struct Frame {
    pub(crate) gbuffer: GBuffer,
    /// What surrounds the scene, where it says so.
    pub(crate) environment: Option<Surroundings>,
}

/// Renders the G-buffer of a mesh or scene file; blocks.
pub(crate) fn render(scene: &Path, args: CameraArgs) -> Result<Frame, Failure> {
    let mesh = MeshScene::load(scene)?;
    let camera = mesh.camera(args.camera.unwrap_or(0));
    let camera = camera.map_err(|error| Failure::usage(format!("{error}: {}", scene.display())))?;
    let size = args.size.unwrap_or_else(|| size_for(&camera));
    Ok(Frame {
        gbuffer: GBuffer::render(&mesh, &camera, size.width, size.height)?,
        environment: mesh.environment().cloned(),
    })
}

/// What surrounds a scene as a light probe: its picture, or one in `folder` where that is turned or multiplied; blocks.
pub(crate) fn light_probe(surroundings: &Surroundings, folder: &Path) -> Result<PathBuf, Failure> {
    if let Some(file) = surroundings.file() {
        return Ok(file.to_owned());
    }
    let baked = folder.join("environment.exr");
    surroundings.bake()?.write_exr(&baked)?;
    Ok(baked)
}

fn size_for(camera: &Camera) -> Size {
    let aspect = camera.aspect_ratio.filter(|aspect| ASPECT_RANGE.contains(aspect));
    Size {
        width: (ROWS_DEFAULT as f32 * aspect.unwrap_or(ASPECT_DEFAULT)).round() as u32,
        height: ROWS_DEFAULT,
    }
}
