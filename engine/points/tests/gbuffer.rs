//! G-buffers: equal to the independent reference, read under many names, never larger than the limits.

#![allow(clippy::unwrap_used, reason = "a step that fails is a test that fails")]

mod common;

use common::{assert_says, shared};
use glam::{Mat4, Vec3};
use pbgi_points::{
    Camera, GBuffer, GBufferOptions, LayeredImage, MeshScene, PassThrough, Precision, Space, ToneMap, Window, write_png,
};
use std::path::Path;

/// sqrt(mean((x - reference)^2)) / mean(reference) over the covered pixels.
fn relative_rms(ours: &[[f32; 3]], reference: &[[f32; 3]], coverage: &[f32]) -> f64 {
    let (mut squares, mut sum, mut count) = (0.0, 0.0, 0.0);
    for ((ours, reference), covered) in ours.iter().zip(reference).zip(coverage) {
        if *covered == 1.0 {
            for (a, b) in ours.iter().zip(reference) {
                squares += f64::from(a - b).powi(2);
                sum += f64::from(b.abs());
                count += 1.0;
            }
        }
    }
    (squares / count).sqrt() / (sum / count)
}

#[test]
fn the_cornell_box_matches_the_reference() {
    let (Some(scene), Some(gbuffer), Some(reference)) = (
        shared("reference/cornell.glb"),
        shared("reference/cornell.gbuffer.exr"),
        shared("reference/cornell.reference.exr"),
    ) else {
        return;
    };
    let scene = MeshScene::load(&scene).unwrap();
    let ours = GBuffer::render(&scene, &scene.camera(0).unwrap(), 256, 256).unwrap();
    let theirs = GBuffer::read(&gbuffer).unwrap();
    assert_eq!(ours.data_window, theirs.data_window);
    let near = |a: &[f32; 3], b: &[f32; 3], eps: f32| Vec3::from(*a).distance(Vec3::from(*b)) < eps;
    let (our_albedo, their_albedo) = (ours.albedo.as_ref().unwrap(), theirs.albedo.as_ref().unwrap());
    let mut coverage = theirs.coverage.clone();
    let mut on_edges = 0;
    for (i, coverage) in coverage.iter_mut().enumerate() {
        assert_eq!(ours.coverage[i], theirs.coverage[i]);
        assert!(near(&ours.position[i], &theirs.position[i], 1e-5), "pixel {i}");
        let same_normal = near(&ours.normal[i], &theirs.normal[i], 1e-3);
        if !(same_normal && near(&our_albedo[i], &their_albedo[i], 1e-3)) {
            on_edges += 1;
        }
        // The box's edges lie on the picture's diagonals: those rays hit two walls at once, and which one is luck.
        let [x, y, z] = ours.position[i];
        let walls = [(x.abs() - 1.0), (y - 1.0).abs() - 1.0, z + 1.0];
        if walls.iter().filter(|distance| distance.abs() < 1e-5).count() > 1 {
            *coverage = 0.0;
        }
    }
    assert!(on_edges <= 128, "{on_edges} pixels differ");
    let reference = LayeredImage::read_exr(&reference).unwrap();
    let direct = reference.triple("direct").unwrap();
    let error = relative_rms(ours.direct.as_ref().unwrap(), &direct, &coverage);
    println!("direct light: relative RMS {error:.4}");
    assert!(error < 1e-3, "{error}");
}

#[test]
fn a_gbuffer_survives_its_file() {
    let folder = tempfile::tempdir().unwrap();
    let glb = folder.path().join("demo.glb");
    pbgi_points::demo::write_glb(&glb).unwrap();
    let scene = MeshScene::load(&glb).unwrap();
    let gbuffer = GBuffer::render(&scene, &scene.camera(0).unwrap(), 100, 70).unwrap();
    let path = folder.path().join("g.exr");
    gbuffer.write(&path).unwrap();
    let read = GBuffer::read(&path).unwrap();
    assert_eq!(read.position, gbuffer.position);
    assert_eq!(read.normal, gbuffer.normal);
    assert_eq!(read.coverage, gbuffer.coverage);
    assert_eq!(read.world_to_camera, gbuffer.world_to_camera);
    assert_eq!(read.world_to_ndc, gbuffer.world_to_ndc);
    let close = |a: &Option<Vec<[f32; 3]>>, b: &Option<Vec<[f32; 3]>>| {
        let (a, b) = (a.as_ref().unwrap(), b.as_ref().unwrap());
        a.iter()
            .flatten()
            .zip(b.iter().flatten())
            .all(|(a, b)| (a - b).abs() <= b.abs() * 1e-3)
    };
    assert!(close(&read.albedo, &gbuffer.albedo));
    assert!(close(&read.direct, &gbuffer.direct));
    assert!(close(&read.emission, &gbuffer.emission));
    assert!(gbuffer.emission.unwrap().iter().any(|e| e[0] > 4.0), "the panel glows");
}

#[test]
fn positions_project_back_to_their_pixels() {
    let folder = tempfile::tempdir().unwrap();
    let glb = folder.path().join("demo.glb");
    pbgi_points::demo::write_glb(&glb).unwrap();
    let scene = MeshScene::load(&glb).unwrap();
    let camera = Camera::look_at(Vec3::new(0.7, 1.2, 4.0), Vec3::new(0.0, 0.9, 0.0), 0.6);
    let gbuffer = GBuffer::render(&scene, &camera, 64, 48).unwrap();
    let to_camera: Mat4 = gbuffer.world_to_camera.unwrap();
    let tangent = (camera.fov_y / 2.0).tan();
    for (pixel, position) in gbuffer.position.iter().enumerate() {
        if gbuffer.is_hole(pixel) {
            continue;
        }
        let p = to_camera.transform_point3(Vec3::from(*position));
        assert!(p.z > 0.0, "left-handed: z points into the picture");
        let column = (p.x / p.z / tangent * 48.0 + 64.0) / 2.0;
        let row = (48.0 - p.y / p.z / tangent * 48.0) / 2.0;
        assert!((column - (pixel % 64) as f32 - 0.5).abs() < 0.01, "{column}");
        assert!((row - (pixel / 64) as f32 - 0.5).abs() < 0.01, "{row}");
        let towards = Vec3::from(gbuffer.normal[pixel]).dot(camera.eye() - Vec3::from(*position));
        assert!(towards > 0.0, "normals face the camera");
    }
}

/// A picture of other renderers' channels: positions 1, normals up.
fn foreign(position: [&str; 3], normal: [&str; 3]) -> LayeredImage {
    let window = Window {
        x: -3,
        y: 5,
        width: 9,
        height: 7,
    };
    let display = Window::of_size(20, 20);
    let mut image = LayeredImage::with_windows(window, display);
    for (axis, (p, n)) in position.iter().zip(normal).enumerate() {
        image.add(*p, Precision::Float, vec![1.0; 63]);
        image.add(n, Precision::Half, vec![if axis == 1 { 1.0 } else { 0.0 }; 63]);
    }
    image
}

#[test]
fn other_renderers_passes_are_read_with_their_windows() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("passes.exr");
    for (position, normal) in [
        (["P.X", "P.Y", "P.Z"], ["N.X", "N.Y", "N.Z"]),
        (
            ["Pworld.r", "Pworld.g", "Pworld.b"],
            ["Nworld.r", "Nworld.g", "Nworld.b"],
        ),
        (
            ["ViewLayer.Position.X", "ViewLayer.Position.Y", "ViewLayer.Position.Z"],
            ["ViewLayer.Normal.X", "ViewLayer.Normal.Y", "ViewLayer.Normal.Z"],
        ),
        (["WP.R", "WP.G", "WP.B"], ["normals.x", "normals.y", "normals.z"]),
    ] {
        foreign(position, normal).write_exr(&path).unwrap();
        let read = GBuffer::read(&path).unwrap();
        assert_eq!(read.position, vec![[1.0; 3]; 63]);
        assert_eq!(read.normal, vec![[0.0, 1.0, 0.0]; 63]);
        assert_eq!((read.data_window.x, read.data_window.y), (-3, 5));
        assert_eq!(read.display_window, Window::of_size(20, 20));
        assert_eq!(read.hole_count(), 0, "without A every pixel counts");
        assert!(read.albedo.is_none());
    }
    let odd = foreign(["where.X", "where.Y", "where.Z"], ["up.X", "up.Y", "up.Z"]);
    odd.write_exr(&path).unwrap();
    assert_says(
        GBuffer::read(&path),
        &["no world position", "where.X", "up.Z", "--position", "passes.exr"],
    );
    let named = GBufferOptions {
        position: Some("where".to_owned()),
        normal: Some("up".to_owned()),
        space: Space::Checked,
    };
    assert_eq!(GBuffer::read_with(&path, &named).unwrap().hole_count(), 0);
}

/// What the demo's room looks like from a place of no special kind.
fn view() -> GBuffer {
    let folder = tempfile::tempdir().unwrap();
    let glb = folder.path().join("demo.glb");
    pbgi_points::demo::write_glb(&glb).unwrap();
    let scene = MeshScene::load(&glb).unwrap();
    let camera = Camera::look_at(Vec3::new(0.7, 1.2, 4.0), Vec3::new(0.0, 0.9, 0.0), 0.6);
    GBuffer::render(&scene, &camera, 96, 64).unwrap()
}

#[test]
fn positions_of_a_cameras_space_are_refused_or_converted() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("passes.exr");
    let world = view();
    let matrix = world.world_to_camera.unwrap();
    let with = |space| GBufferOptions {
        space,
        ..GBufferOptions::default()
    };
    for along in [1.0, -1.0] {
        let flip = Vec3::new(1.0, 1.0, along);
        let mut seen = world.clone();
        for pixel in (0..world.pixel_count()).filter(|&pixel| !world.is_hole(pixel)) {
            let moved = |v: Vec3| (v * flip).to_array();
            seen.position[pixel] = moved(matrix.transform_point3(Vec3::from(world.position[pixel])));
            seen.normal[pixel] = moved(matrix.transform_vector3(Vec3::from(world.normal[pixel])));
        }
        seen.write(&path).unwrap();
        assert_says(GBuffer::read(&path), &["camera space", "--space camera", "passes.exr"]);
        let back = GBuffer::read_with(&path, &with(Space::Camera)).unwrap();
        for pixel in (0..world.pixel_count()).filter(|&pixel| !world.is_hole(pixel)) {
            for (back, world) in [(&back.position, &world.position), (&back.normal, &world.normal)] {
                assert!(Vec3::from(back[pixel]).distance(Vec3::from(world[pixel])) < 1e-4);
            }
        }
        assert_eq!(back.hole_count(), world.hole_count());
        seen.world_to_camera = None;
        seen.write(&path).unwrap();
        assert_says(GBuffer::read(&path), &["camera space", "--space world", "passes.exr"]);
        assert_says(
            GBuffer::read_with(&path, &with(Space::Camera)),
            &["worldToCamera", "render a world-space", "passes.exr"],
        );
        assert_eq!(
            GBuffer::read_with(&path, &with(Space::World)).unwrap().position,
            seen.position
        );
    }
    // World positions are taken as they are, whether the file says where its camera was or not.
    for matrix in [Some(matrix), None] {
        let mut plain = world.clone();
        plain.world_to_camera = matrix;
        plain.write(&path).unwrap();
        assert_eq!(GBuffer::read(&path).unwrap().position, world.position);
    }
}

#[test]
fn parts_of_different_windows_are_put_together() {
    use exr::prelude::{AnyChannel, AnyChannels, Encoding, FlatSamples, Image, ImageAttributes, IntegerBounds};
    use exr::prelude::{Layer, LayerAttributes, Text, Vec2, WritableImage};
    let part = |name: &str, corner: Vec2<i32>, size: Vec2<usize>, value: f32| {
        let channels = ["X", "Y", "Z"].map(|axis| {
            let samples = FlatSamples::F32(vec![value; size.area()]);
            AnyChannel::new(Text::new_or_panic(axis), samples)
        });
        let attributes = LayerAttributes {
            layer_position: corner,
            ..LayerAttributes::named(Text::new_or_panic(name))
        };
        Layer::new(
            size,
            attributes,
            Encoding::UNCOMPRESSED,
            AnyChannels::sort(channels.into_iter().collect()),
        )
    };
    let display = ImageAttributes::new(IntegerBounds::from_dimensions(Vec2(10, 10)));
    let layers = [
        part("P", Vec2(2, 3), Vec2(5, 4), 2.0),
        part("N", Vec2(-1, 4), Vec2(6, 5), 1.0),
        part("Z", Vec2(-4000, -4000), Vec2(2, 2), 9.0),
    ];
    let mut image = Image::from_layers(display, layers.into_iter().collect::<exr::prelude::SmallVec<_>>());
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("parts.exr");
    image.write().to_file(&path).unwrap();
    let read = GBuffer::read(&path).unwrap();
    let window = |x, y, width, height| Window { x, y, width, height };
    assert_eq!(read.data_window, window(-1, 3, 8, 6));
    for pixel in 0..read.pixel_count() {
        let (x, y) = (pixel as i32 % 8 - 1, pixel as i32 / 8 + 3);
        let (inside_p, inside_n) = ((2..7).contains(&x) && (3..7).contains(&y), x < 5 && y >= 4);
        assert_eq!(read.position[pixel][1], if inside_p { 2.0 } else { 0.0 }, "{x} {y}");
        assert_eq!(read.is_hole(pixel), !inside_n, "{x} {y}");
    }
    // Far apart, two small parts are one huge picture.
    image.layer_data[1].attributes.layer_position = Vec2(1 << 20, 1 << 20);
    image.write().to_file(&path).unwrap();
    assert_says(GBuffer::read(&path), &["pixels of all parts together", "parts.exr"]);
}

#[test]
fn what_is_passed_through_outlives_the_name_of_its_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("passes.exr");
    let mut image = foreign(["P.X", "P.Y", "P.Z"], ["N.X", "N.Y", "N.Z"]);
    let ids: Vec<f32> = (0..63u32).map(|i| f32::from_bits(0x1234_5678 ^ (i << 18))).collect();
    image.add("CryptoObject00.R", Precision::Float, ids.clone());
    for (key, value) in [
        ("cryptomatte/1/name", "CryptoObject"),
        ("show", "dune"),
        ("pbgi/holes", "3"),
    ] {
        image.metadata.insert(key.to_owned(), value.to_owned());
    }
    image.write_exr(&path).unwrap();
    let passed = PassThrough::open(&path).unwrap();
    std::fs::remove_file(&path).unwrap();
    assert_eq!(passed.channel_count(), 1);
    let read = passed.read(image.data_window).unwrap();
    assert_eq!(read.channel("CryptoObject00.R").unwrap(), ids);
    assert_eq!(read.channels.len(), 1);
    assert!(read.metadata["show"] == "dune" && !read.metadata.contains_key("pbgi/holes"));
    // A window of its own: what lies beyond is left out, what is lacking is 0.
    let shifted = passed
        .read(Window {
            x: -1,
            ..image.data_window
        })
        .unwrap();
    let row = &shifted.channel("CryptoObject00.R").unwrap()[9..18];
    assert_eq!(row[..7], ids[11..18]);
    assert_eq!(row[7..], [0.0; 2]);
}

#[test]
fn holes_are_pixels_without_coverage_or_with_broken_numbers() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("holes.exr");
    let mut image = foreign(["P.X", "P.Y", "P.Z"], ["N.X", "N.Y", "N.Z"]);
    image.add("A", Precision::Half, vec![1.0; 63]);
    let mut set = |channel: &str, pixel: usize, value: f32| {
        image.channels.get_mut(channel).unwrap().values[pixel] = value;
    };
    set("P.Y", 0, f32::NAN);
    set("P.X", 1, f32::INFINITY);
    set("N.Z", 2, f32::NEG_INFINITY);
    set("N.Y", 3, 0.0);
    set("A", 4, 0.0);
    set("A", 5, f32::NAN);
    set("A", 6, 0.5);
    image.write_exr(&path).unwrap();
    let read = GBuffer::read(&path).unwrap();
    let holes: Vec<usize> = (0..63).filter(|&pixel| read.is_hole(pixel)).collect();
    assert_eq!(holes, [0, 1, 2, 3, 4, 5]);
    assert_eq!(read.hole_count(), 6);
}

#[test]
fn impossible_pictures_are_refused_before_memory_is_taken() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bad.exr");
    let good = foreign(["P.X", "P.Y", "P.Z"], ["N.X", "N.Y", "N.Z"]);
    good.write_exr(&path).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    // The data window announces 2^30 pixels.
    let name = b"dataWindow\0box2i\0";
    let at = bytes.windows(name.len()).position(|window| window == name).unwrap() + name.len() + 4;
    let mut bomb = bytes.clone();
    let chunks = b"chunkCount\0int\0";
    let chunks = bytes.windows(chunks.len()).position(|window| window == chunks).unwrap() + chunks.len() + 4;
    bomb[chunks..chunks + 4].copy_from_slice(&(1i32 << 20).to_le_bytes());
    for (index, value) in [0i32, 0, (1 << 15) - 1, (1 << 15) - 1].iter().enumerate() {
        bomb[at + 4 * index..at + 4 * index + 4].copy_from_slice(&value.to_le_bytes());
    }
    std::fs::write(&path, bomb).unwrap();
    assert_says(GBuffer::read(&path), &["number of pixels", "1073741824", "bad.exr"]);
    let mut wide = LayeredImage::new(4, 4);
    for channel in 0..1025 {
        wide.add(format!("c{channel}"), Precision::Half, vec![0.0; 16]);
    }
    wide.write_exr(&path).unwrap();
    assert_says(GBuffer::read(&path), &["number of channels", "1025", "1024"]);
    for length in [0, 3, 100, bytes.len() / 2, bytes.len() - 1] {
        std::fs::write(&path, &bytes[..length]).unwrap();
        assert_says(GBuffer::read(&path), &["bad.exr"]);
    }
    assert_says(GBuffer::read(Path::new("nowhere.exr")), &["cannot open", "nowhere.exr"]);
}

#[test]
fn a_size_of_zero_or_beyond_the_limits_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let glb = folder.path().join("demo.glb");
    pbgi_points::demo::write_glb(&glb).unwrap();
    let scene = MeshScene::load(&glb).unwrap();
    let camera = scene.camera(0).unwrap();
    for (width, height) in [(0, 5), (5, 0), (u32::MAX, u32::MAX)] {
        assert_says(GBuffer::render(&scene, &camera, width, height), &["must have 1 to"]);
    }
    assert_says(scene.camera(3), &["camera 3", "has 1"]);
}

/// Not a promise but a look: `cargo test -p pbgi-points --test gbuffer -- --ignored`, then view the pictures.
#[test]
#[ignore = "writes pictures for a person to look at"]
fn pictures_for_looking_at() {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR"));
    let demo = folder.join("demo.glb");
    pbgi_points::demo::write_glb(&demo).unwrap();
    let sponza = shared("data/sponza/sponza_lit.gltf");
    let tree = shared("data/tree/scene.gltf");
    let scenes = [Some(demo), sponza.clone(), sponza, tree];
    for (index, path) in scenes.into_iter().enumerate() {
        let Some(path) = path else { continue };
        let scene = MeshScene::load(&path).unwrap();
        let camera = scene.camera(usize::from(index == 2)).unwrap();
        let gbuffer = GBuffer::render(&scene, &camera, 640, 360).unwrap();
        let (albedo, direct) = (gbuffer.albedo.unwrap(), gbuffer.direct.unwrap());
        let emission = gbuffer.emission.unwrap();
        let ambient = if index == 3 { 3.0 } else { 0.3 };
        let beauty: Vec<[f32; 3]> = (0..albedo.len())
            .map(|i| {
                std::array::from_fn(|c| albedo[i][c] / std::f32::consts::PI * (direct[i][c] + ambient) + emission[i][c])
            })
            .collect();
        let out = folder.join(format!("look{index}.png"));
        write_png(&out, 640, 360, &beauty, ToneMap::Filmic).unwrap();
        println!("{}", out.display());
    }
}
