//! A picture's life around its tiles: open the scene, read the G-buffer, wait for memory; afterwards add up and write.

use crate::bounce::{self, Wanted};
use crate::dispatcher::Dispatcher;
use crate::error::JobError;
use crate::framebuffer::Framebuffer;
use crate::job::ShadeTask;
use crate::limits;
use crate::mounts::Mounted;
use crate::output;
use crate::roots::Place;
use crate::scheduler::JobNo;
use pbgi_cache::JobCounters;
use pbgi_core::limits::IMAGE_PIXELS_MAX;
use pbgi_core::{Environment, SceneInfo, Statistics};
use pbgi_points::{GBuffer, PassThrough, PointsError};
use pbgi_store::StoreError;
use std::collections::HashSet;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;
use tokio::sync::{OwnedSemaphorePermit, watch};

/// What a shading job holds while its tiles are out.
pub struct Shading {
    /// The picture.
    pub frame: Framebuffer,
    /// The scene.
    pub mounted: Mounted,
    /// Light from far away.
    pub environment: Option<Arc<Environment>>,
    /// What the tiles took so far.
    pub counters: Counters,
    /// Tiles to be shaded, along a Z-curve.
    pub tiles_left: Vec<u32>,
    /// Tiles that a former run had stored, in the picture already.
    pub tiles_stored: u64,
    /// What goes from the G-buffer's file into the picture as it is.
    pub passed: PassThrough,
    /// The G-buffer.
    pub gbuffer: Place,
    /// Tells what the tiles are made from: another scene, G-buffer or environment has another one.
    pub fingerprint: String,
    started: Instant,
    memory: Option<OwnedSemaphorePermit>,
}

impl Shading {
    /// Since the first tile could go out.
    pub fn seconds(&self) -> f64 {
        self.started.elapsed().as_secs_f64()
    }
}

/// What tiles took, as workers tell.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Receivers shaded.
    pub receivers: u64,
    /// Elements on their cuts.
    pub cut_elements: u64,
    /// Nodes visited to find the cuts.
    pub nodes_visited: u64,
    /// Bytes of the pages that each receiver touched.
    pub traversal_bytes: u64,
    /// Pages found in a worker's own cache.
    pub local_hits: u64,
    /// Pages found in the shared cache.
    pub shared_hits: u64,
    /// Of these, pages that another job loaded.
    pub shared_hits_other_job: u64,
    /// Pages that the daemon had to read.
    pub cache_misses: u64,
    /// Processor time, nanoseconds.
    pub cpu_nanos: u64,
    /// Time waited for pages, nanoseconds.
    pub io_nanos: u64,
}

impl Counters {
    const COUNT: usize = 10;

    fn fields(&mut self) -> [&mut u64; Self::COUNT] {
        [
            &mut self.receivers,
            &mut self.cut_elements,
            &mut self.nodes_visited,
            &mut self.traversal_bytes,
            &mut self.local_hits,
            &mut self.shared_hits,
            &mut self.shared_hits_other_job,
            &mut self.cache_misses,
            &mut self.cpu_nanos,
            &mut self.io_nanos,
        ]
    }

    /// As they are stored before a tile's values.
    pub fn to_bytes(mut self) -> Vec<u8> {
        self.fields()
            .into_iter()
            .flat_map(|field| field.to_le_bytes())
            .collect()
    }

    /// What [`Self::to_bytes`] made, and the values behind it.
    pub fn split(bytes: &[u8]) -> Option<(Self, &[u8])> {
        let mut counters = Self::default();
        let (head, values) = bytes.split_at_checked(Self::COUNT * 8)?;
        for (field, bytes) in counters.fields().into_iter().zip(head.as_chunks::<8>().0) {
            *field = u64::from_le_bytes(*bytes);
        }
        Some((counters, values))
    }

    /// Adds another tile's. A worker's nonsense does not overflow.
    pub fn add(&mut self, other: &Self) {
        for (sum, value) in self.fields().into_iter().zip(other.clone().fields()) {
            *sum = sum.saturating_add(*value);
        }
    }
}

/// Everything that has to be there before the first tile goes out.
///
/// # Errors
/// A text for people: a file that cannot be used, a picture too large, or the job was stopped.
pub async fn prepare(
    dispatcher: &Arc<Dispatcher>,
    job: JobNo,
    task: &ShadeTask,
    stored: Option<String>,
    mut abort: watch::Receiver<bool>,
) -> Result<Shading, String> {
    let (this, checked) = (dispatcher.clone(), task.clone());
    let checked = tokio::task::spawn_blocking(move || check(&this, &checked)).await;
    let environment = checked.map_err(|error| error.to_string())??;
    let options = dispatcher.options_of(job);
    let wanted = Wanted {
        scene: task.scene.clone(),
        settings: task.settings,
        environment,
        user: options.user,
        priority: options.priority,
        workers: task.workers,
    };
    let mounted = bounce::lit_scene(dispatcher, job, &wanted, &abort).await;
    let (mounted, environment) = (mounted.map_err(|error| error.text)?, wanted.environment);
    let gate = tokio::select! {
        gate = dispatcher.picture_gate.lock() => gate,
        _ = abort.wait_for(|stop| *stop) => return Err(STOPPED.into()),
    };
    let (this, task) = (dispatcher.clone(), task.clone());
    let read = tokio::task::spawn_blocking(move || read(&this, job, &task, (mounted, environment), stored)).await;
    let (mut shading, pixels) = read.map_err(|error| error.to_string())??;
    let passed = shading.passed.channel_count() as u64 * limits::PASSED_BYTES_PER_PIXEL;
    let megabytes = (pixels * (limits::PICTURE_BYTES_PER_PIXEL + passed))
        .div_ceil(1 << 20)
        .max(1);
    let available = dispatcher.config.memory.work_bytes >> 20;
    if megabytes > available {
        return Err(format!(
            "picture too large: {megabytes} MiB of memory needed, {available} MiB of --memory are for pictures and builds; \
             start the daemon with more --memory, or shade the picture in parts"
        ));
    }
    let waiting = dispatcher.work_memory.clone().acquire_many_owned(megabytes as u32);
    let memory = tokio::select! {
        memory = waiting => memory.map_err(|error| error.to_string())?,
        _ = abort.wait_for(|stop| *stop) => return Err(STOPPED.into()),
    };
    drop(gate);
    tracing::debug!(job = job.0, holes = shading.frame.holes(), megabytes, "picture read");
    shading.memory = Some(memory);
    shading.started = Instant::now();
    Ok(shading)
}

/// Why a stopped job's task ended; the scheduler knows the real reason.
const STOPPED: &str = "stopped";

/// What can be said before any work is done: whether the output may be written, and whether what is read can be opened.
/// Returns the environment.
fn check(dispatcher: &Dispatcher, task: &ShadeTask) -> Result<Option<Arc<Environment>>, String> {
    let text = |error: JobError| error.text;
    let output = dispatcher.roots().write(&task.output, task.overwrite).map_err(text)?;
    if !task.overwrite && std::fs::symlink_metadata(&output.path).is_ok() {
        let path = task.output.clone();
        return Err(StoreError::Exists { path }.to_string());
    }
    dispatcher.open_scene(&task.scene).map_err(text)?;
    dispatcher.roots().read(&task.gbuffer).map_err(text)?;
    let environment = task
        .environment
        .as_deref()
        .map(|path| dispatcher.read_environment(path).map_err(text));
    environment.transpose()
}

/// Reads everything; also returns the pixels of the picture.
fn read(
    dispatcher: &Dispatcher,
    job: JobNo,
    task: &ShadeTask,
    (mounted, environment): (Mounted, Option<Arc<Environment>>),
    stored: Option<String>,
) -> Result<(Shading, u64), String> {
    let places = |path: &PathBuf| dispatcher.roots().read(path).map_err(|error| error.text);
    let gbuffer_place = places(&task.gbuffer)?;
    let environment_place = task.environment.as_ref().map(places).transpose()?;
    let environment_path = environment_place.as_ref().map(|place| place.path.as_path());
    let fingerprint = fingerprint(&mounted, &gbuffer_place.path, environment_path);
    let hide = |error: PointsError| gbuffer_place.hide(&error.to_string());
    let passed = PassThrough::open(&gbuffer_place.path).map_err(hide)?;
    let gbuffer = GBuffer::read_with(&gbuffer_place.path, &task.passes).map_err(hide)?;
    let pixels = gbuffer.pixel_count() as u64;
    if pixels > IMAGE_PIXELS_MAX {
        let path = task.gbuffer.display();
        return Err(format!(
            "picture of {pixels} pixels, at most {IMAGE_PIXELS_MAX} are shaded, in {path}"
        ));
    }
    let mut shading = Shading {
        frame: Framebuffer::new(gbuffer),
        mounted,
        environment,
        counters: Counters::default(),
        tiles_left: Vec::new(),
        tiles_stored: 0,
        passed,
        gbuffer: gbuffer_place,
        fingerprint,
        started: Instant::now(),
        memory: None,
    };
    shading.tiles_left = shading.frame.tiles();
    if stored.as_ref() == Some(&shading.fingerprint) {
        take_stored_tiles(dispatcher, job, &mut shading);
    } else {
        dispatcher.table.drop_tiles(job);
    }
    Ok((shading, pixels))
}

/// Puts tiles in place that a former run stored. What does not fit is shaded again.
fn take_stored_tiles(dispatcher: &Dispatcher, job: JobNo, shading: &mut Shading) {
    let tiles = dispatcher.table.tiles(job).unwrap_or_else(|error| {
        tracing::warn!(error, job = job.0, "stored tiles cannot be read");
        Vec::new()
    });
    let left: HashSet<u32> = shading.tiles_left.iter().copied().collect();
    let mut taken = HashSet::new();
    for (tile, bytes) in tiles.iter().filter(|(tile, _)| left.contains(tile)) {
        if let Some((counters, values)) = Counters::split(bytes)
            && shading.frame.check(*tile, values).is_ok()
        {
            shading.frame.fill(*tile, values);
            shading.counters.add(&counters);
            taken.insert(*tile);
        }
    }
    shading.tiles_left.retain(|tile| !taken.contains(tile));
    shading.tiles_stored = taken.len() as u64;
}

/// The build of the scene, and length, time and place of the other files.
fn fingerprint(mounted: &Mounted, gbuffer: &Path, environment: Option<&Path>) -> String {
    let file = |path: &Path| {
        let known = std::fs::metadata(path).map(|file| {
            let (bytes, seconds, nanos, inode) = (file.len(), file.mtime(), file.mtime_nsec(), file.ino());
            format!("{bytes}-{seconds}.{nanos}-{inode}")
        });
        known.unwrap_or_default()
    };
    let environment = environment.map(file).unwrap_or_default();
    let build_id = mounted.scene().info().build_id;
    format!("{build_id} {} {environment}", file(gbuffer))
}

/// Adds up and writes the picture.
///
/// # Errors
/// A text for people.
pub async fn write(
    dispatcher: &Arc<Dispatcher>,
    job: JobNo,
    task: &ShadeTask,
    shading: Shading,
    abort: watch::Receiver<bool>,
) -> Result<Statistics, String> {
    let seconds = shading.seconds();
    let mut statistics = shading_statistics(&shading, &dispatcher.cache.job_counters(job.0), seconds);
    let (memory, cache) = dispatcher.peaks(job);
    statistics.peak_memory_bytes = Some(memory as f64);
    statistics.cache_peak_bytes = Some(cache as f64);
    let Shading {
        frame,
        memory,
        mounted,
        passed,
        gbuffer,
        ..
    } = shading;
    let picture = output::Picture {
        build_id: mounted.scene().info().build_id,
        task: task.clone(),
        statistics: statistics.clone(),
        memory_bytes: dispatcher.config.memory.total_bytes,
        passed,
        gbuffer,
        scratch: dispatcher.config.options.scratch_dir.clone(),
        place: dispatcher
            .roots()
            .write(&task.output, task.overwrite)
            .map_err(|error| error.text)?,
    };
    let written = tokio::task::spawn_blocking(move || {
        let written = output::write(&picture, frame.into_planes(), &|| *abort.borrow());
        drop(memory);
        written
    });
    let bytes = written.await.map_err(|error| error.to_string())??;
    statistics.bytes_written = Some(bytes as f64);
    statistics.peak_memory_bytes = Some(dispatcher.peaks(job).0 as f64);
    Ok(statistics)
}

pub(crate) fn shading_statistics(shading: &Shading, pages: &JobCounters, seconds: f64) -> Statistics {
    let info = shading.mounted.scene().info();
    Statistics {
        holes: Some(shading.frame.holes() as f64),
        ..tile_statistics(info, &shading.counters, pages, seconds)
    }
}

/// What shading tiles of a scene took: every row that does not need to know what they were part of.
pub(crate) fn tile_statistics(info: &SceneInfo, tiles: &Counters, pages: &JobCounters, seconds: f64) -> Statistics {
    let count = |value: u64| Some(value as f64);
    let ratio = |part: u64, whole: u64| (whole > 0).then(|| part as f64 / whole as f64);
    // Loads are counted here, not by workers: one that dies takes its tile's counters with it, but the page was read.
    let misses = pages.loads;
    let requests = tiles.local_hits + tiles.shared_hits + misses;
    Statistics {
        points: count(info.point_count),
        nodes: count(info.node_count),
        shading_calls: count(tiles.receivers),
        shading_seconds: Some(seconds),
        shading_cpu_seconds: Some(tiles.cpu_nanos as f64 * 1e-9),
        shading_io_seconds: Some(tiles.io_nanos as f64 * 1e-9),
        out_of_core_bytes: count(info.out_of_core_bytes()),
        cache_hit_ratio: ratio(requests - misses, requests),
        cache_io_ratio: ratio(pages.distinct_bytes, info.out_of_core_bytes()),
        redundant_reads: count(pages.redundant_reads),
        reloads: count(pages.reloads),
        average_cut_size: ratio(tiles.cut_elements, tiles.receivers),
        average_nodes_traversed: ratio(tiles.nodes_visited, tiles.receivers),
        average_traversal_bytes: ratio(tiles.traversal_bytes, tiles.receivers),
        pages_loaded: count(pages.loads),
        bytes_read: count(pages.bytes_loaded),
        local_hits: count(tiles.local_hits),
        shared_hits: count(tiles.shared_hits),
        shared_hits_other_job: count(tiles.shared_hits_other_job),
        cache_misses: count(misses),
        ..Statistics::default()
    }
}
