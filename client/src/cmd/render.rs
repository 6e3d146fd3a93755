//! `render` and `demo`: from a mesh to a picture in one command.

use super::answer::note;
use super::args::{CameraArgs, DensityArgs, OutputArgs, QualityArgs, ServerArgs, Size, StatsArgs};
use super::composite::composite;
use super::failure::Failure;
use super::files::{self, Existing};
use super::frame::{self, Frame};
use super::interrupt::Interrupt;
use super::look::{ExposureArgs, Look, LookArgs};
use super::progress::Progress;
use super::scenes::{self, SceneCache};
use super::session::{self, Work};
use super::summary;
use clap::Args;
use pbgi_client::{BuildJob, Client, ShadeJob};
use pbgi_core::{BuildSettings, ShadeSettings, Statistics};
use pbgi_points::{CloudOptions, Density, GBuffer, GBufferOptions, LayeredImage, SampleOptions, Space, demo};
use std::path::{Path, PathBuf};

const RENDER_EXAMPLES: &str = "\
Examples:
  pbgi-client render hall.glb -o hall.exr
  pbgi-client render hall.glb -o hall.exr --png hall.png --size 1920x1080 --environment sky.hdr --memory 1G

The root R, G, B is the beauty: albedo / pi (direct + indirect) + emission; the parts, occlusion and bentnormal are layers.
The built scene stays in XDG_CACHE_HOME/pbgi/scenes, keyed by the mesh and its sampling: the next render of it is warm.";

/// `render`
#[derive(Args, Debug)]
#[command(after_help = RENDER_EXAMPLES)]
pub(crate) struct RenderArgs {
    /// A mesh with lights (.glb, .gltf, .obj, .usd, .ply with faces) or a scene file (.toml)
    #[arg(value_name = "SCENE")]
    scene: PathBuf,
    #[command(flatten)]
    output: OutputArgs,
    #[command(flatten)]
    look: LookArgs,
    #[command(flatten)]
    camera: CameraArgs,
    #[command(flatten)]
    density: DensityArgs,
    #[command(flatten)]
    quality: QualityArgs,
    #[command(flatten)]
    stats: StatsArgs,
    #[command(flatten)]
    server: ServerArgs,
}

/// `demo`
#[derive(Args, Debug)]
pub(crate) struct DemoArgs {
    /// The picture; the tone-mapped one lies beside it [default: demo.exr, replaced if it is there]
    #[arg(short, long, value_name = "OUT.exr")]
    output: Option<PathBuf>,
    /// Replace an existing output
    #[arg(long)]
    overwrite: bool,
    /// Pixels of the picture [default: 400x300]
    #[arg(long, value_name = "WxH", value_parser = super::args::picture_size)]
    size: Option<Size>,
    #[command(flatten)]
    exposure: ExposureArgs,
    #[command(flatten)]
    density: DensityArgs,
    #[command(flatten)]
    quality: QualityArgs,
    #[command(flatten)]
    stats: StatsArgs,
    #[command(flatten)]
    server: ServerArgs,
}

const DEMO_OUTPUT: &str = "demo.exr";
const DEMO_SIZE: Size = Size {
    width: 400,
    height: 300,
};
/// Enough for a smooth picture of a small room.
const DEMO_POINTS: u64 = 200_000;

/// Everything about a picture that was checked before work began.
struct Plan {
    input: PathBuf,
    output: PathBuf,
    look: Look,
    camera: CameraArgs,
    density: Density,
    settings: ShadeSettings,
    environment: Option<PathBuf>,
}

pub(crate) async fn render(args: RenderArgs, interrupt: &Interrupt) -> Result<(), Failure> {
    let existing = Existing::from_flag(args.output.overwrite);
    args.stats.check()?;
    let plan = Plan {
        settings: args.quality.settings()?,
        input: files::input(&args.scene)?,
        output: files::output_of_kind(&args.output.output, existing, "exr")?,
        look: args.look.check(existing)?,
        camera: args.camera,
        density: args
            .density
            .density_for(&args.camera)
            .unwrap_or(SampleOptions::default().density),
        environment: args.quality.environment.as_deref().map(files::input).transpose()?,
    };
    picture(&plan, &args.server, &args.stats, interrupt).await
}

pub(crate) async fn demo(args: DemoArgs, interrupt: &Interrupt) -> Result<(), Failure> {
    // The demo may be shown twice; a name that the user chose is the user's.
    let existing = Existing::from_flag(args.overwrite || args.output.is_none());
    let output = args.output.as_deref().unwrap_or(Path::new(DEMO_OUTPUT));
    args.stats.check()?;
    let folder = temporary_folder()?;
    let camera = CameraArgs {
        camera: None,
        size: Some(args.size.unwrap_or(DEMO_SIZE)),
    };
    let mut plan = Plan {
        settings: args.quality.settings()?,
        input: folder.path().join("demo.glb"),
        output: files::output_of_kind(output, existing, "exr")?,
        look: args
            .exposure
            .look(Some(files::output(&output.with_extension("png"), existing)?)),
        density: args
            .density
            .density_for(&camera)
            .unwrap_or(Density::Points(DEMO_POINTS)),
        camera,
        environment: args.quality.environment.as_deref().map(files::input).transpose()?,
    };
    demo::write_glb(&plan.input)?;
    plan.input = files::input(&plan.input)?;
    picture(&plan, &args.server, &args.stats, interrupt).await
}

async fn picture(plan: &Plan, server: &ServerArgs, stats: &StatsArgs, interrupt: &Interrupt) -> Result<(), Failure> {
    let folder = temporary_folder()?;
    let (statistics, gbuffer, shaded) = {
        let mut progress = Progress::new();
        progress.stage("rendering the G-buffer");
        let (input, camera) = (plan.input.clone(), plan.camera);
        let Frame { gbuffer, environment } = interrupt.blocking(move || frame::render(&input, camera)).await?;
        let passes = folder.path().join("gbuffer.exr");
        gbuffer.write(&passes)?;
        let environment = match (&plan.environment, environment) {
            (None, Some(surroundings)) => {
                let folder = folder.path().to_owned();
                let probe = interrupt.blocking(move || frame::light_probe(&surroundings, &folder));
                Some(probe.await?)
            }
            (given, _) => given.clone(),
        };
        let client = session::connect(server, interrupt, &progress).await?;
        let (scene, mut statistics) = scene(plan, &client, interrupt, &mut progress).await?;
        let shaded = folder.path().join("shaded.exr");
        let job = ShadeJob {
            scene,
            gbuffer: passes,
            // Our own passes need no second look.
            passes: GBufferOptions {
                space: Space::World,
                ..GBufferOptions::default()
            },
            output: shaded.clone(),
            overwrite: false,
            settings: plan.settings,
            environment,
            workers: server.job_workers(),
        };
        let shading = session::run(&client, &Work::Shade(job), interrupt, &mut progress).await?;
        add(&mut statistics, &shading);
        (statistics, gbuffer, shaded)
    };
    write(plan, &gbuffer, &shaded, &statistics)?;
    summary::report(&statistics, stats.stats.as_deref())
}

/// The scene of the mesh: the one that an earlier render left, or a new one.
async fn scene(
    plan: &Plan,
    client: &Client,
    interrupt: &Interrupt,
    progress: &mut Progress,
) -> Result<(PathBuf, Statistics), Failure> {
    let cache = SceneCache::open(&session::folders()?.cache)?;
    let (input, density) = (plan.input.clone(), plan.density);
    let digest = interrupt.blocking(move || scenes::digest(&input, density)).await?;
    let kept = interrupt.guard(cache.keep(&digest)).await?;
    let mut statistics = Statistics::default();
    if client.scene(&kept.scene).await.is_ok() {
        progress.say("using the scene that an earlier render built");
    } else {
        let job = BuildJob {
            inputs: vec![plan.input.clone()],
            output: kept.scene.clone(),
            // What lies there and cannot be opened is of no use.
            overwrite: true,
            settings: BuildSettings::default(),
            density: Some(plan.density),
            cloud: CloudOptions::default(),
        };
        match plan.density {
            Density::Points(points) => progress.say(&format!("sampling about {} points", summary::grouped(points))),
            Density::Spacing(spacing) => progress.say(&format!("sampling points {spacing} apart")),
            Density::View(view) => progress.say(&format!("sampling points {} pixels apart", view.pixels)),
        }
        statistics = session::run(client, &Work::Build(job), interrupt, progress).await?;
    }
    kept.mark(&plan.input);
    cache.trim();
    Ok((kept.scene.clone(), statistics))
}

/// One command, one record: bytes of both jobs, the higher peak, everything else from whichever job knows it.
pub(crate) fn add(statistics: &mut Statistics, shading: &Statistics) {
    let build = statistics.clone();
    statistics.update(shading);
    let sum = |a: Option<f64>, b: Option<f64>| a.into_iter().chain(b).reduce(|a, b| a + b);
    let most = |a: Option<f64>, b: Option<f64>| a.into_iter().chain(b).reduce(f64::max);
    statistics.bytes_read = sum(build.bytes_read, shading.bytes_read);
    statistics.bytes_written = sum(build.bytes_written, shading.bytes_written);
    statistics.peak_memory_bytes = most(build.peak_memory_bytes, shading.peak_memory_bytes);
}

fn write(plan: &Plan, gbuffer: &GBuffer, shaded: &Path, statistics: &Statistics) -> Result<(), Failure> {
    let image = composite(gbuffer, LayeredImage::read_exr(shaded)?, statistics)?;
    image.write_exr(&plan.output)?;
    note(format_args!("wrote {}", plan.output.display()));
    plan.look.show(image.data_window, &image.triple("").unwrap_or_default())
}

pub(crate) fn temporary_folder() -> Result<tempfile::TempDir, Failure> {
    let folder = tempfile::Builder::new().prefix("pbgi-render-").tempdir();
    folder.map_err(|error| {
        Failure::failed(format!(
            "cannot make a temporary folder: {error}; set TMPDIR to one that has room"
        ))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_record_of_a_render_covers_both_jobs() {
        let mut statistics = Statistics {
            build_seconds: Some(2.0),
            bytes_read: Some(10.0),
            peak_memory_bytes: Some(7.0),
            ..Default::default()
        };
        let shading = Statistics {
            shading_seconds: Some(3.0),
            bytes_read: Some(5.0),
            peak_memory_bytes: Some(6.0),
            ..Default::default()
        };
        add(&mut statistics, &shading);
        assert_eq!(statistics.build_seconds, Some(2.0));
        assert_eq!(statistics.shading_seconds, Some(3.0));
        assert_eq!(statistics.bytes_read, Some(15.0));
        assert_eq!(statistics.peak_memory_bytes, Some(7.0));
        assert_eq!(statistics.bytes_written, None);
    }
}
