//! [`construct`]: planning, making nodes and writing, each on threads of its own.

use crate::content_hash::ContentHash;
use crate::error::BuildError;
use crate::octree::placement::{Placed, Placement};
use crate::octree::plan::{Crew, Job, Step, plan};
use crate::octree::subtree::{Subtree, SubtreeBuilder, SubtreeNodes};
use crate::sort::SortedStream;
use crate::sort::feed::{Feed, Piece};
use pbgi_core::{BuildSettings, PointRecord, Quantizer};
use pbgi_store::SceneWriter;
use std::io;
use std::ops::Range;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Mutex, PoisonError};
use std::thread::{Builder, Scope};
use std::time::{Duration, Instant};

/// How a construction is spread over threads. The bytes do not depend on it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Gang {
    /// Threads that make nodes; one more plans, and the caller's writes.
    pub threads: usize,
    /// Points of a job, half of the most.
    pub job_points: usize,
}

impl Gang {
    /// Jobs on their way at once, done ones that wait for their turn included.
    pub fn jobs_in_flight(&self) -> usize {
        // Those in the channel, the one being written, the one being planned, and the one being sent.
        2 * self.threads + 3
    }
}

/// What construction made.
#[derive(Clone, Debug, Default)]
pub struct Constructed {
    /// What was written.
    pub placed: Placed,
    /// Of all points in their order.
    pub hash: ContentHash,
    /// Time spent working, waiting aside.
    pub busy: BusySeconds,
}

/// Time that the threads of a build worked, apart from reading.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BusySeconds {
    /// Merging runs, planning.
    pub planning: f64,
    /// Fetching points and making nodes, summed over threads.
    pub nodes: f64,
    /// Placing nodes, checksums and handing bytes to the system.
    pub writing: f64,
    /// Waiting for the disk at the end, until the scene is durable and published.
    pub syncing: f64,
    /// Before all of this, beside reading: sorting runs and writing them.
    pub spilling: f64,
}

/// A job that is done. Its memory is used again.
#[derive(Default)]
struct Done {
    steps: Vec<Step>,
    piece: Piece,
    nodes: SubtreeNodes,
    /// For each subtree of `steps` its root, and the groups of `nodes` below it.
    subtrees: Vec<(Subtree, Range<usize>)>,
}

/// What the writing end takes, in order.
enum Part {
    Job(Receiver<Done>),
    Points(Vec<PointRecord>),
    Failed(BuildError),
}

/// What is the same for all.
#[derive(Clone, Copy)]
struct Common<'a> {
    quantizer: &'a Quantizer,
    leaf_max: usize,
    /// Memory of jobs that have been written.
    spare: &'a Mutex<Vec<Done>>,
}

/// Makes the octree of all points of `stream` and writes it; `records_max` bounds node slots. `tell` hears how many points
/// have been written.
///
/// # Errors
/// Those of `stream`, the writer and `tell`; [`BuildError::Limit`] before an index would wrap.
pub fn construct(
    stream: &mut (dyn SortedStream + Send),
    writer: &mut SceneWriter,
    quantizer: &Quantizer,
    settings: &BuildSettings,
    gang: Gang,
    records_max: u64,
    tell: &mut dyn FnMut(u64) -> Result<(), BuildError>,
) -> Result<Constructed, BuildError> {
    let spare = Mutex::new(Vec::new());
    let common = Common {
        quantizer,
        leaf_max: settings.leaf_max as usize,
        spare: &spare,
    };
    let (to_workers, jobs) = sync_channel(gang.threads);
    let (to_writer, parts) = sync_channel(2 * gang.threads);
    let jobs = Mutex::new(jobs);
    std::thread::scope(|scope| {
        let mut workers = Vec::new();
        for _ in 0..gang.threads {
            let jobs = &jobs;
            workers.push(start(scope, "pbgi-nodes", move || work(jobs, common))?);
        }
        let dispatcher = Dispatcher {
            to_workers,
            to_writer,
            waited: Duration::ZERO,
        };
        let planner = start(scope, "pbgi-plan", move || {
            dispatcher.run(Feed::new(stream), common, gang.job_points)
        })?;
        let placement = Placement::new(writer, quantizer, settings, records_max);
        // The channel goes with it, so that the others end when this does.
        let written = write(placement, parts, common, tell);
        let planning = joined(planner.join());
        let nodes = workers.into_iter().map(|worker| joined(worker.join())).sum();
        let mut constructed = written?;
        constructed.busy.planning = planning;
        constructed.busy.nodes = nodes;
        Ok(constructed)
    })
}

fn start<'scope, T: Send + 'scope>(
    scope: &'scope Scope<'scope, '_>,
    name: &str,
    body: impl FnOnce() -> T + Send + 'scope,
) -> Result<std::thread::ScopedJoinHandle<'scope, T>, BuildError> {
    let started: io::Result<_> = Builder::new().name(name.to_owned()).spawn_scoped(scope, body);
    started.map_err(BuildError::Thread)
}

fn joined<T>(result: std::thread::Result<T>) -> T {
    result.unwrap_or_else(|panic| std::panic::resume_unwind(panic))
}

/// The planning end: sends every job to whoever is free, and where to await it to the writing end.
struct Dispatcher {
    to_workers: SyncSender<(Job, SyncSender<Done>)>,
    to_writer: SyncSender<Part>,
    waited: Duration,
}

impl Dispatcher {
    /// Plans everything; returns the seconds worked.
    fn run(mut self, feed: Feed<'_>, common: Common<'_>, job_points: usize) -> f64 {
        let started = Instant::now();
        if let Err(error) = plan(feed, &mut self, common.quantizer, common.leaf_max, job_points) {
            // When nobody listens, the writing end has failed before, and says why.
            let _ = self.to_writer.send(Part::Failed(error));
        }
        started.elapsed().saturating_sub(self.waited).as_secs_f64()
    }

    fn send(&mut self, part: Part) -> Result<(), BuildError> {
        let started = Instant::now();
        let sent = self.to_writer.send(part);
        self.waited += started.elapsed();
        sent.map_err(|_| BuildError::Cancelled)
    }
}

impl Crew for Dispatcher {
    fn take(&mut self, job: Job) -> Result<(), BuildError> {
        let (to_writer, done) = sync_channel(1);
        // First of all, so that the jobs in the hands of workers are bounded by the channel to the writer.
        self.send(Part::Job(done))?;
        let started = Instant::now();
        let sent = self.to_workers.send((job, to_writer));
        self.waited += started.elapsed();
        sent.map_err(|_| BuildError::Cancelled)
    }

    fn write(&mut self, points: Vec<PointRecord>) -> Result<(), BuildError> {
        self.send(Part::Points(points))
    }
}

/// Makes nodes until there are no jobs any more; returns the seconds worked.
fn work(jobs: &Mutex<Receiver<(Job, SyncSender<Done>)>>, common: Common<'_>) -> f64 {
    let mut busy = Duration::ZERO;
    loop {
        let next = jobs.lock().unwrap_or_else(PoisonError::into_inner).recv();
        let Ok((job, to_writer)) = next else {
            return busy.as_secs_f64();
        };
        let started = Instant::now();
        let spare = common.spare.lock().unwrap_or_else(PoisonError::into_inner).pop();
        let mut done = spare.unwrap_or_default();
        make(job, &mut done, common);
        busy += started.elapsed();
        // Nobody waits for it when the build has failed.
        let _ = to_writer.send(done);
    }
}

fn make(job: Job, done: &mut Done, common: Common<'_>) {
    done.piece = job.piece;
    done.nodes.clear();
    done.subtrees.clear();
    done.steps = job.steps;
    let mut builder = SubtreeBuilder {
        codes: &done.piece.codes,
        points: &done.piece.points,
        first_point: job.first_point,
        quantizer: common.quantizer,
        leaf_max: common.leaf_max,
        out: &mut done.nodes,
    };
    let mut from = 0;
    for step in &done.steps {
        if let Step::Subtree { voxel, points } = *step {
            let first_group = builder.out.groups.len();
            let root = builder.subtree(voxel, from, from + points);
            from += points;
            done.subtrees.push((root, first_group..builder.out.groups.len()));
        }
    }
}

/// Puts everything together and writes it.
fn write(
    mut placement: Placement<'_>,
    parts: Receiver<Part>,
    common: Common<'_>,
    tell: &mut dyn FnMut(u64) -> Result<(), BuildError>,
) -> Result<Constructed, BuildError> {
    let mut hash = ContentHash::default();
    let (mut points, mut busy) = (0, Duration::ZERO);
    loop {
        tell(points)?;
        match parts.recv() {
            Err(_) => break,
            Ok(Part::Failed(error)) => return Err(error),
            Ok(Part::Points(some)) => {
                let started = Instant::now();
                append(&mut placement, &mut hash, &some)?;
                points += some.len() as u64;
                busy += started.elapsed();
            }
            Ok(Part::Job(done)) => {
                // Fails only when the worker panicked, which its end tells.
                let Ok(mut done) = done.recv() else { continue };
                let started = Instant::now();
                append(&mut placement, &mut hash, &done.piece.points)?;
                points += done.piece.points.len() as u64;
                put_together(&mut placement, &mut done)?;
                common.spare.lock().unwrap_or_else(PoisonError::into_inner).push(done);
                busy += started.elapsed();
            }
        }
    }
    Ok(Constructed {
        placed: placement.finish()?,
        hash,
        busy: BusySeconds {
            writing: busy.as_secs_f64(),
            ..BusySeconds::default()
        },
    })
}

fn append(placement: &mut Placement<'_>, hash: &mut ContentHash, points: &[PointRecord]) -> Result<(), BuildError> {
    points.iter().for_each(|point| hash.add(point));
    placement.points(points)
}

fn put_together(placement: &mut Placement<'_>, done: &mut Done) -> Result<(), BuildError> {
    let mut subtrees = done.subtrees.drain(..);
    let mut slot = 0;
    for step in done.steps.drain(..) {
        match step {
            Step::Subtree { .. } => {
                if let Some((root, groups)) = subtrees.next() {
                    slot = placement.nodes(&mut done.nodes, groups, slot)?;
                    placement.push(root);
                }
            }
            Step::Made(made) => {
                placement.count(&made.1);
                placement.push(made.0);
            }
            Step::Close { voxel, mask } => placement.close(voxel, mask)?,
        }
    }
    placement.count(&done.nodes.tallies);
    Ok(())
}
