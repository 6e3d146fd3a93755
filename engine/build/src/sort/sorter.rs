//! [`Sorter`]: takes points in any order and gives them back sorted, through scratch where memory does not hold them.

use crate::budget::Budget;
use crate::content_hash::UnorderedHash;
use crate::error::BuildError;
use crate::limits::LEN_HINT_TRUST;
use crate::sort::SortedStream;
use crate::sort::buffer::PointBuffer;
use crate::sort::merge::Merge;
use crate::sort::radix::SortedPoints;
use crate::sort::resume::{Content, Known, Span, without_gaps};
use pbgi_core::{PointRecord, Quantizer};
use pbgi_store::{Run, RunWriter, ScratchDir, StoreError, Volume};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread::{Builder, JoinHandle};
use std::time::Instant;

/// Collects points, spills sorted runs: one is sorted and written while the next is collected.
pub struct Sorter {
    buffer: PointBuffer,
    spilling: Spilling,
    runs: Vec<Span>,
    // Dropped after the runs in it.
    scratch: Option<Arc<ScratchDir>>,
    volume: Arc<dyn Volume>,
    scratch_dir: PathBuf,
    budget: Budget,
    /// Points that the input says it has.
    expected: u64,
    /// Names the scratch folder, where runs may outlive this process.
    input_key: Option<u64>,
    /// Points at the start of the input that are in runs already.
    known: Known,
    next_run: u64,
    traffic: Traffic,
}

/// The run that is being made. Dropping it waits for its end, so that nothing is written to scratch any more.
#[derive(Default)]
struct Spilling(Option<JoinHandle<Result<Spilled, BuildError>>>);

struct Spilled {
    span: Span,
    /// Emptied.
    buffer: PointBuffer,
    seconds: f64,
}

impl Spilling {
    fn wait(&mut self) -> Result<Option<Spilled>, BuildError> {
        match self.0.take().map(JoinHandle::join) {
            None => Ok(None),
            Some(Ok(spilled)) => spilled.map(Some),
            Some(Err(panic)) => std::panic::resume_unwind(panic),
        }
    }
}

impl Drop for Spilling {
    fn drop(&mut self) {
        if let Some(thread) = self.0.take() {
            // Whoever drops it has an error of its own to tell.
            let _ = thread.join();
        }
    }
}

/// What went to scratch and came back.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Traffic {
    /// Runs written.
    pub runs: u64,
    /// Bytes written.
    pub bytes_written: u64,
    /// Bytes read, those of the last merge included.
    pub bytes_read: u64,
    /// Time spent sorting runs and writing them.
    pub spill_seconds: f64,
    /// Runs that were there already.
    pub runs_resumed: u64,
}

/// All points, ready to be read in order.
pub enum SortResult {
    /// All in memory.
    Memory(PointBuffer),
    /// In runs, few enough to be merged at once.
    Runs(Vec<Run>, Arc<ScratchDir>),
}

/// Told about points done in a stage; an error stops the sort.
pub type Watch<'a> = &'a mut dyn FnMut(u64) -> Result<(), BuildError>;

impl Sorter {
    /// An empty sorter; scratch is touched by the first spill.
    pub fn new(volume: &Arc<dyn Volume>, scratch_dir: &Path, input_key: Option<u64>, budget: Budget) -> Self {
        Self {
            buffer: PointBuffer::new(budget.core_points),
            spilling: Spilling::default(),
            runs: Vec::new(),
            scratch: None,
            volume: volume.clone(),
            scratch_dir: scratch_dir.to_owned(),
            budget,
            expected: 0,
            input_key,
            known: Known::default(),
            next_run: 0,
            traffic: Traffic::default(),
        }
    }

    /// Says how many points the input says it has, before any are given. It may be wrong.
    pub fn expect(&mut self, points: Option<u64>) {
        // An estimate need not be exact.
        self.expected = points.map_or(0, |points| (points as f64 * LEN_HINT_TRUST) as u64);
        if !self.fits_core() {
            self.buffer = PointBuffer::new(self.budget.run_points);
        }
    }

    /// Whether the points are expected to need no runs.
    pub fn fits_core(&self) -> bool {
        self.expected <= self.budget.core_points as u64
    }

    /// Takes over the runs that a killed build of this input left, if they were sorted by the same lattice. The points in
    /// them are to come all the same, to be compared and left out.
    ///
    /// # Errors
    /// Those of scratch.
    pub fn resume(&mut self, quantizer: &Quantizer) -> Result<(), StoreError> {
        let (Some(key), None) = (self.input_key, &self.scratch) else {
            return Ok(());
        };
        let scratch = ScratchDir::create_or_adopt(&self.volume, &self.scratch_dir, key)?;
        let found = scratch.sealed_runs()?;
        self.next_run = found.last().map_or(0, |(run, _)| run.number() + 1);
        self.runs = without_gaps(found, quantizer);
        self.scratch = Some(Arc::new(scratch));
        self.traffic.runs = self.runs.len() as u64;
        self.traffic.runs_resumed = self.traffic.runs;
        self.known = Known::new(&self.runs);
        Ok(())
    }

    /// Takes the points that are in runs already off the next ones of the input; `None` if the input has others at its start:
    /// then [`Self::forget`] is called, and the input given again.
    pub(crate) fn skip_known<'a>(&mut self, points: &'a [PointRecord]) -> Option<&'a [PointRecord]> {
        self.known.skip(points).ok()
    }

    /// Whether all points that are in runs came again, which they must have by the end of the input.
    pub(crate) fn knows_no_more(&self) -> bool {
        self.known.end().is_ok()
    }

    /// Gives up everything: the input is another than that of the runs.
    pub(crate) fn forget(&mut self) -> Result<(), BuildError> {
        self.settle()?;
        self.buffer.clear();
        self.runs.clear();
        self.known = Known::default();
        self.traffic = Traffic::default();
        Ok(())
    }

    /// Threads to work with.
    pub fn threads(&self) -> usize {
        self.budget.gang.threads
    }

    /// Points in memory.
    pub fn buffer(&mut self) -> &mut PointBuffer {
        &mut self.buffer
    }

    /// Scratch traffic so far.
    pub fn traffic(&self) -> Traffic {
        self.traffic
    }

    /// Begins to sort the points in memory and to write them to scratch as a run; waits for the run before.
    ///
    /// # Errors
    /// [`StoreError::NoSpace`] before anything is written where the runs obviously do not fit; other errors of scratch,
    /// which may be those of the run before.
    pub fn spill(&mut self, quantizer: &Quantizer) -> Result<(), BuildError> {
        let spare = self.settle()?;
        let scratch = match &mut self.scratch {
            Some(scratch) => scratch,
            none => none.insert(Arc::new(ScratchDir::create(&self.volume, &self.scratch_dir)?)),
        };
        let spilled: u64 = self.runs.iter().map(|span| span.run.records()).sum();
        let left = self.expected.saturating_sub(spilled).max(self.buffer.len() as u64);
        let needed = left.saturating_mul(size_of::<PointRecord>() as u64);
        check_room(scratch.free_bytes()?, needed, scratch.path())?;
        // The first buffer may have grown for points that were expected to stay in memory: then there is no room beside.
        let oversized = self.buffer.capacity() > self.budget.run_points;
        let next = spare.unwrap_or_else(|| PointBuffer::new(self.budget.run_points));
        let full = std::mem::replace(&mut self.buffer, next);
        let (scratch, quantizer, threads) = (scratch.clone(), *quantizer, self.threads());
        let number = self.number();
        let sealed = self.input_key.is_some();
        let spill = move || write_run(&scratch, number, full, spilled, &quantizer, threads, sealed);
        let thread = Builder::new().name("pbgi-sort".to_owned()).spawn(spill);
        self.spilling.0 = Some(thread.map_err(BuildError::Thread)?);
        if oversized {
            self.settle()?;
        }
        Ok(())
    }

    /// The number of another run.
    fn number(&mut self) -> u64 {
        let number = self.next_run;
        self.next_run += 1;
        self.traffic.runs += 1;
        number
    }

    /// Waits for the run that is being made; returns its memory.
    fn settle(&mut self) -> Result<Option<PointBuffer>, BuildError> {
        let Some(Spilled { span, buffer, seconds }) = self.spilling.wait()? else {
            return Ok(None);
        };
        self.traffic.bytes_written += span.run.bytes();
        self.traffic.spill_seconds += seconds;
        self.runs.push(span);
        Ok((buffer.capacity() <= self.budget.run_points).then_some(buffer))
    }

    /// Whether something was spilled.
    pub fn has_runs(&self) -> bool {
        self.traffic.runs > 0
    }

    /// Ends: spills what is left if there are runs, and merges runs until the last merge can take them all.
    ///
    /// # Errors
    /// Those of scratch and of `watch`.
    pub fn finish(mut self, quantizer: &Quantizer, watch: Watch<'_>) -> Result<(SortResult, Traffic), BuildError> {
        if !self.has_runs() {
            return Ok((SortResult::Memory(self.buffer), self.traffic));
        }
        if !self.buffer.is_empty() {
            self.spill(quantizer)?;
        }
        self.settle()?;
        let Some(scratch) = self.scratch.take() else {
            return Ok((SortResult::Memory(self.buffer), self.traffic));
        };
        // The merges need the memory.
        self.buffer = PointBuffer::new(0);
        while self.runs.len() > self.budget.fan_in {
            let mut shorter = std::mem::take(&mut self.runs).into_iter();
            while shorter.len() > 0 {
                let group: Vec<Span> = shorter.by_ref().take(self.budget.fan_in).collect();
                let merged = self.merge(group, &scratch, quantizer, watch)?;
                self.runs.push(merged);
            }
        }
        self.traffic.bytes_read += self.runs.iter().map(|span| span.run.bytes()).sum::<u64>();
        let runs = self.runs.into_iter().map(|span| span.run).collect();
        Ok((SortResult::Runs(runs, scratch), self.traffic))
    }

    /// Merges consecutive runs into one. They go when it is sealed.
    fn merge(
        &mut self,
        mut group: Vec<Span>,
        scratch: &ScratchDir,
        quantizer: &Quantizer,
        watch: Watch<'_>,
    ) -> Result<Span, BuildError> {
        if group.len() == 1
            && let Some(span) = group.pop()
        {
            return Ok(span);
        }
        let bytes = group.iter().map(|span| span.run.bytes()).sum();
        check_room(scratch.free_bytes()?, bytes, scratch.path())?;
        let mut content = Content {
            first: group.iter().map(|span| span.content.first).min().unwrap_or_default(),
            hash: UnorderedHash::default(),
        };
        group.iter().for_each(|span| content.hash.merge(span.content.hash));
        let blocks = self.budget.blocks_per_read(group.len());
        let mut merge = Merge::new(group.into_iter().map(|span| span.run).collect(), blocks, *quantizer)?;
        let mut writer = RunWriter::create(scratch, self.number())?;
        let mut done = 0u64;
        let (mut codes, mut points) = (Vec::new(), Vec::new());
        while merge.next_batch(&mut codes, &mut points)? {
            writer.append(&points)?;
            done += points.len() as u64;
            watch(done)?;
            codes.clear();
            points.clear();
        }
        self.traffic.bytes_read += bytes;
        self.traffic.bytes_written += bytes;
        let run = match self.input_key {
            Some(_) => writer.finish_sealed(&content.to_note(quantizer))?,
            None => writer.finish()?,
        };
        Ok(Span { run, content })
    }
}

/// Sorts a buffer, whose first point is number `first` of the input, and writes it as run `number`.
fn write_run(
    scratch: &ScratchDir,
    number: u64,
    buffer: PointBuffer,
    first: u64,
    quantizer: &Quantizer,
    threads: usize,
    sealed: bool,
) -> Result<Spilled, BuildError> {
    let started = Instant::now();
    let capacity = buffer.capacity();
    let mut sorted = SortedPoints::new(buffer, quantizer, threads);
    let mut writer = RunWriter::create(scratch, number)?;
    let mut hash = UnorderedHash::default();
    let (mut codes, mut points) = (Vec::new(), Vec::new());
    while sorted.next_batch(&mut codes, &mut points)? {
        points.iter().for_each(|point| hash.add(point));
        writer.append(&points)?;
        codes.clear();
        points.clear();
    }
    let content = Content { first, hash };
    let run = if sealed {
        writer.finish_sealed(&content.to_note(quantizer))?
    } else {
        writer.finish()?
    };
    Ok(Spilled {
        span: Span { run, content },
        buffer: PointBuffer::with_spare(sorted.into_spare(), capacity),
        seconds: started.elapsed().as_secs_f64(),
    })
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
