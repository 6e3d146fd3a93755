//! Samples mesh files and says how long it takes: `cargo run --release -p pbgi-points --example sample -- SCENE.glb 5000000`.

use pbgi_core::PointStream;
use pbgi_points::{Density, MeshPoints, MeshScene, SampleOptions};
use std::path::Path;
use std::time::Instant;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let (Some(path), Some(points)) = (arguments.next(), arguments.next()) else {
        return Err("usage: sample SCENE POINTS".into());
    };
    let start = Instant::now();
    let scene = MeshScene::load(Path::new(&path))?;
    println!(
        "{} triangles loaded and indexed in {:.2?}",
        scene.triangle_count(),
        start.elapsed()
    );
    let options = SampleOptions {
        density: Density::Points(points.parse()?),
        ..SampleOptions::default()
    };
    let start = Instant::now();
    let mut stream = MeshPoints::new(scene, &options)?;
    let (mut count, mut batch) = (0, Vec::new());
    while stream.next_batch(&mut batch)? {
        count += batch.len();
        batch.clear();
    }
    println!(
        "{count} points laid out and lit in {:.2?}, spacing {:.4}",
        start.elapsed(),
        stream.spacing()
    );
    Ok(())
}
