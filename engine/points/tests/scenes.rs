//! Scene files and PLY meshes: what they place, and what is wrong with them, line by line.

#![allow(clippy::unwrap_used, reason = "a step that fails is a test that fails")]

mod common;

use common::{assert_says, collect, sample};
use glam::Vec3;
use pbgi_points::{Density, GBuffer, InputOptions, LightKind, MeshScene, open_input, scene_meshes};
use std::fs;
use std::path::{Path, PathBuf};

/// A square of one unit on the floor, facing up, as text.
const SQUARE: &str = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n\
    element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n0 0 1\n1 0 1\n1 0 0\n4 0 1 2 3\n";

fn scene(folder: &Path, text: &str) -> PathBuf {
    fs::write(folder.join("square.ply"), SQUARE).unwrap();
    let path = folder.join("scene.toml");
    fs::write(&path, text).unwrap();
    path
}

fn load(text: &str) -> MeshScene {
    let folder = tempfile::tempdir().unwrap();
    MeshScene::load(&scene(folder.path(), text)).unwrap()
}

/// The lines that say what is wrong with a text.
fn problems(text: &str) -> Vec<String> {
    let folder = tempfile::tempdir().unwrap();
    let path = scene(folder.path(), text);
    let error = MeshScene::load(&path).err().unwrap().to_string();
    let prefix = format!("{}:", path.display());
    error
        .lines()
        .map(|line| line.strip_prefix(&prefix).unwrap().to_owned())
        .collect()
}

#[test]
fn meshes_are_placed_as_written() {
    let scene = load(
        "[[mesh]]\nfile = \"square.ply\"\nscale = [2, 1, 1]\n\
         instances = [{ translate = [0, 5, 0] }, { rotate = [0, 0, 90], translate = [10, 0, 0] }]\n",
    );
    assert_eq!(scene.triangle_count(), 4);
    assert!((scene.area() - 4.0).abs() < 1e-9);
    let bounds = scene.bounds();
    // The second one stands upright: x became y.
    assert!(Vec3::from(bounds.min).distance(Vec3::ZERO) < 1e-5, "{bounds:?}");
    assert!(
        Vec3::from(bounds.max).distance(Vec3::new(10.0, 5.0, 1.0)) < 1e-5,
        "{bounds:?}"
    );
    let points = sample(scene, Density::Points(1_000));
    let upright = points
        .iter()
        .filter(|point| (point.position[0] - 10.0).abs() < 1e-5)
        .count();
    assert!((450..550).contains(&upright), "{upright} of {}", points.len());
    let mirrored = load("[[mesh]]\nfile = \"square.ply\"\nscale = [-1, 1, 1]\n");
    let points = sample(mirrored, Density::Points(100));
    assert!(
        points.iter().all(|point| point.normal()[1] > 0.99),
        "a mirror does not turn it over"
    );
}

#[test]
fn lights_and_cameras_are_those_of_the_scene_then_those_of_its_files() {
    let folder = tempfile::tempdir().unwrap();
    pbgi_points::demo::write_glb(&folder.path().join("demo.glb")).unwrap();
    let text = "\
        [[mesh]]\nfile = \"demo.glb\"\ntranslate = [10, 0, 0]\n\
        [[light.point]]\nposition = [0, 1, 0]\nintensity = 2\ncolor = [1, 0.5, 0]\nrange = 3\n\
        [[light.spot]]\nposition = [0, 1, 0]\ntarget = [0, 0, 0]\nintensity = 1\nouter_angle = 60\n\
        [[light.directional]]\ndirection = [0, -2, 0]\nirradiance = 3\n\
        [[camera]]\nname = \"mine\"\nposition = [0, 1, 5]\ntarget = [0, 1, 0]\nfov = 90\naspect = 2\n";
    let scene = MeshScene::load(&scene(folder.path(), text)).unwrap();
    let [point, spot, sun, lamp] = scene.lights() else {
        panic!("{:?}", scene.lights())
    };
    assert_eq!((point.intensity, point.range), ([2.0, 1.0, 0.0], Some(3.0)));
    assert!(
        matches!(spot.kind, LightKind::Spot { cos_inner, cos_outer } if cos_inner == 1.0 && (cos_outer - 0.5).abs() < 1e-6)
    );
    assert_eq!((sun.direction, sun.intensity), (Vec3::NEG_Y, [3.0; 3]));
    assert_eq!(lamp.position, Vec3::new(10.0, 1.85, 0.0), "it moves with its file");
    let [mine, theirs] = scene.cameras() else { panic!() };
    assert_eq!((mine.name.as_deref(), mine.aspect_ratio), (Some("mine"), Some(2.0)));
    assert!((mine.fov_y - std::f32::consts::FRAC_PI_2).abs() < 1e-6);
    assert_eq!(theirs.eye(), Vec3::new(10.0, 1.0, 5.0));
    let fewer = text.replace("[10, 0, 0]\n", "[10, 0, 0]\nlights = false\ncameras = false\n");
    let scene = MeshScene::load(&self::scene(folder.path(), &fewer)).unwrap();
    assert_eq!((scene.lights().len(), scene.cameras().len()), (3, 1));
}

#[test]
fn a_rectangle_glows_on_the_side_of_its_edges_cross_product() {
    let text = "[[light.rectangle]]\ncorner = [0, 2, 0]\nedge_u = [1, 0, 0]\nedge_v = [0, 0, 1]\nradiance = 5\ncolor = [1, 0.5, 0]\n";
    let points = sample(load(text), Density::Points(100));
    assert!(
        points.iter().all(|point| point.normal()[1] < -0.99),
        "u cross v points down"
    );
    let sides = points[0].sides();
    assert_eq!((sides.front, sides.back), ([5.0, 2.5, 0.0], [0.0; 3]));
    let both = sample(load(&format!("{text}both_sides = true\n")), Density::Points(100));
    assert_eq!(both[0].sides().back, [5.0, 2.5, 0.0]);
}

#[test]
fn an_albedo_replaces_the_materials() {
    let text = "[[mesh]]\nfile = \"square.ply\"\nalbedo = [0.5, 0.25, 0]\n[[light.directional]]\ndirection = [0, -1, 0]\nirradiance = 3.1415927\n";
    let point = sample(load(text), Density::Points(100))[0];
    for (value, expected) in point.sides().front.iter().zip([0.5, 0.25, 0.0]) {
        assert!((value - expected).abs() < 1e-3, "{point:?}");
    }
}

#[test]
fn an_environment_is_named_and_goes_with_the_scene() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("sky.hdr"), "").unwrap();
    let text = "[[mesh]]\nfile = \"square.ply\"\n[environment]\nfile = \"sky.hdr\"\n";
    let path = scene(folder.path(), text);
    let found = MeshScene::load(&path).unwrap();
    let file = found.environment().unwrap().file();
    assert_eq!(file.unwrap(), folder.path().join("sky.hdr"));
    assert_eq!(scene_meshes(&path).unwrap(), [folder.path().join("square.ply")]);
}

#[test]
fn every_problem_is_told_in_a_line_of_its_own() {
    let wrong = problems(
        "[[mesh]]\nfile = \"square.ply\"\nscale = 0\n\n[[mesh]]\nfile = \"../away.obj\"\n[[mesh]]\nfile = \"gone.obj\"\n\
         [[light.point]]\nposition = [0, 0, 0]\nintensity = -1\n[[camera]]\nposition = [0, 0, 0]\ntarget = [0, 0, 0]\nfov = 200\n",
    );
    let expected = [
        ("12: ", "target other than its position"),
        ("9: ", "intensity and color"),
        ("1: ", "scale must be other than 0"),
        ("6: ", "outside of the scene's folder"),
        ("8: ", "there is no file"),
    ];
    assert_eq!(wrong.len(), expected.len(), "{wrong:?}");
    for (line, words) in expected {
        assert!(
            wrong
                .iter()
                .any(|found| found.starts_with(line) && found.contains(words)),
            "{line}{words}: {wrong:#?}"
        );
    }
}

#[test]
fn keys_are_strict() {
    for (text, line, words) in [
        ("[[mesh]]\nfile = \"square.ply\"\nscael = 2\n", "3: ", "scael"),
        ("[[mash]]\nfile = \"square.ply\"\n", "1: ", "mash"),
        ("[[mesh]]\nscale = 2\n", "1: ", "file"),
        ("[[mesh]]\nfile = \"square.ply\"\nscale = \"big\"\n", "3: ", "number"),
        ("[[mesh]]\nfile = \"square.ply\"\ntranslate = [1, 2]\n", "3: ", "3"),
        ("[[light.area]]\n", "1: ", "area"),
        ("[[mesh]\n", "1: ", ""),
    ] {
        let wrong = problems(text);
        assert!(
            wrong.len() == 1 && wrong[0].starts_with(line) && wrong[0].contains(words),
            "{text}: {wrong:?}"
        );
    }
}

#[test]
fn a_scene_of_scenes_or_of_nothing_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = scene(folder.path(), "[[mesh]]\nfile = \"scene.toml\"\n");
    assert_says(
        MeshScene::load(&path).map(drop),
        &["a mesh of kind \"toml\"", "scene.toml"],
    );
    let path = scene(folder.path(), "");
    assert_says(MeshScene::load(&path).map(drop), &["no triangles", "scene.toml"]);
}

#[test]
fn instances_beyond_the_limit_are_refused_before_they_are_made() {
    let folder = tempfile::tempdir().unwrap();
    // A thousand squares in a mesh file, each placed; the scene places that file 5,000 times.
    let mut gltf = common::GltfScene::new();
    let mesh = gltf.rectangle(Vec3::ZERO, Vec3::X, Vec3::Y, None);
    let accessor = gltf.document["meshes"][mesh]["primitives"][0].clone();
    gltf.document["meshes"][mesh]["primitives"] = vec![accessor; 60].into();
    for index in 0..1_000 {
        gltf.node(serde_json::json!({ "mesh": mesh, "translation": [index, 0, 0] }));
    }
    gltf.write(folder.path());
    let path = folder.path().join("many.toml");
    let instances = "{ scale = 2 }, ".repeat(5_000);
    fs::write(
        &path,
        format!("[[mesh]]\nfile = \"scene.gltf\"\ninstances = [{instances}]\n"),
    )
    .unwrap();
    assert_says(
        MeshScene::load(&path).map(drop),
        &["number of placed meshes", "5000000", "many.toml"],
    );
}

/// A triangle and a quad in binary, with properties and elements that are of no interest.
fn binary(little: bool) -> Vec<u8> {
    let format = if little {
        "binary_little_endian"
    } else {
        "binary_big_endian"
    };
    let mut bytes = format!(
        "ply\nformat {format} 1.0\nelement material 1\nproperty uchar shine\nelement vertex 5\nproperty double x\nproperty float y\n\
         property float z\nproperty uchar red\nproperty float nx\nproperty float ny\nproperty float nz\nelement face 2\n\
         property uchar flags\nproperty list uchar uint vertex_index\nelement edge 1\nproperty list uchar short ends\nend_header\n"
    )
    .into_bytes();
    let order = |mut raw: Vec<u8>| {
        if !little {
            raw.reverse();
        }
        raw
    };
    bytes.push(9);
    for [x, y, z] in [
        [0.0, 0.0, 0.0],
        [0.0, 0.0, 1.0],
        [1.0, 0.0, 1.0],
        [1.0, 0.0, 0.0],
        [3.0, 0.0, 0.0f32],
    ] {
        bytes.extend(order(f64::from(x).to_le_bytes().to_vec()));
        for value in [y, z] {
            bytes.extend(order(value.to_le_bytes().to_vec()));
        }
        bytes.push(200);
        for value in [0.0f32, 1.0, 0.0] {
            bytes.extend(order(value.to_le_bytes().to_vec()));
        }
    }
    for face in [&[0u32, 1, 2, 3][..], &[3, 2, 4]] {
        bytes.extend([7, face.len() as u8]);
        face.iter()
            .for_each(|index| bytes.extend(order(index.to_le_bytes().to_vec())));
    }
    bytes.extend([2, 0, 0, 0, 0]);
    bytes
}

#[test]
fn ply_files_with_faces_are_meshes() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mesh.ply");
    for little in [true, false] {
        fs::write(&path, binary(little)).unwrap();
        let scene = MeshScene::load(&path).unwrap();
        assert_eq!(scene.triangle_count(), 3);
        assert!((scene.area() - 2.0).abs() < 1e-6, "{}", scene.area());
    }
    let options = InputOptions {
        density: Density::Points(500),
        ..InputOptions::default()
    };
    let mut input = open_input(std::slice::from_ref(&path), &options).unwrap();
    assert!(collect(&mut input).len() > 400, "sampled, not read as five points");
    let whole = binary(true);
    for length in [whole.len() - 1, whole.len() - 20, whole.len() - 100] {
        fs::write(&path, &whole[..length]).unwrap();
        assert_says(MeshScene::load(&path).map(drop), &["truncated", "mesh.ply"]);
    }
    fs::write(&path, SQUARE.replace("4 0 1 2 3", "4 0 1 2 4")).unwrap();
    assert_says(MeshScene::load(&path).map(drop), &["vertex 4, there are 4", "mesh.ply"]);
    fs::write(&path, SQUARE.replace("1 0 1\n", "1 nan 1\n")).unwrap();
    assert_says(
        MeshScene::load(&path).map(drop),
        &["vertex 2 is not finite", "mesh.ply"],
    );
    fs::write(&path, SQUARE.replace("1 0 1\n", "1 O 1\n")).unwrap();
    assert_says(MeshScene::load(&path).map(drop), &["\"O\" is no number", "mesh.ply"]);
}

#[test]
fn the_example_of_the_documentation_is_sound() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/court.toml");
    let scene = MeshScene::load(&path).unwrap();
    assert_eq!((scene.cameras().len(), scene.lights().len()), (2, 2));
    let gbuffer = GBuffer::render(&scene, &scene.camera(0).unwrap(), 64, 36).unwrap();
    assert!(gbuffer.hole_count() < 1_000, "{} holes", gbuffer.hole_count());
    let emission = gbuffer.emission.unwrap();
    let lit = gbuffer.direct.unwrap().iter().filter(|light| light[0] > 0.5).count();
    assert!(lit > 300, "{lit} pixels in the sun");
    assert!(emission.iter().any(|light| light[0] > 1.0), "the panel is seen");
}

#[test]
fn a_light_that_travels_along_an_axis_is_shadowed() {
    for axis in 0..3 {
        for sign in [-1.0, 1.0] {
            let mut direction = [0.0f32; 3];
            direction[axis] = sign;
            // Two squares across the light, one behind the other.
            let turn = [[0, 0, 90], [0, 0, 0], [90, 0, 0]][axis];
            let behind = direction;
            let text = format!(
                "[[mesh]]\nfile = \"square.ply\"\ninstances = [{{ rotate = {turn:?} }}, {{ rotate = {turn:?}, translate = {behind:?} }}]\n\
                 [[light.directional]]\ndirection = {direction:?}\nirradiance = 3\n"
            );
            for point in sample(load(&text), Density::Points(200)) {
                let lit = point.sides().front[0] + point.sides().back[0] > 0.0;
                assert_eq!(
                    lit,
                    point.position[axis].abs() < 0.5,
                    "{direction:?} {:?}",
                    point.position
                );
            }
        }
    }
}
