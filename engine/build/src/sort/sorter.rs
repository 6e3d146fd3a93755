//! [`Sorter`]: takes points in any order and gives them back sorted, through scratch where memory does not hold them.

use crate::budget::Budget;
use crate::error::BuildError;
use crate::limits::{BATCH_POINTS, LEN_HINT_TRUST};
use crate::sort::buffer::PointBuffer;
use crate::sort::merge::Merge;
use pbgi_core::{PointRecord, Quantizer};
use pbgi_store::{Run, RunWriter, ScratchDir, StoreError, Volume};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Collects points, spills sorted runs.
pub struct Sorter {
    buffer: PointBuffer,
    runs: Vec<Run>,
    // Dropped after the runs in it.
    scratch: Option<ScratchDir>,
    volume: Arc<dyn Volume>,
    scratch_dir: PathBuf,
    budget: Budget,
    traffic: Traffic,
}

/// What went to scratch and came back.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Traffic {
    /// Runs written.
    pub runs: u64,
    /// Bytes written.
    pub bytes_written: u64,
    /// Bytes read, those of the last merge included.
    pub bytes_read: u64,
}

/// All points, ready to be read in order.
pub enum SortResult {
    /// All in memory.
    Memory(PointBuffer),
    /// In runs, few enough to be merged at once.
    Runs(Vec<Run>, ScratchDir),
}

/// Told about points done in a stage; an error stops the sort.
pub type Watch<'a> = &'a mut dyn FnMut(u64) -> Result<(), BuildError>;

impl Sorter {
    /// An empty sorter; scratch is touched by the first spill.
    pub fn new(volume: &Arc<dyn Volume>, scratch_dir: &Path, budget: Budget) -> Self {
        Self {
            buffer: PointBuffer::new(budget.run_points),
            runs: Vec::new(),
            scratch: None,
            volume: volume.clone(),
            scratch_dir: scratch_dir.to_owned(),
            budget,
            traffic: Traffic::default(),
        }
    }

    /// Points in memory.
    pub fn buffer(&mut self) -> &mut PointBuffer {
        &mut self.buffer
    }

    /// Scratch traffic so far.
    pub fn traffic(&self) -> Traffic {
        self.traffic
    }

    /// Sorts the points in memory and writes them to scratch as a run. `expected` is how many points the input says it
    /// has.
    ///
    /// # Errors
    /// [`StoreError::NoSpace`] before anything is written where the runs obviously do not fit; other errors of scratch;
    /// those of `watch`.
    pub fn spill(&mut self, quantizer: &Quantizer, expected: Option<u64>, watch: Watch<'_>) -> Result<(), BuildError> {
        let scratch = match &mut self.scratch {
            Some(scratch) => scratch,
            none => none.insert(ScratchDir::create(&self.volume, &self.scratch_dir)?),
        };
        let spilled: u64 = self.runs.iter().map(Run::records).sum();
        let hinted = expected.map_or(0, |points| (points as f64 * LEN_HINT_TRUST) as u64);
        let left = hinted.saturating_sub(spilled).max(self.buffer.len() as u64);
        let needed = left.saturating_mul(size_of::<PointRecord>() as u64);
        check_room(scratch.free_bytes()?, needed, scratch.path())?;
        let mut writer = RunWriter::create(scratch, self.traffic.runs)?;
        let sorted = self.buffer.sorted(quantizer);
        for (done, (_, point)) in sorted.iter().enumerate() {
            writer.push(point)?;
            if done.is_multiple_of(BATCH_POINTS) {
                watch(done as u64)?;
            }
        }
        let run = writer.finish()?;
        self.traffic.runs += 1;
        self.traffic.bytes_written += run.bytes();
        self.runs.push(run);
        self.buffer.clear();
        Ok(())
    }

    /// Whether something was spilled.
    pub fn has_runs(&self) -> bool {
        !self.runs.is_empty()
    }

    /// Ends: spills what is left if there are runs, and merges runs until the last merge can take them all.
    ///
    /// # Errors
    /// Those of scratch and of `watch`.
    pub fn finish(mut self, quantizer: &Quantizer, watch: Watch<'_>) -> Result<(SortResult, Traffic), BuildError> {
        let Some(scratch) = self.scratch.take() else {
            return Ok((SortResult::Memory(self.buffer), self.traffic));
        };
        // The merges need the memory.
        drop(self.buffer);
        while self.runs.len() > self.budget.fan_in {
            let mut longer = Vec::new();
            let mut group = Vec::new();
            let mut runs = std::mem::take(&mut self.runs).into_iter().peekable();
            while let Some(run) = runs.next() {
                group.push(run);
                if group.len() == self.budget.fan_in || runs.peek().is_none() {
                    let group = std::mem::take(&mut group);
                    longer.push(merge_group(
                        group,
                        &scratch,
                        quantizer,
                        &self.budget,
                        &mut self.traffic,
                        watch,
                    )?);
                }
            }
            self.runs = longer;
        }
        self.traffic.bytes_read += self.runs.iter().map(Run::bytes).sum::<u64>();
        Ok((SortResult::Runs(self.runs, scratch), self.traffic))
    }
}

/// Merges consecutive runs into one.
fn merge_group(
    group: Vec<Run>,
    scratch: &ScratchDir,
    quantizer: &Quantizer,
    budget: &Budget,
    traffic: &mut Traffic,
    watch: Watch<'_>,
) -> Result<Run, BuildError> {
    let mut group = group;
    if group.len() == 1
        && let Some(run) = group.pop()
    {
        return Ok(run);
    }
    let bytes = group.iter().map(Run::bytes).sum();
    check_room(scratch.free_bytes()?, bytes, scratch.path())?;
    let blocks = budget.blocks_per_read(group.len() + 1);
    let mut merge = Merge::new(group, blocks, *quantizer)?;
    let mut writer = RunWriter::create(scratch, traffic.runs)?;
    let mut done = 0u64;
    while let Some((_, point)) = merge.next_point()? {
        writer.push(point)?;
        done += 1;
        if done.is_multiple_of(BATCH_POINTS as u64) {
            watch(done)?;
        }
    }
    traffic.runs += 1;
    traffic.bytes_read += bytes;
    traffic.bytes_written += bytes;
    Ok(writer.finish()?)
}

/// Refuses what obviously does not fit, before anything is written.
pub(crate) fn check_room(free: u64, needed: u64, path: &Path) -> Result<(), StoreError> {
    if free >= needed {
        return Ok(());
    }
    Err(StoreError::NoSpace {
        needed,
        free,
        path: path.to_owned(),
    })
}
