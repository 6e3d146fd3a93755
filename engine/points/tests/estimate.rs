//! Normals and radii that are estimated, against surfaces whose own are known.

#![allow(clippy::unwrap_used, reason = "a step that fails is a test that fails")]

mod common;

use common::{collect, shared};
use flate2::read::GzDecoder;
use glam::Vec3;
use pbgi_core::point::Sides;
use pbgi_core::{PointRecord, PointStream};
use pbgi_points::{
    CloudOptions, Density, Facing, InputOptions, MeshPoints, MeshScene, Radius, SampleOptions, open_input,
};
use std::collections::HashMap;
use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};

/// The dragon's triangles as an OBJ file.
fn dragon(folder: &Path) -> Option<PathBuf> {
    let file = fs::File::open(shared("data/dragon_vrip.ply.gz")?).unwrap();
    let path = folder.join("dragon.obj");
    let mut obj = std::io::BufWriter::new(fs::File::create(&path).unwrap());
    let mut lines = BufReader::new(GzDecoder::new(file)).lines().map(Result::unwrap);
    for line in lines.by_ref() {
        if line.trim() == "end_header" {
            break;
        }
    }
    for line in lines {
        let words: Vec<&str> = line.split_whitespace().collect();
        match words.as_slice() {
            ["3", a, b, c] => {
                let [a, b, c] = [a, b, c].map(|index| index.parse::<usize>().unwrap() + 1);
                writeln!(obj, "f {a} {b} {c}").unwrap();
            }
            [x, y, z, ..] => writeln!(obj, "v {x} {y} {z}").unwrap(),
            _ => {}
        }
    }
    obj.flush().unwrap();
    Some(path)
}

/// Positions alone, as a cloud.
fn write_positions(path: &Path, points: &[PointRecord]) {
    let mut bytes = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nend_header\n",
        points.len()
    )
    .into_bytes();
    bytes.extend(
        points
            .iter()
            .flat_map(|point| point.position)
            .flat_map(f32::to_le_bytes),
    );
    fs::write(path, bytes).unwrap();
}

fn options(memory_bytes: u64, threads: usize, scratch: &Path) -> InputOptions {
    InputOptions {
        threads,
        cloud: CloudOptions {
            estimate_normals: Some(Facing::Outward),
            radius: Some(Radius::Estimate),
            ..CloudOptions::default()
        },
        memory_bytes,
        scratch_dir: scratch.to_owned(),
        ..InputOptions::default()
    }
}

fn median(values: &mut [f32]) -> f32 {
    values.sort_by(f32::total_cmp);
    values[values.len() / 2]
}

#[test]
fn estimated_normals_of_the_dragon_are_within_five_degrees_in_the_median_whatever_the_memory() {
    let folder = tempfile::tempdir().unwrap();
    let Some(obj) = dragon(folder.path()) else { return };
    let sample = SampleOptions {
        density: Density::Points(500_000),
        ..SampleOptions::default()
    };
    let known = collect(&mut MeshPoints::new(MeshScene::load(&obj).unwrap(), &sample).unwrap());
    let cloud = folder.path().join("dragon.ply");
    write_positions(&cloud, &known);
    let scratch = folder.path().join("scratch");
    fs::create_dir(&scratch).unwrap();
    let read = |memory, threads| {
        collect(&mut open_input(std::slice::from_ref(&cloud), &options(memory, threads, &scratch)).unwrap())
    };
    let found = read(1 << 30, 2);
    assert!(
        found == read(8_000_000, 1),
        "neither the memory nor the threads change a point"
    );
    assert_eq!(fs::read_dir(&scratch).unwrap().count(), 0);
    assert_eq!(found.len(), known.len());
    let truth: HashMap<[u32; 3], &PointRecord> = known.iter().map(|p| (p.position.map(f32::to_bits), p)).collect();
    let (mut angles, mut shares, mut outward) = (Vec::new(), Vec::new(), 0);
    for point in &found {
        let known = truth[&point.position.map(f32::to_bits)];
        let cosine = point.normal().dot(known.normal());
        outward += u32::from(cosine > 0.0);
        angles.push(cosine.abs().min(1.0).acos().to_degrees());
        shares.push(point.radius / known.radius);
    }
    let (angle, share) = (median(&mut angles), median(&mut shares));
    let tail = angles[angles.len() * 95 / 100];
    println!(
        "angle error: median {angle:.2}, 95 % below {tail:.1} degrees; radius {share:.3} of the known; {:.0} % outward",
        100.0 * f64::from(outward) / found.len() as f64
    );
    assert!(angle < 5.0, "{angle}");
    assert!((0.85..1.15).contains(&share), "{share}");
}

#[test]
fn normals_face_where_they_are_told() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("ball.ply");
    let ball: Vec<PointRecord> = (0..20_000)
        .map(|i| {
            let (y, turn) = (1.0 - (i as f32 + 0.5) / 10_000.0, i as f32 * 2.399_963);
            let across = (1.0 - y * y).sqrt();
            let position = [across * turn.cos() + 5.0, y, across * turn.sin()];
            PointRecord::new(position, [0.0, 1.0, 0.0], 1.0, Sides::default()).unwrap()
        })
        .collect();
    write_positions(&path, &ball);
    let centre = Vec3::new(5.0, 0.0, 0.0);
    for facing in [
        Facing::Auto,
        Facing::Outward,
        Facing::Up,
        Facing::Viewpoint([5.0, 0.0, 0.0]),
    ] {
        let mut options = options(1 << 30, 2, folder.path());
        options.cloud.estimate_normals = Some(facing);
        for point in collect(&mut open_input(std::slice::from_ref(&path), &options).unwrap()) {
            let (normal, out) = (point.normal(), Vec3::from(point.position) - centre);
            assert!(normal.dot(out).abs() > 0.99, "{normal} at {out}");
            match facing {
                Facing::Auto | Facing::Outward => assert!(normal.dot(out) > 0.0),
                Facing::Up => assert!(normal.y > -0.02),
                Facing::Viewpoint(_) => assert!(normal.dot(out) < 0.0),
            }
            // A sphere of 4 pi shared by 20,000.
            assert!((point.radius / 0.01414 - 1.0).abs() < 0.2, "{}", point.radius);
        }
    }
}

#[test]
fn crowds_lines_and_few_points_get_finite_discs() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("odd.ply");
    let at = |position: [f32; 3]| PointRecord::new(position, [0.0, 1.0, 0.0], 1.0, Sides::default()).unwrap();
    let crowd = || (0..400_000).map(|_| at([0.5; 3]));
    let line = || (0..3000).map(|i| at([i as f32, 0.0, 0.0]));
    let clouds: [Vec<PointRecord>; 6] = [
        Vec::new(),
        vec![at([1.0, 2.0, 3.0])],
        vec![at([0.0; 3]), at([1.0, 0.0, 0.0])],
        crowd().collect(),
        line().collect(),
        crowd().chain(line()).chain([at([1e6; 3])]).collect(),
    ];
    for cloud in &clouds {
        write_positions(&path, cloud);
        // So little memory that the crowd does not fit it.
        for memory in [1 << 30, 8_000_000] {
            let options = options(memory, 2, folder.path());
            let mut stream = open_input(std::slice::from_ref(&path), &options).unwrap();
            let points = collect(&mut stream);
            assert_eq!(points.len(), cloud.len());
            for point in &points {
                point.validate().unwrap();
            }
            stream.rewind().unwrap();
            assert!(points == collect(&mut stream));
        }
    }
}
