//! `sample` and `gbuffer`: what is made of a mesh here, without a daemon.

use super::args::{CameraArgs, DensityArgs, OutputArgs, StatsArgs};
use super::failure::Failure;
use super::files::{self, Existing};
use super::frame;
use super::interrupt::Interrupt;
use super::progress::Progress;
use super::summary;
use clap::Args;
use pbgi_core::{Bounds, PointRecord, PointStream, Statistics};
use pbgi_points::{BoxedPointStream, PointsError, SampleOptions, open_input, write_point_ply};
use std::path::{Path, PathBuf};

const SAMPLE_EXAMPLES: &str = "\
Example:
  pbgi-client sample hall.glb -o hall.ply --spacing 0.02

Points carry the radiance that leaves them: direct light reflected once, and emission.";

/// `sample`
#[derive(Args, Debug)]
#[command(after_help = SAMPLE_EXAMPLES)]
pub(crate) struct SampleArgs {
    /// Meshes that light each other: .glb, .gltf, .obj
    #[arg(required = true, value_name = "SCENE")]
    inputs: Vec<PathBuf>,
    #[command(flatten)]
    output: OutputArgs,
    #[command(flatten)]
    density: DensityArgs,
    #[command(flatten)]
    stats: StatsArgs,
}

pub(crate) async fn sample(args: SampleArgs, interrupt: &Interrupt) -> Result<(), Failure> {
    args.stats.check()?;
    let inputs = files::inputs(&args.inputs)?;
    let output = files::output_of_kind(&args.output.output, Existing::from_flag(args.output.overwrite), "ply")?;
    let mut options = SampleOptions::default();
    options.density = args.density.density().unwrap_or(options.density);
    let aside = interrupt.clone();
    // Not given up on a signal: the stream sees it, so that the half-written file is removed.
    let written = tokio::task::spawn_blocking(move || write_points(&inputs, &output, &options, aside)).await;
    let statistics = written.unwrap_or_else(|error| Err(Failure::failed(format!("defect: {error}"))))?;
    eprintln!("wrote {}", args.output.output.display());
    summary::report(&statistics, args.stats.stats.as_deref())
}

fn write_points(
    inputs: &[PathBuf],
    output: &Path,
    options: &SampleOptions,
    interrupt: Interrupt,
) -> Result<Statistics, Failure> {
    let mut progress = Progress::new();
    progress.stage("loading");
    let inner = open_input(inputs, options)?;
    let mut stream = Observed {
        total: inner.len_hint().unwrap_or(0),
        inner,
        progress,
        interrupt,
        count: 0,
    };
    write_point_ply(output, &mut stream).map_err(|error| match stream.interrupt.asked() {
        true => Failure::Interrupted("nothing was written".to_owned()),
        false => Failure::from(error),
    })?;
    let bytes = std::fs::metadata(output).map_or(0, |metadata| metadata.len());
    Ok(Statistics {
        points: Some(stream.count as f64),
        bytes_written: Some(bytes as f64),
        ..Default::default()
    })
}

/// A stream whose progress is shown and that ends when the user interrupts.
struct Observed {
    inner: BoxedPointStream,
    progress: Progress,
    interrupt: Interrupt,
    count: u64,
    total: u64,
}

impl PointStream for Observed {
    type Error = PointsError;

    fn bounds(&self) -> Option<Bounds> {
        self.inner.bounds()
    }

    fn len_hint(&self) -> Option<u64> {
        self.inner.len_hint()
    }

    fn next_batch(&mut self, batch: &mut Vec<PointRecord>) -> Result<bool, PointsError> {
        if self.interrupt.asked() {
            return Err(PointsError::Request("interrupted".to_owned()));
        }
        let before = batch.len();
        let more = self.inner.next_batch(batch)?;
        self.count += (batch.len() - before) as u64;
        self.progress.show("sampling", self.count, self.total);
        Ok(more)
    }

    fn rewind(&mut self) -> Result<(), PointsError> {
        self.count = 0;
        self.inner.rewind()
    }
}

const GBUFFER_EXAMPLES: &str = "\
Example:
  pbgi-client gbuffer hall.glb --camera 0 --size 1920x1080 -o g.exr

Writes P and N in world space, albedo, direct (irradiance of the punctual lights), emission and A.";

/// `gbuffer`
#[derive(Args, Debug)]
#[command(after_help = GBUFFER_EXAMPLES)]
pub(crate) struct GbufferArgs {
    /// A mesh: .glb, .gltf, .obj
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
    let gbuffer = {
        let mut progress = Progress::new();
        progress.stage("rendering the G-buffer");
        interrupt.blocking(move || frame::render(&scene, args.camera)).await?
    };
    gbuffer.write(&output)?;
    eprintln!("wrote {}", args.output.output.display());
    let bytes = std::fs::metadata(&output).map_or(0, |metadata| metadata.len());
    let statistics = Statistics {
        holes: Some(gbuffer.hole_count() as f64),
        bytes_written: Some(bytes as f64),
        ..Default::default()
    };
    summary::report(&statistics, args.stats.stats.as_deref())
}
