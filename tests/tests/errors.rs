//! Bad input: one clear error that says what, where and what to do, and nothing half-written.

#![allow(clippy::unwrap_used, reason = "tests")]

use pbgi_points::{LayeredImage, Precision};
use pbgi_tests::{DAEMON, House, Picture, Run, assert_same, flip_bit, page_count, program};
use std::fs;
use std::path::Path;

/// Fails as it should, and leaves nothing in the folder `out`.
#[track_caller]
fn refused(house: &House, line: &str, words: &[&str]) -> Run {
    let run = house.line(line).fails_naming(words);
    let errors = run.stderr.lines().filter(|line| line.starts_with("error: ")).count();
    assert_eq!(errors, 1, "{}", run.stderr);
    assert_empty(&house.path("out"));
    run
}

#[track_caller]
fn assert_empty(folder: &Path) {
    let left: Vec<_> = fs::read_dir(folder).unwrap().flatten().collect();
    assert!(left.is_empty(), "{left:?}");
}

fn house() -> House {
    let house = House::new();
    fs::create_dir(house.path("out")).unwrap();
    house
}

fn ply(rows: &[&str]) -> String {
    let names = ["x", "y", "z", "nx", "ny", "nz", "radius", "red", "green", "blue"];
    let mut text = format!("ply\nformat ascii 1.0\nelement vertex {}\n", rows.len());
    for name in names {
        text += &format!("property float {name}\n");
    }
    text + "end_header\n" + &rows.join("\n") + "\n"
}

fn copy_scene(house: &House, to: &str) {
    fs::create_dir(house.path(to)).unwrap();
    for entry in fs::read_dir(house.path("demo.pbgi")).unwrap().flatten() {
        fs::copy(entry.path(), house.path(to).join(entry.file_name())).unwrap();
    }
}

#[test]
fn missing_inputs_are_named() {
    let house = house();
    house.furnish(5_000, "16x16");
    for (line, name) in [
        (format!("build gone.ply -o out/a.pbgi {DAEMON}"), "gone.ply"),
        ("sample gone.glb -o out/a.ply".into(), "gone.glb"),
        ("gbuffer gone.glb -o out/a.exr".into(), "gone.glb"),
        (
            format!("shade gone.pbgi --gbuffer g.exr -o out/a.exr {DAEMON}"),
            "gone.pbgi",
        ),
        (
            format!("shade demo.pbgi --gbuffer gone.exr -o out/a.exr {DAEMON}"),
            "gone.exr",
        ),
        (format!("render gone.glb -o out/a.exr {DAEMON}"), "gone.glb"),
        (format!("build demo.ply gone.ply -o out/a.pbgi {DAEMON}"), "gone.ply"),
    ] {
        refused(&house, &line, &[name]);
    }
}

#[test]
fn damaged_scenes_fail_their_job_and_not_the_daemon() {
    let house = house();
    house.furnish(20_000, "32x32");
    let shade = |scene: &str| format!("shade {scene} --gbuffer g.exr -o out/o.exr {DAEMON}");
    let daemon = house.running("pbgi-server");
    for (scene, file) in [
        ("short_nodes.pbgi", "nodes.pages"),
        ("short_points.pbgi", "points.pages"),
    ] {
        copy_scene(&house, scene);
        let path = house.path(scene).join(file);
        let length = fs::metadata(&path).unwrap().len();
        let open = fs::OpenOptions::new().write(true).open(&path).unwrap();
        open.set_len(length - 1).unwrap();
        let (actual, expected) = ((length - 1).to_string(), length.to_string());
        refused(&house, &shade(scene), &[scene, file, &actual, &expected]);
    }
    for (scene, file, page) in [
        ("bad_nodes.pbgi", "nodes.pages", 0),
        ("bad_points.pbgi", "points.pages", 3),
    ] {
        copy_scene(&house, scene);
        flip_bit(&house.path(scene), file, page);
        refused(&house, &shade(scene), &[scene, file, &format!("page {page}")]);
        // The next job is served by the same daemon.
        let good = shade("demo.pbgi").replace("out/o.exr", &format!("after_{scene}.exr"));
        house.line(&good).ok();
    }
    assert_eq!(house.running("pbgi-server"), daemon);
}

#[test]
fn page_damaged_after_it_was_read_does_not_matter_until_it_is_read_again() {
    let house = house();
    house.furnish(20_000, "32x32");
    let shade = |name: &str, daemon: &str| format!("shade demo.pbgi --gbuffer g.exr -o {name} {daemon}");
    house.line(&shade("before.exr", DAEMON)).ok();
    for page in 0..page_count(&house.path("demo.pbgi")).min(2) {
        flip_bit(&house.path("demo.pbgi"), "nodes.pages", page);
    }
    house.line(&shade("warm.exr", DAEMON)).ok();
    assert_same(
        &Picture::read(&house.path("before.exr")),
        &Picture::read(&house.path("warm.exr")),
    );
    refused(
        &house,
        &shade("out/cold.exr", "--memory 200M --workers 1"),
        &["nodes.pages", "page "],
    );
}

#[test]
fn point_that_is_not_finite_is_named() {
    let house = house();
    let good = "0 0 0 0 1 0 0.1 1 1 1";
    for (bad, field) in [
        ("0 nan 0 0 1 0 0.1 1 1 1", "position"),
        ("0 0 0 0 1 0 nan 1 1 1", "radius"),
    ] {
        fs::write(house.path("bad.ply"), ply(&[good, good, bad, good])).unwrap();
        let line = format!("build bad.ply -o out/a.pbgi {DAEMON}");
        refused(&house, &line, &["bad.ply", "point 2", field]);
    }
    fs::write(house.path("cut.ply"), &ply(&[good; 50])[..700]).unwrap();
    refused(&house, &format!("build cut.ply -o out/a.pbgi {DAEMON}"), &["cut.ply"]);
}

#[test]
fn empty_cloud_is_a_valid_scene_that_is_dark_and_open() {
    let house = house();
    house.furnish(5_000, "16x16");
    fs::write(house.path("empty.ply"), ply(&[])).unwrap();
    house
        .line(&format!("build empty.ply -o empty.pbgi --stats build.json {DAEMON}"))
        .ok();
    assert_eq!(house.statistics("build.json")["points"], 0);
    house
        .line(&format!(
            "shade empty.pbgi --gbuffer g.exr -o out.exr --stats shade.json {DAEMON}"
        ))
        .ok();
    let statistics = house.statistics("shade.json");
    assert_eq!((&statistics["points"], &statistics["holes"]), (&0.into(), &0.into()));
    let picture = Picture::read(&house.path("out.exr"));
    assert!(picture.channel("A").iter().all(|&alpha| alpha == 1.0));
    for name in ["R", "G", "B", "indirect.R", "indirect.G", "indirect.B", "occlusion.Z"] {
        assert!(picture.channel(name).iter().all(|&value| value == 0.0), "{name}");
    }
}

#[test]
fn gbuffer_without_positions_lists_what_it_has() {
    let house = house();
    house.furnish(5_000, "16x16");
    let mut image = LayeredImage::new(2, 2);
    image.add_rgb("diffuse", Precision::Float, &[[0.5; 3]; 4]);
    image.add_xyz("N", Precision::Float, &[[0.0, 1.0, 0.0]; 4]);
    image.write_exr(&house.path("passes.exr")).unwrap();
    let line = format!("shade demo.pbgi --gbuffer passes.exr -o out/a.exr {DAEMON}");
    refused(&house, &line, &["passes.exr", "diffuse.R", "N.X"]);
}

#[test]
fn values_that_cannot_be_are_refused_by_name() {
    let house = house();
    house.furnish(5_000, "16x16");
    for (options, word) in [
        ("--raster-resolution 7", "--raster-resolution"),
        ("--raster-resolution fine", "--raster-resolution"),
        ("--max-solid-angle -1", "max-solid-angle"),
        ("--max-dist nan", "max-dist"),
        ("--workers 0", "--workers"),
        ("--memory lots", "--memory"),
        ("--no-such-option 1", "--no-such-option"),
    ] {
        let line = format!("shade demo.pbgi --gbuffer g.exr -o out/a.exr {options}");
        let run = refused(&house, &line, &[word]);
        assert_eq!(run.code, Some(2), "{options}");
    }
    refused(&house, "gbuffer demo.glb -o out/a.exr --camera 99", &["99"]);
    let line = format!("build demo.ply -o out/a.pbgi --nodes-per-page 1 {DAEMON}");
    refused(&house, &line, &["nodes-per-page"]);
}

#[test]
fn existing_output_stays_unless_overwriting_was_asked_for() {
    let house = house();
    house.furnish(5_000, "16x16");
    for line in [
        format!("build demo.ply -o mine {DAEMON}"),
        "sample demo.glb -o mine.ply --points 1000".into(),
        "gbuffer demo.glb -o mine.exr --size 16x16".into(),
        format!("shade demo.pbgi --gbuffer g.exr -o mine.exr {DAEMON}"),
        format!("render demo.glb -o mine.exr --points 1000 --size 16x16 {DAEMON}"),
    ] {
        for name in ["mine", "mine.ply", "mine.exr"] {
            fs::write(house.path(name), "mine").unwrap();
        }
        refused(&house, &line, &["mine", "--overwrite"]);
        for name in ["mine", "mine.ply", "mine.exr"] {
            assert_eq!(fs::read(house.path(name)).unwrap(), b"mine", "{line}");
        }
        if !line.starts_with("build") {
            house.line(&format!("{line} --overwrite")).ok();
        }
    }
    house
        .line(&format!("build demo.ply -o demo.pbgi --overwrite {DAEMON}"))
        .ok();
}

#[test]
fn memory_that_is_not_there_is_refused_with_both_numbers() {
    let house = house();
    house.furnish(5_000, "16x16");
    let shade = |memory: &str| format!("shade demo.pbgi --gbuffer g.exr -o out/a.exr --workers 2 --memory {memory}");
    refused(&house, &shade("8000G"), &["memory", "--memory"]);
    refused(&house, &shade("16M"), &["memory", "--memory"]);
    // The one daemon that runs is the one that made the scene.
    assert_eq!(house.running("pbgi-server").len(), 1);
    println!("RELIABILITY S3: 8000G and 16M refused, no daemon started");
}

#[test]
fn small_dev_shm_is_an_error_and_not_a_signal() {
    let house = house();
    house.furnish(5_000, "16x16");
    let probe = house
        .command("unshare")
        .args(["-Urm", "mount", "-t", "tmpfs", "-o", "size=16m", "tmpfs", "/dev/shm"])
        .output();
    if !probe.is_ok_and(|output| output.status.success()) {
        eprintln!("SKIPPED: user and mount namespaces cannot be made here");
        return;
    }
    let script = "mount -t tmpfs -o size=16m tmpfs /dev/shm || exit 99; \"$@\"; code=$?; ls -A /dev/shm; exit $code";
    for memory in [&["--memory", "256M"][..], &[]] {
        let mut command = house.command("unshare");
        command.args(["-Urm", "sh", "-c", script, "sh"]);
        command.arg(program("pbgi-client"));
        command.args([
            "shade",
            "demo.pbgi",
            "--gbuffer",
            "g.exr",
            "-o",
            "out/a.exr",
            "--workers",
            "1",
        ]);
        let run = Run::from(command.args(memory).output().unwrap());
        let run = run.fails_naming(&["error: ", "memory", "needed"]);
        assert_eq!(run.code, Some(1), "{run:?}");
        assert_eq!(run.stdout.trim(), "", "a segment is left in /dev/shm");
        assert_empty(&house.path("out"));
    }
    println!("RELIABILITY S2: a tmpfs of 16 MiB: 2 errors with the bytes needed, 0 signals, 0 segments left");
}

#[test]
fn scans_without_normals_name_the_options_that_build_them() {
    let house = house();
    let mut text = "ply\nformat ascii 1.0\nelement vertex 900\n".to_owned();
    for axis in ["x", "y", "z"] {
        text += &format!("property double {axis}\n");
    }
    text += "end_header\n";
    (0..900).for_each(|i| text += &format!("{} 0 {}\n", i % 30, i / 30));
    fs::write(house.path("scan.ply"), text).unwrap();
    let build = |options: &str| format!("build scan.ply -o out/a.pbgi {options} {DAEMON}");
    refused(&house, &build(""), &["scan.ply", "no normals", "--estimate-normals"]);
    refused(
        &house,
        &build("--estimate-normals"),
        &["scan.ply", "no radius", "--radius auto"],
    );
    refused(
        &house,
        &build("--estimate-normals=sideways"),
        &["up, out or a viewpoint"],
    );
    house
        .line(&build("--estimate-normals=up --radius auto --stats scan.json"))
        .ok();
    let statistics: serde_json::Value = serde_json::from_slice(&fs::read(house.path("scan.json")).unwrap()).unwrap();
    assert_eq!(
        (&statistics["points"], &statistics["points_skipped"]),
        (&900.into(), &0.into())
    );
    house
        .line(&format!("build out/a.pbgi -o again.pbgi --leaf-max 4 {DAEMON}"))
        .ok();
    house.line("generate city --points 20000 -o city.ply").ok();
    house.line(&format!("build city.ply -o city.pbgi {DAEMON}")).ok();
}
