//! [`build()`]: reads, sorts, constructs, publishes.

use crate::budget::Budget;
use crate::content_hash::ContentHash;
use crate::error::BuildError;
use crate::intake::{Intake, Watcher, take_in};
use crate::limits::{BATCH_POINTS, BATCHES_IN_FLIGHT};
use crate::octree::construction::{Constructed, construct};
use crate::report::{BuildProgress, BuildReport, BuildRequest, Stage};
use crate::sort::merge::Merge;
use crate::sort::sorter::{SortResult, Sorter, Traffic, check_room};
use crate::sort::{SortedBatch, SortedPoints};
use pbgi_core::{PointRecord, PointStream, Quantizer, SceneInfo};
use pbgi_store::limits::RECORDS_MAX;
use pbgi_store::{OsVolume, SceneWriter, StoreError, Volume};
use std::ops::ControlFlow;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
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
}

impl Default for BuildHost {
    fn default() -> Self {
        Self {
            volume: Arc::new(OsVolume),
            records_max: RECORDS_MAX,
            run_points_max: usize::MAX,
            fan_in_max: usize::MAX,
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
    let mut budget = Budget::new(request.memory_bytes, &request.settings).map_err(BuildError::widen)?;
    budget.run_points = budget.run_points.min(host.run_points_max).max(1);
    budget.fan_in = budget.fan_in.min(host.fan_in_max).max(2);
    let mut watcher = Watcher(observer);
    // First of all, so that an output that cannot be written is known before the points are sorted.
    let writer = SceneWriter::create(&host.volume, &request.output, request.overwrite, &request.settings)?;
    let mut sorter = Sorter::new(&host.volume, &request.scratch_dir, budget);
    let intake = take_in(stream, &mut sorter, host.records_max, &mut watcher)?;
    let job = Job {
        request,
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
        let mut hash = ContentHash::default();
        let mut building = Instant::now();
        if let Some(quantizer) = self.intake.quantizer {
            let sorted;
            (sorted, traffic) = self.merge_down(sorter, &quantizer)?;
            building = Instant::now();
            (constructed, hash) = match sorted {
                SortResult::Memory(buffer) => {
                    self.watcher.tell(Stage::Sorting, 0, Some(points))?;
                    let mut sorted = buffer.sorted(&quantizer);
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
        let info = self.describe(&constructed, hash, writer.node_slots());
        self.watcher.tell(Stage::Building, points, Some(points))?;
        let scene_bytes = writer.finish(&info)?;
        let mut stages = self.intake.seconds;
        stages.building = building.elapsed().as_secs_f64();
        Ok(BuildReport {
            info,
            sort_seconds: stages.reading + stages.sorting + stages.merging,
            build_seconds: stages.building,
            stages,
            bytes_read: traffic.bytes_read,
            bytes_written: traffic.bytes_written + scene_bytes,
            runs: traffic.runs,
            radiance_clamped: self.intake.tally.radiance_clamped,
            harmonics_clamped: constructed.harmonics_clamped,
            overflow_points: constructed.overflow_points,
        })
    }

    /// Until everything is in memory or in few enough runs.
    fn merge_down(&mut self, mut sorter: Sorter, quantizer: &Quantizer) -> Result<(SortResult, Traffic), BuildError> {
        let (points, watcher) = (self.intake.tally.points, &mut self.watcher);
        if sorter.has_runs() {
            let started = Instant::now();
            sorter.spill(quantizer, None, &mut |_| {
                watcher.tell(Stage::Sorting, points, Some(points))
            })?;
            self.intake.seconds.sorting += started.elapsed().as_secs_f64();
        }
        let started = Instant::now();
        let result = sorter.finish(quantizer, &mut |done| watcher.tell(Stage::Merging, done, None))?;
        self.intake.seconds.merging += started.elapsed().as_secs_f64();
        Ok(result)
    }

    /// Construction on this thread, the last merge on another.
    fn construct(
        &mut self,
        points: &mut (dyn SortedPoints + Send),
        writer: &mut SceneWriter,
        quantizer: &Quantizer,
    ) -> Result<(Constructed, ContentHash), BuildError> {
        let (to_construction, from_sort) = sync_channel(BATCHES_IN_FLIGHT);
        let (to_sort, from_construction) = sync_channel(BATCHES_IN_FLIGHT);
        let total = Some(self.intake.tally.points);
        let (settings, records_max, watcher) = (&self.request.settings, self.records_max, &mut self.watcher);
        std::thread::scope(|scope| {
            let producer = std::thread::Builder::new()
                .name("pbgi-merge".to_owned())
                .spawn_scoped(scope, move || produce(points, &to_construction, &from_construction))
                .map_err(BuildError::Thread)?;
            let mut done = 0;
            // Owns its end of the channels: when construction fails, they close, and the producer ends.
            let mut source = move |emptied: SortedBatch| {
                watcher.tell(Stage::Building, done, total)?;
                // A full channel means that there are empty batches enough.
                let _ = to_sort.try_send(emptied);
                let batch: SortedBatch = from_sort.recv().unwrap_or(Ok(SortedBatch::default()))?;
                done += batch.codes.len() as u64;
                Ok(batch)
            };
            let constructed = construct(&mut source, writer, quantizer, settings, records_max);
            drop(source);
            match producer.join() {
                Ok(hash) => Ok((constructed?, hash)),
                Err(panic) => std::panic::resume_unwind(panic),
            }
        })
    }

    fn describe(&self, constructed: &Constructed, hash: ContentHash, node_slots: u64) -> SceneInfo {
        let Intake { tally, quantizer, .. } = &self.intake;
        // A box that was declared for no points at all makes no lattice.
        let quantizer = quantizer.filter(|_| tally.points > 0);
        let settings = self.request.settings;
        SceneInfo {
            build_id: hash.finish(tally.points, quantizer.as_ref(), &settings),
            point_count: tally.points,
            node_count: constructed.node_count,
            node_slots,
            root: constructed.root,
            bounds: quantizer.map(|_| tally.bounds),
            quantizer,
            radius_max: tally.radius_max,
            settings,
        }
    }
}

/// Sends all points in order, and hashes them on the way. Ends early when nobody listens any more.
fn produce(
    points: &mut dyn SortedPoints,
    to_construction: &SyncSender<Result<SortedBatch, StoreError>>,
    from_construction: &Receiver<SortedBatch>,
) -> ContentHash {
    let mut hash = ContentHash::default();
    loop {
        let mut batch = from_construction.try_recv().unwrap_or_default();
        if batch.points.capacity() < BATCH_POINTS {
            batch = SortedBatch::with_room();
        }
        let sorted = points.next_sorted(&mut batch);
        if batch.points.is_empty() && sorted.is_ok() {
            return hash;
        }
        batch.points.iter().for_each(|point| hash.add(point));
        let failed = sorted.is_err();
        if to_construction.send(sorted.map(|()| batch)).is_err() || failed {
            return hash;
        }
    }
}
