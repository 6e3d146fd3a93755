//! [`build()`]: reads, sorts, constructs, publishes.

use crate::budget::Budget;
use crate::error::BuildError;
use crate::intake::{Intake, Watcher, take_in};
use crate::limits::{CACHED_POINTS_MAX, DISK_WATCH_POINTS};
use crate::octree::construction::{Constructed, construct};
use crate::report::{BuildProgress, BuildReport, BuildRequest, Stage};
use crate::sort::SortedStream;
use crate::sort::merge::Merge;
use crate::sort::radix::SortedPoints;
use crate::sort::sorter::{SortResult, Sorter, Traffic, check_room};
use pbgi_core::{PointRecord, PointStream, Quantizer, SceneInfo};
use pbgi_store::limits::RECORDS_MAX;
use pbgi_store::{IoMode, OsVolume, SceneWriter, StoreError, Volume};
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

/// What a build runs on: the real thing by default, doubles and smaller limits for tests.
#[derive(Clone)]
pub struct BuildHost {
    /// Where scratch and output are.
    pub volume: Arc<dyn Volume>,
    /// Points and node slots that an index can count.
    pub records_max: u64,
    /// Points sorted in memory at once, where fewer than the memory would hold.
    pub run_points_max: usize,
    /// Runs merged at once, where fewer than the memory would hold.
    pub fan_in_max: usize,
    /// Threads that make nodes.
    pub threads: usize,
    /// Points of a construction job, where fewer than the memory would hold.
    pub job_points_max: usize,
}

impl Default for BuildHost {
    fn default() -> Self {
        Self {
            volume: Arc::new(OsVolume),
            records_max: RECORDS_MAX,
            run_points_max: usize::MAX,
            fan_in_max: usize::MAX,
            threads: std::thread::available_parallelism().map_or(1, usize::from),
            job_points_max: usize::MAX,
        }
    }
}

/// Builds the octree of all points of `stream` and publishes it as `request.output`. `observer` is called for every few
/// thousand points; `Break` cancels the build.
///
/// # Errors
/// See [`BuildError`]. Nothing is left behind then: no output, no temporary, no scratch.
pub fn build<S: PointStream + ?Sized>(
    stream: &mut S,
    request: &BuildRequest,
    observer: &mut dyn FnMut(BuildProgress) -> ControlFlow<()>,
) -> Result<BuildReport, BuildError<S::Error>> {
    build_on(stream, request, &BuildHost::default(), observer)
}

/// As [`build()`], on a host of choice.
///
/// # Errors
/// As [`build()`].
pub fn build_on<S: PointStream + ?Sized>(
    stream: &mut S,
    request: &BuildRequest,
    host: &BuildHost,
    observer: &mut dyn FnMut(BuildProgress) -> ControlFlow<()>,
) -> Result<BuildReport, BuildError<S::Error>> {
    request.settings.validate()?;
    let mut budget = Budget::new(request.memory_bytes, host.threads, &request.settings).map_err(BuildError::widen)?;
    budget.run_points = budget.run_points.min(host.run_points_max).max(1);
    budget.core_points = budget.core_points.min(host.run_points_max).max(1);
    budget.fan_in = budget.fan_in.min(host.fan_in_max).max(2);
    budget.gang.job_points = budget.gang.job_points.min(host.job_points_max).max(1);
    let mut watcher = Watcher(observer);
    let mut sorter = Sorter::new(&host.volume, &request.scratch_dir, request.input_key, budget);
    sorter.expect(stream.len_hint());
    let large = stream.len_hint().is_some_and(|points| points > CACHED_POINTS_MAX);
    let mode = if large || !sorter.fits_core() {
        IoMode::Direct
    } else {
        IoMode::Buffered
    };
    // Now, so that an output that cannot be written is known before the points are sorted.
    let writer = SceneWriter::create(
        &host.volume,
        &request.output,
        request.overwrite,
        &request.settings,
        mode,
    )?;
    let intake = take_in(stream, &mut sorter, host.records_max, &mut watcher)?;
    let job = Job {
        request,
        volume: host.volume.as_ref(),
        records_max: host.records_max,
        budget,
        intake,
        watcher,
    };
    job.finish(sorter, writer).map_err(BuildError::widen)
}

/// A build whose points are in the sorter.
struct Job<'a> {
    request: &'a BuildRequest,
    volume: &'a dyn Volume,
    records_max: u64,
    budget: Budget,
    intake: Intake,
    watcher: Watcher<'a>,
}

impl Job<'_> {
    fn finish(mut self, sorter: Sorter, mut writer: SceneWriter) -> Result<BuildReport, BuildError> {
        let points = self.intake.tally.points;
        // Nodes come on top; how many is not known yet.
        let point_bytes = points * size_of::<PointRecord>() as u64;
        check_room(writer.free_bytes()?, point_bytes, writer.target())?;
        let mut traffic = Traffic::default();
        let mut constructed = Constructed::default();
        let mut building = Instant::now();
        if let Some(quantizer) = self.intake.quantizer {
            let sorted;
            (sorted, traffic) = self.merge_down(sorter, &quantizer)?;
            building = Instant::now();
            constructed = match sorted {
                SortResult::Memory(buffer) => {
                    self.watcher.tell(Stage::Sorting, 0, Some(points))?;
                    let mut sorted = SortedPoints::new(buffer, &quantizer, self.budget.gang.threads);
                    self.intake.seconds.sorting += building.elapsed().as_secs_f64();
                    building = Instant::now();
                    self.construct(&mut sorted, &mut writer, &quantizer)?
                }
                SortResult::Runs(runs, _scratch) => {
                    let blocks = self.budget.blocks_per_read(runs.len());
                    let mut merge = Merge::new(runs, blocks, quantizer)?;
                    self.construct(&mut merge, &mut writer, &quantizer)?
                }
            };
        }
        debug_assert_eq!(writer.point_count(), points, "every point has been written");
        let info = self.describe(&constructed, writer.node_slots());
        self.watcher.tell(Stage::Building, points, Some(points))?;
        let syncing = Instant::now();
        let scene_bytes = writer.finish(&info)?;
        constructed.busy.syncing = syncing.elapsed().as_secs_f64();
        constructed.busy.spilling = traffic.spill_seconds;
        let mut stages = self.intake.seconds;
        stages.building = building.elapsed().as_secs_f64();
        Ok(BuildReport {
            info,
            sort_seconds: stages.reading + stages.sorting + stages.merging,
            build_seconds: stages.building,
            stages,
            busy: constructed.busy,
            queue_peak_bytes: constructed.placed.queue_peak_bytes,
            bytes_read: traffic.bytes_read,
            bytes_written: traffic.bytes_written + scene_bytes,
            runs: traffic.runs,
            runs_resumed: traffic.runs_resumed,
            radiance_clamped: self.intake.tally.radiance_clamped,
            harmonics_clamped: constructed.placed.tallies.harmonics_clamped,
            overflow_points: constructed.placed.tallies.overflow_points,
        })
    }

    /// Until everything is in memory or in few enough runs.
    fn merge_down(&mut self, sorter: Sorter, quantizer: &Quantizer) -> Result<(SortResult, Traffic), BuildError> {
        let (points, watcher) = (self.intake.tally.points, &mut self.watcher);
        watcher.tell(Stage::Sorting, points, Some(points))?;
        let started = Instant::now();
        let result = sorter.finish(quantizer, &mut |done| watcher.tell(Stage::Merging, done, None))?;
        self.intake.seconds.merging += started.elapsed().as_secs_f64();
        Ok(result)
    }

    fn construct(
        &mut self,
        stream: &mut (dyn SortedStream + Send),
        writer: &mut SceneWriter,
        quantizer: &Quantizer,
    ) -> Result<Constructed, BuildError> {
        let points = self.intake.tally.points;
        let watcher = &mut self.watcher;
        let mut looked_at = 0;
        let mut tell = |done: u64| {
            if done >= looked_at + DISK_WATCH_POINTS {
                looked_at = done;
                // Others fill the disk as well: what cannot end well is ended now.
                let left = (points - done) * size_of::<PointRecord>() as u64;
                check_room(
                    free_bytes(self.volume, &self.request.output)?,
                    left,
                    &self.request.output,
                )?;
            }
            watcher.tell(Stage::Building, done, Some(points))
        };
        let (settings, gang) = (&self.request.settings, self.budget.gang);
        construct(stream, writer, quantizer, settings, gang, self.records_max, &mut tell)
    }

    fn describe(&self, constructed: &Constructed, node_slots: u64) -> SceneInfo {
        let Intake { tally, quantizer, .. } = &self.intake;
        // A box that was declared for no points at all makes no lattice.
        let quantizer = quantizer.filter(|_| tally.points > 0);
        let settings = self.request.settings;
        SceneInfo {
            build_id: constructed
                .hash
                .clone()
                .finish(tally.points, quantizer.as_ref(), &settings),
            point_count: tally.points,
            node_count: constructed.placed.tallies.nodes,
            node_slots,
            root: constructed.placed.root,
            bounds: quantizer.map(|_| tally.bounds),
            quantizer,
            radius_max: tally.radius_max,
            origin: self.intake.origin,
            settings,
        }
    }
}

/// What may still be written beside `output`.
fn free_bytes(volume: &dyn Volume, output: &Path) -> Result<u64, StoreError> {
    let folder = output.parent().filter(|folder| !folder.as_os_str().is_empty());
    let folder = folder.unwrap_or(Path::new("."));
    volume.free_bytes(folder).map_err(|source| StoreError::Io {
        action: "read free space",
        path: folder.to_owned(),
        source,
    })
}
