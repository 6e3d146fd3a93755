//! `sample` and `gbuffer`: what is made of a mesh here, without a daemon.

use super::answer::note;
use super::args::{CameraArgs, CloudArgs, DensityArgs, OutputArgs, StatsArgs};
use super::failure::Failure;
use super::files::{self, Existing};
use super::frame::{self, Frame};
use super::interrupt::Interrupt;
use super::progress::Progress;
use super::summary;
use clap::Args;
use pbgi_core::{PointStream, Statistics};
use pbgi_points::{InputOptions, PlyForm, PointsError, open_input, write_point_ply};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

const SAMPLE_EXAMPLES: &str = "\
Example:
  pbgi-client sample hall.glb -o hall.ply --spacing 0.02

Points carry the radiance that leaves them: direct light reflected once, and emission.";

/// `sample`
#[derive(Args, Debug)]
#[command(after_help = SAMPLE_EXAMPLES)]
pub(crate) struct SampleArgs {
    /// Meshes that light each other (.glb, .gltf, .obj, .usd, .ply with faces) and scene files (.toml), and clouds (.ply, .las, .laz, .ptc, .pbgi), which are converted
    #[arg(required = true, value_name = "SCENE")]
    inputs: Vec<PathBuf>,
    #[command(flatten)]
    output: OutputArgs,
    #[command(flatten)]
    density: DensityArgs,
    #[command(flatten)]
    cloud: CloudArgs,
    #[command(flatten)]
    stats: StatsArgs,
}

pub(crate) async fn sample(args: SampleArgs, interrupt: &Interrupt) -> Result<(), Failure> {
    args.stats.check()?;
    let inputs = files::inputs(&args.inputs)?;
    let output = files::output_of_kind(&args.output.output, Existing::from_flag(args.output.overwrite), "ply")?;
    let mut options = InputOptions::default();
    options.cloud = args.cloud.options();
    args.cloud.say_origin(&inputs)?;
    options.density = args.density.density().unwrap_or(options.density);
    let aside = interrupt.clone();
    // Not given up on a signal: the writer sees it, and removes the half-written file.
    let written = tokio::task::spawn_blocking(move || write_points(&inputs, &output, &options, &aside)).await;
    let statistics = written.unwrap_or_else(|error| Err(Failure::failed(format!("defect: {error}"))))?;
    note(format_args!("wrote {}", args.output.output.display()));
    summary::report(&statistics, args.stats.stats.as_deref())
}

fn write_points(
    inputs: &[PathBuf],
    output: &Path,
    options: &InputOptions,
    interrupt: &Interrupt,
) -> Result<Statistics, Failure> {
    let mut progress = Progress::new();
    progress.stage("loading");
    let mut stream = open_input(inputs, options)?;
    let total = stream.len_hint().unwrap_or(0);
    let mut observer = |count| {
        progress.show("sampling", count, total);
        match interrupt.asked() {
            true => ControlFlow::Break(()),
            false => ControlFlow::Continue(()),
        }
    };
    let points = match write_point_ply(output, PlyForm::Floats, &mut stream, &mut observer) {
        Err(PointsError::Cancelled) => return Err(Failure::Interrupted("nothing was written".to_owned())),
        written => written?,
    };
    let bytes = std::fs::metadata(output).map_or(0, |metadata| metadata.len());
    Ok(Statistics {
        points: Some(points as f64),
        points_skipped: Some(stream.skipped() as f64),
        bytes_written: Some(bytes as f64),
        ..Default::default()
    })
}

const GBUFFER_EXAMPLES: &str = "\
Example:
  pbgi-client gbuffer hall.glb --camera 0 --size 1920x1080 -o g.exr

Writes P and N in world space, albedo, direct (irradiance of the punctual lights), emission and A.";

/// `gbuffer`
#[derive(Args, Debug)]
#[command(after_help = GBUFFER_EXAMPLES)]
pub(crate) struct GbufferArgs {
    /// A mesh (.glb, .gltf, .obj, .usd, .ply with faces) or a scene file (.toml)
    #[arg(value_name = "SCENE")]
    scene: PathBuf,
    #[command(flatten)]
    output: OutputArgs,
    #[command(flatten)]
    camera: CameraArgs,
    #[command(flatten)]
    stats: StatsArgs,
}

pub(crate) async fn gbuffer(args: GbufferArgs, interrupt: &Interrupt) -> Result<(), Failure> {
    args.stats.check()?;
    let scene = files::input(&args.scene)?;
    let output = files::output_of_kind(&args.output.output, Existing::from_flag(args.output.overwrite), "exr")?;
    let Frame { gbuffer, .. } = {
        let mut progress = Progress::new();
        progress.stage("rendering the G-buffer");
        interrupt.blocking(move || frame::render(&scene, args.camera)).await?
    };
    gbuffer.write(&output)?;
    note(format_args!("wrote {}", args.output.output.display()));
    let bytes = std::fs::metadata(&output).map_or(0, |metadata| metadata.len());
    let statistics = Statistics {
        holes: Some(gbuffer.hole_count() as f64),
        bytes_written: Some(bytes as f64),
        ..Default::default()
    };
    summary::report(&statistics, args.stats.stats.as_deref())
}
