//! Error against ray-cast truth, at default settings, on scenes whose geometry is analytic. The bounds are the project's
//! bars for these scenes; `cargo test -p pbgi-shade --test truth -- --nocapture` prints the figures.

#![allow(clippy::unwrap_used, reason = "tests")]

mod support;

use pbgi_core::ShadeSettings;
use pbgi_shade::{Receiver, Shaded, Shader};
use std::f32::consts::PI;
use support::truth::Truth;

/// Rays along one edge of the stratified reference: 4,096 rays, noise 0.002 in occlusion; the same where each takes longer, noise 0.004.
const REFERENCE_SIDE: usize = 64;
const COARSE_REFERENCE_SIDE: usize = 32;
const RECEIVERS: usize = 300;

struct Errors {
    occlusion_rms: f32,
    occlusion_bias: f32,
    irradiance_rms: f32,
    irradiance_mean: f32,
}

fn errors(name: &str, truth: &Truth, points: usize, receivers: &[Receiver], side: usize) -> Errors {
    let (info, mut source) = support::build(&truth.points(points));
    let mut shader = Shader::new(&info, ShadeSettings::default(), None).unwrap();
    let mut shaded = vec![Shaded::default(); receivers.len()];
    shader.shade_group(receivers, &mut source, &mut shaded).unwrap();

    let mut state = 1u64;
    let mut random = || {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1u64 << 24) as f32
    };
    let (mut occlusion, mut bias, mut irradiance, mut mean) = (0.0, 0.0, 0.0, 0.0);
    for (receiver, shaded) in receivers.iter().zip(&shaded) {
        let (covered, light) = truth.reference(receiver, side, &mut random);
        occlusion += (shaded.occlusion - covered).powi(2);
        bias += shaded.occlusion - covered;
        irradiance += (shaded.irradiance[0] - PI * light).powi(2);
        mean += PI * light;
    }
    let count = receivers.len() as f32;
    let errors = Errors {
        occlusion_rms: (occlusion / count).sqrt(),
        occlusion_bias: bias / count,
        irradiance_rms: (irradiance / count).sqrt(),
        irradiance_mean: mean / count,
    };
    println!(
        "{name}: occlusion RMS {:.4} (bias {:+.4}), irradiance RMS {:.4} ({:.1} % of the mean), cut {}",
        errors.occlusion_rms,
        errors.occlusion_bias,
        errors.irradiance_rms,
        100.0 * errors.irradiance_rms / errors.irradiance_mean,
        shader.counters().cut_elements / shader.counters().receivers,
    );
    errors
}

#[test]
fn spheres_over_a_ground_are_within_their_bars() {
    let truth = Truth::spheres();
    let errors = errors(
        "spheres",
        &truth,
        1_000_000,
        &truth.receivers(RECEIVERS),
        REFERENCE_SIDE,
    );
    assert!(errors.occlusion_rms <= 0.009);
    assert!(errors.irradiance_rms <= 0.005);
}

#[test]
fn a_city_under_a_hard_sun_is_within_its_bars() {
    let truth = Truth::city();
    let errors = errors("city", &truth, 2_000_000, &truth.receivers(RECEIVERS), REFERENCE_SIDE);
    assert!(errors.occlusion_rms <= 0.015);
    assert!(errors.irradiance_rms <= 0.04 * errors.irradiance_mean);
}

/// Leaves hide each other, so that crowns cover less than the sum of their leaves.
#[test]
fn below_sparse_crowns_occlusion_is_about_right() {
    let truth = Truth::crowns();
    let mut receivers = truth.receivers(RECEIVERS);
    receivers.retain(|receiver| receiver.position.y == 0.0);
    let errors = errors("crowns", &truth, 150_000, &receivers, COARSE_REFERENCE_SIDE);
    assert!(errors.occlusion_rms <= 0.012);
    assert!(errors.occlusion_bias.abs() <= 0.006);
}

#[test]
fn the_scalar_twin_sees_the_same_bits() {
    let truth = Truth::city();
    let (info, mut source) = support::build(&truth.points(100_000));
    let receivers = truth.receivers(100);
    let mut shade = |scalar: bool| {
        let mut shader = Shader::new(&info, ShadeSettings::default(), None).unwrap();
        if scalar {
            shader.use_scalar();
        }
        let mut shaded = vec![Shaded::default(); receivers.len()];
        shader.shade_group(&receivers, &mut source, &mut shaded).unwrap();
        shaded
    };
    assert_eq!(shade(false), shade(true));
}

#[test]
fn what_a_receiver_gets_does_not_depend_on_its_company() {
    let truth = Truth::city();
    let (info, mut source) = support::build(&truth.points(100_000));
    let receivers = truth.receivers(100);
    let mut shader = Shader::new(&info, ShadeSettings::default(), None).unwrap();
    let mut together = vec![Shaded::default(); receivers.len()];
    shader.shade_group(&receivers, &mut source, &mut together).unwrap();
    let mut alone = together.clone();
    for (receiver, shaded) in receivers.chunks(1).zip(alone.chunks_mut(1)) {
        shader.shade_group(receiver, &mut source, shaded).unwrap();
    }
    assert_eq!(together, alone);
}

#[test]
fn interpolation_saves_receivers_and_keeps_its_error() {
    const ERROR: f32 = 0.02;
    let truth = Truth::city();
    let (info, mut source) = support::build(&truth.points(200_000));
    // Groups as pictures have them: eight by eight, on walls, roofs and the street, and across their edges.
    let spots = truth.receivers(40);
    let groups = spots.chunks(1).map(|spot| {
        let (u, v) = spot[0].normal.any_orthonormal_pair();
        let place = |i: usize| spot[0].position + (u * (i % 8) as f32 + v * (i / 8) as f32) * 0.02;
        (0..64)
            .map(|i| Receiver {
                position: place(i),
                normal: spot[0].normal,
            })
            .collect::<Vec<_>>()
    });
    let shade = |interpolation: f32, group: &[Receiver], source: &mut _| {
        let settings = ShadeSettings {
            interpolation,
            ..ShadeSettings::default()
        };
        let mut shader = Shader::new(&info, settings, None).unwrap();
        let mut shaded = vec![Shaded::default(); group.len()];
        shader.shade_group(group, source, &mut shaded).unwrap();
        (shaded, shader.counters())
    };
    let (mut work, mut work_saved, mut square, mut count) = (0, 0, 0.0, 0.0);
    for group in groups {
        let (all, spent) = shade(0.0, &group, &mut source);
        let (some, saved) = shade(ERROR, &group, &mut source);
        assert_eq!(spent.receivers, saved.receivers);
        work += spent.cut_elements;
        work_saved += saved.cut_elements;
        for (a, b) in all.iter().zip(&some) {
            square += f64::from((a.occlusion - b.occlusion).powi(2));
            count += 1.0;
        }
    }
    let rms = (square / count).sqrt();
    println!(
        "interpolation within {ERROR}: occlusion off by {rms:.4} (RMS), {:.2} of the work",
        work_saved as f64 / work as f64
    );
    assert!(rms < f64::from(ERROR), "{rms}");
    assert!(work_saved * 2 < work, "{work_saved} of {work}");
}
