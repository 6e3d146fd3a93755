//! Files that a scene file names: beside it or below, and nowhere else.

use crate::error::PointsError;
use std::path::{Component, Path, PathBuf};

/// Where `name`, a relative path in the file `scene`, points to.
///
/// # Errors
/// A path that is absolute or goes up: a scene from a stranger must not read what it was not given.
pub(crate) fn beside(scene: &Path, name: &str) -> Result<PathBuf, PointsError> {
    let inside = |part: Component<'_>| matches!(part, Component::Normal(_) | Component::CurDir);
    if !Path::new(name).components().all(inside) {
        let what = format!("the file name {name:?}, which leaves the scene's folder,");
        return Err(PointsError::unsupported(
            scene,
            what,
            "put that file beside the scene, or below",
        ));
    }
    Ok(scene.parent().unwrap_or(Path::new("")).join(name))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_names_below_the_scene_are_followed() {
        let scene = Path::new("/shots/a/scene.gltf");
        for (name, place) in [("t.png", "/shots/a/t.png"), ("./maps/t.png", "/shots/a/maps/t.png")] {
            assert_eq!(beside(scene, name).unwrap(), Path::new(place));
        }
        for name in ["../b/t.png", "maps/../../t.png", "/etc/passwd", ".."] {
            let error = beside(scene, name).unwrap_err().to_string();
            assert!(
                error.contains("leaves the scene's folder") && error.contains(name),
                "{error}"
            );
        }
    }
}
