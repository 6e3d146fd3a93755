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
    let outward = 100.0 * f64::from(outward) / found.len() as f64;
    println!(
        "angle error: median {angle:.2}, 95 % below {tail:.1} degrees; radius {share:.3} of the known; {outward:.2} % outward",
    );
    assert!(angle < 5.0, "{angle}");
    assert!(outward > 99.5, "{outward}");
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

/// Positions and normals that are known.
type Known = Vec<(Vec3, Vec3)>;

/// Numbers that are spread evenly from 0 to 1 and seem random.
struct Spread(u64);

impl Spread {
    fn next(&mut self) -> f32 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 40) as f32 / (1u64 << 24) as f32
    }

    fn direction(&mut self) -> Vec3 {
        let (y, turn) = (2.0 * self.next() - 1.0, std::f32::consts::TAU * self.next());
        let across = (1.0 - y * y).sqrt();
        Vec3::new(across * turn.cos(), y, across * turn.sin())
    }
}

/// A ball that faces out for a `side` of 1 and in for -1.
fn ball(count: usize, centre: Vec3, radius: f32, side: f32) -> Known {
    let mut spread = Spread(count as u64);
    (0..count)
        .map(|_| spread.direction())
        .map(|out| (centre + out * radius, out * side))
        .collect()
}

fn cuboid(count: usize, low: Vec3, high: Vec3, side: f32) -> Known {
    let mut spread = Spread(count as u64);
    let edges = high - low;
    let faces = [edges.y * edges.z, edges.z * edges.x, edges.x * edges.y];
    (0..count)
        .map(|_| {
            let at = spread.next() * faces.iter().sum::<f32>();
            let axis = usize::from(at > faces[0]) + usize::from(at > faces[0] + faces[1]);
            let mut position = low + edges * Vec3::new(spread.next(), spread.next(), spread.next());
            let upper = spread.next() < 0.5;
            position[axis] = if upper { high[axis] } else { low[axis] };
            let mut normal = Vec3::ZERO;
            normal[axis] = if upper { side } else { -side };
            (position, normal)
        })
        .collect()
}

fn torus(count: usize, radius: f32, tube: f32) -> Known {
    let mut spread = Spread(1);
    let mut points = Vec::new();
    while points.len() < count {
        let [turn, around] = [0, 1].map(|_| std::f32::consts::TAU * spread.next());
        if spread.next() * (radius + tube) < radius + tube * around.cos() {
            let out = Vec3::new(turn.cos() * around.cos(), around.sin(), turn.sin() * around.cos());
            points.push((Vec3::new(turn.cos(), 0.0, turn.sin()) * radius + out * tube, out));
        }
    }
    points
}

fn hills(count: usize, high: f32) -> Known {
    let mut spread = Spread(2);
    (0..count)
        .map(|_| {
            let (x, z) = (10.0 * spread.next(), 10.0 * spread.next());
            let y = high * (0.5 * x.sin() + 0.3 * (1.7 * z).cos());
            let normal = Vec3::new(-high * 0.5 * x.cos(), 1.0, high * 0.51 * (1.7 * z).sin());
            (Vec3::new(x, y, z), normal.normalize())
        })
        .collect()
}

/// Moves every point by about `distance` along each axis.
fn noisy(points: &Known, distance: f32) -> Known {
    let mut spread = Spread(3);
    // The sum of four has a deviation of 0.58.
    let mut along = || (0..4).map(|_| spread.next() - 0.5).sum::<f32>() * distance / 0.58;
    points
        .iter()
        .map(|&(position, normal)| (position + Vec3::new(along(), along(), along()), normal))
        .collect()
}

/// A twentieth of the points in one half, and every other one in bands across.
fn uneven(points: &Known) -> Known {
    let mut spread = Spread(4);
    let (low, high) = points
        .iter()
        .fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), (at, _)| {
            (low.min(at.x), high.max(at.x))
        });
    let kept = |at: Vec3| {
        let thin = if at.x > (low + high) / 2.0 { 0.05 } else { 1.0 };
        let band = (at.y * 60.0 / (high - low)).sin() > 0.0;
        thin * if band { 0.5 } else { 1.0 }
    };
    points
        .iter()
        .copied()
        .filter(|(at, _)| spread.next() < kept(*at))
        .collect()
}

/// Percent of the normals that face where the known ones do.
fn percent_outward(folder: &Path, name: &str, known: &Known) -> f64 {
    let path = folder.join(format!("{name}.ply"));
    let record =
        |position: Vec3| PointRecord::new(position.to_array(), [0.0, 1.0, 0.0], 1.0, Sides::default()).unwrap();
    let points: Vec<PointRecord> = known.iter().map(|&(position, _)| record(position)).collect();
    write_positions(&path, &points);
    let mut stream = open_input(std::slice::from_ref(&path), &options(1 << 30, 2, folder)).unwrap();
    let truth: HashMap<[u32; 3], Vec3> = known
        .iter()
        .map(|(position, normal)| (position.to_array().map(f32::to_bits), *normal))
        .collect();
    let found = collect(&mut stream);
    assert_eq!(found.len(), known.len());
    let right = found
        .iter()
        .filter(|point| truth[&point.position.map(f32::to_bits)].dot(point.normal()) > 0.0);
    let percent = 100.0 * right.count() as f64 / known.len() as f64;
    println!("{name}, {} points: {percent:.2} % outward", known.len());
    percent
}

/// Points of a mesh and what its own normals are.
fn known_of(obj: &Path, points: u64) -> Known {
    let sample = SampleOptions {
        density: Density::Points(points),
        ..SampleOptions::default()
    };
    let points = collect(&mut MeshPoints::new(MeshScene::load(obj).unwrap(), &sample).unwrap());
    let known = points.iter().map(|point| (Vec3::from(point.position), point.normal()));
    known.collect()
}

#[test]
fn normals_face_out_of_bodies() {
    let folder = tempfile::tempdir().unwrap();
    let one = Vec3::ONE;
    let touching = [
        ball(50_000, Vec3::ZERO, 1.0, 1.0),
        ball(49_000, Vec3::X * 2.02, 1.0, 1.0),
        cuboid(50_000, Vec3::new(-1.0, 1.02, -1.0), Vec3::new(3.0, 1.5, 1.0), 1.0),
    ];
    let many = (0..27).map(|i| {
        let at = Vec3::new((i % 3) as f32, (i / 3 % 3) as f32, (i / 9) as f32);
        match i % 2 {
            0 => ball(5_000, at, 0.45, 1.0),
            _ => cuboid(6_000, at - 0.4 * one, at + 0.4 * one, 1.0),
        }
    });
    // A body with a hollow, and another body in that.
    let nested = [
        ball(80_000, Vec3::ZERO, 1.0, 1.0),
        ball(20_000, Vec3::ZERO, 0.5, -1.0),
        ball(5_000, Vec3::ZERO, 0.25, 1.0),
    ];
    // Seen from inside, the air of a room is the body, and furniture a hollow in it.
    let room = [
        cuboid(100_000, Vec3::ZERO, Vec3::new(5.0, 2.5, 4.0), 1.0),
        cuboid(10_000, Vec3::new(1.0, 0.3, 1.0), Vec3::new(2.0, 1.0, 2.0), -1.0),
    ];
    // Seen from all sides, it is the walls; these are three distances between representatives thick.
    let house = [
        cuboid(100_000, Vec3::ZERO, Vec3::new(5.0, 2.5, 4.0), 1.0),
        cuboid(50_000, Vec3::new(0.25, 0.25, 0.25), Vec3::new(2.4, 2.25, 3.75), -1.0),
        cuboid(51_000, Vec3::new(2.65, 0.25, 0.25), Vec3::new(4.75, 2.25, 3.75), -1.0),
    ];
    let clouds = [
        ("torus", torus(100_000, 1.0, 0.3), 99.9),
        ("a thin torus", torus(100_000, 1.0, 0.02), 99.9),
        (
            "a box",
            cuboid(100_000, Vec3::ZERO, Vec3::new(1.0, 2.0, 3.0), 1.0),
            99.9,
        ),
        (
            "a plate",
            cuboid(200_000, Vec3::ZERO, Vec3::new(1.0, 0.01, 1.0), 1.0),
            99.9,
        ),
        ("touching bodies", touching.concat(), 99.0),
        ("27 bodies", many.flatten().collect(), 99.9),
        ("a hollow ball", nested[..2].concat(), 99.9),
        ("a ball in a hollow ball", nested.concat(), 99.9),
        ("a room", room.concat(), 99.9),
        ("a house", house.concat(), 99.9),
        ("a noisy torus", noisy(&torus(100_000, 1.0, 0.3), 0.3 * 0.0109), 99.9),
        ("an uneven torus", uneven(&torus(100_000, 1.0, 0.3)), 99.9),
    ];
    for (name, known, least) in &clouds {
        let percent = percent_outward(folder.path(), name, known);
        assert!(percent >= *least, "{name}: {percent}");
    }
}

#[test]
fn open_sheets_face_one_way_and_terrains_up() {
    let folder = tempfile::tempdir().unwrap();
    let dome = ball(40_000, Vec3::ZERO, 1.0, 1.0);
    let dome = dome.into_iter().filter(|(position, _)| position.y > 0.3).collect();
    for (name, known) in [
        ("hills", hills(100_000, 1.0)),
        ("a plane", hills(5_000, 0.0)),
        ("a dome", dome),
    ] {
        let percent = percent_outward(folder.path(), name, &known);
        assert!(percent >= 99.9, "{name}: {percent}");
    }
}

#[test]
fn normals_face_out_of_scanned_bodies_through_noise_gaps_and_few_points() {
    let folder = tempfile::tempdir().unwrap();
    if let Some(dragon) = dragon(folder.path()) {
        let known = known_of(&dragon, 500_000);
        // Spacings of 0.00038, from an area of 0.07.
        for (name, known, least) in [
            (
                "dragon of a tenth of the points",
                known.iter().copied().step_by(10).collect(),
                99.0,
            ),
            ("noisy dragon", noisy(&known, 0.3 * 0.000_38), 99.0),
            ("uneven dragon", uneven(&known), 99.0),
        ] {
            let percent = percent_outward(folder.path(), name, &known);
            assert!(percent >= least, "{name}: {percent}");
        }
    }
    if let Some(bunny) = shared("data/stanford-bunny.obj.gz") {
        let path = folder.path().join("bunny.obj");
        let mut obj = fs::File::create(&path).unwrap();
        std::io::copy(&mut GzDecoder::new(fs::File::open(bunny).unwrap()), &mut obj).unwrap();
        let known = known_of(&path, 200_000);
        for (name, known, least) in [
            ("bunny", known.clone(), 99.5),
            ("bunny of few points", known.iter().copied().step_by(40).collect(), 99.0),
            ("uneven bunny", uneven(&known), 99.5),
        ] {
            let percent = percent_outward(folder.path(), name, &known);
            assert!(percent >= least, "{name}: {percent}");
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
