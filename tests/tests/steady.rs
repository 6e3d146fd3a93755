//! Steady in motion: a camera passes Sponza's columns, and what a place of the world receives stays what it is.

#![allow(clippy::unwrap_used, reason = "tests")]

use glam::Vec3;
use pbgi_build::{BuildRequest, build};
use pbgi_core::{BuildSettings, ShadeSettings};
use pbgi_points::{Camera, Density, GBuffer, InputOptions, MeshScene, open_input};
use pbgi_shade::{Receiver, Shaded, Shader};
use pbgi_store::Overwrite;
use pbgi_tests::{load, shared};
use std::ops::ControlFlow;

const FRAMES: u32 = 60;
const SIZE: (u32, u32) = (160, 96);
const GROUP: u32 = 8;
/// A place is seen where a pixel lies this near, world units; Sponza is 30 long.
const SEEN: f32 = 0.2;

fn receiver(frame: &GBuffer, pixel: usize) -> Receiver {
    Receiver {
        position: frame.position[pixel].into(),
        normal: Vec3::from(frame.normal[pixel]).normalize(),
    }
}

/// The pixel that shows a place, if one does.
fn showing(frame: &GBuffer, place: &Receiver) -> Option<usize> {
    let distance = |pixel: &usize| Vec3::from(frame.position[*pixel]).distance(place.position);
    let pixels = (0..frame.pixel_count()).filter(|&pixel| !frame.is_hole(pixel));
    let nearest = pixels.min_by(|a, b| distance(a).total_cmp(&distance(b)))?;
    (distance(&nearest) < SEEN && receiver(frame, nearest).normal.dot(place.normal) > 0.9).then_some(nearest)
}

#[test]
fn camera_that_passes_sponzas_columns_sees_no_place_change() {
    let Some(path) = shared("data/sponza/sponza_lit.gltf") else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let mesh = MeshScene::load(&path).unwrap();
    let options = InputOptions {
        density: Density::Points(300_000),
        ..InputOptions::default()
    };
    let request = BuildRequest {
        output: folder.path().join("sponza.pbgi"),
        overwrite: Overwrite::Refuse,
        scratch_dir: folder.path().to_path_buf(),
        memory_bytes: 512 << 20,
        settings: BuildSettings::default(),
        input_key: None,
    };
    let mut points = open_input(&[path], &options).unwrap();
    build(&mut points, &request, &mut |_| ControlFlow::Continue(())).unwrap();
    let (info, mut source) = load(&request.output);
    let coarse = ShadeSettings {
        max_solid_angle: 0.2,
        raster_resolution: 32,
        ..ShadeSettings::default()
    };
    let mut shader = Shader::new(&info, coarse, None).unwrap();
    let frames: Vec<GBuffer> = (0..FRAMES)
        .map(|frame| {
            let way = frame as f32 / FRAMES as f32;
            let eye = Vec3::new(-4.0 + 4.0 * way, 1.7, 0.3);
            let camera = Camera::look_at(eye, eye + Vec3::new(1.0, 0.1, -0.8), 1.0);
            GBuffer::render(&mesh, &camera, SIZE.0, SIZE.1).unwrap()
        })
        .collect();
    let places: Vec<Receiver> = (0..SIZE.0 * SIZE.1)
        .step_by(1201)
        .map(|pixel| pixel as usize)
        .filter(|&pixel| !frames[30].is_hole(pixel))
        .map(|pixel| receiver(&frames[30], pixel))
        .collect();
    let (mut seen, mut beside, mut change, mut mean) = (0u32, 0u32, 0.0, 0.0);
    for place in &places {
        let (mut known, mut before) = (None, None);
        for frame in &frames {
            let Some(pixel) = showing(frame, place) else {
                before = None;
                continue;
            };
            // The pixels of the picture's grid, with this one as the place that it is near, and as it is.
            let (column, row) = (
                pixel as u32 % SIZE.0 / GROUP * GROUP,
                pixel as u32 / SIZE.0 / GROUP * GROUP,
            );
            let pixels = (0..GROUP * GROUP).map(|i| ((row + i / GROUP) * SIZE.0 + column + i % GROUP) as usize);
            let pixels: Vec<usize> = pixels.filter(|&pixel| !frame.is_hole(pixel)).collect();
            let at = pixels.iter().position(|&other| other == pixel).unwrap();
            let mut group: Vec<Receiver> = pixels.iter().map(|&pixel| receiver(frame, pixel)).collect();
            let mut shaded = vec![Shaded::default(); group.len()];
            shader.shade_group(&group, &mut source, &mut shaded).unwrap();
            let own = shaded[at].occlusion;
            group[at] = *place;
            shader.shade_group(&group, &mut source, &mut shaded).unwrap();
            assert_eq!(*known.get_or_insert(shaded[at]), shaded[at], "at {:?}", place.position);
            seen += 1;
            if let Some(before) = before.replace(own) {
                let step: f32 = own - before;
                change += f64::from(step * step);
                mean += f64::from(own);
                beside += 1;
            }
        }
    }
    let change = (change / f64::from(beside)).sqrt();
    eprintln!(
        "{} places, seen {seen} times in {FRAMES} frames: no change; pixels beside them change by {change:.4} (RMS) of {:.3} from \
         frame to frame",
        places.len(),
        mean / f64::from(beside)
    );
    assert!(seen > 300, "{seen} times seen");
}
