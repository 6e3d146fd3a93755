//! `build`, `shade`, and what is done with jobs: `jobs`, `watch`, `cancel`.

use super::args::{DensityArgs, OctreeArgs, OutputArgs, QualityArgs, RunningArgs, ServerArgs, StatsArgs};
use super::failure::Failure;
use super::files::{self, Existing};
use super::interrupt::Interrupt;
use super::progress::Progress;
use super::session::{self, Work};
use super::summary;
use clap::Args;
use pbgi_client::{BuildJob, Job, JobState, ShadeJob};
use std::path::PathBuf;

const BUILD_EXAMPLES: &str = "\
Examples:
  pbgi-client build cloud.ply -o cloud.pbgi
  pbgi-client build hall.glb chairs.obj -o hall.pbgi --spacing 0.02 --memory 1G";

/// `build`
#[derive(Args, Debug)]
#[command(after_help = BUILD_EXAMPLES)]
pub(crate) struct BuildArgs {
    /// Meshes (.glb, .gltf, .obj), sampled and lit by their lights, and point clouds (.ply)
    #[arg(required = true, value_name = "INPUT")]
    inputs: Vec<PathBuf>,
    #[command(flatten)]
    output: OutputArgs,
    #[command(flatten)]
    density: DensityArgs,
    #[command(flatten)]
    octree: OctreeArgs,
    #[command(flatten)]
    stats: StatsArgs,
    #[command(flatten)]
    server: ServerArgs,
}

pub(crate) async fn build(args: BuildArgs, interrupt: &Interrupt) -> Result<(), Failure> {
    let existing = Existing::from_flag(args.output.overwrite);
    let job = BuildJob {
        inputs: files::inputs(&args.inputs)?,
        output: files::output(&args.output.output, existing)?,
        overwrite: existing.replaces(),
        settings: args.octree.settings()?,
        density: args.density.density(),
    };
    run(Work::Build(job), &args.output, &args.stats, &args.server, interrupt).await
}

const SHADE_EXAMPLES: &str = "\
Example:
  pbgi-client shade hall.pbgi --gbuffer passes.exr -o indirect.exr --environment sky.hdr

The G-buffer is an EXR file with world-space P and N. The output has the layers indirect (irradiance), occlusion (0 open,
1 closed) and bentnormal; the root R, G, B equal indirect.";

/// `shade`
#[derive(Args, Debug)]
#[command(after_help = SHADE_EXAMPLES)]
pub(crate) struct ShadeArgs {
    /// A scene made by build
    #[arg(value_name = "NAME.pbgi")]
    scene: PathBuf,
    /// World-space positions and normals of the pixels, an EXR file
    #[arg(long, value_name = "G.exr")]
    gbuffer: PathBuf,
    #[command(flatten)]
    output: OutputArgs,
    #[command(flatten)]
    quality: QualityArgs,
    #[command(flatten)]
    stats: StatsArgs,
    #[command(flatten)]
    server: ServerArgs,
}

pub(crate) async fn shade(args: ShadeArgs, interrupt: &Interrupt) -> Result<(), Failure> {
    let existing = Existing::from_flag(args.output.overwrite);
    let job = ShadeJob {
        settings: args.quality.settings()?,
        scene: files::input(&args.scene)?,
        gbuffer: files::input(&args.gbuffer)?,
        output: files::output_of_kind(&args.output.output, existing, "exr")?,
        overwrite: existing.replaces(),
        environment: args.quality.environment.as_deref().map(files::input).transpose()?,
        workers: args.server.job_workers(),
    };
    run(Work::Shade(job), &args.output, &args.stats, &args.server, interrupt).await
}

async fn run(
    work: Work,
    output: &OutputArgs,
    stats: &StatsArgs,
    server: &ServerArgs,
    interrupt: &Interrupt,
) -> Result<(), Failure> {
    stats.check()?;
    let statistics = {
        let mut progress = Progress::new();
        let client = session::connect(server, interrupt, &progress).await?;
        session::run(&client, &work, interrupt, &mut progress).await?
    };
    eprintln!("wrote {}", output.output.display());
    summary::report(&statistics, stats.stats.as_deref())
}

/// `jobs`
#[derive(Args, Debug)]
pub(crate) struct ListArgs {
    #[command(flatten)]
    running: RunningArgs,
}

pub(crate) async fn list(args: ListArgs, interrupt: &Interrupt) -> Result<(), Failure> {
    let jobs = interrupt.guard(async {
        let mut jobs = Vec::new();
        for client in session::running(&args.running).await? {
            jobs.extend(client.list().await?);
        }
        Ok(jobs)
    });
    let jobs = jobs.await?;
    if jobs.is_empty() {
        eprintln!("no jobs yet");
    }
    let width = jobs.iter().map(|job| job.id.len()).max().unwrap_or(0);
    for job in &jobs {
        println!(
            "{:width$}  {:9}  {:>5}  {}",
            job.id,
            job.state.name(),
            share(job),
            job.title
        );
        if job.state == JobState::Failed {
            println!("{:width$}  {}", "", job.error);
        }
    }
    Ok(())
}

/// How far a running job's stage is.
fn share(job: &Job) -> String {
    let running = job.state == JobState::Running && job.total > 0;
    let percent = || (job.done.min(job.total) * 100).checked_div(job.total);
    let percent = running.then(percent).flatten();
    percent.map_or_else(String::new, |percent| format!("{percent} %"))
}

/// `watch`
#[derive(Args, Debug)]
pub(crate) struct WatchArgs {
    /// The job, as jobs lists it
    #[arg(value_name = "JOB")]
    job: String,
    #[command(flatten)]
    stats: StatsArgs,
    #[command(flatten)]
    running: RunningArgs,
}

pub(crate) async fn watch(args: WatchArgs, interrupt: &Interrupt) -> Result<(), Failure> {
    args.stats.check()?;
    let job = {
        let mut progress = Progress::new();
        let watched = async {
            let (client, _) = session::find_job(&args.running, &args.job).await?;
            Ok::<Job, Failure>(client.watch(&args.job, |job| progress.job(job)).await?)
        };
        tokio::select! {
            job = watched => job?,
            () = interrupt.wait() => return Err(Failure::Interrupted("the job goes on".to_owned())),
        }
    };
    let statistics = session::ended(&job)?;
    eprintln!("{} succeeded", job.id);
    summary::report(&statistics, args.stats.stats.as_deref())
}

/// `cancel`
#[derive(Args, Debug)]
pub(crate) struct CancelArgs {
    /// The job, as jobs lists it
    #[arg(value_name = "JOB")]
    job: String,
    #[command(flatten)]
    running: RunningArgs,
}

pub(crate) async fn cancel(args: CancelArgs, interrupt: &Interrupt) -> Result<(), Failure> {
    let job = interrupt.guard(async {
        let (client, before) = session::find_job(&args.running, &args.job).await?;
        if before.state.ended() {
            return Ok(before);
        }
        Ok(client.cancel(&args.job).await?)
    });
    let job = job.await?;
    let state = if job.state.ended() {
        job.state.name()
    } else {
        "being cancelled"
    };
    println!("{} is {state}", job.id);
    Ok(())
}
