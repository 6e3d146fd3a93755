//! The same picture, to the last bit, however it was come by.

use pbgi_tests::{DAEMON, House, Picture, assert_same};
use std::time::Duration;

/// Coarse: what counts here is that every value is the same, and small caches make it slow.
const QUALITY: &str = "--max-solid-angle 0.15 --raster-resolution 16";

fn shade(house: &House, scene: &str, daemon: &str) -> (Picture, serde_json::Value) {
    let run = format!("{scene}-{}", daemon.replace(' ', ""));
    house
        .line(&format!(
            "shade {scene} --gbuffer g.exr -o {run}.exr --stats {run}.json {QUALITY} {daemon}"
        ))
        .ok();
    (
        Picture::read(&house.path(&format!("{run}.exr"))),
        house.statistics(&format!("{run}.json")),
    )
}

#[test]
fn number_of_workers_does_not_change_a_bit() {
    let house = House::new();
    house.furnish(60_000, "96x64");
    let (two, _) = shade(&house, "demo.pbgi", DAEMON);
    let (one, _) = shade(&house, "demo.pbgi", "--memory 256M --workers 1");
    let (three, _) = shade(&house, "demo.pbgi", "--memory 256M --workers 3");
    assert!(two.channel("indirect.R").iter().any(|&value| value > 0.1));
    assert_same(&two, &one);
    assert_same(&two, &three);
}

#[test]
fn cache_of_a_tenth_of_the_scene_does_not_change_a_bit() {
    let house = House::new();
    house.furnish(600_000, "64x64");
    house
        .line(&format!(
            "build demo.ply -o small.pbgi --nodes-per-page 64 --points-per-page 128 {DAEMON}"
        ))
        .ok();
    let (whole, roomy) = shade(&house, "small.pbgi", "--memory 512M --workers 2");
    assert_eq!(roomy["reloads"], 0, "{roomy:#}");
    // Two workers at the least memory that holds their frames.
    let (tight, statistics) = shade(&house, "small.pbgi", "--memory 58M --workers 2");
    let number = |name: &str| statistics[name].as_f64().unwrap();
    assert!(number("reloads") > 100.0, "{statistics:#}");
    assert_eq!(number("redundant_reads"), 0.0);
    assert!(
        number("cache_peak_bytes") * 8.0 < number("out_of_core_bytes"),
        "{statistics:#}"
    );
    assert_same(&whole, &tight);
    println!(
        "RELIABILITY S8: {} pages read again in a cache of 1/{:.0} of the scene, 0 bits differ",
        number("reloads"),
        number("out_of_core_bytes") / number("cache_peak_bytes")
    );
}

#[test]
fn chunk_levels_and_page_sizes_do_not_change_a_bit() {
    let house = House::new();
    house.furnish(60_000, "64x64");
    let (reference, _) = shade(&house, "demo.pbgi", DAEMON);
    for (name, options) in [
        ("depth0.pbgi", "--chunk-levels 0"),
        ("depth3.pbgi", "--chunk-levels 3"),
        ("tiny.pbgi", "--nodes-per-page 16 --points-per-page 16"),
        (
            "odd.pbgi",
            "--nodes-per-page 200 --points-per-page 1000 --chunk-levels 1",
        ),
    ] {
        house.line(&format!("build demo.ply -o {name} {options} {DAEMON}")).ok();
        let (picture, _) = shade(&house, name, DAEMON);
        assert_same(&picture, &reference);
    }
}

#[test]
fn the_same_build_gives_the_same_files() {
    let house = House::new();
    house.furnish(60_000, "16x16");
    house
        .line("build demo.ply -o again.pbgi --memory 200M --workers 1")
        .ok();
    for file in ["nodes.pages", "points.pages", "manifest.toml"] {
        let read = |scene: &str| std::fs::read(house.path(scene).join(file)).unwrap();
        assert!(read("demo.pbgi") == read("again.pbgi"), "{file} differs");
    }
}

#[test]
fn workers_killed_in_mid_frame_do_not_change_a_bit() {
    let house = House::new();
    // Many short tiles, so that some are done between two kills.
    house.furnish(60_000, "320x320");
    let line =
        |run: &str| format!("shade demo.pbgi --gbuffer g.exr -o {run}.exr --stats {run}.json {QUALITY} {DAEMON}");
    house.line(&line("calm")).ok();
    let mut job = house.start(&line("storm"));
    let mut kills = 0;
    while job.runs() && kills < 5 {
        kills += usize::from(house.kill_workers(kills == 1).is_some());
        std::thread::sleep(Duration::from_millis(if kills == 0 { 5 } else { 50 }));
    }
    job.end().ok();
    assert!(kills >= 2, "only {kills} kills while tiles were outstanding");
    assert_same(
        &Picture::read(&house.path("calm.exr")),
        &Picture::read(&house.path("storm.exr")),
    );
    let (calm, storm) = (house.statistics("calm.json"), house.statistics("storm.json"));
    for name in ["shading_calls", "holes", "average_cut_size"] {
        assert_eq!(calm[name], storm[name], "{name}");
    }
}
