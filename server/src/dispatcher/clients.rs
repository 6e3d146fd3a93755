//! What clients ask of the daemon.

use super::{Dispatcher, Record};
use crate::error::{JobError, JobErrorKind};
use crate::job::{JobState, JobStatus, Request, check_job_id, check_path, no_such_job};
use crate::limits;
use crate::mounts::MountStatus;
use crate::scheduler::{Event, JobNo};
use crate::supervisor::WorkerBirth;
use pbgi_cache::CacheCounters;
use pbgi_core::{PageKind, SceneInfo, Statistics};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;
use tokio::sync::watch;

/// The daemon, for people.
#[derive(Clone, Debug)]
pub struct DaemonStatus {
    /// The memory cap.
    pub memory_bytes: u64,
    /// Of that, the segment.
    pub segment_bytes: u64,
    /// What is in it.
    pub cache: CacheCounters,
    /// Workers: who, whether at work, and how many frames they hold.
    pub workers: Vec<(WorkerBirth, bool, u32)>,
    /// Scenes.
    pub mounts: Vec<MountStatus>,
    /// Jobs that wait.
    pub jobs_queued: usize,
    /// Jobs that run.
    pub jobs_running: usize,
}

impl Dispatcher {
    /// Takes a job; the same name with the same request is the same job.
    ///
    /// # Errors
    /// A request that makes no sense, a name that is taken, an output that another job makes, or a full queue.
    pub fn submit(self: &Arc<Self>, id: &str, request: Request) -> Result<JobStatus, JobError> {
        check_job_id(id)?;
        request.validate()?;
        let mut state = self.lock();
        if let Some(record) = state.names.get(id).and_then(|number| state.jobs.get(number)) {
            if *record.request == request {
                return Ok(record.status.borrow().clone());
            }
            let text = format!("job {id:?} exists with another request; choose another name");
            return Err(JobError::new(JobErrorKind::Exists, text));
        }
        if state.draining {
            return Err(JobError::new(JobErrorKind::Unavailable, crate::scheduler::DRAINING));
        }
        if state.scheduler.counts().0 >= limits::JOBS_QUEUED_MAX {
            let text = format!(
                "{} jobs wait already; try again when some have ended",
                limits::JOBS_QUEUED_MAX
            );
            return Err(JobError::new(JobErrorKind::Exhausted, text));
        }
        if !state.outputs.insert(request.output().to_owned()) {
            let text = format!("another job is making this output, at {}", request.output().display());
            return Err(JobError::new(JobErrorKind::Busy, text));
        }
        state.number_last += 1;
        let job = JobNo(state.number_last);
        let status = JobStatus {
            id: id.to_owned(),
            number: job,
            state: JobState::Queued,
            stage: "waiting",
            done: 0,
            total: 0,
            error: String::new(),
            statistics: Statistics::default(),
            title: request.title(),
        };
        let span = tracing::info_span!("job", id, number = job.0, title = status.title);
        span.in_scope(|| tracing::info!("job accepted"));
        let kind = request.kind();
        let record = Record {
            request: Arc::new(request),
            status: watch::Sender::new(status),
            abort: watch::Sender::new(false),
            span,
            shading: None,
            memory_peak_bytes: 0,
            cache_peak_bytes: 0,
        };
        state.jobs.insert(job, record);
        state.names.insert(id.to_owned(), job);
        state.active = Instant::now();
        if state.parked > 0 {
            self.supervisor.unpark();
        }
        self.dispatch(&mut state, Event::Submit { job, kind }, None);
        match state.jobs.get(&job) {
            Some(record) => Ok(record.status.borrow().clone()),
            None => Err(no_such_job(id)),
        }
    }

    /// A job as it is now.
    ///
    /// # Errors
    /// There is none of that name.
    pub fn job(&self, id: &str) -> Result<JobStatus, JobError> {
        self.watch(id).map(|status| status.borrow().clone())
    }

    /// A job as it is and will be.
    ///
    /// # Errors
    /// There is none of that name.
    pub fn watch(&self, id: &str) -> Result<watch::Receiver<JobStatus>, JobError> {
        let state = self.lock();
        let record = state.names.get(id).and_then(|number| state.jobs.get(number));
        record
            .map(|record| record.status.subscribe())
            .ok_or_else(|| no_such_job(id))
    }

    /// All jobs that are remembered, newest first.
    pub fn jobs(&self) -> Vec<JobStatus> {
        let state = self.lock();
        state
            .jobs
            .values()
            .rev()
            .map(|record| record.status.borrow().clone())
            .collect()
    }

    /// Stops a job. One that has ended stays as it is.
    ///
    /// # Errors
    /// There is none of that name.
    pub fn cancel(self: &Arc<Self>, id: &str) -> Result<JobStatus, JobError> {
        let mut state = self.lock();
        let job = *state.names.get(id).ok_or_else(|| no_such_job(id))?;
        self.dispatch(&mut state, Event::Cancel { job }, None);
        let record = state.jobs.get(&job);
        record
            .map(|record| record.status.borrow().clone())
            .ok_or_else(|| no_such_job(id))
    }

    /// Opens, mounts and describes a scene.
    ///
    /// # Errors
    /// It is none, or damaged.
    pub async fn scene(self: &Arc<Self>, path: PathBuf) -> Result<SceneInfo, JobError> {
        check_path("scene", &path)?;
        let mounts = self.mounts.clone();
        let opened = tokio::task::spawn_blocking(move || mounts.open(&path)).await;
        let opened = opened.map_err(|error| JobError::new(JobErrorKind::Internal, error.to_string()))?;
        opened.map(|mounted| mounted.scene().info().clone())
    }

    /// The daemon.
    pub fn status(&self) -> DaemonStatus {
        let pins = |slot| {
            [PageKind::Node, PageKind::Point]
                .map(|kind| self.cache.pins(slot, kind))
                .iter()
                .sum()
        };
        let (cache, mounts) = (self.cache.counters(), self.mounts.list());
        let state = self.lock();
        let worker = |sitting: &super::Sitting| {
            let busy = state.scheduler.is_busy(sitting.birth.seat);
            (sitting.birth, busy, pins(sitting.birth.seat.slot))
        };
        let (jobs_queued, jobs_running) = state.scheduler.counts();
        DaemonStatus {
            memory_bytes: self.config.memory.total_bytes,
            segment_bytes: self.cache.layout().total_bytes(),
            cache,
            workers: state.seats.iter().flatten().map(worker).collect(),
            mounts,
            jobs_queued,
            jobs_running,
        }
    }

    /// Asks the daemon to stop, as SIGTERM does.
    pub fn request_stop(&self) {
        self.stop.send_replace(true);
    }

    /// Becomes true when somebody asked the daemon to stop.
    pub fn stop_requested(&self) -> watch::Receiver<bool> {
        self.stop.subscribe()
    }

    /// Whether the daemon can do its work.
    pub fn health(&self) -> watch::Receiver<bool> {
        self.healthy.subscribe()
    }

    /// Tells watchers how far a job is.
    pub(crate) fn progress(&self, job: JobNo, stage: &'static str, done: u64, total: u64) {
        if let Some(record) = self.lock().jobs.get(&job) {
            record
                .status
                .send_modify(|status| (status.stage, status.done, status.total) = (stage, done, total));
        }
    }
}
