//! The ray-cast truth itself, on scenes whose answer is known.

#![allow(clippy::unwrap_used, reason = "tests")]

use glam::Vec3;
use pbgi_points::{MeshScene, demo};

#[test]
fn rays_from_the_middle_of_the_demo_see_its_floor_below_and_its_light_above() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("demo.glb");
    demo::write_glb(&path).unwrap();
    let scene = MeshScene::load(&path).unwrap();
    let bounds = scene.bounds();
    let middle = (Vec3::from(bounds.min) + Vec3::from(bounds.max)) * 0.5;
    let down = scene.raycast(middle, Vec3::NEG_Y, 16, 1, 1);
    assert!(down.occlusion > 0.9, "{down:?}");
    assert!(down.irradiance.iter().all(|&value| value > 0.0), "{down:?}");
    assert_eq!(
        down,
        scene.raycast(middle, Vec3::NEG_Y, 16, 1, 1),
        "the same rays give the same answer"
    );
    assert_eq!(down.occlusion, scene.raycast_occlusion(middle, Vec3::NEG_Y, 16, 1));
    let far = scene.raycast(Vec3::from(bounds.max) + Vec3::ONE, Vec3::ONE.normalize(), 8, 1, 1);
    assert_eq!(far.occlusion, 0.0);
}
