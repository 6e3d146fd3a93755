//! Scenes whose irradiance and occlusion are known in closed form.

#![allow(clippy::unwrap_used, reason = "tests")]

mod support;

use glam::Vec3;
use pbgi_core::{Environment, HitSides, PointRecord, ShadeSettings};
use pbgi_shade::{Receiver, Shaded, Shader};
use std::f32::consts::PI;

fn shade_with(
    points: &[PointRecord],
    settings: ShadeSettings,
    sky: Option<&Environment>,
    at: &[Receiver],
) -> Vec<Shaded> {
    let (info, mut source) = support::build(points);
    let mut shader = Shader::new(&info, settings, sky).unwrap();
    let mut results = vec![Shaded::default(); at.len()];
    shader.shade_group(at, &mut source, &mut results).unwrap();
    results
}

fn shade(points: &[PointRecord], at: &[Receiver]) -> Vec<Shaded> {
    shade_with(points, ShadeSettings::default(), None, at)
}

fn up(x: f32, y: f32, z: f32) -> Receiver {
    Receiver {
        position: Vec3::new(x, y, z),
        normal: Vec3::Y,
    }
}

/// The inside of the cube from -1 to 1.
fn room(count: usize, radiance: f32) -> Vec<PointRecord> {
    let mut points = vec![];
    let (x, y, z) = (Vec3::X * 2.0, Vec3::Y * 2.0, Vec3::Z * 2.0);
    let low = Vec3::splat(-1.0);
    for (corner, u, v) in [
        (low, z, x),
        (low + y, x, z),
        (low, x, y),
        (low + z, y, x),
        (low, y, z),
        (low + x, z, y),
    ] {
        support::quad(corner, u, v, count, radiance, &mut points);
    }
    points
}

#[test]
fn a_closed_room_of_constant_radiance_gives_pi_l_and_no_opening() {
    for (count, tolerance) in [(50, 0.045), (100, 0.035), (300, 0.015)] {
        let receivers = [
            up(0.0, -1.0, 0.0),
            up(0.9, -1.0, 0.9),
            up(0.999, -1.0, 0.3),
            up(0.0, 0.5, 0.2),
            Receiver {
                position: Vec3::new(1.0, 0.1, 0.2),
                normal: -Vec3::X,
            },
            Receiver {
                position: Vec3::new(0.3, 0.1, 0.2),
                normal: Vec3::new(0.3, 0.5, -0.8),
            },
        ];
        for (receiver, result) in receivers.iter().zip(shade(&room(count, 2.0), &receivers)) {
            let e = result.irradiance[0];
            assert!(
                (e / (2.0 * PI) - 1.0).abs() < tolerance,
                "{count}: {receiver:?}: {result:?}"
            );
            assert!(
                (result.occlusion - 1.0).abs() < tolerance,
                "{count}: {receiver:?}: {result:?}"
            );
        }
    }
}

#[test]
fn an_open_plane_is_neither_lit_nor_occluded() {
    let mut points = vec![];
    support::quad(
        Vec3::new(-1.0, 0.0, -1.0),
        Vec3::Z * 2.0,
        Vec3::X * 2.0,
        100,
        1.0,
        &mut points,
    );
    let sky = Environment::new(2, 1, vec![[3.0, 2.0, 1.0]; 2]).unwrap();
    let receivers: Vec<_> = (0..200)
        .map(|i| up((i % 20) as f32 * 0.09 - 0.86, 0.0, (i / 20) as f32 * 0.17 - 0.8))
        .collect();
    for result in shade_with(&points, ShadeSettings::default(), Some(&sky), &receivers) {
        assert_eq!(result.occlusion, 0.0);
        assert!((result.irradiance[0] - 3.0 * PI).abs() < 1e-3, "{result:?}");
        assert!(Vec3::from(result.bent_normal).distance(Vec3::Y) < 1e-3);
    }
}

#[test]
fn a_sphere_above_covers_the_cosine_times_its_solid_angle() {
    for (center, radius) in [
        (Vec3::new(0.0, 2.0, 0.0), 1.0f32),
        (Vec3::new(1.5, 2.0, 0.5), 0.7),
        (Vec3::new(3.0, 1.0, 0.0), 0.5),
    ] {
        let mut points = vec![];
        support::sphere(center, radius, 40_000, 1.0, &mut points);
        let distance = center.length();
        let expected = center.y / distance * (radius / distance).powi(2);
        let [result] = shade(&points, &[up(0.0, 0.0, 0.0)])[..] else {
            panic!()
        };
        assert!(
            (result.occlusion - expected).abs() < 0.01,
            "{center}: {} for {expected}",
            result.occlusion
        );
        assert!(
            (result.irradiance[0] / PI - expected).abs() < 0.01,
            "{center}: {} for {expected}",
            result.irradiance[0] / PI
        );
    }
}

#[test]
fn a_coaxial_disc_covers_its_share() {
    for (a, h) in [(1.0f32, 1.0f32), (0.5, 1.0), (2.0, 0.7), (0.3, 0.1)] {
        let mut points = vec![];
        support::disc(Vec3::Y * h, -Vec3::Y, a, 30_000, 1.0, &mut points);
        let expected = a * a / (a * a + h * h);
        let [result] = shade(&points, &[up(0.0, 0.0, 0.0)])[..] else {
            panic!()
        };
        assert!(
            (result.occlusion - expected).abs() < 0.01,
            "a {a} h {h}: {} for {expected}",
            result.occlusion
        );
    }
}

#[test]
fn an_emissive_quad_lights_by_its_form_factor() {
    // A square of side 2 at height 1, one corner above the receiver: the textbook's parallel differential form factor.
    let mut points = vec![];
    support::quad(
        Vec3::new(0.0, 1.0, 0.0),
        Vec3::X * 2.0,
        Vec3::Z * 2.0,
        150,
        5.0,
        &mut points,
    );
    let x = 2.0 / 5f32.sqrt();
    let quarter = x * x.atan() / PI;
    let [result] = shade(&points, &[up(0.0, 0.0, 0.0)])[..] else {
        panic!()
    };
    assert!(
        (result.irradiance[0] / (PI * 5.0) - quarter).abs() < 0.005,
        "{result:?} for {quarter}"
    );
    assert!((result.occlusion - quarter).abs() < 0.005);
}

#[test]
fn the_back_of_a_light_is_dark_but_hides() {
    let mut points = vec![];
    support::quad(
        Vec3::new(-1.0, 1.0, -1.0),
        Vec3::Z * 2.0,
        Vec3::X * 2.0,
        100,
        5.0,
        &mut points,
    );
    let [result] = shade(&points, &[up(0.0, 0.0, 0.0)])[..] else {
        panic!()
    };
    assert!(result.irradiance[0] < 0.01, "{result:?}");
    assert!(result.occlusion > 0.5);
}

#[test]
fn occlusion_beyond_the_maximum_distance_does_not_count() {
    let settings = |max_dist| ShadeSettings {
        max_dist,
        ..Default::default()
    };
    let points = room(100, 1.0);
    let at = [up(0.0, -1.0, 0.0)];
    let near = shade_with(&points, settings(0.5), None, &at)[0];
    assert_eq!(near.occlusion, 0.0);
    assert!(near.irradiance[0] > 0.98 * PI, "light is not cut off: {near:?}");
    let all = shade_with(&points, settings(10.0), None, &at)[0];
    assert!(all.occlusion > 0.98);
}

#[test]
fn an_empty_scene_is_dark_and_open() {
    let [result] = shade(&[], &[up(0.0, 0.0, 0.0)])[..] else {
        panic!()
    };
    assert_eq!(
        result,
        Shaded {
            irradiance: [0.0; 3],
            occlusion: 0.0,
            bent_normal: result.bent_normal
        }
    );
    assert!(Vec3::from(result.bent_normal).distance(Vec3::Y) < 1e-5);
}

#[test]
fn a_hole_is_zero() {
    let hole = Receiver {
        position: Vec3::ZERO,
        normal: Vec3::ZERO,
    };
    let lost = Receiver {
        position: Vec3::splat(f32::NAN),
        normal: Vec3::Y,
    };
    assert_eq!(shade(&room(20, 1.0), &[hole, lost]), [Shaded::default(); 2]);
}

#[test]
fn surfaces_are_there_for_who_sees_a_side_that_counts() {
    let with = |points: &[PointRecord], hit_sides, at: Receiver| {
        let settings = ShadeSettings {
            hit_sides,
            ..ShadeSettings::default()
        };
        shade_with(points, settings, None, &[at])[0]
    };
    let (x, z) = (Vec3::X * 2.0, Vec3::Z * 2.0);
    let corner = Vec3::new(-1.0, 1.0, -1.0);
    let (mut down, mut up_turned, mut ball) = (vec![], vec![], vec![]);
    support::quad(corner, x, z, 40, 1.0, &mut down);
    support::quad(corner, z, x, 40, 1.0, &mut up_turned);
    assert!(down[0].normal().y < -0.9 && up_turned[0].normal().y > 0.9);
    support::sphere(Vec3::new(0.0, 3.0, 0.0), 1.0, 20_000, 1.0, &mut ball);
    let at = up(0.1, 0.0, 0.2);
    for points in [&down, &ball] {
        let both = with(points, HitSides::Both, at);
        assert!(both.occlusion > 0.1 && both.irradiance[0] > 0.3, "{both:?}");
        let front = with(points, HitSides::Front, at);
        assert!((front.occlusion - both.occlusion).abs() < 0.02, "{front:?} {both:?}");
        assert!(
            (front.irradiance[0] / both.irradiance[0] - 1.0).abs() < 0.1,
            "{front:?} {both:?}"
        );
    }
    assert_eq!(with(&down, HitSides::Back, at).occlusion, 0.0);
    assert_eq!(with(&up_turned, HitSides::Front, at).occlusion, 0.0);
    let from_below = with(&up_turned, HitSides::Back, at);
    assert!(
        from_below.occlusion > 0.1 && from_below.irradiance == [0.0; 3],
        "{from_below:?}"
    );
    // The far half of a ball shows its inside, which is as large and sends nothing.
    let inside = with(&ball, HitSides::Back, at);
    let whole = with(&ball, HitSides::Both, at);
    assert!(
        (inside.occlusion / whole.occlusion - 1.0).abs() < 0.3,
        "{inside:?} {whole:?}"
    );
    assert!(inside.irradiance[0] < 0.3 * whole.irradiance[0], "{inside:?} {whole:?}");
}
