//! `build`, `shade`, and what is done with jobs: `jobs`, `watch`, `cancel`.

use super::answer::{note, say};
use super::args::{
    CloudArgs, DensityArgs, FormArgs, JobArgs, OctreeArgs, OutputArgs, PassArgs, QualityArgs, RunningArgs, SeenArgs,
    ServerArgs, StatsArgs,
};
use super::failure::Failure;
use super::files::{self, Existing};
use super::interrupt::Interrupt;
use super::look::{Look, LookArgs};
use super::progress::Progress;
use super::render::temporary_folder;
use super::session::{self, Work};
use super::summary;
use super::view::Seen;
use clap::Args;
use pbgi_client::{BuildJob, Job, JobState, ShadeJob};
use pbgi_points::LayeredImage;
use std::f32::consts::FRAC_1_PI;
use std::path::{Path, PathBuf};

const BUILD_EXAMPLES: &str = "\
Examples:
  pbgi-client build cloud.ply -o cloud.pbgi
  pbgi-client build hall.glb chairs.obj -o hall.pbgi --spacing 0.02 --memory 1G
  pbgi-client build tile1.laz tile2.laz -o town.pbgi --estimate-normals --radius auto";

/// `build`
#[derive(Args, Debug)]
#[command(after_help = BUILD_EXAMPLES)]
pub(crate) struct BuildArgs {
    /// Meshes (.glb, .gltf, .obj, .usd, .ply with faces) and scene files (.toml), sampled and lit by their lights; point clouds (.ply, .las, .laz, .ptc), of which those of
    /// the LAS family are turned so that y is up; scenes (.pbgi) whose points are built again
    #[arg(required = true, value_name = "INPUT")]
    inputs: Vec<PathBuf>,
    #[command(flatten)]
    output: OutputArgs,
    #[command(flatten)]
    density: DensityArgs,
    #[command(flatten)]
    cloud: CloudArgs,
    #[command(flatten)]
    octree: OctreeArgs,
    #[command(flatten)]
    job: JobArgs,
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
        cloud: args.cloud.options(),
    };
    args.cloud.say_origin(&job.inputs)?;
    run(
        Work::Build(job),
        &args.output,
        &args.job,
        &args.stats,
        &args.server,
        interrupt,
    )
    .await
}

const SHADE_EXAMPLES: &str = "\
Examples:
  pbgi-client shade hall.pbgi --gbuffer passes.exr -o indirect.exr --environment sky.hdr
  pbgi-client shade hall.pbgi --gbuffer passes.exr --position Pcam --normal Ncam --space camera -o indirect.exr
  pbgi-client shade town.pbgi --camera auto -o indirect.exr

The G-buffer is an EXR file with P and N; without one, what a camera sees is found among the points. The output has the layers indirect (irradiance), occlusion (0 open, 1 closed) and
bentnormal; the root R, G, B equal indirect. Cryptomatte layers and the header's attributes go into it as they are.";

/// `shade`
#[derive(Args, Debug)]
#[command(after_help = SHADE_EXAMPLES)]
pub(crate) struct ShadeArgs {
    /// A scene made by build
    #[arg(value_name = "NAME.pbgi")]
    scene: PathBuf,
    /// World-space positions and normals of the pixels, an EXR file
    #[arg(long, value_name = "G.exr")]
    gbuffer: Option<PathBuf>,
    #[command(flatten)]
    passes: PassArgs,
    #[command(flatten)]
    look: LookArgs,
    #[command(flatten)]
    output: OutputArgs,
    #[command(flatten)]
    seen: SeenArgs,
    #[command(flatten)]
    quality: QualityArgs,
    #[command(flatten)]
    job: JobArgs,
    #[command(flatten)]
    stats: StatsArgs,
    #[command(flatten)]
    server: ServerArgs,
}

pub(crate) async fn shade(args: ShadeArgs, interrupt: &Interrupt) -> Result<(), Failure> {
    let existing = Existing::from_flag(args.output.overwrite);
    let look = args.look.check(existing)?;
    let folder;
    let gbuffer = match (&args.gbuffer, args.seen.is_given()) {
        (Some(path), false) => files::input(path)?,
        (None, true) if !args.job.detach => {
            folder = temporary_folder()?;
            folder.path().join("gbuffer.exr")
        }
        (None, true) => {
            return Err(Failure::usage(
                "--detach is for a G-buffer that is there: give --gbuffer",
            ));
        }
        _ => {
            return Err(Failure::usage(
                "give either --gbuffer or a camera: --camera, --camera-file or --eye",
            ));
        }
    };
    let job = ShadeJob {
        settings: args.quality.settings()?,
        scene: args.job.scene(&args.scene)?,
        gbuffer,
        passes: args.passes.options(),
        output: files::output_of_kind(&args.output.output, existing, "exr")?,
        overwrite: existing.replaces(),
        environment: args.quality.environment.as_deref().map(files::input).transpose()?,
        workers: args.server.job_workers(),
    };
    let output = job.output.clone();
    if look.wanted() && (args.job.detach || files::in_a_root(&output)) {
        return Err(Failure::usage(
            "--png and --preview need the finished picture here: leave out --detach, and let -o name a file of this machine",
        ));
    }
    if args.gbuffer.is_none() {
        let seen = Seen {
            scene: job.scene.clone(),
            workers: job.workers,
            settings: job.settings,
        };
        let mut progress = Progress::new();
        let client = session::connect(&args.server, interrupt, &progress).await?;
        let (gbuffer, _) = seen.gbuffer(&args.seen, &client, interrupt, &mut progress).await?;
        gbuffer.write(&job.gbuffer)?;
    }
    run(
        Work::Shade(job),
        &args.output,
        &args.job,
        &args.stats,
        &args.server,
        interrupt,
    )
    .await?;
    if look.wanted() {
        show_irradiance(&look, &output)?;
    }
    Ok(())
}

/// Shows irradiance as a white surface reflects it.
fn show_irradiance(look: &Look, picture: &Path) -> Result<(), Failure> {
    let image = LayeredImage::read_exr_channels(picture, |name| name.starts_with("indirect."))?;
    let irradiance = image.triple("indirect").unwrap_or_default();
    let radiance: Vec<[f32; 3]> = irradiance
        .iter()
        .map(|pixel| pixel.map(|value| value * FRAC_1_PI))
        .collect();
    look.show(image.data_window, &radiance)
}

async fn run(
    work: Work,
    output: &OutputArgs,
    job: &JobArgs,
    stats: &StatsArgs,
    server: &ServerArgs,
    interrupt: &Interrupt,
) -> Result<(), Failure> {
    stats.check()?;
    let statistics = {
        let mut progress = Progress::new();
        let client = session::connect(server, interrupt, &progress).await?;
        let options = job.options();
        let submitted = session::submit(&client, &work, job.job_id.as_deref(), &options, &progress);
        let submitted = interrupt.guard(submitted).await?;
        if job.detach {
            return say(&submitted.id);
        }
        session::follow(&client, &submitted.id, interrupt, &mut progress).await?
    };
    note(format_args!("wrote {}", output.output.display()));
    summary::report(&statistics, stats.stats.as_deref())
}

/// `jobs`
#[derive(Args, Debug)]
pub(crate) struct ListArgs {
    /// One job in full, with its history
    #[arg(value_name = "JOB")]
    job: Option<String>,
    #[command(flatten)]
    form: FormArgs,
    #[command(flatten)]
    running: RunningArgs,
}

pub(crate) async fn list(args: ListArgs, interrupt: &Interrupt) -> Result<(), Failure> {
    if let Some(id) = &args.job {
        let (_, job) = interrupt.guard(session::find_job(&args.running, id)).await?;
        return say(&match args.form.json {
            true => summary::pretty(&job),
            false => in_full(&job),
        });
    }
    let jobs = interrupt.guard(async {
        let mut jobs = Vec::new();
        for client in session::running(&args.running).await? {
            jobs.extend(client.list().await?);
        }
        Ok(jobs)
    });
    let jobs = jobs.await?;
    if args.form.json {
        return say(&summary::pretty(&jobs));
    }
    if jobs.is_empty() {
        note(format_args!("no jobs yet"));
    }
    let width = jobs.iter().map(|job| job.id.len()).max().unwrap_or(0);
    for job in &jobs {
        say(&format!(
            "{:width$}  {:9}  {:>5}  {}",
            job.id,
            standing(job),
            share(job),
            job.title
        ))?;
        if job.state == JobState::Failed {
            say(&format!("{:width$}  {}", "", job.error))?;
        }
    }
    Ok(())
}

fn in_full(job: &Job) -> String {
    let options = &job.options;
    let words = |(name, value): (&String, &String)| format!("{name}={value}");
    let labels: Vec<String> = options.labels.iter().map(words).collect();
    let rows = [
        ("job", job.id.clone()),
        ("task", job.title.clone()),
        (
            "state",
            [standing(job), doing(job), &share(job)]
                .join(" ")
                .trim()
                .replace("  ", " "),
        ),
        ("user", options.user.clone()),
        ("labels", labels.join(" ")),
        ("priority", options.priority.to_string()),
        ("after", options.after.join(" ")),
        ("error", job.error.clone()),
    ];
    let given = rows.iter().filter(|(_, value)| !value.is_empty());
    let mut text: String = given.map(|(name, value)| format!("{name:9} {value}\n")).collect();
    for event in &job.history {
        text.push_str(&format!("{}  {}\n", utc(event.unix_millis), event.text));
    }
    text
}

/// Date and time in UTC.
fn utc(unix_millis: i64) -> String {
    let (days, millis) = (unix_millis.div_euclid(86_400_000), unix_millis.rem_euclid(86_400_000));
    // The civil calendar repeats every 400 years; years are counted from March, so that the leap day comes last.
    let shifted = days + 719_468;
    let (era, day) = (shifted.div_euclid(146_097), shifted.rem_euclid(146_097));
    let year = (day - day / 1_460 + day / 36_524 - day / 146_096) / 365;
    let day = day - (365 * year + year / 4 - year / 100);
    let month = (5 * day + 2) / 153;
    let (date, month_number) = (
        day - (153 * month + 2) / 5 + 1,
        if month < 10 { month + 3 } else { month - 9 },
    );
    let year = year + era * 400 + i64::from(month_number <= 2);
    let (hours, minutes, seconds) = (millis / 3_600_000, millis / 60_000 % 60, millis / 1_000 % 60);
    format!("{year:04}-{month_number:02}-{date:02}T{hours:02}:{minutes:02}:{seconds:02}Z")
}

/// Where a job is, in a word.
fn standing(job: &Job) -> &str {
    match job.stage.as_str() {
        // It waits for somebody, not for its turn.
        rest @ ("paused" | "pausing") => rest,
        _ => job.state.name(),
    }
}

/// What a running job does.
fn doing(job: &Job) -> &str {
    match job.state {
        JobState::Running if standing(job) == job.state.name() => &job.stage,
        _ => "",
    }
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
    note(format_args!("{} succeeded", job.id));
    summary::report(&statistics, args.stats.stats.as_deref())
}

/// `cancel` and `pause`
#[derive(Args, Debug)]
pub(crate) struct CancelArgs {
    /// The job, as jobs lists it
    #[arg(value_name = "JOB")]
    job: String,
    /// Why, for the job's history
    #[arg(long, value_name = "TEXT", default_value = "")]
    reason: String,
    #[command(flatten)]
    running: RunningArgs,
}

pub(crate) async fn cancel(args: CancelArgs, interrupt: &Interrupt) -> Result<(), Failure> {
    let job = interrupt.guard(async {
        let (client, before) = session::find_job(&args.running, &args.job).await?;
        if before.state.ended() {
            return Ok(before);
        }
        Ok(client.cancel(&args.job, &args.reason).await?)
    });
    let job = job.await?;
    let state = if job.state.ended() {
        job.state.name()
    } else {
        "being cancelled"
    };
    say(&format!("{} is {state}", job.id))
}

pub(crate) async fn pause(args: CancelArgs, interrupt: &Interrupt) -> Result<(), Failure> {
    let job = interrupt.guard(async {
        let (client, _) = session::find_job(&args.running, &args.job).await?;
        Ok(client.pause(&args.job, &args.reason).await?)
    });
    let job = job.await?;
    say(&format!("{} is {}", job.id, standing(&job)))
}

/// `resume` and `retry`
#[derive(Args, Debug)]
pub(crate) struct JobNameArgs {
    /// The job, as jobs lists it
    #[arg(value_name = "JOB")]
    job: String,
    #[command(flatten)]
    running: RunningArgs,
}

pub(crate) async fn resume(args: JobNameArgs, interrupt: &Interrupt) -> Result<(), Failure> {
    let job = interrupt.guard(async {
        let (client, _) = session::find_job(&args.running, &args.job).await?;
        Ok(client.resume(&args.job).await?)
    });
    let job = job.await?;
    say(&format!("{} is {}", job.id, standing(&job)))
}

pub(crate) async fn retry(args: JobNameArgs, interrupt: &Interrupt) -> Result<(), Failure> {
    let job = interrupt.guard(async {
        let (client, _) = session::find_job(&args.running, &args.job).await?;
        Ok(client.retry(&args.job).await?)
    });
    let job = job.await?;
    say(&format!("{} is {}", job.id, standing(&job)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_told_in_utc() {
        for (millis, text) in [
            (0, "1970-01-01T00:00:00Z"),
            (951_827_696_789, "2000-02-29T12:34:56Z"),
            (1_795_586_400_000, "2026-11-25T06:00:00Z"),
            (-1, "1969-12-31T23:59:59Z"),
        ] {
            assert_eq!(utc(millis), text);
        }
    }
}
