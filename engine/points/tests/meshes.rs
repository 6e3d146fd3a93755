//! Mesh files: what is in them arrives, what is wrong with them is said.

#![allow(clippy::unwrap_used, reason = "a step that fails is a test that fails")]

mod common;

use common::{GltfScene, assert_says, mutate, png_uri, sample, shared};
use glam::Vec3;
use pbgi_points::{Density, GBuffer, LightKind, MeshScene, demo};
use serde_json::json;
use std::fs;
use std::path::Path;

fn quad() -> (GltfScene, usize) {
    let mut scene = GltfScene::new();
    let mesh = scene.rectangle(Vec3::ZERO, Vec3::X, Vec3::Y, None);
    scene.node(json!({ "mesh": mesh }));
    (scene, mesh)
}

/// A unit square of which a camera in front sees nothing else.
fn albedo_of(scene: &mut GltfScene, material: serde_json::Value) -> Vec<[f32; 3]> {
    let material = scene.push("materials", material);
    let mesh = scene.rectangle(Vec3::ZERO, Vec3::X, Vec3::Y, Some(material));
    scene.node(json!({ "mesh": mesh }));
    let camera = scene.push(
        "cameras",
        json!({ "type": "perspective", "perspective": { "yfov": 0.9272952, "znear": 0.1 } }),
    );
    scene.node(json!({ "camera": camera, "translation": [0.5, 0.5, 1.0] }));
    let loaded = scene.load().unwrap();
    let gbuffer = GBuffer::render(&loaded, &loaded.camera(0).unwrap(), 4, 4).unwrap();
    assert_eq!(gbuffer.hole_count(), 0);
    gbuffer.albedo.unwrap()
}

#[test]
fn textures_arrive_the_right_way_up_and_decoded() {
    let mut scene = GltfScene::new();
    // Red above green, left of blue above grey.
    let texels = [
        [255, 0, 0, 255],
        [0, 0, 255, 255],
        [0, 255, 0, 255],
        [188, 188, 188, 255],
    ];
    let image = scene.push("images", json!({ "uri": png_uri(2, 2, &texels) }));
    let sampler = scene.push("samplers", json!({ "wrapS": 33071, "wrapT": 33071 }));
    let texture = scene.push("textures", json!({ "source": image, "sampler": sampler }));
    let albedo = albedo_of(
        &mut scene,
        json!({ "pbrMetallicRoughness": { "baseColorTexture": { "index": texture }, "baseColorFactor": [0.5, 1.0, 1.0, 1.0] } }),
    );
    let near = |pixel: usize, colour: [f32; 3]| {
        let distance = Vec3::from(albedo[pixel]).distance(Vec3::from(colour));
        assert!(distance < 5e-3, "pixel {pixel}: {:?} is not {colour:?}", albedo[pixel]);
    };
    near(0, [0.5, 0.0, 0.0]);
    near(3, [0.0, 0.0, 1.0]);
    near(12, [0.0, 1.0, 0.0]);
    near(15, [0.2515, 0.503, 0.503]);
}

#[test]
fn texture_transforms_are_those_of_the_extension() {
    let turned = |transform: serde_json::Value| {
        let mut scene = GltfScene::new();
        scene.document["extensionsUsed"] = json!(["KHR_texture_transform"]);
        let texels = [
            [255, 0, 0, 255],
            [0, 0, 255, 255],
            [0, 255, 0, 255],
            [255, 255, 255, 255],
        ];
        let image = scene.push("images", json!({ "uri": png_uri(2, 2, &texels) }));
        let texture = scene.push("textures", json!({ "source": image }));
        let albedo = albedo_of(
            &mut scene,
            json!({ "pbrMetallicRoughness": { "baseColorTexture": {
                "index": texture, "extensions": { "KHR_texture_transform": transform } } } }),
        );
        // The brightest channel of a texel's middle, near a corner of the picture.
        [0, 3, 12, 15].map(|pixel: usize| albedo[pixel].map(|channel| channel > 0.4))
    };
    let (red, blue, green, white) = (
        [true, false, false],
        [false, false, true],
        [false, true, false],
        [true; 3],
    );
    assert_eq!(turned(json!({ "offset": [0.5, 0.0] })), [blue, red, white, green]);
    assert_eq!(turned(json!({ "offset": [0.0, 0.5] })), [green, white, red, blue]);
    assert_eq!(turned(json!({ "scale": [-1.0, 1.0] })), [blue, red, white, green]);
    // A quarter turn counter-clockwise where v points down: u' = v, v' = -u.
    let quarter = std::f32::consts::FRAC_PI_2;
    assert_eq!(turned(json!({ "rotation": quarter })), [green, red, white, blue]);
}

#[test]
fn lights_and_cameras_are_placed_by_their_nodes() {
    let (mut scene, _) = quad();
    let turn = [
        0.0,
        std::f32::consts::FRAC_1_SQRT_2,
        0.0,
        std::f32::consts::FRAC_1_SQRT_2,
    ];
    let spot = json!({ "type": "spot", "intensity": 2.0, "color": [1.0, 0.5, 0.25], "range": 7.0,
        "spot": { "innerConeAngle": 0.1, "outerConeAngle": 0.5 } });
    scene.light(
        spot,
        json!({ "translation": [1.0, 2.0, 3.0], "rotation": turn, "scale": [3.0, 3.0, 3.0] }),
    );
    let perspective = |fov: f32| json!({ "type": "perspective", "perspective": { "yfov": fov, "znear": 0.1 } });
    scene.push("cameras", perspective(0.5));
    scene.push("cameras", perspective(0.7));
    scene.node(json!({ "camera": 1 }));
    scene.node(json!({ "camera": 0, "rotation": turn, "scale": [2.0, 2.0, 2.0] }));
    let loaded = scene.load().unwrap();
    let light = loaded.lights()[0];
    assert_eq!(light.intensity, [2.0, 1.0, 0.5]);
    assert_eq!(light.range, Some(7.0));
    assert!(light.position.distance(Vec3::new(1.0, 2.0, 3.0)) < 1e-6);
    assert!(light.direction.distance(Vec3::NEG_X) < 1e-6);
    assert!(matches!(light.kind, LightKind::Spot { cos_inner, .. } if (cos_inner - 0.1f32.cos()).abs() < 1e-6));
    let camera = loaded.camera(0).unwrap();
    assert_eq!(camera.fov_y, 0.5);
    assert!(
        (camera.world_from_camera.determinant() - 1.0).abs() < 1e-5,
        "scale is no part of a camera"
    );
}

#[test]
fn strips_fans_and_unindexed_triangles_are_read() {
    for (mode, corners, triangles) in [(4, 6, 2), (5, 4, 2), (6, 4, 2), (0, 4, 0)] {
        let mut scene = GltfScene::new();
        let ring = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]];
        let fan = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
        let soup = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
        let list: &[[f32; 2]] = match mode {
            4 => &soup,
            6 => &fan,
            _ => &ring,
        };
        assert_eq!(list.len(), corners);
        let positions: Vec<f32> = list.iter().flat_map(|&[x, y]| [x, y, 0.0]).collect();
        let positions = scene.floats(&positions, "VEC3");
        let primitive = json!({ "attributes": { "POSITION": positions }, "mode": mode });
        let mesh = scene.push("meshes", json!({ "primitives": [primitive] }));
        scene.node(json!({ "mesh": mesh }));
        let loaded = scene.load();
        if triangles == 0 {
            assert_says(loaded, &["no triangles", "export a mesh"]);
            continue;
        }
        let loaded = loaded.unwrap();
        assert_eq!(loaded.triangle_count(), triangles);
        let points = sample(loaded, Density::Points(1000));
        assert!(
            points.iter().all(|p| p.normal().z > 0.99),
            "all triangles of mode {mode} face the same way"
        );
    }
}

#[test]
fn many_uses_of_a_mesh_are_seen_where_they_are_placed() {
    // More triangles than are copied, so that they are placed.
    let mut scene = GltfScene::new();
    let n = 60u32;
    let mut positions = Vec::new();
    let mut indices: Vec<u8> = Vec::new();
    for y in 0..=n {
        for x in 0..=n {
            positions.extend([x as f32 / n as f32, y as f32 / n as f32, 0.0]);
        }
    }
    for y in 0..n {
        for x in 0..n {
            let a = y * (n + 1) + x;
            let quad = [a, a + 1, a + n + 2, a, a + n + 2, a + n + 1];
            indices.extend(quad.iter().flat_map(|i| i.to_le_bytes()));
        }
    }
    let positions = scene.floats(&positions, "VEC3");
    let indices = scene.accessor(&indices, (6 * n * n) as usize, 5125, "SCALAR");
    let primitive = json!({ "attributes": { "POSITION": positions }, "indices": indices });
    let mesh = scene.push("meshes", json!({ "primitives": [primitive] }));
    for x in 0..20 {
        scene.node(
            json!({ "mesh": mesh, "translation": [2.0 * x as f32, 0.0, 0.0], "scale": [1.0, 1.0 + x as f32, 1.0] }),
        );
    }
    scene.light(json!({ "type": "directional", "intensity": 1.0 }), json!({}));
    let loaded = scene.load().unwrap();
    assert_eq!(loaded.triangle_count(), 20 * 7200);
    assert!((loaded.area() - 210.0).abs() < 1e-3);
    let camera = pbgi_points::Camera::look_at(Vec3::new(19.5, 10.0, 60.0), Vec3::new(19.5, 10.0, 0.0), 0.7);
    let seen = GBuffer::render(&loaded, &camera, 400, 200).unwrap();
    for pixel in 0..seen.pixel_count() {
        let [x, y, z] = seen.position[pixel];
        if seen.coverage[pixel] > 0.0 {
            assert!(z.abs() < 1e-5 && x.rem_euclid(2.0) <= 1.0001 && y <= 1.0001 + (x / 2.0).floor());
            assert!(
                (seen.direct.as_ref().unwrap()[pixel][0] - 1.0).abs() < 1e-4,
                "the light travels along -z"
            );
        }
    }
    let covered = seen.coverage.iter().filter(|&&a| a > 0.0).count();
    assert!((4200..4600).contains(&covered), "{covered}");
    let points = sample(loaded, Density::Points(21_000));
    assert!(points.len().abs_diff(21_000) < 500, "{}", points.len());
}

#[test]
fn wavefront_files_have_their_colours_and_holes() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.obj");
    let texels = [[255, 255, 255, 255]];
    let uri = png_uri(1, 1, &texels);
    assert!(uri.starts_with("data:"));
    fs::write(
        folder.path().join("a.mtl"),
        "newmtl red\nKd 0.5 0.25 0.125\nnewmtl lamp\nKd 0 0 0\nKe 3 2 1\nnewmtl glass\nd 0.1\n",
    )
    .unwrap();
    let text = "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 5\nv 1 0 5\nv 1 1 5\nv 0 1 5\n\
        v 0 0 9\nv 1 0 9\nv 1 1 9\nusemtl red\nf 1 2 3 4\nusemtl lamp\nf 5 6 7 8\nusemtl glass\nf 9 10 11\n";
    fs::write(&path, text).unwrap();
    let scene = MeshScene::load(&path).unwrap();
    assert_eq!(scene.triangle_count(), 5);
    let points = sample(scene, Density::Points(2500));
    for point in points {
        assert!(point.position[2] < 6.0, "glass is a hole");
        let expected = if point.position[2] > 4.0 {
            [3.0, 2.0, 1.0]
        } else {
            [0.0; 3]
        };
        assert_eq!(point.sides().front, expected);
    }
    fs::remove_file(folder.path().join("a.mtl")).unwrap();
    assert_says(MeshScene::load(&path), &["material library", "mtllib", "a.obj"]);
    fs::write(folder.path().join("a.mtl"), "newmtl red\nmap_Kd missing.png\n").unwrap();
    assert_says(MeshScene::load(&path), &["missing.png", "copy it", "a.obj"]);
}

#[test]
fn a_wavefront_opacity_map_cuts_holes_by_its_brightness_or_its_alpha() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.obj");
    let text = "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n\
        usemtl leaf\nf 1/1 2/2 3/3 4/4\n";
    fs::write(&path, text).unwrap();
    fs::write(
        folder.path().join("a.mtl"),
        "newmtl leaf\nKd 1 1 1\nmap_d -clamp on mask.png\n",
    )
    .unwrap();
    let mask = folder.path().join("mask.png");
    // White on the left; then the same in the alpha of a picture that is bright all over.
    let bright = image::GrayImage::from_fn(8, 1, |x, _| image::Luma([if x < 4 { 255 } else { 0 }]));
    let alpha = image::RgbaImage::from_fn(8, 1, |x, _| image::Rgba([255, 255, 255, if x < 4 { 255 } else { 0 }]));
    bright.save(&mask).unwrap();
    let by_brightness = sample(MeshScene::load(&path).unwrap(), Density::Points(1000));
    alpha.save(&mask).unwrap();
    let by_alpha = sample(MeshScene::load(&path).unwrap(), Density::Points(1000));
    for points in [by_brightness, by_alpha] {
        assert!(points.len() > 400, "{}", points.len());
        assert!(points.iter().all(|point| point.position[0] < 0.51));
    }
    // Behind another mesh with a texture of its own.
    let other = folder.path().join("b.obj");
    fs::write(&other, text.replace("a.mtl", "b.mtl").replace("leaf", "wall")).unwrap();
    fs::write(folder.path().join("b.mtl"), "newmtl wall\nmap_Kd white.png\n").unwrap();
    image::GrayImage::from_pixel(2, 2, image::Luma([255]))
        .save(folder.path().join("white.png"))
        .unwrap();
    let scene = folder.path().join("both.toml");
    let meshes = "[[mesh]]\nfile = \"b.obj\"\ntranslate = [0, 0, 3]\n[[mesh]]\nfile = \"a.obj\"\n";
    fs::write(&scene, meshes).unwrap();
    let points = sample(MeshScene::load(&scene).unwrap(), Density::Points(1000));
    let leaf = points.iter().filter(|point| point.position[2] < 1.0);
    assert!(leaf.clone().count() > 200);
    assert!(leaf.clone().all(|point| point.position[0] < 0.51));
}

#[test]
fn colours_of_a_ply_meshs_vertices_are_its_albedo() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    let head = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n\
        property uchar red\nproperty uchar green\nproperty uchar blue\n\
        element face 1\nproperty list uchar int vertex_indices\nend_header\n";
    // Red on the left, blue on the right; sRGB 188 is half of white.
    let body = "0 0 0 188 0 0\n1 0 0 0 0 188\n1 1 0 0 0 188\n0 1 0 188 0 0\n4 0 1 2 3\n";
    fs::write(&path, format!("{head}{body}")).unwrap();
    let points = sample(MeshScene::load(&path).unwrap(), Density::Points(500));
    assert!(points.len() > 400);
    for point in points {
        let [red, green, blue] = point.reflectance().albedo;
        let x = point.position[0];
        assert!((red - 0.5 * (1.0 - x)).abs() < 0.01, "{x} {red}");
        assert!(green == 0.0 && (blue - 0.5 * x).abs() < 0.01, "{x} {blue}");
    }
}

/// A square that one node of a turned parent places often, with these attributes.
fn instanced(attributes: impl FnOnce(&mut GltfScene) -> serde_json::Value) -> GltfScene {
    let (mut scene, mesh) = (GltfScene::new(), 0);
    scene.rectangle(Vec3::ZERO, Vec3::X, Vec3::Y, None);
    let attributes = attributes(&mut scene);
    scene.document["extensionsUsed"] = json!(["EXT_mesh_gpu_instancing"]);
    scene.document["extensionsRequired"] = json!(["EXT_mesh_gpu_instancing"]);
    let extension = json!({ "EXT_mesh_gpu_instancing": { "attributes": attributes } });
    let child = scene.push(
        "nodes",
        json!({ "mesh": mesh, "scale": [2, 2, 2], "extensions": extension }),
    );
    scene.node(json!({ "children": [child], "translation": [0, 1, 0] }));
    scene
}

#[test]
fn instances_of_one_node_lie_where_nodes_of_their_own_would() {
    let half = std::f32::consts::FRAC_1_SQRT_2;
    let (translations, scales) = (
        [[0.0f32, 0.0, 0.0], [5.0, 0.0, -1.0], [0.0, 9.0, 0.5]],
        [[1.0f32, 1.0, 1.0], [0.5, 2.0, 1.0], [3.0, 1.0, 1.0]],
    );
    let rotations = [[0.0, 0.0, 0.0, 1.0], [0.0, half, 0.0, half], [half, 0.0, 0.0, -half]];
    let scene = instanced(|scene| {
        // Rotations as whole numbers, as exporters pack them.
        let packed: Vec<u8> = rotations
            .iter()
            .flatten()
            .flat_map(|value| ((value * 32_767.0f32).round() as i16).to_le_bytes())
            .collect();
        let rotation = scene.accessor(&packed, 3, 5122, "VEC4");
        scene.document["accessors"][rotation]["normalized"] = json!(true);
        json!({
            "TRANSLATION": scene.floats(translations.as_flattened(), "VEC3"),
            "ROTATION": rotation,
            "SCALE": scene.floats(scales.as_flattened(), "VEC3"),
            "_ID": 99,
        })
    });
    let points = sample(scene.load().unwrap(), Density::Spacing(0.1));

    let mut scene = GltfScene::new();
    let mesh = scene.rectangle(Vec3::ZERO, Vec3::X, Vec3::Y, None);
    let children: Vec<usize> = (0..3)
        .map(|i| {
            let (at, turn, scale) = (translations[i], rotations[i], scales[i]);
            scene.push(
                "nodes",
                json!({ "mesh": mesh, "translation": at, "rotation": turn, "scale": scale }),
            )
        })
        .collect();
    let middle = scene.push("nodes", json!({ "children": children, "scale": [2, 2, 2] }));
    scene.node(json!({ "children": [middle], "translation": [0, 1, 0] }));
    let expected = sample(scene.load().unwrap(), Density::Spacing(0.1));

    assert!(expected.len() > 1000 && points.len() == expected.len());
    for (point, expected) in points.iter().zip(&expected) {
        let distance = Vec3::from(point.position).distance(Vec3::from(expected.position));
        assert!(distance < 1e-3, "{point:?} {expected:?}");
        assert!(point.normal().dot(expected.normal()) > 0.999);
    }
}

/// So many that they are grouped, and each has less than a point: rays find the one above another, and points are spread evenly.
#[test]
fn a_multitude_of_instances_is_traced_and_sampled_as_one_would_be() {
    const SIDE: usize = 200;
    let mut scene = GltfScene::new();
    scene.rectangle(Vec3::ZERO, Vec3::X, Vec3::Y, None);
    // Squares in pairs, one far above the other; in odd columns the lower one lies aside, in the light.
    let mut places = Vec::new();
    for index in 0..SIDE * SIDE {
        let (x, y) = ((index % SIDE) as f32 * 3.0, (index / SIDE) as f32 * 3.0);
        let aside = if index % 2 == 0 { 0.0 } else { 1.5 };
        places.extend([[x + aside, y, 0.0], [x, y, 5.0 + x / 100.0]]);
    }
    let translation = scene.floats(places.as_flattened(), "VEC3");
    let extension = json!({ "EXT_mesh_gpu_instancing": { "attributes": { "TRANSLATION": translation } } });
    scene.node(json!({ "mesh": 0, "extensions": extension }));
    scene.light(json!({ "type": "directional", "intensity": 1.0 }), json!({}));
    scene.document["extensionsUsed"] = json!(["EXT_mesh_gpu_instancing", "KHR_lights_punctual"]);

    let whole = scene.load().unwrap();
    let side = (SIDE - 1) as f32 * 3.0 + 1.0;
    assert_eq!(whole.bounds().max, [side + 1.5, side, 5.0 + (side - 1.0) / 100.0]);
    assert!((whole.area() - (2 * SIDE * SIDE) as f64).abs() < 1e-6);
    let points = sample(whole, Density::Points(20_000));
    assert!((19_990..=20_010).contains(&points.len()), "{}", points.len());
    let mut counts = [0; 16];
    for point in &points {
        let [x, y, z] = point.position;
        let (column, lower) = ((x / 3.0) as usize, z < 1.0);
        let lit = point.sides().front[0] > 0.0;
        assert_eq!(lit, !lower || column % 2 == 1, "{:?}", point.position);
        counts[(x / side * 3.99) as usize * 4 + (y / side * 3.99) as usize] += 1;
    }
    assert!(counts.iter().all(|count| (1000..1500).contains(count)), "{counts:?}");
}

#[test]
fn instances_that_contradict_themselves_are_named() {
    let says = |parts: &[&str], attributes: &dyn Fn(&mut GltfScene) -> serde_json::Value| {
        assert_says(instanced(attributes).load(), parts);
    };
    says(&["node 0", "neither TRANSLATION"], &|_| json!({}));
    says(
        &["node 0", "accessor 99", "not in the file"],
        &|_| json!({ "SCALE": 99 }),
    );
    says(
        &["node 0", "ROTATION", "no accessor's number"],
        &|_| json!({ "ROTATION": -1 }),
    );
    says(&["node 0", "SCALE", "1 elements"], &|scene| {
        let (two, one) = (scene.floats(&[1.0; 6], "VEC3"), scene.floats(&[1.0; 3], "VEC3"));
        json!({ "TRANSLATION": two, "SCALE": one })
    });
    says(
        &["node 0", "must be Vec4"],
        &|scene| json!({ "ROTATION": scene.floats(&[1.0; 3], "VEC3") }),
    );
    says(
        &["not finite"],
        &|scene| json!({ "ROTATION": scene.floats(&[0.0; 4], "VEC4") }),
    );
}

#[test]
fn what_is_missing_or_broken_is_named() {
    let load = |path: &Path| MeshScene::load(path);
    assert_says(load(Path::new("nowhere.glb")), &["cannot read", "nowhere.glb"]);
    assert_says(load(Path::new("nowhere.obj")), &["cannot open", "nowhere.obj"]);
    assert_says(load(Path::new("scene.max")), &["\"max\"", "convert"]);
    let folder = tempfile::tempdir().unwrap();
    let (scene, _) = quad();
    let path = scene.write(folder.path());
    let whole = fs::read(&path).unwrap();
    let bin = fs::read(folder.path().join("scene.bin")).unwrap();
    fs::write(folder.path().join("scene.bin"), &bin[..bin.len() - 1]).unwrap();
    assert_says(load(&path), &["buffer 0", "truncated", "scene.gltf"]);
    fs::remove_file(folder.path().join("scene.bin")).unwrap();
    assert_says(load(&path), &["scene.bin", "missing", "scene.gltf"]);
    fs::write(&path, &whole[..whole.len() / 2]).unwrap();
    assert_says(load(&path), &["not a usable glTF file", "scene.gltf"]);
    let (mut scene, _) = quad();
    scene.push("images", json!({ "uri": "leaf.png" }));
    scene.push("textures", json!({ "source": 0 }));
    scene.push(
        "materials",
        json!({ "pbrMetallicRoughness": { "baseColorTexture": { "index": 0 } } }),
    );
    assert_says(scene.load(), &["leaf.png", "missing"]);
    let (mut scene, mesh) = quad();
    scene.document["nodes"][0]["children"] = json!([0]);
    assert_says(scene.load(), &["node 0", "cycle"]);
    scene.document["nodes"][0] = json!({ "mesh": mesh, "scale": [1e38, 1e38, 1e38], "translation": [3e38, 0, 0] });
    assert_says(scene.load(), &["vertex", "not finite"]);
}

#[test]
fn vertices_that_are_not_finite_are_refused_with_their_number() {
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let mut scene = GltfScene::new();
        let positions = scene.floats(&[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, bad, 0.0], "VEC3");
        let mesh = scene.push(
            "meshes",
            json!({ "primitives": [{ "attributes": { "POSITION": positions } }] }),
        );
        scene.node(json!({ "mesh": mesh }));
        assert_says(scene.load(), &["mesh 0 primitive 0", "vertex 2 is not finite"]);
    }
}

#[test]
fn damaged_numbers_in_a_document_are_errors_not_panics() {
    let (scene, _) = quad();
    let damage: [(&str, serde_json::Value); 11] = [
        ("/accessors/0/count", json!(1_000_000)),
        ("/accessors/0/count", json!(0)),
        ("/accessors/0/byteOffset", json!(u64::MAX)),
        ("/accessors/2/componentType", json!(5126)),
        ("/bufferViews/0/byteOffset", json!(u64::MAX)),
        ("/bufferViews/0/byteLength", json!(u64::MAX)),
        ("/bufferViews/0/buffer", json!(7)),
        ("/meshes/0/primitives/0/indices", json!(99)),
        ("/scenes/0/nodes/0", json!(42)),
        ("/accessors/0/type", json!("VEC2")),
        ("/meshes/0/primitives/0/attributes/POSITION", json!(99)),
    ];
    for (place, value) in damage {
        let mut broken = GltfScene {
            document: scene.document.clone(),
            bin: scene.bin.clone(),
        };
        match broken.document.pointer_mut(place) {
            Some(target) => *target = value.clone(),
            None => {
                let (parent, key) = place.rsplit_once('/').unwrap();
                broken.document.pointer_mut(parent).unwrap()[key] = value.clone();
            }
        }
        let result = broken.load();
        assert!(result.is_err(), "{place} = {value} is accepted");
    }
}

#[test]
fn every_truncation_and_many_mutations_of_a_glb_are_survived() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("demo.glb");
    demo::write_glb(&path).unwrap();
    let bytes = fs::read(&path).unwrap();
    for length in (0..bytes.len()).step_by(bytes.len() / 97) {
        fs::write(&path, &bytes[..length]).unwrap();
        assert!(MeshScene::load(&path).is_err(), "{length} bytes");
    }
    // The document, not the numbers of its buffer.
    mutate(&bytes, 20..4000, 200, |broken| {
        fs::write(&path, broken).unwrap();
        drop(MeshScene::load(&path));
    });
}

#[test]
fn the_demo_scene_has_all_that_a_render_needs() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("demo.glb");
    demo::write_glb(&path).unwrap();
    let scene = MeshScene::load(&path).unwrap();
    assert_eq!((scene.lights().len(), scene.cameras().len()), (1, 1));
    let seen = GBuffer::render(&scene, &scene.camera(0).unwrap(), 64, 64).unwrap();
    assert!(seen.hole_count() < 64 * 64 / 20);
    assert!(fs::metadata(&path).unwrap().len() < 1 << 20);
}

#[test]
fn the_leaves_of_the_tree_are_cut_out_of_their_cards() {
    if let Some(path) = shared("data/tree/scene.gltf") {
        let scene = MeshScene::load(&path).unwrap();
        assert_eq!(scene.triangle_count(), 778);
        let area = scene.area();
        let points = sample(scene, Density::Points(20_000));
        let covered: f64 = points.iter().map(|p| f64::from(p.area())).sum::<f64>() / area;
        println!("{covered} of the tree is surface");
        assert!(
            (0.1..0.8).contains(&covered),
            "leaves are cut out of their cards: {covered}"
        );
    }
}

#[test]
fn names_that_leave_the_folder_of_the_scene_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir(folder.path().join("in")).unwrap();
    fs::write(folder.path().join("out.bin"), [0u8; 64]).unwrap();
    fs::write(folder.path().join("out.mtl"), "newmtl m\n").unwrap();
    let gltf = folder.path().join("in/a.gltf");
    for uri in ["../out.bin", "%2e%2e/out.bin", "/etc/hostname"] {
        let text = format!(
            r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[]}}],"buffers":[{{"uri":"{uri}","byteLength":4}}]}}"#
        );
        fs::write(&gltf, text).unwrap();
        assert_says(
            MeshScene::load(&gltf).map(drop),
            &["leaves the scene's folder", "put that file beside", "a.gltf"],
        );
    }
    let obj = folder.path().join("in/a.obj");
    fs::write(&obj, "mtllib ../out.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").unwrap();
    assert_says(MeshScene::load(&obj).map(drop), &["leaves the scene's folder", "a.obj"]);
}

#[test]
fn geometry_that_exceeds_the_memory_is_refused_with_what_it_needs() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("demo.glb");
    pbgi_points::demo::write_glb(&path).unwrap();
    let scene = MeshScene::load(&path).unwrap();
    let needed = scene.memory_bytes();
    assert!(MeshScene::load_within(&[&path], needed).is_ok());
    let refused = MeshScene::load_within(&[&path], needed - 1).map(drop);
    assert_says(
        refused,
        &["not enough memory", "geometry", &needed.to_string(), "--memory"],
    );
    // Before it is read at all.
    assert_says(
        MeshScene::load_within(&[&path], 1000).map(drop),
        &["1000 bytes are available"],
    );
    // Two files need both.
    assert!(MeshScene::load_within(&[&path, &path], needed + needed / 2).is_err());
}
