//! Error against time, of the gather and of ray casting the mesh, on the same receivers in one run and on one core.
//!
//! `cargo bench -p pbgi-tests --bench gather -- [spheres] [cornell] [sponza] [street] [glade] [city] [forest]` (all by default; scenes
//! whose files are absent are skipped, loudly). What it prints are the tables of `docs/gathering.md`. Errors are against rays at the mesh: two
//! independent references per receiver, whose noise drops out of the mean of the product of both differences.

#![allow(clippy::unwrap_used, reason = "a benchmark asserts")]

use glam::Vec3;
use pbgi_build::{BuildRequest, build};
use pbgi_core::{BuildSettings, SceneInfo, ShadeSettings};
use pbgi_points::{Camera, Density, GBuffer, InputOptions, Kind, MeshScene, ProceduralScene, ViewDensity, open_input};
use pbgi_shade::{ArraySource, Receiver, Shaded, Shader};
use pbgi_store::Overwrite;
use pbgi_tests::load;
use std::f32::consts::{PI, TAU};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::time::{Instant, SystemTime};

/// Picture that the receivers are taken from.
const SIZE: (u32, u32) = (960, 544);
/// Edge of a group of receivers, as the worker shades them.
const GROUP: u32 = 8;
/// One group of so many is shaded.
const GROUP_STEP: u32 = 61;
/// Rays of each of the two references, along one edge of their grid.
const REFERENCE_SIDE: u32 = 32;
/// Settings of the gather: solid angle of a cut element, raster resolution, error of interpolation.
const SETTINGS: [(f32, u32, f32); 11] = [
    (1.0, 32, 0.0),
    (0.5, 32, 0.0),
    (0.5, 32, 0.02),
    (0.2, 32, 0.0),
    (0.2, 32, 0.02),
    (0.1, 32, 0.0),
    (0.05, 32, 0.0),
    (0.1, 64, 0.0),
    (0.05, 64, 0.0),
    (0.05, 64, 0.02),
    (0.02, 64, 0.0),
];
/// Rays along one edge of the grid.
const RAY_SIDES: [u32; 4] = [4, 8, 16, 32];

/// Scenes.
const NAMES: [&str; 7] = ["spheres", "cornell", "sponza", "street", "glade", "city", "forest"];

/// One line of the table.
struct Row {
    what: String,
    micros: f64,
    occlusion: f64,
    irradiance: f64,
    note: String,
}

/// What the estimates are held against.
struct Truth {
    first: Vec<[f32; 2]>,
    second: Vec<[f32; 2]>,
    mean_irradiance: f64,
}

impl Truth {
    fn new(mesh: &MeshScene, receivers: &[Receiver]) -> Self {
        let cast = |salt: u64| -> Vec<[f32; 2]> {
            let at = |(receiver, index): (&Receiver, u64)| {
                let found = mesh.raycast(
                    receiver.position,
                    receiver.normal,
                    REFERENCE_SIDE,
                    salt << 40 | index,
                    1,
                );
                [found.occlusion, mean(found.irradiance)]
            };
            receivers.iter().zip(0..).map(at).collect()
        };
        let (first, second) = std::thread::scope(|scope| {
            let first = scope.spawn(|| cast(1));
            (cast(2), first.join().unwrap())
        });
        let sum: f64 = first
            .iter()
            .zip(&second)
            .map(|(a, b)| f64::from(a[1] + b[1]) / 2.0)
            .sum();
        Self {
            mean_irradiance: sum / receivers.len() as f64,
            first,
            second,
        }
    }

    /// RMS of occlusion, and of irradiance over its mean.
    fn errors(&self, estimates: &[[f32; 2]]) -> (f64, f64) {
        let rms = |channel: usize| {
            let product = |(index, estimate): (usize, &[f32; 2])| {
                let (a, b) = (self.first[index][channel], self.second[index][channel]);
                f64::from(estimate[channel] - a) * f64::from(estimate[channel] - b)
            };
            let sum: f64 = estimates.iter().enumerate().map(product).sum();
            (sum / estimates.len() as f64).max(0.0).sqrt()
        };
        (rms(0), rms(1) / self.mean_irradiance)
    }
}

fn mean(rgb: [f32; 3]) -> f32 {
    (rgb[0] + rgb[1] + rgb[2]) / 3.0
}

/// What is shaded.
struct Scene {
    name: String,
    /// The mesh.
    file: PathBuf,
    density: Density,
    camera: usize,
}

/// Receivers in whole groups, spread over the picture.
fn receivers(mesh: &MeshScene, camera: usize) -> Vec<Vec<Receiver>> {
    let camera = mesh.camera(camera).unwrap_or_else(|_| Camera::framing(&mesh.bounds()));
    let (width, height) = SIZE;
    let frame = GBuffer::render(mesh, &camera, width, height).unwrap();
    let mut groups = Vec::new();
    let columns = width / GROUP;
    for group in (0..columns * (height / GROUP)).step_by(GROUP_STEP as usize) {
        let (left, top) = (group % columns * GROUP, group / columns * GROUP);
        let pixels = (0..GROUP * GROUP).map(|i| ((top + i / GROUP) * width + left + i % GROUP) as usize);
        let seen = pixels.filter(|&pixel| !frame.is_hole(pixel)).map(|pixel| Receiver {
            position: frame.position[pixel].into(),
            normal: Vec3::from(frame.normal[pixel]).normalize(),
        });
        groups.push(seen.collect());
    }
    groups
}

fn gather_row(
    info: &SceneInfo,
    source: &mut ArraySource,
    groups: &[Vec<Receiver>],
    truth: &Truth,
    row: (f32, u32, f32),
) -> Row {
    let settings = ShadeSettings {
        max_solid_angle: row.0,
        raster_resolution: row.1,
        interpolation: row.2,
        ..ShadeSettings::default()
    };
    let mut shader = Shader::new(info, settings, None).unwrap();
    let mut shaded: Vec<Vec<Shaded>> = groups
        .iter()
        .map(|group| vec![Shaded::default(); group.len()])
        .collect();
    let mut best = f64::INFINITY;
    let mut counters = shader.counters();
    for _ in 0..3 {
        let before = shader.counters();
        let start = Instant::now();
        for (group, shaded) in groups.iter().zip(&mut shaded) {
            shader.shade_group(group, source, shaded).unwrap();
        }
        best = best.min(start.elapsed().as_secs_f64());
        counters = shader.counters();
        counters.cut_elements -= before.cut_elements;
        counters.receivers -= before.receivers;
    }
    let estimates: Vec<[f32; 2]> = shaded
        .iter()
        .flatten()
        .map(|shaded| [shaded.occlusion, mean(shaded.irradiance)])
        .collect();
    let (occlusion, irradiance) = truth.errors(&estimates);
    let count = counters.receivers as f64;
    Row {
        what: match row.2 {
            0.0 => format!("gather, solid angle {}, raster {}", row.0, row.1),
            error => format!("gather, {}, {}, interpolated {error}", row.0, row.1),
        },
        micros: best * 1e6 / count,
        occlusion,
        irradiance,
        note: format!(
            "cut {:.0}, {:.0} ns an element",
            counters.cut_elements as f64 / count,
            best * 1e9 / counters.cut_elements as f64
        ),
    }
}

fn ray_rows(mesh: &MeshScene, receivers: &[Receiver], truth: &Truth, side: u32) -> [Row; 2] {
    let seed = |index: usize| 3 << 40 | index as u64;
    let start = Instant::now();
    let occlusion = receivers.iter().enumerate().map(|(index, receiver)| {
        let share = mesh.raycast_occlusion(receiver.position, receiver.normal, side, seed(index));
        [share, 0.0]
    });
    let occlusion: Vec<[f32; 2]> = occlusion.collect();
    let occlusion_micros = start.elapsed().as_secs_f64() * 1e6 / receivers.len() as f64;
    let start = Instant::now();
    let bounce = receivers.iter().enumerate().map(|(index, receiver)| {
        let found = mesh.raycast(receiver.position, receiver.normal, side, seed(index), 1);
        [found.occlusion, mean(found.irradiance)]
    });
    let bounce: Vec<[f32; 2]> = bounce.collect();
    let bounce_micros = start.elapsed().as_secs_f64() * 1e6 / receivers.len() as f64;
    let rays = side * side;
    [
        Row {
            what: format!("{rays} rays, occlusion alone"),
            micros: occlusion_micros,
            occlusion: truth.errors(&occlusion).0,
            irradiance: f64::NAN,
            note: String::new(),
        },
        Row {
            what: format!("{rays} rays, one bounce"),
            micros: bounce_micros,
            occlusion: truth.errors(&bounce).0,
            irradiance: truth.errors(&bounce).1,
            note: String::new(),
        },
    ]
}

fn measure(scene: &Scene, scratch: &Path) {
    let Scene { name, file, .. } = scene;
    let mesh = MeshScene::load(file).unwrap();
    let groups = receivers(&mesh, scene.camera);
    let all: Vec<Receiver> = groups.iter().flatten().copied().collect();
    let truth = Truth::new(&mesh, &all);

    let options = InputOptions {
        density: scene.density,
        memory_bytes: 8_000_000_000,
        scratch_dir: scratch.to_owned(),
        ..InputOptions::default()
    };
    let mut input = open_input(std::slice::from_ref(file), &options).unwrap();
    let output = scratch.join(format!("{name}.pbgi"));
    let request = BuildRequest {
        output: output.clone(),
        overwrite: Overwrite::Refuse,
        scratch_dir: scratch.to_owned(),
        memory_bytes: 4_000_000_000,
        settings: BuildSettings::default(),
        input_key: None,
    };
    build(&mut input, &request, &mut |_| ControlFlow::Continue(())).unwrap();
    let (info, mut source) = load(&output);

    println!(
        "\n## {}{}\n\n{} triangles, {} points, {} receivers\n",
        name[..1].to_uppercase(),
        &name[1..],
        mesh.triangle_count(),
        info.point_count,
        all.len()
    );
    println!("| method | us a receiver | occlusion RMS | indirect RMS over mean | |\n|---|---|---|---|---|");
    let mut rows = Vec::new();
    for row in SETTINGS {
        rows.push(gather_row(&info, &mut source, &groups, &truth, row));
    }
    for side in RAY_SIDES {
        rows.extend(ray_rows(&mesh, &all, &truth, side));
    }
    for row in rows {
        let indirect = if row.irradiance.is_nan() {
            String::new()
        } else {
            format!("{:.2} %", 100.0 * row.irradiance)
        };
        println!(
            "| {} | {:.1} | {:.4} | {indirect} | {} |",
            row.what, row.micros, row.occlusion, row.note
        );
    }
}

/// A scene by its name; `None` if its file is absent.
fn scene(name: &str, scratch: &Path) -> Option<Scene> {
    let procedural = |kind: Kind, size: u64| {
        let path = scratch.join(format!("{name}.glb"));
        let scene = ProceduralScene::new(kind, size, 1).unwrap();
        scene.write_glb(&path).unwrap();
        path
    };
    let seen = |camera| {
        Density::View(ViewDensity {
            camera,
            size: [SIZE.0, SIZE.1],
            pixels: 1.0,
            floor: None,
            ceiling: None,
        })
    };
    let (file, density, camera) = match name {
        "spheres" => (spheres(scratch), Density::Points(1_000_000), 0),
        "cornell" => (
            pbgi_tests::shared("reference/cornell.glb")?,
            Density::Points(2_000_000),
            0,
        ),
        "sponza" => (pbgi_tests::shared("data/sponza/sponza_lit.gltf")?, seen(0), 0),
        // 1.6 million triangles and 10,000 trees, before the eyes of somebody who walks there.
        "street" => (procedural(Kind::City, 48_000_000), seen(1), 1),
        "glade" => (procedural(Kind::Forest, 150_000_000), seen(1), 1),
        // From afar. Windows lie 0.3 deep: the distance between points is below half of that.
        "city" => (procedural(Kind::City, 2_000_000), Density::Points(16_000_000), 0),
        "forest" => (procedural(Kind::Forest, 2_000_000), Density::Points(16_000_000), 0),
        _ => panic!("{name:?} is no scene: choose {}", NAMES.join(", ")),
    };
    Some(Scene {
        name: name.to_owned(),
        file,
        density,
        camera,
    })
}

/// 64 spheres over a ground of 20 x 20, half of them touching it, under a sun: the scene of `truth.rs` in pbgi-shade, as a
/// mesh, with shadows.
fn spheres(scratch: &Path) -> PathBuf {
    const ROWS: u32 = 48;
    const COLUMNS: u32 = 96;
    let mut object = String::from("v -10 0 -10\nv -10 0 10\nv 10 0 10\nv 10 0 -10\nf 1 2 3 4\n");
    for i in 0..64u32 {
        let radius = 0.6 + 0.4 * ((i * 7 % 11) as f32 / 11.0);
        let lift = if i % 2 == 0 { 0.0 } else { 0.5 + 0.1 * (i % 5) as f32 };
        let [x, z] = [i % 8, i / 8].map(|place| (place as f32 - 3.5) * 2.4);
        for row in 0..=ROWS {
            let (sin, cos) = (PI * row as f32 / ROWS as f32).sin_cos();
            for column in 0..COLUMNS {
                let (east, north) = (TAU * column as f32 / COLUMNS as f32).sin_cos();
                let [px, py, pz] = [sin * east, cos, sin * north].map(|part| part * radius);
                object += &format!("v {} {} {}\n", x + px, radius + lift + py, z + pz);
            }
        }
        let first = 5 + i * (ROWS + 1) * COLUMNS;
        for row in 0..ROWS {
            for column in 0..COLUMNS {
                let next = (column + 1) % COLUMNS;
                let at = |row: u32, column: u32| first + row * COLUMNS + column;
                let [a, b, c, d] = [at(row, column), at(row + 1, column), at(row + 1, next), at(row, next)];
                object += &format!("f {a} {b} {c}\nf {a} {c} {d}\n");
            }
        }
    }
    std::fs::write(scratch.join("spheres.obj"), object).unwrap();
    let path = scratch.join("spheres.toml");
    let scene = r#"
        [[mesh]]
        file = "spheres.obj"
        albedo = [0.5, 0.5, 0.5]
        [[light.directional]]
        direction = [-0.3, -0.8, -0.5]
        irradiance = 1
        [[camera]]
        position = [0, 9, 16]
        target = [0, 0, 0]
        fov = 45
    "#;
    std::fs::write(&path, scene).unwrap();
    path
}

/// Days since the beginning of 1970.
#[allow(clippy::disallowed_methods, reason = "a benchmark says when it was run")]
fn day() -> u64 {
    SystemTime::now()
        .duration_since(SystemTime::UNIX_EPOCH)
        .unwrap()
        .as_secs()
        / 86_400
}

fn main() {
    let given: Vec<String> = std::env::args().skip(1).filter(|arg| !arg.starts_with("--")).collect();
    let names = if given.is_empty() {
        NAMES.map(str::to_owned).to_vec()
    } else {
        given
    };
    let processor = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = processor.lines().find(|line| line.starts_with("model name"));
    println!("cargo bench -p pbgi-tests --bench gather -- {}", names.join(" "));
    println!(
        "{}; one core; day {} since 1970",
        model.unwrap_or("unknown processor"),
        day()
    );
    let scratch = tempfile::tempdir().unwrap();
    for name in &names {
        if let Some(scene) = scene(name, scratch.path()) {
            measure(&scene, scratch.path());
        }
    }
}
