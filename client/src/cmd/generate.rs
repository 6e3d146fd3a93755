//! `generate`: a procedural scene of any size, as points or as triangles.

use super::answer::note;
use super::args::{OutputArgs, StatsArgs};
use super::failure::Failure;
use super::files::{self, Existing};
use super::interrupt::Interrupt;
use super::progress::Progress;
use super::summary;
use clap::Args;
use pbgi_client::size::parse_count;
use pbgi_core::Statistics;
use pbgi_points::{Kind, PlyForm, PointsError, ProceduralScene, write_point_ply};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "\
Examples:
  pbgi-client generate city --points 128000000 -o city.ply
  pbgi-client generate forest --points 200000 -o forest.glb

The same kind, number and seed give the same file. Points (.ply) carry sun and sky without shadows; triangles (.glb) come
with a sun and a camera, for render and gbuffer.";

/// `generate`
#[derive(Args, Debug)]
#[command(after_help = EXAMPLES)]
pub(crate) struct GenerateArgs {
    /// tree, tighten (a head of hair), city or forest
    #[arg(value_name = "KIND")]
    kind: Kind,
    /// About this many points: 2000000, 2M; the scene grows with them
    #[arg(long, allow_negative_numbers = true, value_name = "N", default_value_t = 1_000_000, value_parser = parse_count)]
    points: u64,
    /// Another seed, another scene
    #[arg(long, value_name = "S", default_value_t = 1)]
    seed: u64,
    #[command(flatten)]
    output: OutputArgs,
    #[command(flatten)]
    stats: StatsArgs,
}

pub(crate) async fn generate(args: GenerateArgs, interrupt: &Interrupt) -> Result<(), Failure> {
    args.stats.check()?;
    let output = files::output(&args.output.output, Existing::from_flag(args.output.overwrite))?;
    let (kind, points, seed, aside) = (args.kind, args.points, args.seed, interrupt.clone());
    // Not given up on a signal: the writer sees it, and removes the half-written file.
    let written = tokio::task::spawn_blocking(move || write(kind, points, seed, &output, &aside)).await;
    let statistics = written.unwrap_or_else(|error| Err(Failure::failed(format!("defect: {error}"))))?;
    note(format_args!("wrote {}", args.output.output.display()));
    summary::report(&statistics, args.stats.stats.as_deref())
}

fn write(kind: Kind, points: u64, seed: u64, output: &PathBuf, interrupt: &Interrupt) -> Result<Statistics, Failure> {
    let extension = output
        .extension()
        .unwrap_or_default()
        .to_string_lossy()
        .to_ascii_lowercase();
    let mut scene = ProceduralScene::new(kind, points, seed)?;
    let written = match extension.as_str() {
        "ply" => Some(write_points(&mut scene, points, output, interrupt)?),
        "glb" => {
            scene.write_glb(output)?;
            None
        }
        _ => return Err(Failure::usage(format!("output {output:?} must end in .ply or .glb"))),
    };
    let bytes = std::fs::metadata(output).map_or(0, |metadata| metadata.len());
    Ok(Statistics {
        points: written.map(|points| points as f64),
        bytes_written: Some(bytes as f64),
        ..Default::default()
    })
}

fn write_points(
    scene: &mut ProceduralScene,
    points: u64,
    output: &Path,
    interrupt: &Interrupt,
) -> Result<u64, Failure> {
    let mut progress = Progress::new();
    let mut observer = |count| {
        progress.show("generating", count, points);
        match interrupt.asked() {
            true => ControlFlow::Break(()),
            false => ControlFlow::Continue(()),
        }
    };
    match write_point_ply(output, PlyForm::Records, scene, &mut observer) {
        Err(PointsError::Cancelled) => Err(Failure::Interrupted("nothing was written".to_owned())),
        written => Ok(written?),
    }
}
