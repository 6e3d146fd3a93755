//! EXR files exchanged with the reference implementation, both ways: `pip install OpenEXR numpy` for the `python3` of the path.

#![allow(clippy::unwrap_used, reason = "tests")]

use pbgi_points::{GBuffer, LayeredImage, Window};
use pbgi_tests::{DAEMON, House, workspace_root};
use serde_json::Value;
use std::fs;
use std::process::Command;

/// Runs the other side; its output.
fn exchange(arguments: &[&str]) -> Vec<u8> {
    let script = workspace_root().join("tests/tests/openexr/exchange.py");
    let output = Command::new("python3").arg(script).args(arguments).output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{arguments:?}: {text}");
    output.stdout
}

/// Whether the reference implementation is there; a loud skip if not.
fn reference() -> bool {
    let found = Command::new("python3").args(["-c", "import OpenEXR, numpy"]).output();
    let there = found.is_ok_and(|output| output.status.success());
    if !there {
        eprintln!("SKIPPED: python3 has no modules OpenEXR and numpy, no file was exchanged with the reference reader");
    }
    there
}

const WIDTH: usize = 70;
const HEIGHT: usize = 45;

#[test]
fn gbuffers_of_every_form_are_read() {
    if !reference() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    exchange(&["write", folder.path().to_str().unwrap()]);
    let files = fs::read_dir(folder.path()).unwrap().flatten().map(|entry| entry.path());
    let mut count = 0;
    for path in files {
        let read = GBuffer::read(&path).unwrap();
        let data = Window {
            x: -5,
            y: -3,
            width: WIDTH as u32,
            height: HEIGHT as u32,
        };
        assert_eq!((read.data_window, read.display_window), (data, Window::of_size(80, 50)));
        let cropped = path.ends_with("crops.exr");
        for (pixel, position) in read.position.iter().enumerate() {
            let (column, row) = (pixel % WIDTH, pixel / WIDTH);
            let outside = cropped && (column >= WIDTH - 10 || row >= HEIGHT - 10);
            let hole = outside || [(1, 1), (2, 2), (3, 3)].contains(&(column, row));
            assert_eq!(read.is_hole(pixel), hole, "{path:?}: pixel {column}, {row}");
            if !hole {
                let (x, y) = (column as f32, row as f32);
                assert_eq!(*position, [x + 0.5, y * 0.25, x * y + 1.0], "{path:?}");
                assert_eq!(read.normal[pixel], [0.0, 1.0, 0.0], "{path:?}");
            }
        }
        count += 1;
    }
    assert_eq!(count, 10);
    let full = GBuffer::read(&folder.path().join("full.exr")).unwrap();
    let moved = full.world_to_camera.unwrap().transform_point3(glam::Vec3::splat(1.0));
    assert_eq!(
        moved.to_array(),
        [3.0, 4.0, 3.0],
        "row vectors in the file, column vectors here"
    );
    assert_eq!(full.world_to_ndc.unwrap().w_axis.to_array(), [5.0, 6.0, 7.0, 8.0]);
}

#[test]
fn the_reference_reads_our_pictures_and_finds_what_was_passed_through() {
    if !reference() {
        return;
    }
    let house = House::new();
    house.furnish(20_000, "40x30");
    let described = |name: &str| -> Value {
        let path = house.path(name);
        serde_json::from_slice(&exchange(&["read", path.to_str().unwrap()])).unwrap()
    };
    house
        .line(&format!(
            "render demo.glb -o r.exr --size 40x30 --points 20000 {DAEMON}"
        ))
        .ok();
    for name in ["g.exr", "r.exr"] {
        let ours = LayeredImage::read_exr(&house.path(name)).unwrap();
        let theirs = described(name);
        let attributes = &theirs["attributes"];
        assert_eq!(theirs["parts"], 1);
        assert_eq!(attributes["dataWindow"], serde_json::json!([[0, 0], [39, 29]]));
        assert!(attributes["type"].as_str().unwrap().contains("tiled"), "{attributes}");
        assert!(
            attributes["compression"].as_str().unwrap().contains("ZIP"),
            "{attributes}"
        );
        for (attribute, matrix) in [
            ("worldToCamera", ours.world_to_camera.unwrap()),
            ("worldToNDC", ours.world_to_ndc.unwrap()),
        ] {
            let rows: Vec<[f32; 4]> = serde_json::from_value(attributes[attribute].clone()).unwrap();
            assert_eq!(rows, matrix.to_cols_array_2d(), "{attribute}");
        }
        let channels = theirs["channels"].as_object().unwrap();
        assert!(channels.keys().eq(ours.channels.keys()), "{channels:?}");
        for (channel, ours) in &ours.channels {
            let sum: f64 = ours.values.iter().map(|&value| f64::from(value)).sum();
            let theirs = channels[channel]["sum"].as_f64().unwrap();
            assert!(
                (sum - theirs).abs() <= 1e-9 * sum.abs().max(1.0),
                "{channel}: {sum} {theirs}"
            );
        }
        for (key, value) in &ours.metadata {
            assert_eq!(attributes[key], value.as_str(), "{key}");
        }
    }
    let attributes = &described("r.exr")["attributes"];
    for key in [
        "pbgi/build_id",
        "pbgi/max_solid_angle",
        "pbgi/cache_hit_ratio",
        "pbgi/memory_bytes",
    ] {
        assert!(attributes[key].is_string(), "{key}: {attributes}");
    }

    exchange(&["write", house.path("run").to_str().unwrap()]);
    house
        .line(&format!(
            "shade demo.pbgi --gbuffer run/full.exr -o shaded.exr {DAEMON}"
        ))
        .ok();
    let (gbuffer, shaded) = (house.path("run/full.exr"), house.path("shaded.exr"));
    exchange(&["same", gbuffer.to_str().unwrap(), shaded.to_str().unwrap()]);
}
