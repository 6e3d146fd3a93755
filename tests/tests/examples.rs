//! The worked examples of docs/examples.md, as they stand there. What needs a module of Python or a program that is not there is
//! skipped with a word.

#![allow(clippy::unwrap_used, reason = "tests")]

use pbgi_points::{GBuffer, LayeredImage, Window};
use pbgi_tests::{DAEMON, House, Picture, SHADED, assert_same_values, program, relative_rms, rms, workspace_root};
use std::path::{Path, PathBuf};
use std::process::Command;

fn example(name: &str) -> PathBuf {
    workspace_root().join("docs/examples").join(name)
}

/// The interpreter behind `python3` if it has these modules; a loud skip if not.
fn python_with(modules: &str) -> Option<PathBuf> {
    // Asked for itself: what the path leads to may be a shim that needs the user's home.
    let code = format!("import sys, {modules}; print(sys.executable)");
    let found = Command::new("python3").args(["-c", &code]).output();
    let found = found.ok().filter(|output| output.status.success());
    if found.is_none() {
        eprintln!("SKIPPED: python3 has not all of the modules {modules}");
    }
    Some(String::from_utf8(found?.stdout).unwrap().trim().into())
}

/// Runs a script of the examples, with our programs in the path and the Python client at hand; its output.
#[track_caller]
fn script(house: &House, python: &Path, name: &str, arguments: &[&str]) -> String {
    let programs = program("pbgi-client");
    let path = format!(
        "{}:{}",
        programs.parent().unwrap().display(),
        std::env::var("PATH").unwrap()
    );
    let output = house
        .command(python)
        .arg(example(name))
        .args(arguments)
        .env("PATH", path)
        .env("PYTHONPATH", workspace_root().join("client/python"))
        .env("PYTHONDONTWRITEBYTECODE", "1")
        .output()
        .unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{name} {arguments:?}: {errors}");
    String::from_utf8(output.stdout).unwrap()
}

fn build(house: &House, scene: &str, name: &str, points: u32) {
    let scene = example(scene);
    let scene = scene.display();
    house
        .line(&format!("build {scene} -o {name} --points {points} {DAEMON}"))
        .ok();
}

#[test]
fn points_are_shaded_from_python() {
    let Some(python) = python_with("grpc, numpy, google.protobuf") else {
        return;
    };
    let house = House::new();
    build(&house, "court.toml", "court.pbgi", 60_000);
    let scene = house.path("court.pbgi");
    let line = ["--from=-2.6,0.01,1.5", "--to=2.6,0.01,1.5"];
    let told = script(
        &house,
        &python,
        "points.py",
        &[scene.to_str().unwrap(), line[0], line[1]],
    );
    let numbers = |row: &str| -> Vec<f64> { row.split_whitespace().map(|word| word.parse().unwrap()).collect() };
    let rows: Vec<Vec<f64>> = told.lines().skip(1).map(numbers).collect();
    assert_eq!(rows.len(), 9, "{told}");
    let redness = |row: &Vec<f64>| row[3] / row[5];
    assert!(redness(&rows[0]) > 2.0 * redness(&rows[8]), "{told}");
    assert!(rows.iter().all(|row| row[6] > 0.0 && row[6] < 1.0), "{told}");
}

/// A part of the picture, with the whole one's display window: what a renderer writes for a region.
fn cut_out(image: &LayeredImage, part: Window) -> LayeredImage {
    let mut cut = LayeredImage::with_windows(part, image.display_window);
    let width = image.data_window.width as usize;
    for (name, channel) in &image.channels {
        let rows = channel.values.chunks_exact(width);
        let rows = rows.skip(part.y as usize).take(part.height as usize);
        let values = rows.flat_map(|row| &row[part.x as usize..][..part.width as usize]);
        cut.add(name, channel.precision, values.copied().collect());
    }
    cut
}

#[test]
fn a_crop_is_shaded_as_it_lies_in_the_whole_and_from_memory() {
    let house = House::new();
    build(&house, "court.toml", "court.pbgi", 60_000);
    let court = example("court.toml");
    house
        .line(&format!("gbuffer {} -o g.exr --size 160x90", court.display()))
        .ok();
    let part = Window {
        x: 64,
        y: 32,
        width: 40,
        height: 24,
    };
    let passes = LayeredImage::read_exr(&house.path("g.exr")).unwrap();
    cut_out(&passes, part).write_exr(&house.path("crop_g.exr")).unwrap();
    let shade = |gbuffer: &str, name: &str| {
        let line = format!("shade court.pbgi --gbuffer {gbuffer}.exr -o {name}.exr --stats {name}.json {DAEMON}");
        house.line(&line).ok();
        LayeredImage::read_exr(&house.path(&format!("{name}.exr"))).unwrap()
    };
    let whole = cut_out(&shade("g", "whole"), part);
    let crop = shade("crop_g", "crop");
    assert_eq!(
        (crop.data_window, crop.display_window),
        (part, Window::of_size(160, 90))
    );
    for name in SHADED {
        assert_same_values(name, whole.channel(name).unwrap(), crop.channel(name).unwrap());
    }
    assert_eq!(house.statistics("crop.json")["cache_misses"], 0);

    if Command::new("oiiotool").arg("--version").output().is_err() {
        eprintln!("SKIPPED: no oiiotool (pip install OpenImageIO), its crop was not compared with ours");
        return;
    }
    let line = "g.exr --crop 40x24+64+32 -o oiio_g.exr";
    let output = house.command("oiiotool").args(line.split(' ')).output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let [ours, theirs] = ["crop_g.exr", "oiio_g.exr"].map(|name| GBuffer::read(&house.path(name)).unwrap());
    assert_eq!(
        (ours.data_window, ours.display_window, ours.position, ours.normal),
        (
            theirs.data_window,
            theirs.display_window,
            theirs.position,
            theirs.normal
        )
    );
}

/// Shades the box with some passes.
fn indirect(house: &House, gbuffer: &str, name: &str) -> Picture {
    house
        .line(&format!(
            "shade cornell.pbgi --gbuffer {gbuffer} -o {name}.exr {DAEMON}"
        ))
        .ok();
    Picture::read(&house.path(&format!("{name}.exr")))
}

/// Pixels in which both renderers met the same surface, and met it away from the box's edges: in the middle of an edge both
/// walls are right, and light differs between them.
fn seen_alike(theirs: &Picture, ours: &Picture) -> Vec<f32> {
    const TOUCH: f32 = 1e-4;
    let [x, y, z] = ["P.X", "P.Y", "P.Z"].map(|name| ours.channel(name));
    let walls = |i: usize| [x[i] + 1.0, x[i] - 1.0, y[i], y[i] - 2.0, z[i] + 1.0].map(f32::abs);
    let on_edge = |i: usize| walls(i).iter().filter(|distance| **distance < TOUCH).count() > 1;
    let alike = |name: &str, i: usize| (theirs.channel(name)[i] - ours.channel(name)[i]).abs() < TOUCH;
    let same = |i: usize| {
        ["P.X", "P.Y", "P.Z", "N.X", "N.Y", "N.Z", "A"]
            .iter()
            .all(|name| alike(name, i))
    };
    let mask: Vec<f32> = (0..x.len())
        .map(|i| ours.channel("A")[i] * f32::from(u8::from(same(i) && !on_edge(i))))
        .collect();
    let covered = |mask: &[f32]| mask.iter().filter(|value| **value > 0.5).count();
    let (left, all) = (covered(&mask), covered(ours.channel("A")));
    assert!(left * 100 > all * 97, "{left} of {all} pixels show the same");
    mask
}

#[test]
fn passes_of_mitsuba_give_the_light_that_our_own_give() {
    let house = House::new();
    build(&house, "cornell.glb", "cornell.pbgi", 200_000);
    let (mesh, passes) = (example("cornell.glb"), example("cornell_mitsuba.exr"));
    let (mesh, passes) = (mesh.to_str().unwrap(), passes.to_str().unwrap());
    let theirs = indirect(&house, passes, "indirect");
    let size = format!("{}x{}", theirs.width, theirs.height);
    house.line(&format!("gbuffer {mesh} -o g.exr --size {size}")).ok();
    let ours = indirect(&house, "g.exr", "ours");
    let (their_passes, our_passes) = (Picture::read(Path::new(passes)), Picture::read(&house.path("g.exr")));
    let both = seen_alike(&their_passes, &our_passes);
    let colours = ["indirect.R", "indirect.G", "indirect.B"].map(|name| (theirs.channel(name), ours.channel(name)));
    let errors = [
        rms(theirs.channel("occlusion.Z"), ours.channel("occlusion.Z"), &both),
        relative_rms(&colours, &both),
    ];
    println!(
        "with passes of Mitsuba and with ours: occlusion {:.1e}, indirect {:.1e}",
        errors[0], errors[1]
    );
    assert!(errors[0] < 0.002 && errors[1] < 0.005, "{errors:?}");

    if let Some(python) = python_with("OpenEXR, numpy") {
        script(&house, &python, "composite.py", &[passes, "indirect.exr", "beauty.exr"]);
        house
            .line(&format!(
                "render {mesh} -o render.exr --size {size} --points 200000 {DAEMON}"
            ))
            .ok();
        let [beauty, render] = ["beauty.exr", "render.exr"].map(|name| Picture::read(&house.path(name)));
        let colours = ["R", "G", "B"].map(|name| (beauty.channel(name), render.channel(name)));
        let error = relative_rms(&colours, &both);
        println!("the beauty with Mitsuba's direct light and with ours: {error:.1e}");
        assert!(error < 0.005, "{error}");
        assert_eq!(beauty.channel("occlusion.Z").len(), render.channel("occlusion.Z").len());
    }
    if let Some(python) = python_with("mitsuba, numpy") {
        script(
            &house,
            &python,
            "mitsuba_passes.py",
            &[mesh, "anew.exr", "--size", &theirs.width.to_string()],
        );
        let (kept, anew) = (
            GBuffer::read(example("cornell_mitsuba.exr").as_path()).unwrap(),
            GBuffer::read(&house.path("anew.exr")).unwrap(),
        );
        let far = |a: &[f32; 3], b: &[f32; 3]| a.iter().zip(b).any(|(a, b)| (a - b).abs() > 1e-4);
        let moved = kept
            .position
            .iter()
            .zip(&anew.position)
            .filter(|(a, b)| far(a, b))
            .count();
        assert!(moved * 1000 < kept.position.len(), "{moved} positions are elsewhere");
    }
}
