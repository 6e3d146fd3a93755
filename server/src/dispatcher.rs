//! Where the scheduler meets the world: holds the jobs, carries out what the scheduler says, and answers workers and clients.
//!
//! Everything happens under one lock, briefly: what takes time is spawned. Entry points for workers are here, for clients in
//! `clients`, for the daemon's clock in `upkeep`, for what outlives the daemon in `durable`.

mod clients;
mod durable;
mod figures;
mod live;
mod upkeep;

pub use clients::{CacheReport, DaemonStatus, Submission};
pub use figures::{JobFigures, SceneFigures, Totals};

use crate::bounce::Makers;
use crate::config::Config;
use crate::error::{JobError, JobErrorKind};
use crate::framebuffer::{Preview, TileReceivers};
use crate::job::{JobState, JobStatus, Request};
use crate::limits;
use crate::live::Live;
use crate::mounts::Mounts;
use crate::roots::Roots;
use crate::scheduler::{Death, Effect, End, Event, JobNo, LeaseId, Scheduler, Seat};
use crate::shade_job::{self, Counters, Shading};
use crate::supervisor::{Handle, WorkerBirth};
use crate::table::JobTable;
use pbgi_cache::CacheOwner;
use pbgi_core::{Environment, MountId, SceneInfo, ShadeSettings};
use std::collections::{BTreeMap, HashMap, VecDeque};
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock};
use std::time::Instant;
use tokio::sync::{Notify, Semaphore, watch};
use tracing::{Instrument, Span};

/// The daemon's middle.
pub struct Dispatcher {
    pub(crate) config: Config,
    pub(crate) cache: Arc<CacheOwner>,
    pub(crate) mounts: Arc<Mounts>,
    pub(crate) supervisor: Handle,
    pub(crate) table: Arc<JobTable>,
    roots: RwLock<Arc<Roots>>,
    /// Mebibytes of the work share that are free.
    pub(crate) work_memory: Arc<Semaphore>,
    /// One picture is read at a time: how large it is shows only then.
    pub(crate) picture_gate: tokio::sync::Mutex<()>,
    /// Who makes which scene of further bounces.
    pub(crate) makers: Makers,
    runtime: tokio::runtime::Handle,
    /// Rung when a worker that found no tile may ask again.
    wake: Notify,
    stop: watch::Sender<bool>,
    healthy: watch::Sender<bool>,
    state: Mutex<State>,
}

struct State {
    scheduler: Scheduler,
    jobs: BTreeMap<JobNo, Record>,
    lives: BTreeMap<JobNo, Live>,
    names: HashMap<String, JobNo>,
    /// Ended jobs, oldest first.
    ended: VecDeque<JobNo>,
    /// Failed jobs whose tiles are kept, oldest first.
    failed: VecDeque<JobNo>,
    /// Outputs of jobs that have not ended.
    outputs: HashMap<PathBuf, JobNo>,
    seats: Vec<Option<Sitting>>,
    build_pids: HashMap<JobNo, u32>,
    number_last: u64,
    totals: Totals,
    /// What the tiles of each scene took, since it was mounted.
    scenes: HashMap<MountId, Counters>,
    draining: bool,
    parked: usize,
    active: Instant,
}

/// A job, and what it holds while it runs.
struct Record {
    request: Arc<Request>,
    kept: durable::Kept,
    status: watch::Sender<JobStatus>,
    abort: watch::Sender<bool>,
    span: Span,
    shading: Option<Box<Shading>>,
    /// What is shown of a picture that is done.
    preview: Option<Arc<Preview>>,
    memory_peak_bytes: u64,
    cache_peak_bytes: u64,
}

/// A worker.
struct Sitting {
    birth: WorkerBirth,
    ready: bool,
    work: Option<Work>,
}

/// What a worker works on.
struct Work {
    lease: LeaseId,
    job: JobNo,
    tile: u32,
    span: Span,
}

/// A tile on its way to a worker.
#[derive(Clone, Debug, PartialEq)]
pub struct TileLease {
    /// The lease.
    pub lease: LeaseId,
    /// The job.
    pub job: JobNo,
    /// The tile.
    pub tile: u32,
    /// What is to be shaded.
    pub receivers: TileReceivers,
}

/// What comes back for it.
#[derive(Clone, Debug, PartialEq)]
pub enum TileOutcome {
    /// Seven little-endian floats for each receiver.
    Values {
        /// The floats.
        values: Vec<u8>,
        /// What it took.
        counters: Counters,
    },
    /// Why there are none.
    Failure(String),
}

/// What a worker must know of a job.
#[derive(Clone, Debug)]
pub struct TaskInfo {
    /// The scene.
    pub scene: SceneInfo,
    /// Its mount.
    pub mount: MountId,
    /// How to shade.
    pub settings: ShadeSettings,
    /// Light from far away.
    pub environment: Option<Arc<Environment>>,
    /// Angle between neighbouring rays, where the tiles are rays.
    pub pixel_angle: Option<f32>,
}

impl Dispatcher {
    /// No jobs yet. `runtime` carries the jobs' tasks.
    pub fn new(
        config: Config,
        cache: Arc<CacheOwner>,
        mounts: Arc<Mounts>,
        supervisor: Handle,
        table: Arc<JobTable>,
        roots: Roots,
        runtime: tokio::runtime::Handle,
    ) -> Self {
        let state = State {
            scheduler: Scheduler::default(),
            jobs: BTreeMap::new(),
            lives: BTreeMap::new(),
            names: HashMap::new(),
            ended: VecDeque::new(),
            failed: VecDeque::new(),
            outputs: HashMap::new(),
            seats: (0..config.options.workers).map(|_| None).collect(),
            build_pids: HashMap::new(),
            number_last: 0,
            totals: Totals::default(),
            scenes: HashMap::new(),
            draining: false,
            parked: 0,
            active: Instant::now(),
        };
        Self {
            work_memory: Arc::new(Semaphore::new((config.memory.work_bytes >> 20) as usize)),
            picture_gate: tokio::sync::Mutex::new(()),
            makers: Makers::default(),
            config,
            cache,
            mounts,
            supervisor,
            table,
            roots: RwLock::new(Arc::new(roots)),
            runtime,
            wake: Notify::new(),
            stop: watch::Sender::new(false),
            healthy: watch::Sender::new(true),
            state: Mutex::new(state),
        }
    }

    /// Which files clients may name now.
    pub(crate) fn roots(&self) -> Arc<Roots> {
        self.roots.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Changes which files clients may name. Files that running jobs have open stay open.
    pub(crate) fn change_roots(&self, roots: Roots) {
        *self.roots.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(roots);
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(|_| {
            // A panic in the middle of a change: nobody may see what it left. The next start cleans up.
            tracing::error!("the dispatcher panicked");
            std::process::abort()
        })
    }

    /// Runs an event through the scheduler and carries out what follows. Answers to a worker are returned.
    fn dispatch(
        self: &Arc<Self>,
        state: &mut State,
        event: Event,
        result: Option<(Vec<u8>, Counters)>,
    ) -> Option<Effect> {
        let mut result = result;
        let mut answer = None;
        for effect in state.scheduler.on(event, Instant::now()) {
            match effect {
                Effect::Start(job) => self.start(state, job),
                Effect::Abort(job) => {
                    if let Some(record) = state.jobs.get(&job) {
                        record.abort.send_replace(true);
                    }
                }
                Effect::Accept { job, tile } => {
                    if let Some((values, counters)) = result.take() {
                        self.accept(state, job, tile, values, &counters);
                    }
                    answer = Some(effect);
                }
                Effect::Park(job) => self.park(state, job),
                Effect::Write(job) => self.write(state, job),
                Effect::Ended { job, end } => self.ended(state, job, end),
                Effect::Kill(seat) => self.supervisor.kill(seat),
                Effect::Wake => self.wake.notify_waiters(),
                Effect::Grant { .. } | Effect::Drop | Effect::Alive => answer = Some(effect),
            }
        }
        answer
    }

    fn start(self: &Arc<Self>, state: &mut State, job: JobNo) {
        let Some(record) = state.jobs.get(&job) else { return };
        record.status.send_modify(|status| {
            status.state = JobState::Running;
            status.stage = "reading".into();
            status.note("started");
        });
        self.save(job, record);
        let (request, abort) = (record.request.clone(), record.abort.subscribe());
        let fingerprint = record.kept.fingerprint.clone();
        let this = self.clone();
        let run = async move {
            match &*request {
                Request::Build(task) => {
                    let outcome = crate::builder::run(&this, job, task, abort).await;
                    this.finished(job, outcome);
                }
                Request::Shade(task) => match shade_job::prepare(&this, job, task, fingerprint, abort).await {
                    Ok(shading) => this.prepared(job, shading),
                    Err(error) => this.finished(job, Err(error)),
                },
            }
        };
        self.runtime.spawn(run.instrument(record.span.clone()));
    }

    fn prepared(self: &Arc<Self>, job: JobNo, shading: Shading) {
        let mut state = self.lock();
        let Some(record) = state.jobs.get_mut(&job) else { return };
        let (tiles, done) = (shading.tiles_left.clone(), shading.tiles_stored);
        record.status.send_modify(|status| {
            status.stage = "shading".into();
            (status.done, status.total) = (done, done + tiles.len() as u64);
            if done > 0 {
                status.note(format!("goes on with {done} of {} tiles done", status.total));
            }
        });
        record.kept.fingerprint = Some(shading.fingerprint.clone());
        record.shading = Some(Box::new(shading));
        self.save(job, record);
        self.dispatch(&mut state, Event::Prepared { job, tiles }, None);
    }

    fn write(self: &Arc<Self>, state: &mut State, job: JobNo) {
        let Some(record) = state.jobs.get_mut(&job) else { return };
        Self::keep_preview(record);
        let Some(shading) = record.shading.take() else { return };
        record.status.send_modify(|status| status.stage = "writing".into());
        let (request, abort) = (record.request.clone(), record.abort.subscribe());
        let this = self.clone();
        let run = async move {
            let outcome = match &*request {
                Request::Shade(task) => shade_job::write(&this, job, task, *shading, abort).await,
                Request::Build(_) => Err("a build has no picture".to_owned()),
            };
            this.finished(job, outcome);
        };
        self.runtime.spawn(run.instrument(record.span.clone()));
    }

    fn finished(self: &Arc<Self>, job: JobNo, outcome: Result<pbgi_core::Statistics, String>) {
        let mut state = self.lock();
        if let (Some(record), Ok(statistics)) = (state.jobs.get(&job), &outcome) {
            record.status.send_modify(|status| {
                status.statistics.update(statistics);
                if let Some(text) = statistics.diagnosis() {
                    status.note(text);
                }
            });
        }
        let outcome = outcome.map(|_| ());
        self.dispatch(&mut state, Event::Finished { job, outcome }, None);
    }

    /// A paused job gives its picture back; its finished tiles wait in the table.
    fn park(&self, state: &mut State, job: JobNo) {
        let Some(record) = state.jobs.get_mut(&job) else { return };
        record.shading = None;
        record.status.send_modify(|status| {
            status.state = JobState::Queued;
            status.stage = "paused".into();
        });
        self.save(job, record);
    }

    fn ended(&self, state: &mut State, job: JobNo, end: End) {
        self.cache.end_job(job.0);
        state.active = Instant::now();
        if let Some(live) = state.lives.remove(&job) {
            if let End::Failed(error) = end {
                // It has room for one more than there are tiles; a client that left does not listen.
                let _ = live.results.try_send(Err(error));
            }
            return;
        }
        let unmet = match &end {
            End::Unmet(before) => state.jobs.get(before).map(|record| record.status.borrow().id.clone()),
            _ => None,
        };
        let Some(record) = state.jobs.get_mut(&job) else { return };
        record.shading = None;
        if end == End::Suspended {
            record.status.send_modify(|status| {
                status.state = JobState::Queued;
                status.stage = "waiting for the next daemon".into();
                status.suspended = true;
                status.note("suspended: the daemon stopped");
            });
            self.save(job, record);
            record.span = Span::none();
            return;
        }
        state.outputs.remove(record.request.output());
        let (job_state, error) = match end {
            End::Succeeded => (JobState::Succeeded, String::new()),
            End::Cancelled => (JobState::Cancelled, String::new()),
            End::Failed(error) => (JobState::Failed, error),
            End::Unmet(_) | End::Suspended => {
                let before = unmet.unwrap_or_default();
                (
                    JobState::Failed,
                    format!("job {before:?}, which it comes after, did not succeed"),
                )
            }
        };
        record.span.in_scope(|| match job_state {
            JobState::Failed => tracing::error!(error, "job failed"),
            _ => tracing::info!(state = ?job_state, "job ended"),
        });
        record.status.send_modify(|status| {
            status.stage = "".into();
            status.note(match job_state {
                JobState::Succeeded => "succeeded".to_owned(),
                JobState::Cancelled => "cancelled".to_owned(),
                _ => format!("failed: {error}"),
            });
            (status.state, status.error) = (job_state, error);
        });
        self.save(job, record);
        // The span ends with the job, though the record stays.
        record.span = Span::none();
        *state.totals.ended.entry(job_state).or_default() += 1;
        self.retire(state, job, job_state);
    }

    /// A worker was started.
    pub fn worker_born(&self, birth: WorkerBirth) {
        let mut state = self.lock();
        if let Some(seat) = state.seats.get_mut(usize::from(birth.seat.slot)) {
            let (ready, work) = (false, None);
            *seat = Some(Sitting { birth, ready, work });
        }
    }

    /// A worker is dead and waited for.
    pub fn worker_dead(self: &Arc<Self>, seat: Seat, death: Death) {
        let mut state = self.lock();
        state.totals.worker_deaths += 1;
        if let Some(sitting) = state.seats.get_mut(usize::from(seat.slot))
            && sitting.as_ref().is_some_and(|sitting| sitting.birth.seat == seat)
            && let Some(work) = sitting.take().and_then(|sitting| sitting.work)
        {
            state.note(work.job, format!("tile {}: its worker died ({death:?})", work.tile));
        }
        self.dispatch(&mut state, Event::WorkerGone { seat, death }, None);
    }

    /// So many slots are parked; without workers no picture can be shaded.
    pub fn workers_parked(self: &Arc<Self>, slots: usize, reason: &str) {
        let mut state = self.lock();
        state.parked = slots;
        let none_left = slots == state.seats.len();
        self.healthy.send_replace(!none_left);
        let reason = none_left.then(|| format!("no worker can be started: {reason}"));
        self.dispatch(&mut state, Event::Workless { reason }, None);
    }

    /// Checks who speaks on the queue.
    ///
    /// # Errors
    /// [`JobErrorKind::Unauthenticated`] for anybody but the worker in that seat.
    pub fn authenticate(&self, seat: Seat, token: &[u8]) -> Result<(), JobError> {
        let mut state = self.lock();
        let sitting = state.seats.get_mut(usize::from(seat.slot)).and_then(Option::as_mut);
        if let Some(sitting) = sitting
            && sitting.birth.seat == seat
            && same(token, &sitting.birth.token)
        {
            if !sitting.ready {
                sitting.ready = true;
                self.supervisor.ready(seat);
            }
            return Ok(());
        }
        Err(JobError::new(
            JobErrorKind::Unauthenticated,
            "not the worker of that seat",
        ))
    }

    /// A tile for a worker; `None` if there is none for some seconds.
    pub async fn lease(self: &Arc<Self>, seat: Seat) -> Option<TileLease> {
        let deadline = tokio::time::Instant::now() + limits::LEASE_WAIT;
        loop {
            let mut rung = std::pin::pin!(self.wake.notified());
            rung.as_mut().enable();
            if let Some(lease) = self.try_lease(seat) {
                return Some(lease);
            }
            tokio::select! {
                () = rung => {}
                () = tokio::time::sleep_until(deadline) => return None,
            }
        }
    }

    fn try_lease(self: &Arc<Self>, seat: Seat) -> Option<TileLease> {
        let mut state = self.lock();
        let sits = |sitting: &Sitting| sitting.birth.seat == seat;
        if !state.seats.get(usize::from(seat.slot))?.as_ref().is_some_and(sits) {
            return None;
        }
        let granted = self.dispatch(&mut state, Event::Ask { seat }, None)?;
        let Effect::Grant { lease, job, tile, .. } = granted else {
            return None;
        };
        let (receivers, parent) = match (state.lives.get(&job), state.jobs.get(&job)) {
            (Some(live), _) => (live.tiles.get(&tile)?.clone(), Span::none()),
            (None, record) => {
                let record = record?;
                (record.shading.as_ref()?.frame.receivers(tile), record.span.clone())
            }
        };
        let span =
            tracing::debug_span!(parent: &parent, "tile", tile, lease = lease.0, slot = seat.slot, epoch = seat.epoch);
        let work = Work { lease, job, tile, span };
        if let Some(sitting) = state.seats.get_mut(usize::from(seat.slot))?.as_mut() {
            sitting.work = Some(work);
        }
        Some(TileLease {
            lease,
            job,
            tile,
            receivers,
        })
    }

    /// A worker shows that it lives; tells whether its lease does.
    pub fn heartbeat(self: &Arc<Self>, seat: Seat, lease: LeaseId) -> bool {
        let mut state = self.lock();
        self.dispatch(&mut state, Event::Heartbeat { seat, lease }, None) == Some(Effect::Alive)
    }

    /// A worker is done with a tile; tells whether its result was taken.
    pub fn complete(self: &Arc<Self>, seat: Seat, lease: LeaseId, outcome: TileOutcome) -> bool {
        let mut state = self.lock();
        let sitting = state.seats.get_mut(usize::from(seat.slot)).and_then(Option::as_mut);
        let work = sitting.and_then(|sitting| sitting.work.take_if(|work| work.lease == lease));
        let (mut failure, mut result) = (None, None);
        match outcome {
            TileOutcome::Failure(text) => failure = Some(text),
            TileOutcome::Values { values, counters } => {
                // Without work the lease has ended, as the scheduler knows.
                match work.as_ref().map_or(Ok(()), |work| state.check(work, &values)) {
                    Ok(()) => result = Some((values, counters)),
                    Err(text) => failure = Some(format!("the worker's answer is wrong: {text}")),
                }
            }
        }
        if let (Some(text), Some(work)) = (&failure, &work) {
            state.note(work.job, format!("tile {} failed: {text}", work.tile));
        }
        let answer = self.dispatch(&mut state, Event::Complete { seat, lease, failure }, result);
        matches!(answer, Some(Effect::Accept { .. }))
    }

    /// What a worker must know of a job.
    ///
    /// # Errors
    /// The job is over.
    pub fn task(&self, job: JobNo) -> Result<TaskInfo, JobError> {
        let state = self.lock();
        if let Some(live) = state.lives.get(&job) {
            return Ok(TaskInfo {
                scene: live.mounted.scene().info().clone(),
                mount: live.mounted.id(),
                settings: live.settings,
                environment: live.environment.clone(),
                pixel_angle: live.pixel_angle,
            });
        }
        let record = state.jobs.get(&job);
        match record.and_then(|record| Some((record.shading.as_ref()?, &*record.request))) {
            Some((shading, Request::Shade(task))) => Ok(TaskInfo {
                scene: shading.mounted.scene().info().clone(),
                mount: shading.mounted.id(),
                settings: task.settings,
                environment: shading.environment.clone(),
                pixel_angle: None,
            }),
            _ => Err(JobError::new(JobErrorKind::NotFound, format!("task {} is over", job.0))),
        }
    }

    /// The span of the tile that a worker works on, as the parent of its page loads.
    pub fn tile_span(&self, seat: Seat) -> Span {
        let state = self.lock();
        let sitting = state.seats.get(usize::from(seat.slot)).and_then(Option::as_ref);
        let work = sitting
            .filter(|sitting| sitting.birth.seat == seat)
            .and_then(|sitting| sitting.work.as_ref());
        work.map_or_else(Span::none, |work| work.span.clone())
    }
}

impl State {
    /// Checks a tile's values against what was asked for.
    fn check(&self, work: &Work, values: &[u8]) -> Result<(), String> {
        if let Some(live) = self.lives.get(&work.job) {
            return live.check(work.tile, values);
        }
        let shading = self.jobs.get(&work.job).and_then(|record| record.shading.as_ref());
        shading.map_or(Ok(()), |shading| shading.frame.check(work.tile, values))
    }

    /// Adds a line to a job's history.
    fn note(&self, job: JobNo, text: String) {
        if let Some(record) = self
            .jobs
            .get(&job)
            .filter(|record| !record.status.borrow().state.ended())
        {
            record.status.send_modify(|status| status.note(text));
        }
    }
}

/// Compares in a time that does not tell where the difference is.
fn same(given: &[u8], token: &[u8; 16]) -> bool {
    given.len() == token.len() && given.iter().zip(token).fold(0, |all, (a, b)| all | (a ^ b)) == 0
}
