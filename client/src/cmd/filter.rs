//! `filter`: what a scene's light does at the points of a cloud, baked onto the cloud.

use super::answer::note;
use super::args::{OutputArgs, QualityArgs, ReadingArgs, ServerArgs, StatsArgs};
use super::failure::Failure;
use super::files::{self, Existing};
use super::interrupt::Interrupt;
use super::progress::Progress;
use super::session;
use super::summary;
use clap::{Args, ValueEnum};
use pbgi_client::LiveJob;
use pbgi_core::{Bounds, SceneInfo};
use pbgi_points::{
    BakeChannel, BakeOptions, BakedValues, InputOptions, LasForm, PointsError, Receiver, Receivers, check_bake,
    write_baked,
};
use std::collections::VecDeque;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::time::Instant;
use tokio::sync::mpsc;

const FILTER_EXAMPLES: &str = "\
Examples:
  pbgi-client filter town.pbgi -o town.ply
      The scene's own points with occlusion and irradiance.
  pbgi-client filter town.pbgi tile1.laz -o tile1_lit.laz --channels sky,irradiance --environment sky.hdr
  pbgi-client filter town.pbgi tile1.laz -o tile1_shaded.laz --as rgb,intensity

The output has the points of the cloud in their order, with everything else that they had. Occlusion is 0 in the open and 1
inside; sky is 1 - occlusion; irradiance is W/m2. LAS and LAZ carry them as extra dimensions.";

/// Memory for bringing a cloud into order; what does not fit goes to scratch.
const ORDER_MEMORY_BYTES: u64 = 64 << 20;
/// Blocks of receivers that wait for the daemon.
const BLOCKS_AHEAD: usize = 2;
/// Receivers of a block: sixteen tiles.
const BLOCK_RECEIVERS: usize = 1 << 14;

/// `filter`
#[derive(Args, Debug)]
#[command(after_help = FILTER_EXAMPLES)]
pub(crate) struct FilterArgs {
    /// A scene made by build
    #[arg(value_name = "NAME.pbgi")]
    scene: PathBuf,
    /// The cloud: .ply, .las, .laz, .ptc, .pbgi; points without normals get them [default: the scene's own points]
    #[arg(value_name = "IN")]
    input: Option<PathBuf>,
    #[command(flatten)]
    output: OutputArgs,
    /// What is baked, with commas between
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_values = ["occlusion", "irradiance"])]
    channels: Vec<ChannelArg>,
    /// How LAS and LAZ carry it, with commas between: extra dimensions; the sky visibility as intensity; the colours darkened by it
    #[arg(long = "as", value_name = "LIST", value_delimiter = ',')]
    forms: Vec<FormArg>,
    #[command(flatten)]
    reading: ReadingArgs,
    #[command(flatten)]
    quality: QualityArgs,
    /// Higher ones go first, -1000 to 1000
    #[arg(
        long,
        value_name = "N",
        default_value_t = 0,
        allow_negative_numbers = true,
        help_heading = "Job"
    )]
    priority: i32,
    #[command(flatten)]
    stats: StatsArgs,
    #[command(flatten)]
    server: ServerArgs,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum ChannelArg {
    Occlusion,
    Sky,
    Irradiance,
    Bentnormal,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum FormArg {
    Extra,
    Intensity,
    Rgb,
}

impl From<ChannelArg> for BakeChannel {
    fn from(channel: ChannelArg) -> Self {
        match channel {
            ChannelArg::Occlusion => Self::Occlusion,
            ChannelArg::Sky => Self::Sky,
            ChannelArg::Irradiance => Self::Irradiance,
            ChannelArg::Bentnormal => Self::BentNormal,
        }
    }
}

impl From<FormArg> for LasForm {
    fn from(form: FormArg) -> Self {
        match form {
            FormArg::Extra => Self::Extra,
            FormArg::Intensity => Self::Intensity,
            FormArg::Rgb => Self::Rgb,
        }
    }
}

/// Everything about a bake that was checked before work began.
struct Plan {
    input: PathBuf,
    output: PathBuf,
    bake: BakeOptions,
    reading: InputOptions,
    job: LiveJob,
}

pub(crate) async fn filter(args: FilterArgs, interrupt: &Interrupt) -> Result<(), Failure> {
    args.stats.check()?;
    let mut plan = plan(&args)?;
    let mut progress = Progress::new();
    let client = session::connect(&args.server, interrupt, &progress).await?;
    let info = interrupt
        .guard(async { Ok(client.scene(&plan.job.scene).await?) })
        .await?;
    let origin = plan.reading.cloud.origin.get_or_insert(info.origin);
    if *origin != [0.0; 3] && plan.input != plan.job.scene {
        let [x, y, z] = *origin;
        progress.say(&format!(
            "positions are relative to {x},{y},{z} of the file, as the scene's are"
        ));
    }
    let started = Instant::now();
    let ordered = order(&plan, &info, interrupt, &mut progress).await?;
    let sort_seconds = started.elapsed().as_secs_f64();
    let count = ordered.receivers.count();
    let mut values = BakedValues::create(&plan.reading.scratch_dir, count)?;
    // The first values come when the scenes of further bounces are made.
    progress.stage(match plan.job.settings.bounces {
        ..=1 => "shading",
        _ => "bouncing the light",
    });
    let (mut statistics, skipped) = {
        let (blocks, receivers) = mpsc::channel(BLOCKS_AHEAD);
        let (places, mut shaded_places) = std::sync::mpsc::channel();
        let feeder = tokio::task::spawn_blocking(move || feed(ordered, &blocks, &places));
        let (mut waiting, mut done) = (VecDeque::new(), 0);
        let take = |block: &[[f32; 7]]| -> Result<(), Failure> {
            for &shaded in block {
                let place = next_place(&mut waiting, &mut shaded_places)?;
                values.put(place, shaded)?;
            }
            done += block.len() as u64;
            progress.show("shading", done, count);
            Ok(())
        };
        let statistics = interrupt.guard(client.shade_points(&plan.job, receivers, take)).await?;
        let skipped = feeder
            .await
            .unwrap_or_else(|error| Err(Failure::failed(format!("defect: {error}"))))?;
        (statistics, skipped)
    };
    values.flush()?;
    let aside = interrupt.clone();
    // Not given up on a signal: the writer sees it, and removes the half-written file.
    let written = tokio::task::spawn_blocking(move || write(&plan, &values, count, &mut progress, &aside)).await;
    let bytes = written.unwrap_or_else(|error| Err(Failure::failed(format!("defect: {error}"))))?;
    note(format_args!("wrote {}", args.output.output.display()));
    statistics.bytes_written = Some(bytes as f64);
    statistics.sort_seconds = Some(sort_seconds);
    statistics.points_skipped = Some(skipped as f64);
    summary::report(&statistics, args.stats.stats.as_deref())
}

fn plan(args: &FilterArgs) -> Result<Plan, Failure> {
    let scene = files::input(&args.scene)?;
    let input = args.input.as_deref().map(files::input).transpose()?;
    let input = input.unwrap_or_else(|| scene.clone());
    let output = files::output(&args.output.output, Existing::from_flag(args.output.overwrite))?;
    check_bake(&input, &output)?;
    if output == input {
        let text = format!("{output:?} is the input: choose another name with -o");
        return Err(Failure::usage(text));
    }
    let is_las = |path: &Path| {
        ["las", "laz"]
            .iter()
            .any(|kind| path.extension().is_some_and(|name| name.eq_ignore_ascii_case(kind)))
    };
    if !args.forms.is_empty() && !is_las(&output) {
        return Err(Failure::usage(
            "--as is for LAS and LAZ; PLY has a property for every number",
        ));
    }
    let cloud = args.reading.options();
    let forms = if args.forms.is_empty() {
        &[FormArg::Extra][..]
    } else {
        &args.forms
    };
    Ok(Plan {
        bake: BakeOptions {
            channels: args.channels.iter().map(|&channel| channel.into()).collect(),
            las: forms.iter().map(|&form| form.into()).collect(),
            invalid_points: cloud.invalid_points,
        },
        reading: InputOptions {
            cloud,
            memory_bytes: ORDER_MEMORY_BYTES,
            ..InputOptions::default()
        },
        job: LiveJob {
            scene,
            settings: args.quality.settings()?,
            environment: args.quality.environment.as_deref().map(files::input).transpose()?,
            priority: Some(args.priority),
            workers: args.server.job_workers(),
        },
        input,
        output,
    })
}

/// Receivers that are ready to be handed out.
struct Ordered {
    receivers: Receivers,
    first: Vec<Receiver>,
}

/// Opens the cloud and brings it into order.
async fn order(
    plan: &Plan,
    info: &SceneInfo,
    interrupt: &Interrupt,
    progress: &mut Progress,
) -> Result<Ordered, Failure> {
    progress.stage("bringing the points into order");
    let (input, options, aside) = (plan.input.clone(), plan.reading.clone(), interrupt.clone());
    let opened = move || {
        let mut receivers = Receivers::open(&input, &options)?;
        let mut first = Vec::new();
        while first.is_empty() && !aside.asked() && receivers.next_batch(&mut first)? {}
        Ok(Ordered { receivers, first })
    };
    let ordered = interrupt.blocking(opened).await?;
    match (ordered.receivers.bounds(), info.bounds) {
        (Some(cloud), Some(scene)) if is_far(&cloud, &scene) => Err(Failure::failed(format!(
            "the cloud lies from {:?} to {:?}, far from the scene, which lies from {:?} to {:?}: give --origin as when the \
             scene was built, in {:?}",
            cloud.min, cloud.max, scene.min, scene.max, plan.input
        ))),
        _ => Ok(ordered),
    }
}

/// Whether boxes are further apart than the second one is large.
fn is_far(cloud: &Bounds, scene: &Bounds) -> bool {
    let reach = scene.diagonal();
    !cloud.is_empty()
        && (0..3).any(|axis| cloud.min[axis] > scene.max[axis] + reach || cloud.max[axis] < scene.min[axis] - reach)
}

/// Hands receivers to the stream, and their places to whoever takes the values; points that were dropped.
fn feed(
    ordered: Ordered,
    blocks: &mpsc::Sender<Vec<[f32; 6]>>,
    places: &std::sync::mpsc::Sender<Vec<u64>>,
) -> Result<u64, Failure> {
    let Ordered {
        mut receivers,
        first: mut batch,
    } = ordered;
    loop {
        for block in batch.chunks(BLOCK_RECEIVERS) {
            let numbers = |receiver: &Receiver| {
                let ([x, y, z], [nx, ny, nz]) = (receiver.position, receiver.normal);
                [x, y, z, nx, ny, nz]
            };
            // Who left does not listen: the stream has ended with an error, which is told there.
            let _ = places.send(block.iter().map(|receiver| receiver.place).collect());
            if blocks.blocking_send(block.iter().map(numbers).collect()).is_err() {
                return Ok(receivers.skipped());
            }
        }
        batch.clear();
        if !receivers.next_batch(&mut batch)? {
            return Ok(receivers.skipped());
        }
    }
}

/// The place of the next value: they come in the order of the receivers.
fn next_place(waiting: &mut VecDeque<u64>, places: &mut std::sync::mpsc::Receiver<Vec<u64>>) -> Result<u64, Failure> {
    if waiting.is_empty()
        && let Ok(block) = places.try_recv()
    {
        waiting.extend(block);
    }
    let place = waiting.pop_front();
    place.ok_or_else(|| Failure::failed("the daemon's answer has values for receivers that were never sent"))
}

/// Writes the cloud with what was baked; the bytes of the file.
fn write(
    plan: &Plan,
    values: &BakedValues,
    count: u64,
    progress: &mut Progress,
    interrupt: &Interrupt,
) -> Result<u64, Failure> {
    let mut observer = |done| {
        progress.show("writing", done, count);
        match interrupt.asked() {
            true => ControlFlow::Break(()),
            false => ControlFlow::Continue(()),
        }
    };
    match write_baked(&plan.input, &plan.output, values, &plan.bake, &mut observer) {
        Err(PointsError::Cancelled) => Err(Failure::Interrupted("nothing was written".to_owned())),
        Err(error) => Err(error.into()),
        Ok(_) => Ok(std::fs::metadata(&plan.output).map_or(0, |metadata| metadata.len())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cloud_that_was_moved_by_another_origin_is_far() {
        let of = |min: f32, max: f32| Bounds {
            min: [min; 3],
            max: [max; 3],
        };
        assert!(!is_far(&of(0.0, 1.0), &of(0.5, 2.0)));
        assert!(!is_far(&of(0.0, 1.0), &of(1.5, 2.0)));
        assert!(is_far(&of(5_000.0, 5_001.0), &of(0.0, 100.0)));
        assert!(!is_far(&Bounds::EMPTY, &of(0.0, 1.0)));
    }
}
