//! Clouds without a renderer: light baked onto points, and pictures of scenes that have no meshes.

#![allow(clippy::unwrap_used, reason = "tests")]

use pbgi_core::{PointRecord, PointStream};
use pbgi_points::{GBuffer, InputOptions, Window, open_input};
use pbgi_tests::{DAEMON, House, Picture, Signal, rms, signal, wait_for};
use std::fs;
use std::path::Path;
use std::time::Duration;

fn points(path: &Path) -> Vec<PointRecord> {
    let mut points = Vec::new();
    let mut stream = open_input(&[path.to_owned()], &InputOptions::default()).unwrap();
    while stream.next_batch(&mut points).unwrap() {}
    points
}

/// The rows of a binary PLY file of floats.
fn rows(path: &Path) -> Vec<Vec<f32>> {
    let bytes = fs::read(path).unwrap();
    let end = b"end_header\n";
    let start = bytes.windows(end.len()).position(|text| text == end).unwrap() + end.len();
    let header = String::from_utf8_lossy(&bytes[..start]).into_owned();
    let numbers = header.matches("property float").count();
    let floats: Vec<f32> = bytes[start..]
        .chunks_exact(4)
        .map(|word| f32::from_le_bytes([word[0], word[1], word[2], word[3]]))
        .collect();
    floats.chunks_exact(numbers).map(<[f32]>::to_vec).collect()
}

#[test]
fn points_get_what_a_picture_of_them_would_show() {
    let house = House::new();
    house.furnish(20_000, "16x16");
    house
        .line(&format!(
            "filter demo.pbgi demo.ply -o lit.ply --channels occlusion,irradiance,bentnormal --stats lit.json {DAEMON}"
        ))
        .ok();
    let (given, lit) = (points(&house.path("demo.ply")), rows(&house.path("lit.ply")));
    assert_eq!(given.len(), lit.len());
    // In the order of the file, with everything that a point had.
    for (row, old) in lit.iter().zip(rows(&house.path("demo.ply"))) {
        assert_eq!(row[..17], old);
    }
    // A picture whose pixels are the first points.
    let edge = 64;
    let shown = &given[..edge * edge];
    let picture = GBuffer {
        data_window: Window::of_size(edge as u32, edge as u32),
        display_window: Window::of_size(edge as u32, edge as u32),
        world_to_camera: None,
        world_to_ndc: None,
        position: shown.iter().map(|point| point.position).collect(),
        normal: shown.iter().map(|point| point.normal().to_array()).collect(),
        coverage: vec![1.0; shown.len()],
        albedo: None,
        direct: None,
        emission: None,
    };
    picture.write(&house.path("points.exr")).unwrap();
    house
        .line(&format!(
            "shade demo.pbgi --gbuffer points.exr -o points_lit.exr {DAEMON}"
        ))
        .ok();
    let shaded = Picture::read(&house.path("points_lit.exr"));
    let names = ["occlusion.Z", "indirect.R", "indirect.G", "indirect.B", "bentnormal.X"];
    for (column, name) in names.into_iter().enumerate() {
        for (row, &value) in lit.iter().zip(shaded.channel(name)) {
            let baked = row[17 + column];
            // The picture may be in half precision.
            assert!(
                (baked - value).abs() <= 1e-3 * value.abs() + 1e-3,
                "{name}: {baked} {value}"
            );
        }
    }
    let statistics = house.statistics("lit.json");
    assert_eq!(statistics["shading_calls"], given.len());
    assert_eq!(
        (&statistics["holes"], &statistics["points_skipped"]),
        (&0.into(), &0.into())
    );
    for name in [
        "points",
        "shading_seconds",
        "sort_seconds",
        "bytes_written",
        "peak_memory_bytes",
    ] {
        assert!(statistics[name].as_f64().unwrap() > 0.0, "{name}");
    }
    // The scene's own points, along the curve, get the same.
    house
        .line(&format!(
            "filter demo.pbgi -o own.ply --channels occlusion,irradiance,bentnormal {DAEMON}"
        ))
        .ok();
    let key = |row: &Vec<f32>| row.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
    let (mut own, mut lit) = (rows(&house.path("own.ply")), lit);
    // Radiance has gone through half precision there.
    let place_and_values = |row: &mut Vec<f32>| drop(row.drain(3..13));
    own.iter_mut().chain(&mut lit).for_each(place_and_values);
    own.sort_by_key(key);
    lit.sort_by_key(key);
    assert!(own == lit);
}

#[test]
fn a_scan_without_normals_or_near_origin_is_baked_where_it_lies() {
    let house = House::new();
    // A plateau above a plain, with coordinates that 32 bits do not hold.
    let mut builder = las::Builder::from((1, 4));
    builder.point_format = las::point::Format::new(3).unwrap();
    let transform = |offset| las::Transform { scale: 0.01, offset };
    builder.transforms = las::Vector {
        x: transform(4_000_000.0),
        y: transform(5_000_000.0),
        z: transform(0.0),
    };
    let path = house.path("scan.las");
    let mut writer = las::Writer::from_path(&path, builder.into_header().unwrap()).unwrap();
    for index in 0..10_000u32 {
        // Neighbours in the file are far apart.
        let cell = index * 7_919 % 10_000;
        let (x, y) = (f64::from(cell % 100), f64::from(cell / 100));
        let point = las::Point {
            x: 4_000_100.0 + x * 0.5,
            y: 5_000_100.0 + y * 0.5,
            z: if x < 50.0 { 0.0 } else { 10.0 },
            classification: las::point::Classification::Ground,
            gps_time: Some(f64::from(index)),
            color: Some(las::Color::new(30_000, 40_000, 50_000)),
            ..las::Point::default()
        };
        writer.write_point(point).unwrap();
    }
    writer.close().unwrap();
    house
        .line(&format!(
            "build scan.las -o scan.pbgi --estimate-normals --radius auto {DAEMON}"
        ))
        .ok();
    house
        .line(&format!("filter scan.pbgi scan.las -o out.laz --channels sky {DAEMON}"))
        .ok();
    let read = |name: &str| -> Vec<las::Point> {
        let mut reader = las::Reader::from_path(house.path(name)).unwrap();
        reader.read_all().unwrap().points().map(Result::unwrap).collect()
    };
    let (before, after) = (read("scan.las"), read("out.laz"));
    let mut sky = Vec::new();
    for (old, new) in before.iter().zip(&after) {
        let (extra, old) = (new.extra_bytes.clone(), old.clone());
        assert_eq!(
            *new,
            las::Point {
                extra_bytes: extra.clone(),
                ..old
            }
        );
        sky.push((new.x - 4_000_100.0, f32::from_le_bytes(extra.try_into().unwrap())));
    }
    assert_eq!(sky.len(), 10_000);
    let mean = |low: f64, high: f64| {
        let chosen: Vec<f32> = sky
            .iter()
            .filter(|(x, _)| (low..high).contains(x))
            .map(|&(_, sky)| sky)
            .collect();
        chosen.iter().sum::<f32>() / chosen.len() as f32
    };
    // Open on the plateau, open far from it, half shut at its foot.
    assert!(
        mean(30.0, 48.0) > 0.97 && mean(0.0, 5.0) > 0.9,
        "{} {}",
        mean(30.0, 48.0),
        mean(0.0, 5.0)
    );
    assert!(mean(22.0, 24.4) < mean(0.0, 5.0) - 0.01);
    // A cloud that lies elsewhere is not silently left in the open.
    house
        .line(&format!("filter scan.pbgi scan.las -o far.las --origin 0,0,0 {DAEMON}"))
        .fails_naming(&["far from the scene", "--origin", "scan.las"]);
    assert!(fs::metadata(house.path("far.las")).is_err());
}

#[test]
fn a_bake_that_is_stopped_leaves_no_file() {
    let house = House::new();
    house.furnish(60_000, "16x16");
    fs::create_dir(house.path("out")).unwrap();
    let left = || fs::read_dir(house.path("out")).unwrap().count();
    for stop in [Signal::SIGINT, Signal::SIGKILL] {
        let mut job = house.start(&format!(
            "filter demo.pbgi -o out/lit.ply --max-solid-angle 0.002 {DAEMON}"
        ));
        let busy = || house.line("status").stdout.contains(", shading");
        assert!(wait_for(Duration::from_secs(30), || busy() || !job.runs()) && job.runs());
        let clients = house.processes();
        let client = clients
            .iter()
            .find(|(_, command)| command.contains("filter demo.pbgi"))
            .unwrap()
            .0;
        signal(client, stop);
        let run = job.end();
        match stop {
            Signal::SIGINT => assert_eq!(run.code, Some(130), "{run:?}"),
            _ => assert_eq!(run.code, None),
        }
        assert_eq!(left(), 0);
        // The daemon lets the work go.
        assert!(wait_for(Duration::from_secs(20), || !busy()));
    }
}

#[test]
fn what_makes_no_sense_is_said_at_once() {
    let house = House::new();
    house.furnish(2_000, "16x16");
    fs::write(house.path("short.ply"), "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n").unwrap();
    for (line, words) in [
        ("filter demo.pbgi demo.glb -o a.ply", &["mesh"][..]),
        ("filter demo.pbgi demo.ply -o a.laz", &["a.laz", ".ply"]),
        ("filter demo.pbgi demo.ply -o a.ply --as rgb", &["--as", "LAS"]),
        ("filter demo.pbgi gone.ply -o a.ply", &["gone.ply"]),
        ("filter demo.pbgi short.ply -o a.ply", &["short.ply", "truncated"]),
        ("filter demo.pbgi demo.ply -o demo.ply --overwrite", &["is the input"]),
        ("filter gone.pbgi -o a.ply", &["gone.pbgi"]),
        ("view demo.pbgi -o a.jpg", &[".png"]),
        ("view demo.pbgi -o a.png --eye 1,2,3 --look-at 1,2,3", &["same place"]),
        ("view demo.pbgi -o a.png --camera 3", &["--camera-file"]),
        ("shade demo.pbgi -o a.exr", &["--gbuffer"]),
        ("shade demo.pbgi --gbuffer g.exr --camera auto -o a.exr", &["either"]),
    ] {
        house.line(&format!("{line} {DAEMON}")).fails_naming(words);
        for name in ["a.ply", "a.laz", "a.png", "a.jpg", "a.exr"] {
            assert!(fs::metadata(house.path(name)).is_err(), "{line} left {name}");
        }
    }
}

#[test]
fn the_camera_sees_among_points_what_it_sees_of_the_mesh() {
    let house = House::new();
    house.furnish(60_000, "64x48");
    house
        .line(&format!("shade demo.pbgi --gbuffer g.exr -o mesh.exr {DAEMON}"))
        .ok();
    house
        .line(&format!(
            "shade demo.pbgi --camera 0 --camera-file demo.glb --size 64x48 -o points.exr {DAEMON}"
        ))
        .ok();
    let (mesh, points) = (
        Picture::read(&house.path("mesh.exr")),
        Picture::read(&house.path("points.exr")),
    );
    let alpha = mesh.channel("A");
    let covered = |alpha: f32| alpha >= 0.5;
    let other = alpha
        .iter()
        .zip(points.channel("A"))
        .filter(|(a, b)| covered(**a) != covered(**b))
        .count();
    assert!(
        other * 50 < alpha.len(),
        "{other} pixels are covered in one picture only"
    );
    let off = rms(points.channel("occlusion.Z"), mesh.channel("occlusion.Z"), alpha);
    println!("occlusion at what points show: RMS {off:.4} from that at the mesh");
    assert!(off < 0.15, "{off}");
    house
        .line(&format!(
            "view demo.pbgi -o view.png --size 64x48 --stats view.json {DAEMON}"
        ))
        .ok();
    assert_eq!(&fs::read(house.path("view.png")).unwrap()[..8], b"\x89PNG\r\n\x1a\n");
    assert!(house.statistics("view.json")["shading_calls"].as_u64().unwrap() > 500);
}
