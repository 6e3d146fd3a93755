//! Pictures and scenes as people have them: holes, camera space, scene files, pictures to look at, answers for scripts.

#![allow(clippy::unwrap_used, reason = "tests")]

use glam::Vec3;
use pbgi_points::{GBuffer, LayeredImage};
use pbgi_tests::{DAEMON, House, SHADED, workspace_root};
use std::collections::BTreeSet;

/// D14: a pixel with a broken number is black and counted, and spoils no other.
#[test]
fn holes_of_a_gbuffer_stay_black_and_do_not_spread() {
    let house = House::new();
    house.furnish(20_000, "64x48");
    let shade = |gbuffer: &str, name: &str| {
        let line = format!("shade demo.pbgi --gbuffer {gbuffer} -o {name}.exr --stats {name}.json {DAEMON}");
        house.line(&line).ok();
        LayeredImage::read_exr(&house.path(&format!("{name}.exr"))).unwrap()
    };
    let whole = shade("g.exr", "whole");
    let mut passes = LayeredImage::read_exr(&house.path("g.exr")).unwrap();
    let covered = |pixel: &usize| whole.channel("A").unwrap()[*pixel] == 1.0;
    let holes: Vec<usize> = (0..64 * 48).step_by(97).filter(covered).collect();
    let wrong = [
        ("P.X", f32::NAN),
        ("P.Y", f32::INFINITY),
        ("N.Z", f32::NAN),
        ("N.X", f32::NEG_INFINITY),
        ("A", 0.0),
        ("A", f32::NAN),
    ];
    for (&hole, (channel, value)) in holes.iter().zip(wrong.iter().cycle()) {
        passes.channels.get_mut(*channel).unwrap().values[hole] = *value;
    }
    passes.write_exr(&house.path("holes.exr")).unwrap();
    let torn = shade("holes.exr", "torn");
    // Receivers are shaded in groups of 8 by 8, which share what is far away.
    let group = |pixel: usize| (pixel % 64 / 8, pixel / 64 / 8);
    let touched: BTreeSet<_> = holes.iter().map(|&hole| group(hole)).collect();
    for name in SHADED {
        let (whole, torn) = (whole.channel(name).unwrap(), torn.channel(name).unwrap());
        for pixel in 0..64 * 48 {
            if holes.contains(&pixel) {
                assert_eq!(torn[pixel], 0.0, "{name} at {pixel}");
            } else if touched.contains(&group(pixel)) {
                assert!((torn[pixel] - whole[pixel]).abs() < 0.1, "{name} at {pixel}");
            } else {
                assert_eq!(torn[pixel], whole[pixel], "{name} at {pixel}");
            }
        }
    }
    assert!(holes.iter().all(|&hole| torn.channel("A").unwrap()[hole] == 0.0));
    let counted = |name: &str| house.statistics(name)["holes"].as_u64().unwrap();
    assert_eq!(counted("torn.json"), counted("whole.json") + holes.len() as u64);
    println!("RELIABILITY D14: {} holes torn, no other pixel changed", holes.len());
}

#[test]
fn passes_of_a_cameras_space_are_refused_or_converted_under_any_name() {
    let house = House::new();
    house.furnish(20_000, "48x36");
    let shade = |options: &str, name: &str| house.line(&format!("shade demo.pbgi {options} -o {name}.exr {DAEMON}"));
    shade("--gbuffer g.exr", "world").ok();
    let passes = GBuffer::read(&house.path("g.exr")).unwrap();
    let matrix = passes.world_to_camera.unwrap();
    let mut image = passes.to_image();
    image.channels.retain(|name, _| name == "A");
    let seen = |vectors: &[[f32; 3]], of: fn(&glam::Mat4, Vec3) -> Vec3| -> Vec<[f32; 3]> {
        vectors
            .iter()
            .map(|&vector| of(&matrix, vector.into()).to_array())
            .collect()
    };
    let precision = pbgi_points::Precision::Float;
    image.add_rgb(
        "cam.pos",
        precision,
        &seen(&passes.position, glam::Mat4::transform_point3),
    );
    image.add_rgb(
        "cam.nrm",
        precision,
        &seen(&passes.normal, glam::Mat4::transform_vector3),
    );
    image.write_exr(&house.path("cam.exr")).unwrap();
    shade("--gbuffer cam.exr", "none").fails_naming(&["no world normal", "--normal", "cam.nrm", "cam.exr"]);
    let named = "--gbuffer cam.exr --normal cam.nrm --position cam.pos";
    shade(named, "none").fails_naming(&["camera space", "--space camera", "cam.exr"]);
    assert!(std::fs::metadata(house.path("none.exr")).is_err());
    shade(&format!("{named} --space camera"), "converted").ok();
    let line = "diff converted.exr world.exr --layer occlusion --layer indirect --threshold 0.005";
    house.line(line).ok();
}

#[test]
fn a_scene_file_is_rendered_and_shown() {
    let house = House::new();
    let example = workspace_root().join("docs/examples/court.toml");
    let line = format!(
        "render {} -o court.exr --png court.png --exposure 0.5 --preview --size 64x36 --points 30000 {DAEMON}",
        example.display()
    );
    let run = house.line(&line).ok();
    assert!(run.stderr.contains("the output is no terminal"), "{}", run.stderr);
    assert!(std::fs::read(house.path("court.png")).unwrap().starts_with(b"\x89PNG"));
    let image = LayeredImage::read_exr(&house.path("court.exr")).unwrap();
    let (beauty, emission) = (image.triple("").unwrap(), image.triple("emission").unwrap());
    // Left of the middle, above the ground: the red wall.
    let [r, g, b] = beauty[16 * 64 + 5];
    assert!(r > 3.0 * g && g > b && b > 0.0, "{r} {g} {b}");
    assert!(emission.iter().any(|light| light[0] == 6.0), "the panel is seen");
    let indirect = image.triple("indirect").unwrap();
    assert!(
        indirect
            .iter()
            .flatten()
            .all(|value| value.is_finite() && *value >= 0.0)
    );
}

#[test]
fn answers_for_scripts_are_json() {
    let house = House::new();
    house.furnish(5_000, "16x16");
    house
        .line(&format!(
            "shade demo.pbgi --gbuffer g.exr -o o.exr --job-id mine --png o.png {DAEMON}"
        ))
        .ok();
    assert!(std::fs::metadata(house.path("o.png")).is_ok());
    let json = |line: &str| -> serde_json::Value { serde_json::from_str(&house.line(line).ok().stdout).unwrap() };
    let jobs = json("jobs --json");
    assert_eq!(
        (&jobs[0]["id"], &jobs[0]["state"]),
        (&"mine".into(), &"succeeded".into())
    );
    assert_eq!(
        json("jobs mine --json")["statistics"]["points"],
        jobs[0]["statistics"]["points"]
    );
    assert_eq!(json("status --json")[0]["memory_bytes"], 256 << 20);
    let cache = json("cache --json");
    assert!(cache[0]["nodes"]["resident"].as_u64().unwrap() > 0 && cache[0]["address"].is_string());
    let info = json(&format!("info demo.pbgi --json {DAEMON}"));
    assert_eq!(info["point_count"], jobs[0]["statistics"]["points"]);
    assert!(info["shape"]["levels"].as_array().unwrap().len() > 2);
}
