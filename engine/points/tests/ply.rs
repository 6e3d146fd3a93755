//! PLY clouds: every encoding, every error named, nothing half-read.

#![allow(clippy::unwrap_used, reason = "a step that fails is a test that fails")]

mod common;

use common::{assert_says, collect, mutate};
use pbgi_core::point::Sides;
use pbgi_core::{PointRecord, PointStream};
use pbgi_points::ply::{PlyPoints, PlyWriter};
use pbgi_points::{CloudOptions, Density, InputOptions, PlyForm, PointsError, open_input, write_point_ply};
use std::fs;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

const HEADER: &str = "property float x\nproperty float y\nproperty float z\n\
    property float nx\nproperty float ny\nproperty float nz\nproperty float radius\n\
    property float red\nproperty float green\nproperty float blue\n";

fn header(format: &str, count: usize, properties: &str) -> Vec<u8> {
    format!("ply\nformat {format} 1.0\nelement vertex {count}\n{properties}end_header\n").into_bytes()
}

fn write(folder: &Path, parts: &[&[u8]]) -> PathBuf {
    let path = folder.join("cloud.ply");
    fs::write(&path, parts.concat()).unwrap();
    path
}

fn read(path: &Path) -> Result<Vec<PointRecord>, PointsError> {
    let mut stream = PlyPoints::open(path, [0.0; 3], &CloudOptions::default())?;
    let mut points = Vec::new();
    while stream.next_batch(&mut points)? {}
    Ok(points)
}

/// Ten numbers a point.
fn numbers(index: usize) -> [f32; 10] {
    let i = index as f32;
    [i, i * 0.5, -i, 0.0, 1.0, 0.0, 0.1, 0.25, 0.5, i * 0.125]
}

#[test]
fn ascii_and_both_binary_encodings_give_the_same_points() {
    let folder = tempfile::tempdir().unwrap();
    let rows: Vec<[f32; 10]> = (0..40_000).map(numbers).collect();
    let text: String = rows
        .iter()
        .map(|row| row.map(|value| value.to_string()).join(" ") + "\n")
        .collect();
    let little: Vec<u8> = rows.iter().flatten().flat_map(|value| value.to_le_bytes()).collect();
    let big: Vec<u8> = rows
        .iter()
        .flatten()
        .flat_map(|value| value.to_bits().swap_bytes().to_le_bytes())
        .collect();
    let mut all = Vec::new();
    for (format, body) in [
        ("ascii", text.as_bytes()),
        ("binary_little_endian", &little),
        ("binary_big_endian", &big),
    ] {
        let path = write(folder.path(), &[&header(format, rows.len(), HEADER), body]);
        let mut stream = PlyPoints::open(&path, [0.0; 3], &CloudOptions::default()).unwrap();
        assert_eq!(stream.len_hint(), Some(40_000));
        let points = collect(&mut stream);
        stream.rewind().unwrap();
        assert_eq!(points, collect(&mut stream), "a second reading is the same");
        assert_eq!(points.len(), rows.len());
        all.push(points);
    }
    assert!(all[0] == all[1] && all[1] == all[2]);
    assert_eq!(all[0][8].position, [8.0, 4.0, -8.0]);
    assert_eq!(all[0][8].sides().front, [0.25, 0.5, 1.0]);
    assert_eq!(all[0][8].sides().back, [0.0; 3]);
}

#[test]
fn other_properties_elements_and_lists_are_skipped() {
    let folder = tempfile::tempdir().unwrap();
    let head = "ply\ncomment hello\nformat binary_little_endian 1.0\n\
        element camera 2\nproperty uchar id\nproperty list uchar int route\n\
        element vertex 1\nproperty double quality\nproperty double x\nproperty double y\nproperty double z\n\
        property short nx\nproperty short ny\nproperty short nz\nproperty float radius\nproperty uchar alpha\n\
        property uchar red\nproperty uchar green\nproperty uchar blue\n\
        element face 1\nproperty list uchar int vertex_indices\nend_header\n";
    let mut body: Vec<u8> = vec![7, 2, 1, 0, 0, 0, 2, 0, 0, 0, 8, 0];
    for value in [9.0f64, 1.0, 2.0, 3.0] {
        body.extend(value.to_le_bytes());
    }
    for value in [0i16, 0, -5] {
        body.extend(value.to_le_bytes());
    }
    body.extend(0.5f32.to_le_bytes());
    body.extend([77, 255, 188, 0]);
    body.extend([3, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
    let points = read(&write(folder.path(), &[head.as_bytes(), &body])).unwrap();
    assert_eq!(points.len(), 1);
    assert_eq!(points[0].position, [1.0, 2.0, 3.0]);
    assert!((points[0].normal().z + 1.0).abs() < 1e-4);
    let [r, g, b] = points[0].sides().front;
    assert!(r == 1.0 && b == 0.0 && (g - 0.503).abs() < 2e-3, "bytes are sRGB: {g}");
}

#[test]
fn an_empty_cloud_is_valid() {
    let folder = tempfile::tempdir().unwrap();
    for format in ["ascii", "binary_little_endian"] {
        let path = write(folder.path(), &[&header(format, 0, HEADER)]);
        assert_eq!(read(&path).unwrap(), []);
    }
}

#[test]
fn missing_properties_are_named_with_a_remedy() {
    let folder = tempfile::tempdir().unwrap();
    for (missing, remedy) in [("x", "position"), ("ny", "all three"), ("green", "all three")] {
        let kept: String = HEADER
            .split_inclusive('\n')
            .filter(|line| line.trim_end().rsplit(' ').next() != Some(missing))
            .collect();
        let path = write(folder.path(), &[&header("ascii", 0, &kept)]);
        assert_says(
            read(&path),
            &[&format!("property {missing} is missing"), remedy, "cloud.ply"],
        );
    }
    for (missing, says, remedy) in [
        ("n", "no normals", "--estimate-normals"),
        ("radius", "no radius", "--radius auto"),
    ] {
        let kept: String = HEADER
            .split_inclusive('\n')
            .filter(|line| !line.starts_with(&format!("property float {missing}")))
            .collect();
        let path = write(folder.path(), &[&header("ascii", 0, &kept)]);
        let opened = open_input(&[path], &InputOptions::default());
        assert_says(opened.map(drop), &[says, remedy, "cloud.ply"]);
    }
    assert_says(read(&folder.path().join("none.ply")), &["cannot open", "none.ply"]);
}

#[test]
fn a_point_with_a_broken_number_is_named_with_index_and_field() {
    let folder = tempfile::tempdir().unwrap();
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for field in 0..10 {
            let mut rows: Vec<[f32; 10]> = (0..20_000).map(numbers).collect();
            rows[17_003][field] = bad;
            let body: Vec<u8> = rows.iter().flatten().flat_map(|value| value.to_le_bytes()).collect();
            let path = write(
                folder.path(),
                &[&header("binary_little_endian", rows.len(), HEADER), &body],
            );
            let name = ["position", "normal", "radius", "radiance"][[0, 0, 0, 1, 1, 1, 2, 3, 3, 3][field]];
            assert_says(read(&path), &["point 17003 of 20000", name, "not finite", "cloud.ply"]);
        }
    }
    for (field, value, says) in [
        (4, 0.0, "normal is zero"),
        (6, 0.0, "radius is not positive"),
        (6, -1.0, "radius is not positive"),
        (8, -0.5, "radiance is negative"),
    ] {
        let mut row = numbers(1);
        row[field] = value;
        let text = row.map(|value| value.to_string()).join(" ");
        let path = write(folder.path(), &[&header("ascii", 1, HEADER), text.as_bytes()]);
        assert_says(read(&path), &["point 0 of 1", says]);
    }
    let path = write(
        folder.path(),
        &[&header("ascii", 1, HEADER), b"1 2 three 0 1 0 1 0 0 0\n"],
    );
    assert_says(read(&path), &["point 0 of 1", "property z", "three"]);
    println!(
        "RELIABILITY D11: 30 numbers that are not finite, 4 that are out of range, 1 that is none: 35 refusals with index and field"
    );
}

#[test]
fn a_file_of_another_length_than_announced_names_both() {
    let folder = tempfile::tempdir().unwrap();
    let head = header("binary_little_endian", 100, HEADER);
    let body: Vec<u8> = (0..100).flat_map(numbers).flat_map(f32::to_le_bytes).collect();
    let whole = head.len() + body.len();
    for cut in [1, 39, 40, 2000, 4000] {
        let path = write(folder.path(), &[&head, &body[..body.len() - cut]]);
        assert_says(
            read(&path),
            &["truncated", &whole.to_string(), &(whole - cut).to_string()],
        );
    }
    let path = write(folder.path(), &[&head, &body, b"x"]);
    assert_says(
        read(&path),
        &[&whole.to_string(), &(whole + 1).to_string(), "count is wrong"],
    );
    let path = write(folder.path(), &[&header("ascii", 3, HEADER), b"1 2 3 0 1 0 1 0 0 0\n"]);
    assert_says(read(&path), &["truncated", "expected 3 points, found 1"]);
    let huge = header("binary_little_endian", usize::MAX, HEADER);
    assert_says(read(&write(folder.path(), &[&huge])), &["announces"]);
}

#[test]
fn damaged_headers_are_errors() {
    let folder = tempfile::tempdir().unwrap();
    let long = format!("ply\nformat ascii 1.0\n{}", "comment x\n".repeat(10_000));
    let many = format!(
        "ply\nformat ascii 1.0\nelement vertex 1\n{}end_header\n",
        "property float a\n".repeat(300)
    );
    for (text, says) in [
        ("", "no PLY file"),
        ("plx\n", "no PLY file"),
        ("ply\nformat ascii 1.0\n", "end_header"),
        ("ply\nformat morse 1.0\nend_header\n", "morse"),
        ("ply\nelement vertex 1\nend_header\n", "line 3"),
        ("ply\nformat ascii 1.0\nelement vertex -3\nend_header\n", "line 3"),
        ("ply\nformat ascii 1.0\nproperty float x\nend_header\n", "line 3"),
        (
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty quark x\nend_header\n",
            "line 4",
        ),
        (
            "ply\nformat ascii 1.0\nelement face 1\nend_header\n",
            "no element \"vertex\"",
        ),
        (&long, "end_header"),
        (&many, "more than 256 properties"),
    ] {
        assert_says(read(&write(folder.path(), &[text.as_bytes()])), &[says, "cloud.ply"]);
    }
}

fn points(count: usize) -> Vec<PointRecord> {
    let point = |i: usize| {
        let x = i as f32;
        let sides = Sides {
            front: [x, 0.5, 0.25],
            back: [0.125, x, 1.0],
        };
        PointRecord::new([x, -x, 2.0 * x], [0.0, 0.6, 0.8], 0.25 + x, sides).unwrap()
    };
    (0..count).map(point).collect()
}

#[test]
fn written_points_are_read_back_with_both_sides() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("out.ply");
    let ours = points(50);
    let mut writer = PlyWriter::create(&path, PlyForm::Floats, &["occlusion"]).unwrap();
    ours.iter().for_each(|point| writer.push(point, &[0.5]).unwrap());
    assert!(fs::metadata(&path).is_err(), "nothing appears before it is whole");
    assert_eq!(writer.finish().unwrap(), 50);
    let back = read(&path).unwrap();
    assert_eq!(back.len(), 50);
    for (a, b) in ours.iter().zip(&back) {
        assert_eq!((a.position, a.radius, a.sides()), (b.position, b.radius, b.sides()));
        assert!(a.normal().distance(b.normal()) < 1e-4);
    }
    let copy = folder.path().join("copy.ply");
    let mut seen = 0;
    let mut stream = PlyPoints::open(&path, [0.0; 3], &CloudOptions::default()).unwrap();
    let count = write_point_ply(&copy, PlyForm::Floats, &mut stream, &mut |points| {
        seen = points;
        ControlFlow::Continue(())
    });
    assert_eq!((count.unwrap(), seen), (50, 50));
    assert_eq!(read(&copy).unwrap(), back);
}

#[test]
fn a_cancelled_or_failed_writing_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let input = folder.path().join("in.ply");
    let mut writer = PlyWriter::create(&input, PlyForm::Floats, &[]).unwrap();
    points(10).iter().for_each(|point| writer.push(point, &[]).unwrap());
    writer.finish().unwrap();
    let output = folder.path().join("out.ply");
    let mut stream = PlyPoints::open(&input, [0.0; 3], &CloudOptions::default()).unwrap();
    let stopped = write_point_ply(&output, PlyForm::Floats, &mut stream, &mut |_| ControlFlow::Break(()));
    assert!(matches!(stopped, Err(PointsError::Cancelled)));
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
}

#[test]
fn inputs_of_several_kinds_make_one_stream() {
    let folder = tempfile::tempdir().unwrap();
    let cloud = folder.path().join("cloud.PLY");
    let mut writer = PlyWriter::create(&cloud, PlyForm::Floats, &[]).unwrap();
    points(10).iter().for_each(|point| writer.push(point, &[]).unwrap());
    writer.finish().unwrap();
    let room = folder.path().join("room.glb");
    pbgi_points::demo::write_glb(&room).unwrap();
    let options = InputOptions {
        density: Density::Points(5000),
        ..InputOptions::default()
    };
    let alone = collect(&mut open_input(std::slice::from_ref(&room), &options).unwrap()).len();
    let mut both = open_input(&[cloud, room], &options).unwrap();
    assert_eq!(both.len_hint(), Some(5010));
    let all = collect(&mut both);
    assert_eq!(all.len(), alone + 10);
    both.rewind().unwrap();
    assert_eq!(collect(&mut both), all);
    let kind = PathBuf::from("scene.fbx");
    assert_says(
        open_input(&[kind], &options).map(drop),
        &["\"fbx\"", "convert it", "scene.fbx"],
    );
    assert_says(open_input(&[], &options).map(drop), &["no input file"]);
}

#[test]
fn mutations_of_a_cloud_are_survived() {
    let folder = tempfile::tempdir().unwrap();
    let body: Vec<u8> = (0..20).flat_map(numbers).flat_map(f32::to_le_bytes).collect();
    let binary = [header("binary_little_endian", 20, HEADER), body].concat();
    let text: String = (0..20)
        .map(|i| numbers(i).map(|value| value.to_string()).join(" ") + "\n")
        .collect();
    let ascii = [header("ascii", 20, HEADER), text.into_bytes()].concat();
    for bytes in [binary, ascii] {
        mutate(&bytes, 0..bytes.len(), 300, |broken| {
            drop(read(&write(folder.path(), &[broken])));
        });
    }
}
