//! `view`, and what `shade --camera` needs: what a camera sees of a built scene, without meshes.

use super::args::{OutputArgs, QualityArgs, SeenArgs, ServerArgs, Size, StatsArgs};
use super::failure::Failure;
use super::files::{self, Existing};
use super::interrupt::Interrupt;
use super::look::ExposureArgs;
use super::progress::Progress;
use super::render::{add, temporary_folder};
use super::session::{self, Work};
use super::summary;
use clap::Args;
use pbgi_client::{Client, LiveJob, ShadeJob};
use pbgi_core::{Bounds, ShadeSettings, Statistics};
use pbgi_points::{Camera, GBuffer, GBufferOptions, HitBuffer, LayeredImage, MeshScene};
use std::f32::consts::FRAC_1_PI;
use std::path::{Path, PathBuf};
use tokio::sync::mpsc;

const VIEW_EXAMPLES: &str = "\
Examples:
  pbgi-client view town.pbgi -o town.png
  pbgi-client view town.pbgi -o street.png --eye 120,8,-40 --look-at 200,5,-60 --fov 60 --environment sky.hdr

The picture shows the points' colours in the light of a white sky, or of the environment, and of each other; points without
colour are grey. Positions are the scene's: y up, relative to the origin that info tells.";

/// Where no surface is.
const BACKGROUND: [f32; 3] = [0.78, 0.85, 0.93];
/// Albedo of a scene without colours.
const GREY: [f32; 3] = [0.7; 3];
/// Blocks of rays in one message: a tile.
const MESSAGE_BLOCKS: usize = 16;
/// Messages that wait for the daemon.
const MESSAGES_AHEAD: usize = 4;

/// `view`
#[derive(Args, Debug)]
#[command(after_help = VIEW_EXAMPLES)]
pub(crate) struct ViewArgs {
    /// A scene made by build
    #[arg(value_name = "NAME.pbgi")]
    scene: PathBuf,
    #[command(flatten)]
    output: OutputArgs,
    #[command(flatten)]
    seen: SeenArgs,
    #[command(flatten)]
    exposure: ExposureArgs,
    #[command(flatten)]
    quality: QualityArgs,
    #[command(flatten)]
    stats: StatsArgs,
    #[command(flatten)]
    server: ServerArgs,
}

pub(crate) async fn view(args: ViewArgs, interrupt: &Interrupt) -> Result<(), Failure> {
    args.stats.check()?;
    let existing = Existing::from_flag(args.output.overwrite);
    let output = files::output_of_kind(&args.output.output, existing, "png")?;
    let request = Seen {
        scene: files::input(&args.scene)?,
        workers: args.server.job_workers(),
        settings: args.quality.settings()?,
    };
    let environment = args.quality.environment.as_deref().map(files::input).transpose()?;
    let folder = temporary_folder()?;
    let (statistics, gbuffer, shaded) = {
        let mut progress = Progress::new();
        let client = session::connect(&args.server, interrupt, &progress).await?;
        let (gbuffer, mut statistics) = request.gbuffer(&args.seen, &client, interrupt, &mut progress).await?;
        let passes = folder.path().join("gbuffer.exr");
        gbuffer.write(&passes)?;
        let shaded = folder.path().join("shaded.exr");
        let job = ShadeJob {
            scene: request.scene.clone(),
            gbuffer: passes,
            passes: GBufferOptions::default(),
            output: shaded.clone(),
            overwrite: false,
            settings: request.settings,
            environment: environment.clone(),
            workers: request.workers,
        };
        let shading = session::run(&client, &Work::Shade(job), interrupt, &mut progress).await?;
        add(&mut statistics, &shading);
        (statistics, gbuffer, shaded)
    };
    let sky = if environment.is_some() { 0.0 } else { 1.0 };
    let pixels = picture(&gbuffer, &LayeredImage::read_exr(&shaded)?, sky)?;
    args.exposure
        .look_of_colours(output)
        .show(gbuffer.data_window, &pixels)?;
    summary::report(&statistics, args.stats.stats.as_deref())
}

/// The points' colours in the light of a sky of radiance `sky` where it is open, and in what was shaded.
fn picture(gbuffer: &GBuffer, shaded: &LayeredImage, sky: f32) -> Result<Vec<[f32; 3]>, Failure> {
    let missing = || Failure::failed("the shaded picture lacks indirect or occlusion");
    let indirect = shaded.triple("indirect").ok_or_else(missing)?;
    let occlusion = shaded.channel("occlusion.Z").ok_or_else(missing)?;
    let colours = gbuffer.albedo.as_deref().unwrap_or(&[]);
    let grey = colours.iter().flatten().all(|&value| value == 0.0);
    let pixel = |index: usize| {
        let albedo = if grey { GREY } else { colours[index] };
        let share = gbuffer.coverage[index];
        std::array::from_fn(|c| {
            let light = sky * (1.0 - occlusion[index]) + indirect[index][c] * FRAC_1_PI;
            albedo[c] * light * share + BACKGROUND[c] * (1.0 - share)
        })
    };
    Ok((0..gbuffer.pixel_count()).map(pixel).collect())
}

/// Whose view is asked for.
pub(crate) struct Seen {
    pub(crate) scene: PathBuf,
    pub(crate) workers: Option<u32>,
    pub(crate) settings: ShadeSettings,
}

impl Seen {
    /// Finds what the camera sees; the points' radiance is the albedo.
    pub(crate) async fn gbuffer(
        &self,
        args: &SeenArgs,
        client: &Client,
        interrupt: &Interrupt,
        progress: &mut Progress,
    ) -> Result<(GBuffer, Statistics), Failure> {
        let info = interrupt.guard(async { Ok(client.scene(&self.scene).await?) }).await?;
        let (size, bounds) = (args.size(), info.bounds.unwrap_or(Bounds::EMPTY));
        let camera = camera(args, &bounds, size)?;
        let mut buffer = HitBuffer::new(&camera, size.width, size.height);
        let job = LiveJob {
            scene: self.scene.clone(),
            settings: self.settings,
            environment: None,
            priority: None,
            workers: self.workers,
        };
        let (messages, rays) = mpsc::channel(MESSAGES_AHEAD);
        let mut blocks = buffer.rays();
        let feeder = tokio::task::spawn_blocking(move || {
            loop {
                let message: Vec<[f32; 6]> = blocks.by_ref().take(MESSAGE_BLOCKS).flatten().collect();
                // Who left does not listen: the stream has ended with an error, which is told there.
                if message.is_empty() || messages.blocking_send(message).is_err() {
                    return;
                }
            }
        });
        let (angle, total) = (buffer.pixel_angle(), buffer.ray_count());
        let mut done = 0;
        let take = |hits: &[[f32; 10]]| -> Result<(), Failure> {
            buffer.take(hits);
            done += hits.len() as u64;
            progress.show("looking", done, total);
            Ok(())
        };
        let mut statistics = interrupt.guard(client.trace_rays(&job, angle, rays, take)).await?;
        let ended = feeder.await;
        ended.map_err(|error| Failure::failed(format!("defect: {error}")))?;
        // The table's rows of shading are those of receivers.
        statistics.shading_calls = None;
        Ok((buffer.finish(), statistics))
    }
}

/// The camera that the options describe.
fn camera(args: &SeenArgs, bounds: &Bounds, size: Size) -> Result<Camera, Failure> {
    let aspect = size.width as f32 / size.height as f32;
    let number = args.camera_number()?;
    if let Some(file) = &args.camera_file {
        return file_camera(file, number);
    }
    let Some(eye) = args.eye else {
        if bounds.is_empty() {
            return Err(Failure::failed("the scene has no points to look at"));
        }
        return Ok(Camera::overview(bounds, aspect));
    };
    let centre: [f32; 3] = std::array::from_fn(|axis| (bounds.min[axis] + bounds.max[axis]) / 2.0);
    let target = args.look_at.unwrap_or(centre);
    if eye == target {
        return Err(Failure::usage("--eye and --look-at are the same place"));
    }
    Ok(Camera::look_at_upright(
        eye.into(),
        target.into(),
        args.up().into(),
        args.fov.to_radians(),
    ))
}

fn file_camera(file: &Path, number: usize) -> Result<Camera, Failure> {
    let mesh = MeshScene::load(&files::input(file)?)?;
    let camera = mesh.camera(number);
    camera.map_err(|error| Failure::usage(format!("{error}: {}", file.display())))
}

#[cfg(test)]
mod tests {
    use super::*;
    use pbgi_points::{Precision, Window};
    use std::f32::consts::PI;

    #[test]
    fn the_picture_is_colour_times_light_over_the_background() {
        let gbuffer = GBuffer {
            data_window: Window::of_size(2, 1),
            display_window: Window::of_size(2, 1),
            world_to_camera: None,
            world_to_ndc: None,
            position: vec![[0.0; 3]; 2],
            normal: vec![[0.0, 1.0, 0.0]; 2],
            coverage: vec![1.0, 0.0],
            albedo: Some(vec![[0.5, 0.25, 0.0], [0.0; 3]]),
            direct: None,
            emission: None,
        };
        let mut shaded = LayeredImage::new(2, 1);
        shaded.add_rgb("indirect", Precision::Float, &[[PI, 0.0, 0.0], [0.0; 3]]);
        shaded.add("occlusion.Z", Precision::Float, vec![0.5, 0.0]);
        let pixels = picture(&gbuffer, &shaded, 1.0).unwrap();
        for (value, expected) in pixels[0].iter().zip([0.75, 0.125, 0.0]) {
            assert!((value - expected).abs() < 1e-6, "{pixels:?}");
        }
        assert_eq!(pixels[1], BACKGROUND);
    }
}
