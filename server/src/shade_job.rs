//! A picture's life around its tiles: open the scene, read the G-buffer, wait for memory; afterwards add up and write.

use crate::dispatcher::Dispatcher;
use crate::error::JobError;
use crate::framebuffer::Framebuffer;
use crate::job::ShadeTask;
use crate::limits;
use crate::mounts::{Mounted, Mounts};
use crate::output;
use crate::scheduler::JobNo;
use pbgi_cache::JobCounters;
use pbgi_core::limits::IMAGE_PIXELS_MAX;
use pbgi_core::{Environment, Statistics};
use pbgi_points::{GBuffer, read_environment};
use pbgi_store::StoreError;
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
    started: Instant,
    _memory: OwnedSemaphorePermit,
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
    /// Adds another tile's. A worker's nonsense does not overflow.
    pub fn add(&mut self, other: &Self) {
        let add = |sum: &mut u64, value: u64| *sum = sum.saturating_add(value);
        add(&mut self.receivers, other.receivers);
        add(&mut self.cut_elements, other.cut_elements);
        add(&mut self.nodes_visited, other.nodes_visited);
        add(&mut self.traversal_bytes, other.traversal_bytes);
        add(&mut self.local_hits, other.local_hits);
        add(&mut self.shared_hits, other.shared_hits);
        add(&mut self.shared_hits_other_job, other.shared_hits_other_job);
        add(&mut self.cache_misses, other.cache_misses);
        add(&mut self.cpu_nanos, other.cpu_nanos);
        add(&mut self.io_nanos, other.io_nanos);
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
    mut abort: watch::Receiver<bool>,
) -> Result<Shading, String> {
    let gate = tokio::select! {
        gate = dispatcher.picture_gate.lock() => gate,
        _ = abort.wait_for(|stop| *stop) => return Err(STOPPED.into()),
    };
    let (mounts, task) = (dispatcher.mounts.clone(), task.clone());
    let read = tokio::task::spawn_blocking(move || read(&mounts, &task)).await;
    let (frame, mounted, environment) = read.map_err(|error| error.to_string())??;
    let megabytes = (frame.pixel_count() * limits::PICTURE_BYTES_PER_PIXEL)
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
    tracing::debug!(job = job.0, holes = frame.holes(), megabytes, "picture read");
    Ok(Shading {
        frame,
        mounted,
        environment,
        counters: Counters::default(),
        started: Instant::now(),
        _memory: memory,
    })
}

/// Why a stopped job's task ended; the scheduler knows the real reason.
const STOPPED: &str = "stopped";

type Ingredients = (Framebuffer, Mounted, Option<Arc<Environment>>);

fn read(mounts: &Mounts, task: &ShadeTask) -> Result<Ingredients, String> {
    // Said now, not after the work is done.
    if !task.overwrite && std::fs::symlink_metadata(&task.output).is_ok() {
        let path = task.output.clone();
        return Err(StoreError::Exists { path }.to_string());
    }
    let mounted = mounts.open(&task.scene).map_err(|error: JobError| error.text)?;
    let environment = match &task.environment {
        Some(path) => {
            let environment = read_environment(path).map_err(|error| error.to_string())?;
            Some(Arc::new(crate::environment::shrink(environment)))
        }
        None => None,
    };
    let gbuffer = GBuffer::read(&task.gbuffer).map_err(|error| error.to_string())?;
    let pixels = gbuffer.pixel_count() as u64;
    if pixels > IMAGE_PIXELS_MAX {
        let path = task.gbuffer.display();
        return Err(format!(
            "picture of {pixels} pixels, at most {IMAGE_PIXELS_MAX} are shaded, in {path}"
        ));
    }
    Ok((Framebuffer::new(gbuffer), mounted, environment))
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
    let seconds = shading.started.elapsed().as_secs_f64();
    let mut statistics = shading_statistics(&shading, &dispatcher.cache.job_counters(job.0), seconds);
    let (memory, cache) = dispatcher.peaks(job);
    statistics.peak_memory_bytes = Some(memory as f64);
    statistics.cache_peak_bytes = Some(cache as f64);
    let picture = output::Picture {
        build_id: shading.mounted.scene().info().build_id,
        task: task.clone(),
        statistics: statistics.clone(),
        scratch: dispatcher.config.options.scratch_dir.clone(),
    };
    let Shading {
        frame, _memory: memory, ..
    } = shading;
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

fn shading_statistics(shading: &Shading, pages: &JobCounters, seconds: f64) -> Statistics {
    let info = shading.mounted.scene().info();
    let tiles = &shading.counters;
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
        holes: count(shading.frame.holes()),
        ..Statistics::default()
    }
}
