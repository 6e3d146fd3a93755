//! Clouds of every shape become the tree they must become.

use crate::support::{Cloud, build_and_audit, point, sheet, small_pages};
use pbgi_core::BuildSettings;
use proptest::prelude::*;

#[test]
fn no_points_make_a_valid_empty_scene() {
    for cloud in [Cloud::new(Vec::new()), Cloud::new(Vec::new()).bounded()] {
        let (tree, report) = build_and_audit(&cloud, BuildSettings::default());
        assert_eq!((tree.node_count(), report.info.root), (0, None));
        assert_eq!((report.info.bounds, report.info.quantizer), (None, None));
    }
    let mut cloud = Cloud::new(Vec::new());
    cloud.bounds = Some(pbgi_core::Bounds {
        min: [0.0; 3],
        max: [1.0; 3],
    });
    build_and_audit(&cloud, BuildSettings::default());
    println!("RELIABILITY D8: 3 clouds without points, 3 valid scenes without nodes");
}

#[test]
fn up_to_sixteen_points_are_one_leaf_and_seventeen_are_divided() {
    let corners = |count: usize| {
        let corner = |i: usize| [0, 1, 2].map(|axis| (i >> axis & 1) as f32 + 0.001 * i as f32);
        Cloud::new((0..count).map(|i| point(corner(i))).collect())
    };
    for (points, nodes) in [(1, 1), (8, 1), (16, 1), (17, 9)] {
        let (tree, _) = build_and_audit(&corners(points), BuildSettings::default());
        assert_eq!(tree.node_count(), nodes, "{points} points");
    }
    println!("RELIABILITY D9: 1, 8 and 16 points are 1 node, 17 are 9");
}

#[test]
fn a_million_equal_points_are_a_chain_with_one_overflow_leaf() {
    let cloud = Cloud::new(vec![point([1.0, 2.0, 3.0]); 1_000_000]);
    for chunk_levels in [0, 3] {
        let settings = BuildSettings {
            chunk_levels,
            ..BuildSettings::default()
        };
        let (tree, report) = build_and_audit(&cloud, settings);
        assert_eq!(tree.node_count(), 22);
        assert_eq!(tree.levels, [1; 22]);
        assert_eq!((tree.overflow_points, report.overflow_points), (1_000_000, 1_000_000));
    }
    println!("RELIABILITY D2: 1,000,000 equal points: 22 nodes, one overflow leaf of 1,000,000");
}

#[test]
fn sixteen_equal_points_are_no_overflow() {
    let mut points = vec![point([0.0; 3]); 16];
    points.push(point([1.0; 3]));
    let (tree, report) = build_and_audit(&Cloud::new(points), BuildSettings::default());
    assert_eq!((tree.node_count(), report.overflow_points), (3, 0));
}

#[test]
fn points_on_cell_corners_and_on_the_maximum_faces_are_all_kept() {
    // The axis-aligned grid whose points lie on the corners of cells, of which a strict comparison keeps none.
    let grid: Vec<_> = (0..65 * 65)
        .map(|i| point([(i % 65) as f32, 0.0, (i / 65) as f32]))
        .collect();
    let (tree, _) = build_and_audit(&Cloud::new(grid), small_pages());
    assert!(tree.node_count() > 300);
    let cube = (0..9 * 9 * 9)
        .map(|i| point([i % 9, i / 9 % 9, i / 81].map(|v| v as f32 / 8.0)))
        .collect();
    build_and_audit(&Cloud::new(cube).bounded(), small_pages());
    println!("RELIABILITY D6: 4,225 points on corners of cells and 729 on faces of a box, all of them kept");
}

#[test]
fn flat_and_linear_clouds_and_any_scale_build() {
    for scale in [1e-30, 1e-6, 1.0, 1e6, 1e18] {
        let line: Vec<_> = (0..500).map(|i| point([0.0, i as f32 * scale, 0.0])).collect();
        let plane: Vec<_> = (0..500)
            .map(|i| point([(i % 20) as f32 * scale, (i / 20) as f32 * scale, 3.0]))
            .collect();
        for cloud in [line, plane] {
            let (tree, _) = build_and_audit(&Cloud::new(cloud), small_pages());
            assert!(tree.node_count() > 30, "scale {scale}");
        }
    }
    println!("RELIABILITY D4: lines and planes at 5 scales, 10 scenes whole");
}

#[test]
fn coordinates_and_radii_of_any_size_make_finite_nodes() {
    let radii = [f32::MIN_POSITIVE / 16.0, 1e-30, 1e-3, 1.0, 1e15, 1e30, f32::MAX];
    for scale in [f32::MIN_POSITIVE / 16.0, 1e-30, 1.0, 1e30, f32::MAX] {
        let points = sheet(300).into_iter().enumerate().map(|(i, mut point)| {
            point.position = point.position.map(|value| value / 10.0 * scale);
            point.radius = radii[i % radii.len()];
            point
        });
        build_and_audit(&Cloud::new(points.collect()), small_pages());
        for radius in radii {
            let tiny = sheet(100)
                .into_iter()
                .map(|point| pbgi_core::PointRecord { radius, ..point });
            build_and_audit(&Cloud::new(tiny.collect()), small_pages());
        }
    }
    println!("RELIABILITY D7: 5 scales of coordinates, 7 of radii, 40 scenes with finite nodes");
}

#[test]
fn one_octant_and_a_speck_far_away_are_built_in_any_order() {
    // Everything in one corner of the root: the order in which a sort by octants has the least to do.
    let mut points: Vec<_> = sheet(20_000)
        .into_iter()
        .map(|mut point| {
            point.position = point.position.map(|value| value * 1e-4);
            point
        })
        .collect();
    points.insert(7, point([1000.0; 3]));
    let (tree, _) = build_and_audit(&Cloud::new(points.clone()), small_pages());
    points.reverse();
    let (reversed, _) = build_and_audit(&Cloud::new(points), small_pages());
    assert_eq!(tree.levels, reversed.levels);
}

#[test]
fn every_chunk_size_and_page_size_gives_the_same_tree() {
    let cloud = Cloud::new(sheet(20_000));
    let mut shapes = Vec::new();
    for chunk_levels in 0..=5 {
        for (nodes_per_page, points_per_page) in [(16, 16), (17, 33), (256, 1024), (2048, 16_384)] {
            let settings = BuildSettings {
                leaf_max: 16,
                chunk_levels,
                nodes_per_page,
                points_per_page,
            };
            let (tree, report) = build_and_audit(&cloud, settings);
            shapes.push((tree.levels, report.info.node_count));
        }
    }
    assert!(shapes.windows(2).all(|pair| pair[0] == pair[1]));
}

#[test]
fn every_leaf_size_is_kept() {
    let cloud = Cloud::new(sheet(3000));
    for leaf_max in [1, 2, 16, 100, 1024] {
        build_and_audit(
            &cloud,
            BuildSettings {
                leaf_max,
                ..small_pages()
            },
        );
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, ..ProptestConfig::default() })]

    #[test]
    fn any_cloud_is_built_right(
        lattice in prop::collection::vec((0u8..12, 0u8..12, 0u8..12, 1usize..30), 1..80),
        chunk_levels in 0u32..=5,
        leaf_max in 1u32..20,
        nodes_per_page in 16u32..40,
    ) {
        let repeat = |(x, y, z, count): (u8, u8, u8, usize)| vec![point([x, y, z].map(f32::from)); count];
        let points: Vec<_> = lattice.into_iter().flat_map(repeat).collect();
        let settings = BuildSettings { leaf_max, chunk_levels, nodes_per_page, points_per_page: 16 };
        build_and_audit(&Cloud::new(points), settings);
    }
}
