//! Clouds without meshes, beside the truth of analytic shapes: light at the points themselves, and what rays meet.
//! `cargo test -p pbgi-shade --test clouds -- --nocapture` prints the figures.

#![allow(clippy::unwrap_used, reason = "tests")]

mod support;

use glam::Vec3;
use pbgi_core::{PointRecord, ShadeSettings};
use pbgi_shade::{Hit, Ray, Receiver, Shaded, Shader, Tracer};
use support::truth::Truth;

const POINTS: usize = 400_000;
const RECEIVERS: usize = 400;
const REFERENCE_SIDE: usize = 40;

fn random() -> impl FnMut() -> f32 {
    let mut state = 7u64;
    move || {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1u64 << 24) as f32
    }
}

/// RMS and mean error of occlusion at points of the cloud, moved off their surface by up to `noise` radii either way.
fn errors_at_points(noise: f32) -> (f32, f32) {
    let truth = Truth::spheres();
    let mut random = random();
    let exact = truth.points(POINTS);
    let moved = |point: &PointRecord, share: f32| {
        let position = Vec3::from(point.position) + point.normal() * (share * noise * point.radius);
        PointRecord {
            position: position.to_array(),
            ..*point
        }
    };
    let points: Vec<PointRecord> = exact.iter().map(|point| moved(point, 2.0 * random() - 1.0)).collect();
    let (info, mut source) = support::build(&points);
    let surface: Vec<Receiver> = truth.receivers(RECEIVERS);
    // The points of the cloud that are nearest to places that can be seen.
    let step = points.len() / RECEIVERS;
    let chosen = (0..RECEIVERS).map(|index| index * step);
    let seen = chosen.filter(|&index| {
        let place = Vec3::from(exact[index].position) + exact[index].normal() * 2e-3;
        place.y > 0.0 && truth.hit(place, exact[index].normal()).is_none_or(|(t, _)| t > 0.02)
    });
    let seen: Vec<usize> = seen.collect();
    assert!(!surface.is_empty() && seen.len() > RECEIVERS / 2);
    let at = |point: &PointRecord| Receiver {
        position: point.position.into(),
        normal: point.normal(),
    };
    let receivers: Vec<Receiver> = seen.iter().map(|&index| at(&points[index])).collect();
    let mut shaded = vec![Shaded::default(); receivers.len()];
    let mut shader = Shader::new(&info, ShadeSettings::default(), None).unwrap();
    shader.shade_group(&receivers, &mut source, &mut shaded).unwrap();
    let (mut squares, mut sum) = (0.0, 0.0);
    for (&index, shaded) in seen.iter().zip(&shaded) {
        let (covered, _) = truth.reference(&at(&exact[index]), REFERENCE_SIDE, &mut random);
        squares += (shaded.occlusion - covered).powi(2);
        sum += shaded.occlusion - covered;
    }
    let count = seen.len() as f32;
    ((squares / count).sqrt(), sum / count)
}

#[test]
fn points_neither_shadow_themselves_nor_leak() {
    for (noise, rms_max, mean_max) in [(0.0, 0.02, 0.01), (0.1, 0.03, 0.02), (0.3, 0.08, 0.06)] {
        let (rms, mean) = errors_at_points(noise);
        println!("noise of {noise} radii: occlusion RMS {rms:.4}, mean {mean:+.4}");
        assert!(rms <= rms_max && mean.abs() <= mean_max, "noise {noise}: {rms} {mean}");
    }
}

#[test]
fn rays_meet_the_surface_that_the_points_were_taken_from() {
    let truth = Truth::spheres();
    let (info, mut source) = support::build(&truth.points(POINTS));
    let (eye, target, edge, angle) = (Vec3::new(9.0, 9.0, 14.0), Vec3::new(0.0, 0.5, 0.0), 160, 0.005);
    let forward = (target - eye).normalize();
    let (right, up) = (
        forward.cross(Vec3::Y).normalize(),
        forward.cross(Vec3::Y).normalize().cross(forward),
    );
    let mut tracer = Tracer::new(&info, angle);
    let (mut met, mut wrong, mut depth, mut bend, mut light) = (0, 0, 0.0, 0.0, 0.0);
    for block in 0..(edge / 8) * (edge / 8) {
        let rays: Vec<Ray> = (0..64)
            .map(|index| {
                let column = block % (edge / 8) * 8 + index % 8;
                let row = block / (edge / 8) * 8 + index / 8;
                let place = |pixel: i32| (pixel as f32 + 0.5 - edge as f32 / 2.0) * angle;
                Ray {
                    origin: eye,
                    direction: (forward + right * place(column) - up * place(row)).normalize(),
                }
            })
            .collect();
        let mut hits = vec![Hit::default(); rays.len()];
        tracer.trace_group(&rays, &mut source, &mut hits).unwrap();
        for (ray, hit) in rays.iter().zip(&hits) {
            let Some((t, normal)) = truth.hit(eye, ray.direction) else {
                wrong += usize::from(hit.coverage >= 0.5);
                continue;
            };
            let off = (Vec3::from(hit.position).distance(eye) - t).abs();
            if hit.coverage < 0.5 || off > 0.05 * t {
                wrong += 1;
                continue;
            }
            met += 1;
            depth += (off / t).powi(2);
            bend += Vec3::from(hit.normal).angle_between(normal).powi(2);
            let radiance = truth.radiance(eye + ray.direction * t, normal);
            light += (hit.radiance[0] - radiance).powi(2);
        }
    }
    let rms = |sum: f32| (sum / met as f32).sqrt();
    let share = wrong as f32 / (edge * edge) as f32;
    println!(
        "{met} hits, {:.2} % on another surface or none; depth {:.4}, normal {:.3} rad, radiance {:.4}; {} discs a ray",
        100.0 * share,
        rms(depth),
        rms(bend),
        rms(light),
        tracer.counters().cut_elements / (edge / 8 * (edge / 8)) as u64,
    );
    // A rim is a fraction of a pixel wider than what it belongs to.
    assert!(share < 0.06, "{share}");
    assert!(rms(depth) < 0.005 && rms(bend) < 0.2 && rms(light) < 0.02);
}

#[test]
fn rays_that_go_nowhere_meet_nothing() {
    let mut points = vec![];
    support::quad(
        Vec3::new(-1.0, 0.0, -1.0),
        Vec3::Z * 2.0,
        Vec3::X * 2.0,
        40,
        1.0,
        &mut points,
    );
    let (info, mut source) = support::build(&points);
    let mut tracer = Tracer::new(&info, 0.01);
    let ray = |direction| Ray {
        origin: Vec3::Y,
        direction,
    };
    let rays = [
        ray(Vec3::ZERO),
        ray(Vec3::Y),
        ray(Vec3::NEG_Y),
        ray(Vec3::new(5.0, -1.0, 0.0)),
    ];
    let mut hits = [Hit::default(); 4];
    tracer.trace_group(&rays, &mut source, &mut hits).unwrap();
    let covered = hits.map(|hit| hit.coverage);
    assert_eq!(covered, [0.0, 0.0, 1.0, 0.0]);
    assert!(Vec3::from(hits[2].position).length() < 1e-3);
    assert!(Vec3::from(hits[2].normal).distance(Vec3::Y) < 1e-3 && (hits[2].radiance[1] - 1.0).abs() < 0.01);
    let empty = support::build(&[]);
    let mut tracer = Tracer::new(&empty.0, 0.01);
    let mut source = empty.1;
    tracer.trace_group(&rays, &mut source, &mut hits).unwrap();
    assert_eq!(hits, [Hit::default(); 4]);
}
