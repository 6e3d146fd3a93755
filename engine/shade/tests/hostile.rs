//! Scenes that no build made: forged, with indices that lead anywhere, or so degenerate that only a cluster can stand for them.
//!
//! `PBGI_MUTANTS=1000000 cargo test --release -p pbgi-shade --test hostile -- --nocapture` is the long run.

#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

mod support;

use glam::Vec3;
use pbgi_core::limits::{CUT_NODES_MAX, MORTON_BITS};
use pbgi_core::node::NodeAttributes;
use pbgi_core::{NodeIndex, NodeKind, NodeRecord, PointIndex, PointRecord, SceneInfo, ShadeSettings};
use pbgi_shade::{ArraySource, Receiver, SceneSource, ShadeError, Shaded, Shader, SourceError, Upcoming};
use std::time::{Duration, Instant};

/// SplitMix64.
fn random(state: &mut u64) -> u64 {
    *state = state.wrapping_add(0x9E37_79B9_7F4A_7C15);
    let mut z = *state;
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// A floor and a ball over it.
fn floor_and_ball() -> Vec<PointRecord> {
    let mut points = vec![];
    support::quad(
        Vec3::new(-1.0, 0.0, -1.0),
        Vec3::Z * 2.0,
        Vec3::X * 2.0,
        24,
        1.0,
        &mut points,
    );
    support::sphere(Vec3::new(0.0, 0.8, 0.0), 0.4, 600, 2.0, &mut points);
    points
}

/// Eight receivers over a floor, so that all lanes are at work.
fn receivers() -> Vec<Receiver> {
    let receiver = |lane: u8| Receiver {
        position: Vec3::new(f32::from(lane) * 0.2 - 0.7, 0.3, f32::from(lane % 3) * 0.2),
        normal: Vec3::Y,
    };
    (0..8).map(receiver).collect()
}

fn settings(max_solid_angle: f32) -> ShadeSettings {
    ShadeSettings {
        max_solid_angle,
        raster_resolution: 16,
        ..ShadeSettings::default()
    }
}

/// Counts what is asked for.
#[derive(Default)]
struct Counting {
    inner: ArraySource,
    nodes: u64,
    points: u64,
}

impl SceneSource for Counting {
    fn node(&mut self, index: NodeIndex, receivers: u8, upcoming: &impl Upcoming) -> Result<&NodeRecord, SourceError> {
        self.nodes += u64::from(receivers.count_ones());
        self.inner.node(index, receivers, upcoming)
    }

    fn points(
        &mut self,
        first: PointIndex,
        count: u32,
        receivers: u8,
        upcoming: &impl Upcoming,
    ) -> Result<&[PointRecord], SourceError> {
        self.points += u64::from(count);
        self.inner.points(first, count, receivers, upcoming)
    }
}

fn shade(info: &SceneInfo, source: &mut Counting, settings: ShadeSettings) -> (Result<(), ShadeError>, Duration) {
    let mut shader = Shader::new(info, settings, None).unwrap();
    let receivers = receivers();
    let begun = Instant::now();
    let outcome = shader.shade_group(&receivers, source, &mut vec![Shaded::default(); receivers.len()]);
    (outcome, begun.elapsed())
}

/// Writes where a node's children or points are, whatever it is.
fn lead(node: &mut NodeRecord, first: u32) {
    bytemuck::bytes_of_mut(node)[12..16].copy_from_slice(&first.to_le_bytes());
}

/// Changes some nodes in ways that checksums would not find if the forger made them anew.
fn forge(nodes: &mut [NodeRecord], seed: &mut u64) {
    let count = nodes.len() as u64;
    for _ in 0..=random(seed) % 6 {
        let victim = (random(seed) % count) as usize;
        let other = nodes[(random(seed) % count) as usize];
        match random(seed) % 4 {
            // Any bits at all.
            0 => {
                let bytes = bytemuck::bytes_of_mut(&mut nodes[victim]);
                for _ in 0..=random(seed) % 16 {
                    let at = random(seed) as usize % bytes.len();
                    bytes[at] = random(seed) as u8;
                }
            }
            // Children that are elsewhere: above, nowhere, or those of another.
            1 => lead(&mut nodes[victim], (random(seed) % (count + 8)) as u32),
            2 => lead(&mut nodes[victim], u32::MAX - random(seed) as u32 % 8),
            _ => nodes[victim] = other,
        }
    }
}

/// Nodes of every level whose eight children are one and the same eight: 8^21 leaves in 170 nodes.
fn bomb(info: &mut SceneInfo) -> ArraySource {
    let attributes = NodeAttributes {
        centroid: Vec3::ZERO,
        axis: Vec3::Y,
        radius_ratio: 0.5,
        spread: 0.0,
        fill: 0.0,
        variation: 0.0,
        folds: [[0.0; 5]; 3],
        visible: Vec3::ONE,
        covariance: [0.1, 0.0, 0.1, 0.0, 0.0, 0.0],
        sh: Default::default(),
    };
    let mut nodes = Vec::new();
    for level in (0..=MORTON_BITS).rev() {
        let kind = match level {
            MORTON_BITS => NodeKind::Leaf {
                first: PointIndex(0),
                count: 1,
            },
            _ => NodeKind::Inner {
                first: NodeIndex(nodes.len() as u32 - 8),
                mask: 0xff,
            },
        };
        let node = NodeRecord::new(level, kind, &attributes);
        nodes.extend(std::iter::repeat_n(node, 8));
    }
    info.root = Some(NodeIndex(nodes.len() as u32 - 1));
    ArraySource {
        nodes,
        points: vec![support::point(Vec3::ZERO, Vec3::Y, 1e-3, 1.0)],
    }
}

#[test]
fn forged_scenes_end_within_the_budget_of_a_cut_and_never_panic() {
    let mutants: u64 = std::env::var("PBGI_MUTANTS").map_or(4_000, |text| text.parse().unwrap());
    let mut seed: u64 = std::env::var("PBGI_SEED").map_or(1, |text| text.parse().unwrap());
    println!("PBGI_SEED={seed}");
    let (info, good) = support::build(&floor_and_ball());
    let (mut refused, mut slowest) = (0, Duration::ZERO);
    for _ in 0..mutants {
        let mut source = Counting {
            inner: good.clone(),
            ..Counting::default()
        };
        forge(&mut source.inner.nodes, &mut seed);
        let (outcome, took) = shade(&info, &mut source, settings(0.02));
        slowest = slowest.max(took);
        refused += u64::from(outcome.is_err());
        assert!(
            source.nodes <= 8 * u64::from(CUT_NODES_MAX) + 8,
            "{} nodes",
            source.nodes
        );
    }
    assert!(refused > mutants / 10, "{refused} of {mutants} mutants were found out");
    let mut info = info;
    let mut source = Counting {
        inner: bomb(&mut info),
        ..Counting::default()
    };
    let (outcome, took) = shade(&info, &mut source, settings(1e-6));
    // It may be covered before the budget is spent: what counts is that it ends.
    let end = match outcome {
        Ok(()) => "ended",
        Err(ShadeError::Budget { .. }) => "was refused",
        Err(other) => panic!("{other}"),
    };
    assert!(
        source.nodes <= 8 * u64::from(CUT_NODES_MAX) + 8,
        "{} nodes",
        source.nodes
    );
    println!(
        "RELIABILITY F9: {mutants} forged scenes, {refused} refused, 0 panics, slowest group {slowest:.1?}; a bomb of 8^21 \
         nodes {end} after {} visits and {took:.1?}",
        source.nodes
    );
}

#[test]
fn millions_of_points_at_one_place_are_one_cluster_to_a_shading_call() {
    const POINTS: usize = 1_000_000;
    let place = support::point(Vec3::new(0.3, 0.9, 0.1), Vec3::NEG_Y, 1e-6, 1.0);
    let floor = support::point(Vec3::new(-1.0, 0.0, -1.0), Vec3::Y, 1e-6, 1.0);
    let cost = |count: usize| {
        let mut points = vec![place; count];
        points.push(floor);
        let (info, inner) = support::build(&points);
        let overflow = inner
            .nodes
            .iter()
            .filter(|node| matches!(node.kind(), NodeKind::Overflow { .. }));
        assert_eq!(overflow.count(), 1);
        let mut source = Counting {
            inner,
            ..Counting::default()
        };
        // Fine enough to open everything that can be opened.
        let (outcome, took) = shade(&info, &mut source, settings(1e-6));
        outcome.unwrap();
        (source.nodes, source.points, took)
    };
    let (few, many) = (cost(17), cost(POINTS));
    assert_eq!(
        (few.0, few.1),
        (many.0, many.1),
        "a shading call notices how many they are"
    );
    println!(
        "RELIABILITY D3: 8 receivers over {POINTS} points at one place: {} nodes visited and {} points read, as over 17 of \
         them; {:.1?}",
        many.0, many.1, many.2
    );
}

#[test]
fn receivers_on_points_and_inside_of_clusters_get_finite_light() {
    let points = floor_and_ball();
    let (info, mut source) = support::build(&points);
    let mut shader = Shader::new(&info, settings(0.05), None).unwrap();
    let (mut seed, mut shaded) = (1, 0);
    for round in 0..24 {
        // On the points themselves, then ever closer to them: 10^-1 to 10^-6.
        let distance = if round < 8 { 0.0 } else { 0.1_f32.powi(round / 3 - 1) };
        let near = |point: &PointRecord| {
            let mut axis = || (random(&mut seed) >> 40) as f32 / (1 << 23) as f32 - 1.0;
            let (aside, normal) = (Vec3::new(axis(), axis(), axis()), Vec3::new(axis(), axis(), axis()));
            Receiver {
                position: Vec3::from(point.position) + aside * distance,
                normal: normal.try_normalize().unwrap_or(Vec3::Y),
            }
        };
        let receivers: Vec<Receiver> = points.iter().map(near).collect();
        for group in receivers.chunks(64) {
            let mut out = vec![Shaded::default(); group.len()];
            shader.shade_group(group, &mut source, &mut out).unwrap();
            for (receiver, shaded) in group.iter().zip(&out) {
                let light = shaded.irradiance.iter().all(|value| value.is_finite() && *value >= 0.0);
                let open = shaded.bent_normal.iter().all(|value| value.is_finite());
                let covered = (0.0..=1.0).contains(&shaded.occlusion);
                assert!(light && open && covered, "{receiver:?}: {shaded:?}");
            }
        }
        shaded += receivers.len();
    }
    println!(
        "RELIABILITY D13: {shaded} receivers on points and 10^-1 to 10^-6 beside them: all values finite, none negative"
    );
}
