//! The program as people meet it: what they get wrong is named, with the remedy, and nothing is left behind.
#![allow(clippy::unwrap_used, reason = "tests assert")]

use std::path::Path;
use std::process::{Command, Output};

/// The program in a folder of its own: no daemon of this user is found or disturbed.
fn client(home: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_pbgi-client"));
    command.current_dir(home).env_clear();
    command.env("HOME", home).env("PBGI_RUNTIME_DIR", home.join("run"));
    command
}

fn run(home: &Path, line: &str) -> Output {
    client(home).args(line.split_whitespace()).output().unwrap()
}

/// Runs a command that must fail with `code`; its words.
fn fails(home: &Path, code: i32, line: &str) -> String {
    let output = run(home, line);
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(code), "{line}: {text}");
    assert!(output.stdout.is_empty(), "{line}");
    text
}

fn files(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).unwrap();
    let mut names: Vec<_> = entries
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    names
}

/// One triangle, a camera and a light in a glTF file and its buffer.
fn triangle(folder: &Path) {
    let numbers = [0.0f32, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0];
    let bytes: Vec<u8> = numbers.iter().flat_map(|number| number.to_le_bytes()).collect();
    std::fs::write(folder.join("t.bin"), bytes).unwrap();
    let gltf = r#"{
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_lights_punctual"],
        "extensions": {"KHR_lights_punctual": {"lights": [{"type": "point", "intensity": 5}]}},
        "scene": 0,
        "scenes": [{"nodes": [0, 1, 2]}],
        "nodes": [
            {"mesh": 0},
            {"camera": 0, "translation": [0.3, 0.3, 2]},
            {"translation": [0.3, 0.3, 1], "extensions": {"KHR_lights_punctual": {"light": 0}}}
        ],
        "cameras": [{"type": "perspective", "perspective": {"yfov": 1, "aspectRatio": 1, "znear": 0.1}}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3",
            "min": [0, 0, 0], "max": [1, 1, 0]}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"uri": "t.bin", "byteLength": 36}]
    }"#;
    std::fs::write(folder.join("t.gltf"), gltf).unwrap();
}

#[test]
fn help_shows_examples_and_every_command() {
    let home = tempfile::tempdir().unwrap();
    let output = run(home.path(), "--help");
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success());
    assert!(
        text.contains("pbgi-client demo") && text.contains("Exit codes"),
        "{text}"
    );
    for command in [
        "render", "gbuffer", "build", "shade", "status", "watch", "cancel", "shutdown",
    ] {
        let output = run(home.path(), &format!("{command} --help"));
        assert!(output.status.success(), "{command}");
    }
}

#[test]
fn wrong_usage_ends_with_code_2_and_names_the_option() {
    let home = tempfile::tempdir().unwrap();
    std::fs::write(home.path().join("a.glb"), "x").unwrap();
    for (line, word) in [
        ("render", "SCENE"),
        ("paint a.glb", "paint"),
        ("render a.glb -o a.exr --memory lots", "--memory"),
        (
            "render a.glb -o a.exr --raster-resolution 7",
            "--raster-resolution is 7",
        ),
        ("render a.glb -o a.exr --max-solid-angle 0", "--max-solid-angle is 0"),
        ("build a.glb -o a.pbgi --leaf-max 0", "--leaf-max is 0"),
        ("build a.glb -o a.pbgi --spacing -1", "--spacing"),
        ("render a.glb -o a.jpg", ".exr"),
        ("sample a.glb -o a.txt", ".ply"),
        ("status --server tcp://host:1", "unix:/path/to/jobs.sock"),
    ] {
        let text = fails(home.path(), 2, line);
        assert!(text.contains(word), "{line}: {text}");
    }
    assert_eq!(files(home.path()), ["a.glb"]);
}

#[test]
fn missing_inputs_are_named_before_anything_starts() {
    let home = tempfile::tempdir().unwrap();
    std::fs::write(home.path().join("g.exr"), "x").unwrap();
    for line in [
        "render lost.glb -o a.exr",
        "sample lost.glb -o a.ply",
        "gbuffer lost.glb -o a.exr",
        "build lost.ply -o a.pbgi",
        "shade lost.pbgi --gbuffer g.exr -o a.exr",
        "info lost.pbgi",
    ] {
        let text = fails(home.path(), 1, line);
        assert!(text.contains("there is no \"lost."), "{line}: {text}");
    }
    assert_eq!(files(home.path()), ["g.exr"]);
}

#[test]
fn an_existing_output_is_kept_unless_overwrite_is_given() {
    let home = tempfile::tempdir().unwrap();
    triangle(home.path());
    std::fs::write(home.path().join("a.ply"), "mine").unwrap();
    let text = fails(home.path(), 1, "sample t.gltf -o a.ply --points 100");
    assert!(text.contains("--overwrite"), "{text}");
    assert_eq!(std::fs::read(home.path().join("a.ply")).unwrap(), b"mine");
    let output = run(home.path(), "sample t.gltf -o a.ply --points 100 --overwrite");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(std::fs::read(home.path().join("a.ply")).unwrap().starts_with(b"ply"));
}

#[test]
fn a_damaged_mesh_is_an_error_that_names_it_and_leaves_nothing() {
    let home = tempfile::tempdir().unwrap();
    std::fs::write(home.path().join("bad.glb"), "not a mesh").unwrap();
    for line in [
        "sample bad.glb -o a.ply",
        "gbuffer bad.glb -o a.exr",
        "render bad.glb -o a.exr",
    ] {
        let text = fails(home.path(), 1, line);
        assert!(text.contains("bad.glb"), "{line}: {text}");
    }
    assert_eq!(files(home.path()), ["bad.glb"]);
}

#[test]
fn sample_and_gbuffer_need_no_daemon_and_write_their_statistics() {
    let home = tempfile::tempdir().unwrap();
    triangle(home.path());
    for (line, row) in [
        ("sample t.gltf -o a.ply --points 500 --stats s.json", "points"),
        ("gbuffer t.gltf -o g.exr --size 16x16 --stats s.json", "holes"),
    ] {
        let output = run(home.path(), line);
        assert!(
            output.status.success(),
            "{line}: {}",
            String::from_utf8_lossy(&output.stderr)
        );
        let text = std::fs::read_to_string(home.path().join("s.json")).unwrap();
        let stats: serde_json::Map<String, serde_json::Value> = serde_json::from_str(&text).unwrap();
        assert_eq!(stats.len(), pbgi_core::Statistics::default().rows().len());
        assert!(stats[row].as_u64().is_some_and(|value| value > 0), "{line}: {text}");
        assert!(stats["shading_seconds"].is_null());
    }
    assert_eq!(files(home.path()), ["a.ply", "g.exr", "s.json", "t.bin", "t.gltf"]);
}

#[test]
fn a_camera_that_is_not_there_is_named() {
    let home = tempfile::tempdir().unwrap();
    triangle(home.path());
    let text = fails(home.path(), 2, "gbuffer t.gltf -o g.exr --camera 3");
    assert!(text.contains("camera 3") && text.contains("t.gltf"), "{text}");
}

#[test]
fn commands_about_a_daemon_say_that_there_is_none() {
    let home = tempfile::tempdir().unwrap();
    for line in ["status", "jobs", "watch job-1", "cancel job-1", "shutdown"] {
        let text = fails(home.path(), 1, line);
        assert!(text.contains("no daemon of yours is running"), "{line}: {text}");
    }
    let text = fails(home.path(), 1, "status --server unix:/nonexistent/jobs.sock");
    assert!(text.contains("/nonexistent/jobs.sock"), "{text}");
}

#[test]
fn a_statistics_file_that_cannot_be_written_is_found_out_first() {
    let home = tempfile::tempdir().unwrap();
    triangle(home.path());
    let text = fails(home.path(), 1, "sample t.gltf -o a.ply --stats no/s.json");
    assert!(text.contains("no/s.json"), "{text}");
    assert_eq!(files(home.path()), ["t.bin", "t.gltf"]);
}

#[test]
fn diff_tells_how_far_pictures_are_apart() {
    let home = tempfile::tempdir().unwrap();
    let write = |name: &str, value: f32| {
        let mut image = pbgi_points::LayeredImage::new(8, 4);
        let mut occlusion = vec![0.5; 32];
        occlusion[11] = value;
        image.add("occlusion.Z", pbgi_points::Precision::Float, occlusion);
        image.add_rgb("", pbgi_points::Precision::Half, &[[1.0; 3]; 32]);
        image.write_exr(&home.path().join(name)).unwrap();
    };
    write("a.exr", 0.75);
    write("b.exr", 0.5);
    let told = |line: &str, code: i32| {
        let output = run(home.path(), line);
        assert_eq!(output.status.code(), Some(code), "{line}: {output:?}");
        String::from_utf8(output.stdout).unwrap()
    };
    let text = told("diff a.exr b.exr", 0);
    assert!(
        text.contains("(root)") && text.contains("2.500e-1") && text.contains("3, 1"),
        "{text}"
    );
    told("diff a.exr b.exr --threshold 0.05", 0);
    told("diff a.exr b.exr --threshold 0.04 -o heat.png", 1);
    assert!(
        files(home.path()).contains(&"heat.png".to_owned()),
        "written whatever the verdict"
    );
    told("diff a.exr b.exr --threshold 0.04 --layer other", 2);
    let text = told("diff a.exr b.exr --layer occlusion --threshold 0.04 --json", 1);
    let report: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert_eq!(report["within_threshold"], false);
    let layer = &report["layers"][0];
    assert_eq!(
        (&layer["layer"], &layer["maximum_at"]),
        (&"occlusion".into(), &serde_json::json!([3, 1]))
    );
    assert!((layer["rms"].as_f64().unwrap() - 0.25 / 32f64.sqrt()).abs() < 1e-9);
    for (line, word) in [
        ("diff a.exr gone.exr", "gone.exr"),
        ("diff a.exr b.exr -o heat.png", "--overwrite"),
        ("diff a.exr b.exr -o heat.exr", ".png"),
        ("diff a.exr b.exr --threshold -1", "--threshold"),
    ] {
        let text = fails(home.path(), 2, line);
        assert!(text.contains(word), "{text}");
    }
}

#[test]
fn problems_of_a_scene_file_are_told_by_line() {
    let home = tempfile::tempdir().unwrap();
    triangle(home.path());
    let scene = "[[mesh]]\nfile = \"t.gltf\"\nscale = 0\n\n[[light.point]]\nposition = [0, 0, 1]\nintensity = -5\n";
    std::fs::write(home.path().join("s.toml"), scene).unwrap();
    let text = fails(home.path(), 1, "gbuffer s.toml -o g.exr");
    assert!(text.contains("s.toml:1: ") && text.contains("s.toml:5: "), "{text}");
    std::fs::write(home.path().join("s.toml"), scene.replace("scale = 0", "skale = 1")).unwrap();
    let text = fails(home.path(), 1, "sample s.toml -o p.ply");
    assert!(text.contains("s.toml:3: ") && text.contains("skale"), "{text}");
    std::fs::write(home.path().join("s.toml"), "[[mesh]]\nfile = \"t.gltf\"\n").unwrap();
    assert!(run(home.path(), "gbuffer s.toml -o g.exr --size 8x8").status.success());
    let names = files(home.path());
    assert!(
        names.contains(&"g.exr".to_owned()) && !names.contains(&"p.ply".to_owned()),
        "{names:?}"
    );
}

#[test]
fn a_picture_to_look_at_is_one_of_this_machine() {
    let home = tempfile::tempdir().unwrap();
    for name in ["s.pbgi", "g.exr"] {
        std::fs::write(home.path().join(name), "").unwrap();
    }
    let shade = "shade s.pbgi --gbuffer g.exr --png o.png -o";
    for line in [format!("{shade} o.exr --detach"), format!("{shade} out:o.exr")] {
        let text = fails(home.path(), 2, &line);
        assert!(text.contains("--png and --preview"), "{text}");
    }
    let text = fails(home.path(), 2, "shade s.pbgi --gbuffer g.exr -o o.exr --space sideways");
    assert!(text.contains("checked, world or camera"), "{text}");
}

#[test]
fn command_whose_words_nobody_reads_goes_on() {
    let home = tempfile::tempdir().unwrap();
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let output = home.path().join("tree.ply");
    let mut command = client(home.path());
    command
        .args(["generate", "tree", "--points", "1000", "-o"])
        .arg(&output);
    assert!(command.stderr(writer).status().unwrap().success());
    assert!(output.metadata().unwrap().len() > 1000);
}

#[test]
fn a_reader_that_has_seen_enough_is_no_failure() {
    let home = tempfile::tempdir().unwrap();
    triangle(home.path());
    let mut command = client(home.path());
    command.args("sample t.gltf -o p.ply --points 100".split_whitespace());
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let output = command.stdout(writer).output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && !text.contains("panicked"), "{text}");
}
