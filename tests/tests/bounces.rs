//! Light that was reflected more than once, against answers that are known and against ray casting.

#![allow(clippy::unwrap_used, reason = "tests")]

use glam::Vec3;
use pbgi_core::PointRecord;
use pbgi_core::point::{Reflectance, Sides};
use pbgi_points::ply::PlyWriter;
use pbgi_points::{GBuffer, MeshScene, PlyForm, Window};
use pbgi_tests::{DAEMON, House, Picture, SHADED, assert_same_values, shared};
use std::f32::consts::PI;
use std::path::Path;

const ALBEDO: f32 = 0.5;
/// Points along an edge of the room's walls.
const EDGE: usize = 120;

/// A closed room from (-1, -1, -1) to (1, 1, 1) whose walls glow inward and reflect half of what comes.
fn write_room(path: &Path) {
    let mut writer = PlyWriter::create(path, PlyForm::Floats, &[]).unwrap();
    let step = 2.0 / EDGE as f32;
    let place = |index: usize| (index as f32 + 0.5) * step - 1.0;
    for normal in [Vec3::X, Vec3::Y, Vec3::Z, -Vec3::X, -Vec3::Y, -Vec3::Z] {
        let (u, v) = normal.any_orthonormal_pair();
        for (row, column) in (0..EDGE).flat_map(|row| (0..EDGE).map(move |column| (row, column))) {
            let position = u * place(row) + v * place(column) - normal;
            let sides = Sides {
                front: [1.0, 0.5, 0.0],
                back: [0.0; 3],
            };
            let point = PointRecord::new(position.to_array(), normal.to_array(), step / PI.sqrt(), sides).unwrap();
            let reflectance = Reflectance {
                albedo: [ALBEDO; 3],
                both_sides: false,
            };
            writer.push(&point.with_reflectance(reflectance), &[]).unwrap();
        }
    }
    writer.finish().unwrap();
}

/// A picture whose pixels are these receivers.
fn write_gbuffer(path: &Path, receivers: &[(Vec3, Vec3)]) {
    let window = Window::of_size(receivers.len() as u32, 1);
    let picture = GBuffer {
        data_window: window,
        display_window: window,
        world_to_camera: None,
        world_to_ndc: None,
        position: receivers.iter().map(|(position, _)| position.to_array()).collect(),
        normal: receivers.iter().map(|(_, normal)| normal.to_array()).collect(),
        coverage: vec![1.0; receivers.len()],
        albedo: None,
        direct: None,
        emission: None,
    };
    picture.write(path).unwrap();
}

#[test]
fn closed_room_glows_as_the_series_of_its_bounces_says() {
    let house = House::new();
    write_room(&house.path("room.ply"));
    house.line(&format!("build room.ply -o room.pbgi {DAEMON}")).ok();
    let directions = [Vec3::X, Vec3::NEG_Y, Vec3::new(0.6, 0.0, -0.8)];
    let places = [Vec3::ZERO, Vec3::new(0.4, -0.3, 0.2), Vec3::new(-0.7, 0.6, 0.1)];
    let mut receivers: Vec<(Vec3, Vec3)> = places
        .into_iter()
        .flat_map(|place| directions.map(|normal| (place, normal)))
        .collect();
    let inside = receivers.len();
    receivers.push((Vec3::new(1.5, 0.0, 0.0), Vec3::NEG_X));
    write_gbuffer(&house.path("g.exr"), &receivers);
    let shade = |name: &str, options: &str, daemon: &str| {
        let run = house
            .line(&format!("shade room.pbgi --gbuffer g.exr -o {name} {options} {daemon}"))
            .ok();
        (Picture::read(&house.path(name)), run.stderr)
    };
    let mut expected = 0.0;
    for bounces in 1..=3 {
        expected += PI * ALBEDO.powi(bounces - 1);
        let (picture, _) = shade(&format!("{bounces}.exr"), &format!("--bounces {bounces}"), DAEMON);
        let red = picture.channel("indirect.R");
        // What leaks at the room's edges is missing in every bounce.
        let most = 0.012 * bounces as f32;
        let errors = red[..inside].iter().map(|value| value / expected - 1.0);
        let worst = errors.fold(
            0.0f32,
            |worst, error| if error.abs() > worst.abs() { error } else { worst },
        );
        let outside = red[inside] / expected;
        eprintln!("{bounces} bounces: off by {worst:.4} at most, {outside:.4} of it outside");
        assert!(worst.abs() < most, "{bounces} bounces: off by {worst}");
        assert!(outside < 0.03, "{outside} of it leaves the room");
        assert_eq!(picture.channel("indirect.B"), vec![0.0; receivers.len()]);
    }
    // Scenes of further bounces are kept, and another daemon finds them.
    house.shutdown();
    let (first, second) = (
        Picture::read(&house.path("3.exr")),
        shade("warm.exr", "--bounces 3", DAEMON),
    );
    assert!(!second.1.contains("gathering"), "{}", second.1);
    // One of other memory and workers does not, and makes the same.
    let alone = shade("alone.exr", "--bounces 3", "--memory 200M --workers 1");
    assert!(alone.1.contains("gathering bounce 2 of 3"), "{}", alone.1);
    for name in SHADED {
        assert_same_values(name, first.channel(name), second.0.channel(name));
        assert_same_values(name, first.channel(name), alone.0.channel(name));
    }
}

#[test]
fn scene_that_reflects_nothing_says_so_and_what_to_do() {
    let house = House::new();
    std::fs::write(
        house.path("cloud.ply"),
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nproperty float nx\n\
         property float ny\nproperty float nz\nproperty float radius\nproperty uchar red\nproperty uchar green\n\
         property uchar blue\nend_header\n0 0 0 0 1 0 0.5 255 0 0\n0 2 0 0 -1 0 0.5 0 255 0\n",
    )
    .unwrap();
    house.line(&format!("build cloud.ply -o black.pbgi {DAEMON}")).ok();
    house
        .line(&format!("build cloud.ply -o grey.pbgi --albedo 0.5 {DAEMON}"))
        .ok();
    write_gbuffer(&house.path("g.exr"), &[(Vec3::ZERO, Vec3::Y)]);
    let shade = |scene: &str| {
        house.line(&format!(
            "shade {scene} --gbuffer g.exr -o {scene}.exr --bounces 2 {DAEMON}"
        ))
    };
    shade("black.pbgi").fails_naming(&["no point of the scene reflects", "--albedo", "black.pbgi"]);
    assert!(std::fs::metadata(house.path("black.pbgi.exr")).is_err());
    shade("grey.pbgi").ok();
    house
        .line("shade grey.pbgi --gbuffer g.exr -o no.exr --bounces 17")
        .fails_naming(&["bounces is 17", "1..=16"]);
    // What the upper disc sends down comes back from the lower one, and down again.
    let picture = Picture::read(&house.path("grey.pbgi.exr"));
    assert!(picture.channel("indirect.G")[0] > 0.0 && picture.channel("indirect.R")[0] > 0.0);
}

#[test]
fn cornell_box_with_three_bounces_is_close_to_ray_casting() {
    const SIDE: u32 = 32;
    let [Some(mesh), Some(gbuffer)] =
        ["cornell.glb", "cornell.gbuffer.exr"].map(|name| shared(&format!("reference/{name}")))
    else {
        return;
    };
    let house = House::new();
    let scene = MeshScene::load(&mesh).unwrap();
    let passes = Picture::read(&gbuffer);
    let axes = |layer: &str| ["X", "Y", "Z"].map(|axis| passes.channel(&format!("{layer}.{axis}")));
    let (position, normal) = (axes("P"), axes("N"));
    let at = |planes: &[&[f32]; 3], pixel: usize| Vec3::from_array(planes.map(|plane| plane[pixel]));
    let receivers: Vec<(Vec3, Vec3)> = (0..256 * 256)
        .step_by(149)
        .filter(|&pixel| passes.channel("A")[pixel] == 1.0)
        .map(|pixel| (at(&position, pixel), at(&normal, pixel)))
        .collect();
    write_gbuffer(&house.path("g.exr"), &receivers);
    house
        .line(&format!(
            "build {} -o cornell.pbgi --points 300000 {DAEMON}",
            mesh.display()
        ))
        .ok();
    for bounces in [1, 3] {
        house
            .line(&format!(
                "shade cornell.pbgi --gbuffer g.exr -o {bounces}.exr --bounces {bounces} {DAEMON}"
            ))
            .ok();
        let picture = Picture::read(&house.path(&format!("{bounces}.exr")));
        let shaded = ["indirect.R", "indirect.G", "indirect.B"].map(|name| picture.channel(name));
        // Two references with rays of their own: their noise drops out of the product of the errors.
        let (mut product, mut sum, mut bias) = (0.0, 0.0, 0.0);
        for (index, &(position, normal)) in receivers.iter().enumerate() {
            let cast = |salt: u64| {
                scene
                    .raycast(position, normal, SIDE, salt << 40 | index as u64, bounces)
                    .irradiance
            };
            let references = [cast(1), cast(2)];
            for (channel, shaded) in shaded.iter().enumerate() {
                let [a, b] = references.map(|reference| f64::from(shaded[index]) - f64::from(reference[channel]));
                product += a * b;
                bias += (a + b) / 2.0;
                sum += f64::from(references[0][channel] + references[1][channel]) / 2.0;
            }
        }
        let count = 3.0 * receivers.len() as f64;
        let (relative, bias) = ((product.max(0.0) / count).sqrt() * count / sum, bias / sum);
        eprintln!(
            "{bounces} bounces: indirect {relative:.4} of its mean, bias {bias:.4}, mean {:.4}",
            sum / count
        );
        assert!(relative < 0.06, "{bounces} bounces: off by {relative}");
        assert!(bias.abs() < 0.03, "{bounces} bounces: biased by {bias}");
    }
}
