//! Light that was reflected more than once. A scene's points carry light that was reflected once; for every bounce more, workers
//! gather at these points what the scene of the bounce before sends them, and a build child makes the scene whose points reflect
//! that too. Such scenes stay in the scratch directory, under a digest of what they were made from: the next job finds them.
//!
//! Start at [`lit_scene`].

use crate::build_child::Spec;
use crate::builder;
use crate::confine::Confine;
use crate::dispatcher::Dispatcher;
use crate::error::{JobError, JobErrorKind};
use crate::framebuffer::TileReceivers;
use crate::limits;
use crate::live::{self, LiveResult, TILE_RECEIVERS, VALUE_BYTES};
use crate::mounts::Mounted;
use crate::output;
use crate::roots::{Place, Want};
use crate::scheduler::JobNo;
use crate::telemetry;
use pbgi_core::limits::RASTER_RESOLUTION_DEFAULT;
use pbgi_core::{BuildId, Environment, ShadeSettings};
use pbgi_points::bounce::RECEIVED_BYTES;
use pbgi_points::{BounceReceivers, CloudOptions};
use std::collections::HashMap;
use std::fs::{self, File};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::io;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::{Duration, Instant};
use tokio::sync::{mpsc, watch};

/// Folder of the scratch directory that holds the scenes.
const FOLDER: &str = "bounces";
/// What such a scene is called while it is being deleted.
const GONE: &str = "gone";

/// What is to be shaded, and for whom.
#[derive(Clone, Debug)]
pub(crate) struct Wanted {
    /// The scene, as the client names it.
    pub(crate) scene: PathBuf,
    /// How it will be shaded, bounces included.
    pub(crate) settings: ShadeSettings,
    /// Light from far away.
    pub(crate) environment: Option<Arc<Environment>>,
    /// For whom.
    pub(crate) user: String,
    /// Higher ones go first.
    pub(crate) priority: i32,
    /// Most workers at once; `None` for all.
    pub(crate) workers: Option<usize>,
}

/// One lock for each scene that is being made: whoever wants the same waits, and finds it made.
#[derive(Debug, Default)]
pub(crate) struct Makers(Mutex<HashMap<PathBuf, Weak<tokio::sync::Mutex<()>>>>);

impl Makers {
    fn of(&self, scene: &Path) -> Arc<tokio::sync::Mutex<()>> {
        let mut makers = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        makers.retain(|_, maker| maker.strong_count() > 0);
        if let Some(maker) = makers.get(scene).and_then(Weak::upgrade) {
            return maker;
        }
        let maker = Arc::default();
        makers.insert(scene.to_owned(), Arc::downgrade(&maker));
        maker
    }
}

/// The scene whose points carry all light but that of the last bounce, which shading itself adds: the one that is asked for,
/// where one bounce is wanted, else one that is made of it or was before. Progress and history are those of `job`.
///
/// # Errors
/// A scene that cannot be used or does not reflect, an environment that cannot be read, a disk that is full, or `abort` said so.
pub(crate) async fn lit_scene(
    dispatcher: &Arc<Dispatcher>,
    job: JobNo,
    wanted: &Wanted,
    abort: &watch::Receiver<bool>,
) -> Result<Mounted, JobError> {
    let (this, path) = (dispatcher.clone(), wanted.scene.clone());
    let opened = blocking(move || {
        let place = this.roots().read(&path)?;
        Ok((this.open_scene(&path)?, place))
    });
    let (mut mounted, place) = opened.await?;
    let original = mounted.scene().info().build_id;
    for bounce in 2..=wanted.settings.bounces {
        let target = target(dispatcher, original, wanted, bounce);
        let maker = dispatcher.makers.of(&target);
        let _making = maker.lock().await;
        let found = open(dispatcher, &target).await;
        if found.as_ref().is_err_and(|error| error.kind == JobErrorKind::NotFound) {
            let step = Step {
                dispatcher,
                job,
                wanted,
                place: &place,
                lit: &mounted,
                bounce,
                target: &target,
            };
            step.make(abort).await?;
            mounted = open(dispatcher, &target).await?;
        } else {
            mounted = found?;
        }
    }
    Ok(mounted)
}

/// Opens a scene of bounces, and marks it as used now.
async fn open(dispatcher: &Arc<Dispatcher>, scene: &Path) -> Result<Mounted, JobError> {
    let (this, scene) = (dispatcher.clone(), scene.to_owned());
    blocking(move || {
        let mounted = this.mounts.open(&scene)?;
        let marked = File::open(&scene).and_then(|folder| folder.set_modified(telemetry::now()));
        if let Err(error) = marked {
            tracing::debug!(%error, "cannot mark a scene of bounces as used");
        }
        Ok(mounted)
    })
    .await
}

async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, JobError> + Send + 'static,
) -> Result<T, JobError> {
    let done = tokio::task::spawn_blocking(work).await;
    done.map_err(|error| JobError::new(JobErrorKind::Internal, error.to_string()))?
}

/// Light of a bounce before the last is averaged over clusters before it is seen: it is gathered more coarsely.
fn gather_settings(settings: &ShadeSettings) -> ShadeSettings {
    ShadeSettings {
        max_solid_angle: (4.0 * settings.max_solid_angle).min(0.5),
        raster_resolution: settings.raster_resolution.min(RASTER_RESOLUTION_DEFAULT / 2),
        bias: settings.bias,
        hit_sides: settings.hit_sides,
        ..ShadeSettings::default()
    }
}

/// Where the scene of a bounce is, or will be.
fn target(dispatcher: &Dispatcher, original: BuildId, wanted: &Wanted, bounce: u32) -> PathBuf {
    let gather = gather_settings(&wanted.settings);
    // Keys without state: the same in the next process.
    let mut hasher = DefaultHasher::new();
    (original, bounce, env!("CARGO_PKG_VERSION")).hash(&mut hasher);
    let numbers = [gather.max_solid_angle, gather.raster_resolution as f32, gather.bias];
    (numbers.map(f32::to_bits), gather.hit_sides.name()).hash(&mut hasher);
    if let Some(environment) = &wanted.environment {
        let pixels = environment.pixels().iter().flatten();
        (environment.width(), environment.height()).hash(&mut hasher);
        pixels.for_each(|value| value.to_bits().hash(&mut hasher));
    }
    folder(&dispatcher.config.options.scratch_dir).join(format!("{:016x}.pbgi", hasher.finish()))
}

fn folder(scratch: &Path) -> PathBuf {
    scratch.join(FOLDER)
}

/// One bounce more.
struct Step<'a> {
    dispatcher: &'a Arc<Dispatcher>,
    job: JobNo,
    wanted: &'a Wanted,
    /// The scene that was asked for.
    place: &'a Place,
    /// The scene of the bounce before.
    lit: &'a Mounted,
    bounce: u32,
    target: &'a Path,
}

impl Step<'_> {
    async fn make(&self, abort: &watch::Receiver<bool>) -> Result<(), JobError> {
        let failed = |text: String| JobError::new(JobErrorKind::Precondition, self.place.hide(&text));
        let folder = folder(&self.dispatcher.config.options.scratch_dir);
        fs::create_dir_all(&folder).map_err(|error| failed(format!("cannot make a scene for bounces: {error}")))?;
        make_room(&folder, limits::BOUNCED_SCENES_MAX - 1, Duration::MAX);
        let received = Received(folder.join(format!("received-{}", output::unique())));
        let started = Instant::now();
        let receivers = self.gather(&received.0, abort).await.map_err(failed)?;
        let gathered = started.elapsed().as_secs_f64();
        let spec = self.spec(&received.0)?;
        let built = builder::run_child(self.dispatcher, self.job, &spec, abort.clone()).await;
        built.map_err(failed)?;
        let built = started.elapsed().as_secs_f64() - gathered;
        self.dispatcher.note(
            self.job,
            format!(
                "light of bounce {} gathered at {receivers} places in {gathered:.1} s, its scene built in {built:.1} s",
                self.bounce - 1
            ),
        );
        Ok(())
    }

    /// Gathers at all points what arrives there; returns at how many places.
    async fn gather(&self, received: &Path, abort: &watch::Receiver<bool>) -> Result<u64, String> {
        let session = live::Session {
            mounted: self.lit.clone(),
            settings: gather_settings(&self.wanted.settings),
            environment: self.wanted.environment.clone(),
            user: self.wanted.user.clone(),
            priority: self.wanted.priority,
            pixel_angle: None,
        };
        let (live, values) = self.dispatcher.start_live(session).map_err(|error| error.text)?;
        let file = File::create(received).map_err(|error| format!("cannot write light of a bounce: {error}"))?;
        let gathering = Gathering {
            dispatcher: self.dispatcher.clone(),
            job: self.job,
            live,
            values,
            file,
            stage: format!(
                "gathering bounce {} of {}",
                self.bounce - 1,
                self.wanted.settings.bounces
            ),
            tiles_max: self
                .wanted
                .workers
                .map_or(limits::LIVE_TILES_MAX, |workers| workers.min(limits::LIVE_TILES_MAX)),
        };
        let original = self.place.path.clone();
        let (dispatcher, mut abort) = (self.dispatcher.clone(), abort.clone());
        let stopper = tokio::spawn(async move {
            // An error says that whoever waited has left, as a client of a stream may.
            let _ = abort.wait_for(|stop| *stop).await;
            dispatcher.close_live(live);
        });
        let outcome = tokio::task::spawn_blocking(move || gathering.run(&original)).await;
        stopper.abort();
        self.dispatcher.close_live(live);
        outcome.map_err(|error| error.to_string())?
    }

    fn spec(&self, received: &Path) -> Result<Spec, JobError> {
        let options = &self.dispatcher.config.options;
        let memory = &self.dispatcher.config.memory;
        let roots = self.dispatcher.roots();
        let scratch = options.scratch_dir.clone();
        // The place is this process's; the child needs the real path.
        let scene = roots.real(&self.wanted.scene, Want::Read)?;
        Ok(Spec {
            confine: (!roots.is_empty()).then(|| Confine {
                read: vec![scene.clone(), scratch.clone()],
                write: vec![scratch.clone()],
            }),
            inputs: vec![scene],
            received: Some(received.to_owned()),
            output: self.target.to_owned(),
            overwrite: true,
            settings: self.lit.scene().info().settings,
            density: None,
            cloud: CloudOptions::default(),
            scratch_dir: scratch,
            memory_bytes: memory.build_bytes,
            data_limit_bytes: memory.total_bytes,
            daemon_pid: std::process::id(),
        })
    }
}

/// Receivers on their way to workers and values on their way back.
struct Gathering {
    dispatcher: Arc<Dispatcher>,
    job: JobNo,
    live: JobNo,
    values: mpsc::Receiver<LiveResult>,
    file: File,
    stage: String,
    tiles_max: usize,
}

impl Gathering {
    fn run(mut self, scene: &Path) -> Result<u64, String> {
        let mut receivers = BounceReceivers::open(scene).map_err(|error| error.to_string())?;
        let (points, mut waiting, mut count) = (receivers.points(), Vec::new(), 0);
        let (mut out, mut tile_next) = (0, 0);
        loop {
            while out < self.tiles_max {
                let wanted = TILE_RECEIVERS - waiting.len();
                receivers
                    .next(wanted, &mut waiting)
                    .map_err(|error| error.to_string())?;
                if waiting.is_empty() {
                    break;
                }
                let rest = waiting.split_off(waiting.len().min(TILE_RECEIVERS));
                count += waiting.len() as u64;
                self.dispatcher.feed(self.live, tile_next, tile(&waiting)?);
                waiting = rest;
                tile_next += 1;
                out += 1;
            }
            let done = receivers.points_done();
            self.dispatcher.progress(self.job, self.stage.clone(), done, points);
            if out == 0 {
                break;
            }
            match self.values.blocking_recv() {
                Some(Ok((tile, values))) => self.keep(tile, &values).map_err(|error| error.to_string())?,
                Some(Err(text)) => return Err(text),
                None => return Err("stopped".into()),
            }
            out -= 1;
        }
        if count == 0 && points > 0 {
            return Err(format!(
                "no point of the scene reflects light, so that there is one bounce at most: build it of a mesh, of a cloud with \
                 albedo_red, albedo_green and albedo_blue, or with --albedo, at {}",
                scene.display()
            ));
        }
        Ok(count)
    }

    fn keep(&self, tile: u32, values: &[u8]) -> io::Result<()> {
        let irradiance: Vec<u8> = values
            .chunks_exact(VALUE_BYTES)
            .flat_map(|values| &values[..RECEIVED_BYTES])
            .copied()
            .collect();
        let place = u64::from(tile) * (TILE_RECEIVERS * RECEIVED_BYTES) as u64;
        self.file.write_all_at(&irradiance, place)
    }
}

fn tile(receivers: &[[[f32; 3]; 2]]) -> Result<TileReceivers, String> {
    let bytes: Vec<u8> = receivers
        .iter()
        .flatten()
        .flatten()
        .flat_map(|number| number.to_le_bytes())
        .collect();
    let tile = live::tiles(&bytes)?.pop();
    tile.ok_or_else(|| "a tile without receivers".to_owned())
}

/// Deletes the light of a bounce whatever happens.
struct Received(PathBuf);

impl Drop for Received {
    fn drop(&mut self) {
        // A leftover is swept at the next start.
        let _ = fs::remove_file(&self.0);
    }
}

/// Removes what a dead daemon left half-made in its scratch directory, and scenes that were not used for long.
pub(crate) fn sweep(scratch: &Path) {
    let folder = folder(scratch);
    let Ok(entries) = fs::read_dir(&folder) else { return };
    for entry in entries.flatten() {
        let path = entry.path();
        let name = entry.file_name();
        let half_made = name
            .to_str()
            .is_some_and(|name| name.starts_with("received-") || name.contains(".tmp-") || name.ends_with(GONE));
        if half_made {
            let _ = fs::remove_dir_all(&path).or_else(|_| fs::remove_file(&path));
        }
    }
    make_room(&folder, limits::BOUNCED_SCENES_MAX, limits::BOUNCED_SCENES_KEPT);
}

/// Deletes all but the latest so many scenes, and those not used for `kept`. Who has one open goes on reading it.
fn make_room(folder: &Path, most: usize, kept: Duration) {
    let Ok(entries) = fs::read_dir(folder) else { return };
    let age = |path: &Path| {
        let modified = fs::metadata(path).and_then(|metadata| metadata.modified());
        modified.ok().and_then(|time| time.elapsed().ok()).unwrap_or_default()
    };
    let mut scenes: Vec<(Duration, PathBuf)> = entries
        .flatten()
        .map(|entry| entry.path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "pbgi"))
        .map(|path| (age(&path), path))
        .collect();
    scenes.sort();
    for (rank, (age, path)) in scenes.iter().enumerate() {
        if rank < most && *age <= kept {
            continue;
        }
        // Renamed first: a scene is whole or not there.
        let gone = path.with_extension(GONE);
        let removed = fs::rename(path, &gone).and_then(|()| fs::remove_dir_all(&gone));
        tracing::info!(path = %path.display(), ?removed, "let go of a scene of bounces");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_latest_scenes_are_kept() {
        let scratch = tempfile::tempdir().unwrap();
        let folder = folder(scratch.path());
        for number in 0..5u64 {
            let scene = folder.join(format!("{number}.pbgi"));
            fs::create_dir_all(&scene).unwrap();
            let now = fs::metadata(&scene).unwrap().modified().unwrap();
            let time = now - Duration::from_secs(100 * ((5 - number) % 5));
            File::open(&scene).unwrap().set_modified(time).unwrap();
        }
        fs::write(folder.join("received-1-1"), "x").unwrap();
        fs::create_dir(folder.join("7.gone")).unwrap();
        make_room(&folder, 3, Duration::from_secs(250));
        sweep(scratch.path());
        let mut left: Vec<_> = fs::read_dir(&folder)
            .unwrap()
            .map(|entry| entry.unwrap().file_name())
            .collect();
        left.sort();
        assert_eq!(left, ["0.pbgi", "3.pbgi", "4.pbgi"]);
    }
}
