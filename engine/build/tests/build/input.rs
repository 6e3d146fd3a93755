//! Input that cannot be built is refused with one error that says which point and why.

use crate::support::{Broken, Cloud, Place, build_cloud, point, sheet, small_pages};
use pbgi_build::BuildError;
use pbgi_core::{Bounds, BuildSettings};
use pbgi_store::{Overwrite, StoreError};
use std::ops::ControlFlow;

/// The error of building `cloud`, which must leave nothing.
fn refusal(cloud: &Cloud, run_points: usize) -> BuildError<Broken> {
    let place = Place::on_disk();
    let mut host = place.host();
    host.run_points_max = run_points;
    let error = build_cloud(cloud, &place, &host, small_pages()).unwrap_err();
    assert!(matches!(place.open(), Err(StoreError::Missing { .. })));
    assert!(place.leftovers(place.volume.as_ref()).is_empty());
    error
}

#[test]
fn points_outside_the_declared_bounds_are_counted_and_the_first_is_named() {
    let mut cloud = Cloud::new(sheet(20_000)).bounded();
    let mut points = cloud.points.to_vec();
    points[12_345].position[1] = 1e6;
    points[15_000].position[2] = -1e6;
    cloud.points = points.into();
    for run_points in [usize::MAX, 1000] {
        let text = refusal(&cloud, run_points).to_string();
        assert!(
            text.starts_with("2 points outside the declared bounds, the first is point 12345 at ["),
            "{text}"
        );
    }
}

#[test]
fn invalid_points_are_counted_and_the_first_is_named() {
    for field in 0..5 {
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -1.0] {
            let mut points = sheet(3000);
            let broken = &mut points[1234];
            match field {
                // A position may be negative.
                0..3 if bad == -1.0 => continue,
                0..3 => broken.position[field] = bad,
                3 => broken.radius = bad,
                _ => broken.radius = 0.0,
            }
            for run_points in [usize::MAX, 1000] {
                let text = refusal(&Cloud::new(points.clone()), run_points).to_string();
                assert!(
                    text.starts_with("1 invalid points, the first is point 1234: "),
                    "{text}"
                );
            }
        }
    }
}

#[test]
fn bounds_that_are_no_box_are_refused() {
    let mut cloud = Cloud::new(sheet(10));
    cloud.bounds = Some(Bounds {
        min: [0.0; 3],
        max: [1.0, f32::INFINITY, 1.0],
    });
    assert!(matches!(refusal(&cloud, usize::MAX), BuildError::Bounds { .. }));
    cloud.bounds = Some(Bounds::EMPTY);
    assert!(matches!(
        refusal(&cloud, usize::MAX),
        BuildError::OutsideBounds { count: 10, .. }
    ));
}

#[test]
fn an_input_that_breaks_off_stops_the_build() {
    for (breaks_at, run_points) in [(0, usize::MAX), (5000, usize::MAX), (5000, 1000)] {
        let mut cloud = Cloud::new(sheet(10_000)).bounded();
        cloud.breaks_at = Some(breaks_at);
        assert!(matches!(refusal(&cloud, run_points), BuildError::Input(Broken(at)) if at == breaks_at));
    }
}

#[test]
fn more_points_or_nodes_than_an_index_counts_are_refused_before_it_wraps() {
    let place = Place::on_disk();
    let build = |points, records_max| {
        let mut host = place.host();
        host.records_max = records_max;
        build_cloud(&Cloud::new(sheet(points)), &place, &host, small_pages())
    };
    build(1000, 1000).unwrap();
    let error = build(1001, 1000).unwrap_err();
    assert!(
        matches!(
            error,
            BuildError::Limit {
                what: "points",
                max: 1000
            }
        ),
        "{error}"
    );

    // A leaf for every point, so that there are more nodes than points.
    let sparse = BuildSettings {
        leaf_max: 1,
        ..small_pages()
    };
    for chunk_levels in [0, 3] {
        let settings = BuildSettings { chunk_levels, ..sparse };
        let mut host = place.host();
        host.records_max = 1000;
        let error = build_cloud(&Cloud::new(sheet(1000)), &place, &host, settings).unwrap_err();
        assert!(
            matches!(
                error,
                BuildError::Limit {
                    what: "nodes",
                    max: 1000
                }
            ),
            "{error}"
        );
        assert!(place.leftovers(place.volume.as_ref()).is_empty());
    }
    println!("RELIABILITY F11: with room for 1,000 records, point 1,001 and node 1,001 are refused");
}

#[test]
fn settings_and_memory_out_of_range_are_refused() {
    let place = Place::on_disk();
    let cloud = Cloud::new(sheet(10));
    let settings = BuildSettings {
        leaf_max: 0,
        ..small_pages()
    };
    let error = build_cloud(&cloud, &place, &place.host(), settings).unwrap_err();
    assert!(error.to_string().contains("leaf-max is 0"), "{error}");
    let mut request = place.request(small_pages());
    request.memory_bytes = 10_000_000;
    let error = pbgi_build::build(&mut cloud.clone(), &request, &mut |_| ControlFlow::Continue(())).unwrap_err();
    assert!(error.to_string().contains("10000000 bytes is too small"), "{error}");
}

#[test]
fn an_output_that_exists_is_refused_before_the_input_is_read() {
    let place = Place::on_disk();
    build_cloud(&Cloud::new(sheet(10)), &place, &place.host(), small_pages()).unwrap();
    let mut request = place.request(small_pages());
    request.overwrite = Overwrite::Refuse;
    let mut unread = Cloud::new(sheet(20));
    unread.breaks_at = Some(0);
    let error = pbgi_build::build(&mut unread, &request, &mut |_| ControlFlow::Continue(())).unwrap_err();
    assert!(matches!(error, BuildError::Store(StoreError::Exists { .. })), "{error}");
    assert_eq!(place.open().unwrap().info().point_count, 10);
}

#[test]
fn radiance_at_the_limit_is_counted() {
    let place = Place::on_disk();
    let mut points = sheet(100);
    let bright = pbgi_core::point::Sides {
        front: [1e9, 0.0, 0.0],
        back: [0.0; 3],
    };
    points[7] = pbgi_core::PointRecord::new(points[7].position, [0.0, 1.0, 0.0], 0.01, bright).unwrap();
    points.push(point([0.0; 3]));
    let report = build_cloud(&Cloud::new(points), &place, &place.host(), small_pages()).unwrap();
    assert_eq!(report.radiance_clamped, 1);
    println!("RELIABILITY D10: 1 radiance of 1e9 clamped and counted");
}

#[test]
fn progress_names_the_stages_in_order_and_never_runs_backwards() {
    let place = Place::on_disk();
    let mut host = place.host();
    (host.run_points_max, host.fan_in_max) = (2000, 2);
    let mut seen = Vec::new();
    let mut observer = |progress: pbgi_build::BuildProgress| {
        seen.push((progress.stage.name(), progress.done));
        ControlFlow::Continue(())
    };
    let request = place.request(small_pages());
    pbgi_build::build_on(&mut Cloud::new(sheet(20_000)).bounded(), &request, &host, &mut observer).unwrap();
    for stage in ["reading", "sorting", "merging", "building"] {
        assert!(seen.iter().any(|(name, _)| *name == stage), "{stage} in {seen:?}");
    }
    assert_eq!(seen.last(), Some(&("building", 20_000)));
    let building: Vec<_> = seen.iter().filter(|(name, _)| *name == "building").collect();
    assert!(building.is_sorted());
    // Reading alternates with sorting; building comes after everything else.
    let first = seen.iter().position(|(name, _)| *name == "building").unwrap();
    assert!(seen[first..].iter().all(|(name, _)| *name == "building"));
}
