//! Scenes from a seed: as many points as were asked for, always the same, within their box, lit, and the same as triangles.

#![allow(clippy::unwrap_used, reason = "a step that fails is a test that fails")]

mod common;

use common::collect;
use pbgi_core::PointStream;
use pbgi_points::{Kind, MeshScene, ProceduralScene};

const KINDS: [Kind; 4] = [Kind::Tree, Kind::Tighten, Kind::City, Kind::Forest];

#[test]
fn a_scene_follows_from_its_kind_number_and_seed() {
    for kind in KINDS {
        let mut scene = ProceduralScene::new(kind, 100_000, 7).unwrap();
        let points = collect(&mut scene);
        assert!(points.len().abs_diff(100_000) < 2_000, "{kind:?}: {}", points.len());
        scene.rewind().unwrap();
        assert!(points == collect(&mut scene), "{kind:?}");
        assert!(points == collect(&mut ProceduralScene::new(kind, 100_000, 7).unwrap()));
        assert!(points != collect(&mut ProceduralScene::new(kind, 100_000, 8).unwrap()));
        let bounds = scene.bounds().unwrap();
        assert!(points.iter().all(|point| bounds.contains(point.position)));
        assert!(points.iter().all(|point| point.validate().is_ok()));
        assert!(
            points
                .iter()
                .all(|point| point.sides().front[1] > 0.0 || point.sides().back[1] > 0.0)
        );
    }
}

#[test]
fn larger_scenes_are_wider_not_denser() {
    for kind in [Kind::City, Kind::Forest] {
        let small = ProceduralScene::new(kind, 1_000_000, 1).unwrap();
        let large = ProceduralScene::new(kind, 4_000_000, 1).unwrap();
        let width = |scene: &ProceduralScene| {
            let bounds = scene.bounds().unwrap();
            bounds.max[0] - bounds.min[0]
        };
        let ratio = width(&large) / width(&small);
        assert!((1.6..2.4).contains(&ratio), "{kind:?}: {ratio}");
    }
}

#[test]
fn triangles_and_points_are_the_same_surface() {
    let folder = tempfile::tempdir().unwrap();
    for kind in KINDS {
        let mut scene = ProceduralScene::new(kind, 50_000, 3).unwrap();
        let path = folder.path().join("scene.glb");
        scene.write_glb(&path).unwrap();
        let mesh = MeshScene::load(&path).unwrap();
        let area: f64 = collect(&mut scene).iter().map(|point| f64::from(point.area())).sum();
        assert!(
            (area / mesh.area() - 1.0).abs() < 0.03,
            "{kind:?}: {area} of {}",
            mesh.area()
        );
        assert_eq!(mesh.lights().len(), 1);
        mesh.camera(0).unwrap();
    }
}
