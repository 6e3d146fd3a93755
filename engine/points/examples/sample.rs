//! Reads or samples inputs as a build does and says how long it takes and how much memory:
//! `cargo run --release -p pbgi-points --example sample -- 5000000 SCENE.glb`, or clouds, whose normals and radii are
//! estimated where they have none. The number is that of points for meshes; `view` in its place samples for the camera.

use pbgi_core::PointStream;
use pbgi_points::{CloudOptions, Density, Facing, InputOptions, Radius, ViewDensity, open_input};
use std::path::PathBuf;
use std::time::Instant;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let density = match arguments.next().as_deref() {
        Some("view") => Density::View(ViewDensity {
            camera: 0,
            size: [1920, 1080],
            pixels: 1.0,
            floor: None,
            ceiling: None,
        }),
        Some(points) => Density::Points(points.parse()?),
        None => return Err("usage: sample POINTS|view INPUT...".into()),
    };
    let options = InputOptions {
        density,
        cloud: CloudOptions {
            estimate_normals: Some(Facing::Auto),
            radius: Some(Radius::Estimate),
            ..CloudOptions::default()
        },
        ..InputOptions::default()
    };
    let paths: Vec<PathBuf> = arguments.map(PathBuf::from).collect();
    let start = Instant::now();
    let mut stream = open_input(&paths, &options)?;
    let kept = stream.memory_bytes() >> 20;
    println!("opened in {:.2?}, at most {kept} MiB kept, {}", start.elapsed(), peak());
    let start = Instant::now();
    let (mut count, mut batch) = (0, Vec::new());
    while stream.next_batch(&mut batch)? {
        count += batch.len();
        batch.clear();
    }
    let seconds = start.elapsed().as_secs_f64();
    let rate = count as f64 / seconds / 1e6;
    println!(
        "{count} points in {seconds:.2} s, {rate:.2} million a second, {}",
        peak()
    );
    Ok(())
}

fn peak() -> String {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find(|line| line.starts_with("VmHWM"));
    format!("peak {}", line.unwrap_or_default().trim_start_matches("VmHWM:").trim())
}
