//! The same points and settings make the same files, whatever the memory, the runs and the order of input.

use crate::support::{Cloud, Place, build_cloud, sheet, shuffled, small_pages};
use pbgi_build::{BuildHost, BuildReport};
use pbgi_core::BuildSettings;
use std::fs;

const POINTS: usize = 37_000;

/// Sorts in memory holding `run_points`, merges `fan_in` at once; the bytes of the three files, and the report.
fn files(cloud: &Cloud, run_points: usize, fan_in: usize) -> ([Vec<u8>; 3], BuildReport) {
    let place = Place::on_disk();
    let mut host = place.host();
    (host.run_points_max, host.fan_in_max) = (run_points, fan_in);
    let report = build_cloud(cloud, &place, &host, small_pages()).unwrap();
    assert!(place.leftovers(place.volume.as_ref()).is_empty());
    let files = ["manifest.toml", "nodes.pages", "points.pages"];
    (files.map(|name| fs::read(place.output().join(name)).unwrap()), report)
}

#[test]
fn one_run_or_thirty_seven_and_any_merge_make_the_same_bytes() {
    let cloud = Cloud::new(sheet(POINTS)).bounded();
    let (in_memory, report) = files(&cloud, usize::MAX, usize::MAX);
    assert_eq!((report.runs, report.bytes_read), (0, 0));
    // Exactly full is not too full.
    assert_eq!(files(&cloud, POINTS, usize::MAX).1.runs, 0);
    for (run_points, fan_in, runs) in [
        (1000, 64, 37),
        (1001, 64, 37),
        (POINTS - 1, 64, 2),
        (1000, 5, 37 + 8 + 2),
        (5000, 2, 8 + 4 + 2),
    ] {
        let (bytes, report) = files(&cloud, run_points, fan_in);
        assert!(bytes == in_memory, "{run_points} points a run, {fan_in} at once");
        assert_eq!(report.runs, runs, "{run_points} points a run, {fan_in} at once");
        assert!(report.bytes_read >= POINTS as u64 * 32);
        assert!(report.bytes_written > report.bytes_read);
    }
}

#[test]
fn any_number_of_threads_and_any_size_of_jobs_make_the_same_bytes() {
    // Dense places that no job holds as a whole: a leaf of the deepest level, and coincident points.
    let mut points = sheet(POINTS);
    points.extend(vec![points[17]; 500]);
    for chunk_levels in [0, 1, 3] {
        let build = |threads, job_points_max, run_points_max| {
            let place = Place::on_disk();
            let host = BuildHost {
                threads,
                job_points_max,
                run_points_max,
                ..place.host()
            };
            let settings = BuildSettings {
                chunk_levels,
                ..small_pages()
            };
            build_cloud(&Cloud::new(points.clone()), &place, &host, settings).unwrap();
            ["nodes.pages", "points.pages", "manifest.toml"].map(|name| fs::read(place.output().join(name)).unwrap())
        };
        let expected = build(1, usize::MAX, usize::MAX);
        for (threads, job_points, run_points) in [
            (2, 16, usize::MAX),
            (2, 100, usize::MAX),
            (5, 1000, usize::MAX),
            (3, 17, 5000),
            (8, 4096, 20_000),
        ] {
            let made = build(threads, job_points, run_points);
            assert!(
                made == expected,
                "{threads} threads, {job_points} points a job, {chunk_levels} chunk levels"
            );
        }
    }
}

#[test]
fn the_order_of_input_does_not_matter() {
    let points = sheet(POINTS);
    let (expected, _) = files(&Cloud::new(points.clone()), usize::MAX, usize::MAX);
    let mut sorted = points.clone();
    sorted.sort_by(|a, b| a.position[0].total_cmp(&b.position[0]));
    let reversed: Vec<_> = sorted.iter().rev().copied().collect();
    for (order, points) in [
        ("shuffled", shuffled(points.clone(), 1)),
        ("shuffled again", shuffled(points, 2)),
        ("sorted", sorted),
        ("reversed", reversed),
    ] {
        for run_points in [usize::MAX, 5000] {
            let (bytes, _) = files(&Cloud::new(points.clone()), run_points, 4);
            assert!(bytes == expected, "{order}, {run_points} points a run");
        }
    }
    println!("RELIABILITY D15: 4 orders, in one run and in many: 8 times the same bytes");
}

#[test]
fn tied_points_keep_the_order_of_input_through_any_number_of_runs() {
    let mut points: Vec<_> = (0..50).flat_map(|_| sheet(40)).collect();
    for (i, point) in points.iter_mut().enumerate() {
        point.radius = 0.01 + i as f32 * 1e-6;
    }
    let cloud = Cloud::new(points);
    let (expected, _) = files(&cloud, usize::MAX, usize::MAX);
    for (run_points, fan_in) in [(100, 64), (100, 3), (333, 2)] {
        assert!(
            files(&cloud, run_points, fan_in).0 == expected,
            "{run_points}, {fan_in}"
        );
    }
}

#[test]
fn bounds_may_be_declared_or_measured() {
    let cloud = Cloud::new(sheet(POINTS));
    let (expected, _) = files(&cloud, usize::MAX, usize::MAX);
    // Measured in a first pass, because the points do not fit.
    assert!(files(&cloud, 1000, 64).0 == expected);
    assert!(files(&cloud.bounded(), 1000, 64).0 == expected);
}

#[test]
fn other_points_or_settings_have_another_build_id() {
    let points = sheet(1000);
    let place = Place::on_disk();
    let id = |points: &[_], settings| {
        build_cloud(&Cloud::new(points.to_vec()), &place, &place.host(), settings)
            .unwrap()
            .info
            .build_id
    };
    let base = id(&points, small_pages());
    assert_eq!(base, id(&points, small_pages()));
    assert_ne!(base, id(&points[1..], small_pages()));
    let mut larger_leaves = small_pages();
    larger_leaves.leaf_max = 17;
    assert_ne!(base, id(&points, larger_leaves));
    let mut brighter = points.clone();
    brighter[500].front_code += 1;
    assert_ne!(base, id(&brighter, small_pages()));
}
