//! Clouds of every kind: all their points, where they are, and one clear error where they cannot be used.

#![allow(clippy::unwrap_used, reason = "a step that fails is a test that fails")]

mod common;

use common::{assert_says, collect, mutate, shared};
use las::{Color, Point, Transform, Vector, Writer};
use pbgi_core::point::Sides;
use pbgi_core::{Bounds, PointRecord, PointStream};
use pbgi_points::ply::{PlyForm, PlyWriter};
use pbgi_points::{
    CloudOptions, Facing, Input, InputOptions, InvalidPoints, PointsError, Radius, open_input, origin_of,
};
use std::fs;
use std::path::{Path, PathBuf};

/// Takes clouds that have nothing but positions.
fn bare() -> InputOptions {
    InputOptions {
        cloud: CloudOptions {
            estimate_normals: Some(Facing::Auto),
            radius: Some(Radius::Estimate),
            ..CloudOptions::default()
        },
        ..InputOptions::default()
    }
}

fn open(path: &Path, options: &InputOptions) -> Result<Input, PointsError> {
    open_input(&[path.to_owned()], options)
}

fn read(path: &Path, options: &InputOptions) -> Result<Vec<PointRecord>, PointsError> {
    let mut stream = open(path, options)?;
    let mut points = Vec::new();
    while stream.next_batch(&mut points)? {}
    Ok(points)
}

fn bounds_of(points: &[PointRecord]) -> Bounds {
    let mut bounds = Bounds::EMPTY;
    points.iter().for_each(|point| bounds.include(point.position));
    bounds
}

/// Every point is there, and within the declared box.
fn whole(path: &Path, count: u64) -> Vec<PointRecord> {
    let mut stream = open(path, &bare()).unwrap();
    assert_eq!(stream.len_hint(), Some(count));
    let declared = stream.bounds().unwrap();
    let points = collect(&mut stream);
    assert_eq!(points.len() as u64, count);
    let actual = bounds_of(&points);
    assert!(declared.contains(actual.min) && declared.contains(actual.max));
    assert!(
        actual.diagonal() > 0.99 * declared.diagonal(),
        "{actual:?} in {declared:?}"
    );
    points
}

#[test]
fn laz_and_copc_files_are_read_to_their_last_point() {
    if let Some(path) = shared("data/lion_takanawa.copc.laz") {
        whole(&path, 341_989);
    }
    if let Some(path) = shared("data/autzen_stadium_crop.laz") {
        let points = whole(&path, 866_813);
        let up = points.iter().filter(|point| point.normal().y > 0.7).count();
        assert!(up * 2 > points.len(), "an aerial scan faces up: {up}");
        assert!(points.iter().all(|point| point.normal().y >= -1e-4));
        let lit = points.iter().filter(|point| point.sides().front != [0.0; 3]).count();
        assert!(lit * 10 > points.len() * 9, "colours are there: {lit}");
        let origin = origin_of(&[path], &CloudOptions::default()).unwrap();
        assert!(origin[0] >= 600_000.0 && origin[1] >= 800_000.0, "{origin:?}");
    }
}

#[test]
#[ignore = "a minute: cargo test --release -p pbgi-points --test clouds -- --ignored"]
fn all_of_autzen_is_read_within_a_small_memory() {
    let Some(path) = shared("data/autzen_10.6M_rgb.laz") else {
        return;
    };
    let mut options = bare();
    options.memory_bytes = 16 << 20;
    let started = std::time::Instant::now();
    let mut stream = open(&path, &options).unwrap();
    let (mut count, mut batch) = (0, Vec::new());
    while stream.next_batch(&mut batch).unwrap() {
        count += batch.len();
        batch.clear();
    }
    assert_eq!(count, 10_653_336);
    let status = fs::read_to_string("/proc/self/status").unwrap();
    let peak = status
        .lines()
        .find(|line| line.starts_with("VmHWM"))
        .unwrap_or_default();
    println!("{count} points in {:.1?}, {peak}", started.elapsed());
}

/// A small LAS file of points on a grid far from the origin, millimetres apart.
fn las(folder: &Path, name: &str, far: f64, white: u16) -> PathBuf {
    let transform = |offset| Transform { scale: 0.001, offset };
    let mut builder = las::Builder::from((1, 4));
    builder.point_format = las::point::Format::new(2).unwrap();
    builder.transforms = Vector {
        x: transform(far),
        y: transform(far),
        z: transform(0.0),
    };
    let path = folder.join(name);
    let mut writer = Writer::from_path(&path, builder.into_header().unwrap()).unwrap();
    for index in 0..400 {
        let (x, y) = (f64::from(index % 20), f64::from(index / 20));
        let point = Point {
            x: far + x * 0.002,
            y: far + y * 0.002,
            z: 5.0 + x * 0.001,
            color: Some(Color::new(white, 0, white)),
            ..Point::default()
        };
        writer.write_point(point).unwrap();
    }
    writer.close().unwrap();
    path
}

#[test]
fn heights_become_y_and_far_clouds_come_near_without_losing_a_millimetre() {
    let folder = tempfile::tempdir().unwrap();
    let path = las(folder.path(), "far.las", 4_123_456.0, u16::MAX);
    let stream = open(&path, &bare()).unwrap();
    assert_eq!(stream.origin(), [4_123_000.0, 4_123_000.0, 0.0]);
    let points = read(&path, &bare()).unwrap();
    let mut columns: Vec<i64> = points
        .iter()
        .map(|p| (f64::from(p.position[0] - 456.0) * 1000.0).round() as i64)
        .collect();
    columns.sort_unstable();
    columns.dedup();
    assert_eq!(columns, (0..20).map(|column| column * 2).collect::<Vec<i64>>());
    for point in &points {
        assert!(
            (point.position[1] - 5.0).abs() < 0.02 && point.position[2] <= -455.9,
            "{point:?}"
        );
        // The slope of the grid is one in two.
        assert!(
            (point.normal().y - 0.894).abs() < 0.02 && point.normal().x < 0.0,
            "{:?}",
            point.normal()
        );
        assert!((0.0005..0.0025).contains(&point.radius), "{}", point.radius);
        assert_eq!(point.sides().front, [1.0, 0.0, 1.0]);
        assert_eq!(point.sides().back, [1.0, 0.0, 1.0], "which side is lit is not known");
    }
    let mut options = bare();
    options.cloud.origin = Some([4_123_450.0, 4_123_450.0, -1.0]);
    let point = read(&path, &options).unwrap()[0];
    assert!(point.position[0] < 7.0 && point.position[1] >= 6.0, "{point:?}");
}

#[test]
fn colours_of_eight_bits_are_as_bright_as_those_of_sixteen() {
    let folder = tempfile::tempdir().unwrap();
    let bytes = read(&las(folder.path(), "a.las", 0.0, 255), &bare()).unwrap();
    let words = read(&las(folder.path(), "b.las", 0.0, u16::MAX), &bare()).unwrap();
    assert_eq!(bytes, words);
}

#[test]
fn a_damaged_las_file_is_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let path = las(folder.path(), "whole.las", 0.0, 255);
    let bytes = fs::read(&path).unwrap();
    let broken = folder.path().join("broken.las");
    for length in [0, 3, 100, 226, 230, 5000, bytes.len() - 1] {
        fs::write(&broken, &bytes[..length]).unwrap();
        assert_says(read(&broken, &bare()).map(drop), &["broken.las"]);
    }
    if let Some(laz) = shared("data/lion_takanawa.copc.laz") {
        let bytes = fs::read(laz).unwrap();
        let broken = folder.path().join("broken.laz");
        fs::write(&broken, &bytes[..bytes.len() / 2]).unwrap();
        assert_says(read(&broken, &bare()).map(drop), &["broken.laz"]);
    }
    assert_says(
        open(&path, &InputOptions::default()).map(drop),
        &["no normals", "--estimate-normals", "whole.las"],
    );
    mutate(&bytes, 0..bytes.len().min(400), 300, |bytes| {
        fs::write(&broken, bytes).unwrap();
        // A scale so small that the box is gone is one thing; a panic would be another.
        drop(read(&broken, &bare()));
    });
}

#[test]
fn tiles_make_one_surface() {
    let folder = tempfile::tempdir().unwrap();
    let tile = |name: &str, columns: std::ops::Range<u32>| {
        let path = folder.path().join(name);
        let mut text = format!(
            "ply\nformat ascii 1.0\nelement vertex {}\nproperty double x\nproperty double y\nproperty double z\nend_header\n",
            columns.len() * 40
        );
        for column in columns {
            (0..40).for_each(|row| text += &format!("{column} 0 {row}\n"));
        }
        fs::write(&path, text).unwrap();
        path
    };
    let (left, right, both) = (tile("l.ply", 0..20), tile("r.ply", 20..40), tile("b.ply", 0..40));
    let mut options = bare();
    options.cloud.estimate_normals = Some(Facing::Up);
    let apart = collect(&mut open_input(&[left, right], &options).unwrap());
    let together = collect(&mut open_input(&[both], &options).unwrap());
    assert!(apart == together, "points at a seam have the neighbours of both tiles");
}

/// Two points in Partio's form.
fn ptc(version: i32) -> Vec<u8> {
    let mut bytes = b"pptc".to_vec();
    bytes.extend(version.to_le_bytes());
    bytes.extend(2f64.to_le_bytes());
    bytes.extend([0; 6 * 4]);
    bytes.extend(vec![0; if version >= 1 { 4 * 4 } else { 0 }]);
    bytes.extend(vec![0; if version >= 2 { 33 * 4 } else { 0 }]);
    bytes.extend([0; 35 * 4]);
    bytes.extend(3i32.to_le_bytes());
    bytes.extend(5i32.to_le_bytes());
    bytes.extend(b"float _area\ncolor _radiosity\nfloat other\n");
    bytes.extend(vec![0; if version >= 1 { 2 * 4 } else { 0 }]);
    for x in [1.0f32, 2.0] {
        bytes.extend([x, 5.0, -3.0].into_iter().flat_map(f32::to_le_bytes));
        // Along +z, and along +y.
        let normal: [u16; 2] = if x == 1.0 { [0, 65535] } else { [32768, 32768] };
        bytes.extend(normal.into_iter().flat_map(u16::to_le_bytes));
        let floats = [9.0, std::f32::consts::PI * 0.25, std::f32::consts::PI, 0.0, x, 7.0];
        bytes.extend(floats.into_iter().flat_map(f32::to_le_bytes));
    }
    bytes
}

#[test]
fn renderman_clouds_bring_area_and_radiosity() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("baked.ptc");
    for version in 0..=2 {
        fs::write(&path, ptc(version)).unwrap();
        let mut stream = open(&path, &InputOptions::default()).unwrap();
        let points = collect(&mut stream);
        stream.rewind().unwrap();
        assert_eq!(points, collect(&mut stream));
        assert_eq!(points.len(), 2);
        assert_eq!(points[1].position, [2.0, 5.0, -3.0]);
        assert!((points[0].radius - 0.5).abs() < 1e-6, "the area counts");
        assert!(points[0].normal().z > 0.999 && points[1].normal().y > 0.999);
        let [r, g, _] = points[0].sides().front;
        assert!((r - 1.0).abs() < 1e-3 && g == 0.0, "radiosity is pi times radiance");
        assert_eq!(points[0].sides().back, [0.0; 3]);
    }
    let whole = ptc(2);
    for length in 0..whole.len() {
        fs::write(&path, &whole[..length]).unwrap();
        assert_says(read(&path, &InputOptions::default()).map(drop), &["baked.ptc"]);
    }
    mutate(&whole, 0..whole.len(), 300, |bytes| {
        fs::write(&path, bytes).unwrap();
        drop(read(&path, &InputOptions::default()));
    });
}

fn point(index: usize) -> PointRecord {
    let x = index as f32;
    let sides = Sides {
        front: [x * 0.125, 1.0, 0.5],
        back: [0.25; 3],
    };
    PointRecord::new([x, -x, 0.1 * x], [0.6, x, 0.8], 0.25, sides).unwrap()
}

#[test]
fn records_come_back_bit_for_bit_and_the_exact_box_is_in_the_header() {
    let folder = tempfile::tempdir().unwrap();
    let points: Vec<PointRecord> = (0..40_000).map(point).collect();
    for form in [PlyForm::Records, PlyForm::Floats] {
        let path = folder.path().join("points.ply");
        let mut writer = PlyWriter::create(&path, form, &[]).unwrap();
        points.iter().for_each(|point| writer.push(point, &[]).unwrap());
        writer.finish().unwrap();
        let mut stream = open(&path, &InputOptions::default()).unwrap();
        assert_eq!(stream.bounds(), Some(bounds_of(&points)));
        let back = collect(&mut stream);
        match form {
            PlyForm::Records => assert!(back == points),
            PlyForm::Floats => assert!(back.iter().zip(&points).all(|(a, b)| a.position == b.position)),
        }
        let mut options = InputOptions::default();
        options.cloud.recompute_bounds = true;
        assert_eq!(open(&path, &options).unwrap().bounds(), None);
        options.cloud = CloudOptions {
            origin: Some([10.0, 0.0, -5.0]),
            ..CloudOptions::default()
        };
        let mut moved = open(&path, &options).unwrap();
        let declared = moved.bounds().unwrap();
        assert_eq!(declared, bounds_of(&collect(&mut moved)));
        assert_eq!(declared.min, [-10.0, -39_999.0, 5.0]);
    }
}

#[test]
fn invalid_points_are_counted_and_refused_or_skipped() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("some.ply");
    let mut writer = PlyWriter::create(&path, PlyForm::Records, &[]).unwrap();
    for index in 0..50_000 {
        let mut point = point(index);
        if index % 1000 == 7 {
            point.radius = f32::NAN;
        }
        writer.push(&point, &[]).unwrap();
    }
    writer.finish().unwrap();
    assert_says(
        read(&path, &InputOptions::default()).map(drop),
        &[
            "point 7 of 50000",
            "radius",
            "first of 50 invalid points",
            "--invalid-points skip",
            "some.ply",
        ],
    );
    let mut options = InputOptions::default();
    options.cloud.invalid_points = InvalidPoints::Skip;
    let mut stream = open(&path, &options).unwrap();
    for _ in 0..2 {
        assert_eq!(collect(&mut stream).len(), 49_950);
        assert_eq!(stream.skipped(), 50);
        stream.rewind().unwrap();
    }
    println!("RELIABILITY D1: 50 of 50,000 points counted, the first named; 49,950 read on request");
}

#[test]
fn a_length_or_count_that_is_wrong_is_refused_naming_both() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("records.ply");
    let mut writer = PlyWriter::create(&path, PlyForm::Records, &[]).unwrap();
    (0..100).for_each(|index| writer.push(&point(index), &[]).unwrap());
    writer.finish().unwrap();
    let whole = fs::read(&path).unwrap();
    for change in 1..=32 {
        let shorter = whole.len() - change * 7;
        fs::write(&path, &whole[..shorter]).unwrap();
        assert_says(
            read(&path, &InputOptions::default()).map(drop),
            &[
                "truncated",
                &whole.len().to_string(),
                &shorter.to_string(),
                "records.ply",
            ],
        );
        let longer = whole.len() + change * 7;
        fs::write(&path, [&whole[..], &vec![0; change * 7]].concat()).unwrap();
        assert_says(
            read(&path, &InputOptions::default()).map(drop),
            &[
                "count is wrong",
                &whole.len().to_string(),
                &longer.to_string(),
                "records.ply",
            ],
        );
    }
    println!("RELIABILITY D12: 64 wrong lengths refused, both named");
}

#[test]
fn a_point_outside_the_declared_box_is_refused_with_count_or_measured() {
    let folder = tempfile::tempdir().unwrap();
    let path = las(folder.path(), "box.las", 0.0, 255);
    let mut bytes = fs::read(&path).unwrap();
    // The header's largest x, at its place in every version of the format.
    bytes[179..187].copy_from_slice(&0.0005f64.to_le_bytes());
    fs::write(&path, &bytes).unwrap();
    assert_says(
        read(&path, &bare()).map(drop),
        &["380 points lie outside the box", "--recompute-bounds"],
    );
    let mut options = bare();
    options.cloud.recompute_bounds = true;
    assert_eq!(read(&path, &options).unwrap().len(), 400);
    println!("RELIABILITY D5: 380 of 400 points outside of the box refused with their number, 400 read when measured");
}
