//! Points on meshes: even, the right number, the right light, the same every time.

#![allow(clippy::unwrap_used, reason = "a step that fails is a test that fails")]

mod common;

use common::{GltfScene, assert_says, collect, png_uri, sample, shared};
use glam::Vec3;
use pbgi_core::{PointRecord, PointStream};
use pbgi_points::{Density, InputOptions, MeshPoints, MeshScene, SampleOptions, ViewDensity, open_input};
use serde_json::json;
use std::collections::HashMap;
use std::f32::consts::PI;

/// A 2 x 2 floor at y = 0 that faces up.
fn floor(scene: &mut GltfScene, material: Option<usize>) -> usize {
    scene.rectangle(Vec3::new(-1.0, 0.0, 1.0), Vec3::X * 2.0, Vec3::Z * -2.0, material)
}

/// Mean and smallest distance of a point to its nearest neighbour.
fn nearest_distances(points: &[PointRecord], spacing: f32) -> (f32, f32) {
    let cell = |p: Vec3| (p / (2.0 * spacing)).floor().as_ivec3();
    let mut grid: HashMap<[i32; 3], Vec<Vec3>> = HashMap::new();
    for point in points {
        let p = Vec3::from(point.position);
        grid.entry(cell(p).to_array()).or_default().push(p);
    }
    let (mut sum, mut smallest) = (0.0f64, f32::INFINITY);
    for point in points {
        let p = Vec3::from(point.position);
        let mut nearest = f32::INFINITY;
        for dx in -1..=1 {
            for dy in -1..=1 {
                for dz in -1..=1 {
                    let key = (cell(p) + glam::IVec3::new(dx, dy, dz)).to_array();
                    for q in grid.get(&key).into_iter().flatten() {
                        let distance = p.distance(*q);
                        if distance > 0.0 {
                            nearest = nearest.min(distance);
                        }
                    }
                }
            }
        }
        sum += f64::from(nearest.min(2.0 * spacing));
        smallest = smallest.min(nearest);
    }
    ((sum / points.len() as f64) as f32, smallest)
}

#[test]
fn points_on_a_plane_are_as_even_as_a_lattice() {
    let mut scene = GltfScene::new();
    let mesh = floor(&mut scene, None);
    scene.node(json!({ "mesh": mesh }));
    let points = sample(scene.load().unwrap(), Density::Spacing(0.01));
    assert!((points.len() as f32 / 40_000.0 - 1.0).abs() < 0.01, "{}", points.len());
    let (mean, smallest) = nearest_distances(&points, 0.01);
    // A hexagonal lattice has 1.07, random points 0.5. The seam between the two triangles must not show.
    assert!(mean / 0.01 > 1.0, "{}", mean / 0.01);
    assert!(smallest / 0.01 > 0.9, "{}", smallest / 0.01);
}

#[test]
fn points_on_a_finely_tessellated_sphere_are_far_more_even_than_random_ones() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("sphere.obj");
    let (rows, columns) = (200u32, 400u32);
    let mut text = String::new();
    for row in 0..=rows {
        for column in 0..columns {
            let (theta, phi) = (row as f32 / rows as f32 * PI, column as f32 / columns as f32 * 2.0 * PI);
            let (x, y, z) = (theta.sin() * phi.cos(), theta.cos(), theta.sin() * phi.sin());
            text += &format!("v {x} {y} {z}\n");
        }
    }
    for row in 0..rows {
        for column in 0..columns {
            let (a, b) = (row * columns + column + 1, row * columns + (column + 1) % columns + 1);
            text += &format!("f {a} {b} {}\nf {a} {} {}\n", b + columns, b + columns, a + columns);
        }
    }
    std::fs::write(&path, text).unwrap();
    let points = sample(MeshScene::load(&path).unwrap(), Density::Points(50_000));
    let spacing = (4.0 * PI / 50_000.0).sqrt();
    let (mean, _) = nearest_distances(&points, spacing);
    println!(
        "mean nearest distance {} spacings, {} points",
        mean / spacing,
        points.len()
    );
    assert!(mean / spacing > 0.9, "{}", mean / spacing);
    let area: f32 = points.iter().map(PointRecord::area).sum();
    assert!((area / (4.0 * PI) - 1.0).abs() < 0.01, "{area}");
}

#[test]
fn points_of_many_tiny_triangles_follow_their_area() {
    // Separate triangles, each a tenth of a point large.
    let mut scene = GltfScene::new();
    let (mut positions, n) = (Vec::new(), 100);
    for y in 0..n {
        for x in 0..n {
            let (x, y) = (x as f32, y as f32);
            positions.extend([x, y, 0.0, x + 0.5, y, 0.0, x, y + 0.5, 0.0]);
        }
    }
    let positions = scene.floats(&positions, "VEC3");
    let mesh = scene.push(
        "meshes",
        json!({ "primitives": [{ "attributes": { "POSITION": positions } }] }),
    );
    scene.node(json!({ "mesh": mesh }));
    let points = sample(scene.load().unwrap(), Density::Points(1000));
    assert!(points.len().abs_diff(1000) <= 1, "{}", points.len());
    for half in [0.0, 50.0] {
        let count = points
            .iter()
            .filter(|p| (half..half + 50.0).contains(&p.position[1]))
            .count();
        assert!(count.abs_diff(500) <= 1, "{count}");
    }
}

#[test]
fn discs_add_up_to_the_area_and_lie_inside_of_the_bounds() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("demo.glb");
    pbgi_points::demo::write_glb(&path).unwrap();
    let scene = MeshScene::load(&path).unwrap();
    let (area, bounds) = (scene.area(), scene.bounds());
    let points = sample(scene, Density::Points(100_000));
    let sum: f64 = points.iter().map(|point| f64::from(point.area())).sum();
    assert!((sum / area - 1.0).abs() < 0.01, "{sum} of {area}");
    assert!(points.len().abs_diff(100_000) < 2000, "{}", points.len());
    assert!(points.iter().all(|point| bounds.contains(point.position)));
}

#[test]
fn sampling_is_the_same_every_time_whatever_the_threads_and_after_rewind() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("demo.glb");
    pbgi_points::demo::write_glb(&path).unwrap();
    let options = |threads| InputOptions {
        density: Density::Points(60_000),
        threads,
        ..InputOptions::default()
    };
    let mut stream = open_input(std::slice::from_ref(&path), &options(2)).unwrap();
    let first = collect(&mut stream);
    stream.rewind().unwrap();
    assert_eq!(first, collect(&mut stream));
    assert_eq!(first, collect(&mut open_input(&[path], &options(1)).unwrap()));
}

#[test]
fn batches_are_bounded_even_on_one_huge_triangle() {
    let mut scene = GltfScene::new();
    let positions = scene.floats(&[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0], "VEC3");
    let mesh = scene.push(
        "meshes",
        json!({ "primitives": [{ "attributes": { "POSITION": positions } }] }),
    );
    scene.node(json!({ "mesh": mesh }));
    let options = SampleOptions {
        density: Density::Points(100_000),
        threads: 1,
    };
    let mut stream = MeshPoints::new(scene.load().unwrap(), &options).unwrap();
    let mut total = 0;
    loop {
        let mut batch = Vec::new();
        if !stream.next_batch(&mut batch).unwrap() {
            break;
        }
        assert!(batch.len() <= pbgi_points::limits::BATCH_POINTS);
        total += batch.len();
    }
    assert!((total as f32 / 1e5 - 1.0).abs() < 0.01, "{total}");
}

#[test]
fn each_side_carries_the_light_that_it_received() {
    for (height, lit_front) in [(2.0, true), (-2.0, false)] {
        let mut scene = GltfScene::new();
        let half = json!({ "pbrMetallicRoughness": { "baseColorFactor": [0.5, 0.25, 1.0, 1.0] } });
        let material = scene.push("materials", half);
        let mesh = floor(&mut scene, Some(material));
        scene.node(json!({ "mesh": mesh }));
        let light = json!({ "type": "point", "color": [1.0, 1.0, 0.5], "intensity": 8.0 });
        scene.light(light, json!({ "translation": [0.0, height, 0.0] }));
        let points = sample(scene.load().unwrap(), Density::Points(10_000));
        for point in &points {
            assert!(point.normal().distance(Vec3::Y) < 1e-3);
            let d = Vec3::from(point.position).distance(Vec3::new(0.0, height, 0.0));
            let e = 8.0 * (2.0 / d) / (d * d);
            let expected = [0.5 * e / PI, 0.25 * e / PI, 0.5 * e / PI];
            let sides = point.sides();
            let (lit, dark) = if lit_front {
                (sides.front, sides.back)
            } else {
                (sides.back, sides.front)
            };
            assert_eq!(dark, [0.0; 3]);
            for channel in 0..3 {
                assert!(
                    (lit[channel] - expected[channel]).abs() < 2e-3 * expected[0],
                    "{lit:?} {expected:?}"
                );
            }
        }
    }
}

#[test]
fn shadows_fall_where_the_light_is_blocked_and_masks_let_it_through() {
    // A sun from above, a small square above the floor: its left half is cut out by its texture.
    let mut scene = GltfScene::new();
    let texels = [[255, 255, 255, 0], [255, 255, 255, 255]];
    let image = scene.push("images", json!({ "uri": png_uri(2, 1, &texels) }));
    let sampler = scene.push("samplers", json!({ "wrapS": 33071, "wrapT": 33071 }));
    let texture = scene.push("textures", json!({ "source": image, "sampler": sampler }));
    let mask = scene.push(
        "materials",
        json!({
            "pbrMetallicRoughness": { "baseColorTexture": { "index": texture } }, "alphaMode": "MASK", "alphaCutoff": 0.5,
        }),
    );
    let ground = floor(&mut scene, None);
    let screen = scene.rectangle(Vec3::new(-0.5, 0.5, 0.5), Vec3::X, Vec3::Z * -1.0, Some(mask));
    scene.node(json!({ "mesh": ground }));
    scene.node(json!({ "mesh": screen }));
    let down = json!({ "rotation": [-std::f32::consts::FRAC_1_SQRT_2, 0.0, 0.0, std::f32::consts::FRAC_1_SQRT_2] });
    scene.light(json!({ "type": "directional", "intensity": 3.0 }), down);
    let points = sample(scene.load().unwrap(), Density::Points(50_000));
    let (mut shadowed, mut through, mut on_screen) = (0, 0, 0);
    for point in &points {
        let [x, y, z] = point.position;
        let lit = point.sides().front[0];
        if y > 0.25 {
            on_screen += 1;
            assert!(x > -0.01, "no points where the texture cuts the screen out: {x}");
        } else if z.abs() < 0.49 && x > 0.01 && x < 0.49 {
            shadowed += 1;
            assert_eq!(lit, 0.0, "in the shadow of the screen at {x} {z}");
        } else {
            assert!(
                !(z.abs() < 0.49 && x > -0.49 && x < -0.01) || lit > 0.9,
                "through the hole"
            );
            through += usize::from(lit > 0.9);
            if x.abs() > 0.51 || z.abs() > 0.51 {
                assert!((lit - 3.0 / PI).abs() < 2e-3, "{lit}");
            }
        }
    }
    assert!(
        shadowed > 1000 && through > 10_000 && on_screen > 1000,
        "{shadowed} {through} {on_screen}"
    );
}

#[test]
fn emission_is_radiance_and_leaves_the_back_of_double_sided_materials_only() {
    for double_sided in [false, true] {
        let mut scene = GltfScene::new();
        scene.document["extensionsUsed"] = json!(["KHR_materials_emissive_strength"]);
        let glow = scene.push(
            "materials",
            json!({
                "doubleSided": double_sided, "emissiveFactor": [1.0, 0.5, 0.0],
                "extensions": { "KHR_materials_emissive_strength": { "emissiveStrength": 4.0 } },
            }),
        );
        let mesh = floor(&mut scene, Some(glow));
        scene.node(json!({ "mesh": mesh }));
        let points = sample(scene.load().unwrap(), Density::Points(100));
        let back = if double_sided { [4.0, 2.0, 0.0] } else { [0.0; 3] };
        assert!(
            points
                .iter()
                .all(|p| p.sides().front == [4.0, 2.0, 0.0] && p.sides().back == back)
        );
    }
}

#[test]
fn instances_are_placed_mirrored_and_lit_like_copies() {
    let mut scene = GltfScene::new();
    let mesh = scene.rectangle(Vec3::ZERO, Vec3::X, Vec3::Z * -1.0, None);
    scene.node(json!({ "mesh": mesh, "translation": [5.0, 1.0, 0.0], "scale": [2.0, 1.0, 3.0] }));
    scene.node(json!({ "mesh": mesh, "scale": [-1.0, 1.0, 1.0] }));
    let loaded = scene.load().unwrap();
    assert_eq!(loaded.triangle_count(), 4);
    assert!((loaded.area() - 7.0).abs() < 1e-9);
    assert_eq!(
        (loaded.bounds().min, loaded.bounds().max),
        ([-1.0, 0.0, -3.0], [7.0, 1.0, 0.0])
    );
    let points = sample(loaded, Density::Points(7000));
    let high = points.iter().filter(|p| p.position[1] > 0.5).count();
    assert!(high.abs_diff(6000) < 100, "{high}");
    assert!(
        points.iter().all(|p| p.normal().distance(Vec3::Y) < 1e-3),
        "mirroring keeps the front"
    );
}

#[test]
fn densities_out_of_range_are_refused() {
    let load = || {
        let mut scene = GltfScene::new();
        let mesh = floor(&mut scene, None);
        scene.node(json!({ "mesh": mesh }));
        scene.load().unwrap()
    };
    for density in [
        Density::Spacing(0.0),
        Density::Spacing(f32::NAN),
        Density::Spacing(1e-9),
        Density::Points(0),
        Density::Points(u64::MAX),
    ] {
        let options = SampleOptions { density, threads: 1 };
        assert_says(MeshPoints::new(load(), &options).map(drop), &["must be"]);
    }
}

#[test]
fn sponza_gives_two_hundred_thousand_lit_points_with_its_masks_cut_out() {
    let Some(path) = shared("data/sponza/sponza_lit.gltf") else {
        return;
    };
    let scene = MeshScene::load(&path).unwrap();
    assert_eq!(scene.lights().len(), 1);
    assert_eq!(scene.cameras().len(), 2);
    assert!(
        (261_000..=262_267).contains(&scene.triangle_count()),
        "{}",
        scene.triangle_count()
    );
    let points = sample(scene, Density::Points(200_000));
    let lit = points
        .iter()
        .filter(|p| p.sides().front[0] > 0.0 || p.sides().back[0] > 0.0)
        .count();
    assert!(
        (points.len() / 50..points.len() / 2).contains(&lit),
        "{lit} are lit by the sun"
    );

    // The same without masks: leaves and chains are whole rectangles.
    let mut document: serde_json::Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    for list in ["images", "buffers"] {
        for entry in document[list].as_array_mut().unwrap() {
            entry["uri"] = json!(format!("sponza/{}", entry["uri"].as_str().unwrap()));
        }
    }
    for material in document["materials"].as_array_mut().unwrap() {
        material.as_object_mut().unwrap().remove("alphaMode");
        material.as_object_mut().unwrap().remove("alphaCutoff");
    }
    let folder = tempfile::tempdir().unwrap();
    std::os::unix::fs::symlink(path.parent().unwrap(), folder.path().join("sponza")).unwrap();
    let opaque = folder.path().join("opaque.gltf");
    std::fs::write(&opaque, document.to_string()).unwrap();
    let whole = sample(MeshScene::load(&opaque).unwrap(), Density::Points(200_000));
    println!("{} points, {} without masks, {lit} lit", points.len(), whole.len());
    assert!(whole.len() - points.len() > 400);
}

#[test]
fn points_are_as_large_as_the_camera_sees_them_between_floor_and_ceiling() {
    // A ground of 200 by 200 seen along it from above its middle.
    let mut scene = GltfScene::new();
    let ground = [
        -100.0, 0.0, -100.0, -100.0, 0.0, 100.0, 100.0, 0.0, 100.0, 100.0, 0.0, -100.0,
    ];
    let positions = scene.floats(&ground, "VEC3");
    let indices: Vec<u8> = [0u16, 1, 2, 0, 2, 3]
        .iter()
        .flat_map(|index| index.to_le_bytes())
        .collect();
    let indices = scene.accessor(&indices, 6, 5123, "SCALAR");
    let mesh = scene.push(
        "meshes",
        json!({ "primitives": [{ "attributes": { "POSITION": positions }, "indices": indices }] }),
    );
    let camera = scene.push(
        "cameras",
        json!({ "type": "perspective", "perspective": { "yfov": 0.9, "znear": 0.1 } }),
    );
    scene.node(json!({ "mesh": mesh }));
    scene.node(json!({ "camera": camera, "translation": [0.0, 2.0, 0.0] }));
    let folder = tempfile::tempdir().unwrap();
    let scene = MeshScene::load(&scene.write(folder.path())).unwrap();
    let (floor, ceiling) = (0.1, 2.0);
    let density = Density::View(ViewDensity {
        camera: 0,
        size: [400, 300],
        pixels: 2.0,
        floor: Some(floor),
        ceiling: Some(ceiling),
    });
    let options = SampleOptions {
        density,
        ..SampleOptions::default()
    };
    let mut stream = MeshPoints::new(scene, &options).unwrap();
    let points = collect(&mut stream);
    stream.rewind().unwrap();
    assert!(points == collect(&mut stream));
    let area: f64 = points.iter().map(|point| f64::from(point.area())).sum();
    assert!((area / 40_000.0 - 1.0).abs() < 0.03, "{area}");
    let pixel = 2.0 * (0.45f32).tan() / 300.0;
    let (mut seen, mut behind) = (0, 0);
    for point in &points {
        let [x, _, z] = point.position;
        let (distance, spacing) = ((x * x + z * z + 4.0).sqrt(), point.area().sqrt());
        assert!((floor * 0.99..ceiling * 1.2).contains(&spacing), "{spacing}");
        let wanted = (2.0 * pixel * distance).clamp(floor, ceiling);
        if z < -x.abs() - 10.0 {
            seen += 1;
            assert!(
                (0.6..1.5).contains(&(spacing / wanted)),
                "{spacing} at {distance}, {wanted} wanted"
            );
        } else if z > 20.0 {
            behind += 1;
            assert!(
                spacing > 1.5 * wanted,
                "{spacing} at {distance} behind, {wanted} in front"
            );
        }
    }
    assert!(seen > 4 * behind, "{seen} in front, {behind} behind");
}
