//! What clients ask of the daemon.

use super::durable::{Kept, user_number};
use super::{Dispatcher, Record, State};
use crate::error::{JobError, JobErrorKind};
use crate::job::{JobOptions, JobState, JobStatus, Request, check_job_id, no_such_job};
use crate::limits;
use crate::mounts::{MountStatus, Mounted};
use crate::roots::Want;
use crate::scheduler::{DRAINING, Event, JobNo, Order};
use crate::shade_job::Counters;
use crate::supervisor::WorkerBirth;
use pbgi_cache::{CacheCounters, SceneCounters, SegmentLayout};
use pbgi_core::{Environment, NodeRecord, PageKind, PageNo, PointRecord, SceneInfo, Statistics};
use pbgi_store::SceneShape;
use std::borrow::Cow;
use std::collections::VecDeque;
use std::path::{Path, PathBuf};
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

/// The page cache, for people.
#[derive(Clone, Debug)]
pub struct CacheReport {
    /// What it is made of.
    pub layout: SegmentLayout,
    /// What was done with it.
    pub cache: CacheCounters,
    /// Scenes, with the counters of their nodes and points.
    pub scenes: Vec<(MountStatus, [SceneCounters; 2])>,
    /// Workers: who, and how many node and point frames they hold.
    pub workers: Vec<(WorkerBirth, [u32; 2])>,
    /// What workers found where, in all tiles since the start.
    pub lookups: Counters,
}

/// A job as it is handed in.
#[derive(Clone, Debug)]
pub struct Submission {
    /// The client's name for it.
    pub id: String,
    /// The task.
    pub request: Request,
    /// What is wanted beside it.
    pub options: JobOptions,
    /// Whether an unfinished job with the same task will do.
    pub attach: bool,
    /// All of that as it came over the wire, to be kept.
    pub wire: Vec<u8>,
}

/// The span that everything about a job is logged in.
pub(super) fn span(status: &JobStatus) -> tracing::Span {
    let options = &status.options;
    let labels: Vec<String> = options
        .labels
        .iter()
        .map(|(key, value)| format!("{key}={value}"))
        .collect();
    tracing::info_span!(
        "job",
        id = status.id,
        number = status.number.0,
        title = status.title,
        user = options.user,
        labels = labels.join(" ")
    )
}

impl Dispatcher {
    /// Takes a job; the same name with the same request is the same job. Returns when the job will survive the daemon.
    ///
    /// # Errors
    /// A request that makes no sense, a name that is taken, an output that another job makes, a full queue, or a disk that
    /// does not take it.
    pub async fn submit(self: &Arc<Self>, submission: Submission) -> Result<JobStatus, JobError> {
        check_job_id(&submission.id)?;
        submission.options.validate()?;
        submission.request.validate(&self.roots())?;
        let (job, status) = {
            let mut state = self.lock();
            match state.find_same(&submission)? {
                Some(job) => (job, state.status(job)?),
                None => self.take(&mut state, submission)?,
            }
        };
        if let Err(error) = self.stored().await {
            let mut state = self.lock();
            let reason = error.text.clone();
            self.dispatch(&mut state, Event::Fail { job, reason }, None);
            return Err(error);
        }
        Ok(status)
    }

    /// Returns when everything that was changed so far will survive the daemon.
    ///
    /// # Errors
    /// A disk that does not take it.
    pub async fn stored(&self) -> Result<(), JobError> {
        let stored = self.table.ticket().await;
        stored
            .unwrap_or_else(|_| Err("the job table was closed".to_owned()))
            .map_err(|reason| JobError::new(JobErrorKind::Unavailable, reason))
    }

    fn take(self: &Arc<Self>, state: &mut State, submission: Submission) -> Result<(JobNo, JobStatus), JobError> {
        if state.draining {
            return Err(JobError::new(JobErrorKind::Unavailable, DRAINING));
        }
        if let Some(reason) = self.table.broken() {
            return Err(JobError::new(JobErrorKind::Unavailable, reason));
        }
        if state.scheduler.counts().0 >= limits::JOBS_QUEUED_MAX {
            let text = format!(
                "{} jobs wait already; try again when some have ended",
                limits::JOBS_QUEUED_MAX
            );
            return Err(JobError::new(JobErrorKind::Exhausted, text));
        }
        let Submission {
            id,
            request,
            options,
            wire,
            ..
        } = submission;
        let order = Order {
            priority: options.priority,
            user: user_number(&options.user),
            after: state.before(&options.after)?,
            paused: options.paused,
        };
        state.number_last += 1;
        let job = JobNo(state.number_last);
        state.claim_output(&request, job)?;
        let mut status = JobStatus {
            id: id.clone(),
            number: job,
            state: JobState::Queued,
            stage: waiting(&options).into(),
            done: 0,
            total: 0,
            error: String::new(),
            statistics: Statistics::default(),
            title: request.title(),
            options,
            history: VecDeque::new(),
            suspended: false,
        };
        status.note("submitted");
        let span = span(&status);
        span.in_scope(|| tracing::info!("job accepted"));
        let kind = request.kind();
        let record = Record {
            request: Arc::new(request),
            kept: Kept {
                wire: wire.into(),
                ..Kept::default()
            },
            status: watch::Sender::new(status),
            abort: watch::Sender::new(false),
            span,
            shading: None,
            preview: None,
            memory_peak_bytes: 0,
            cache_peak_bytes: 0,
        };
        self.save(job, &record);
        state.jobs.insert(job, record);
        state.names.insert(id, job);
        self.enqueue(state, Event::Submit { job, kind, order });
        Ok((job, state.status(job)?))
    }

    pub(super) fn enqueue(self: &Arc<Self>, state: &mut State, event: Event) {
        state.active = Instant::now();
        if state.parked > 0 {
            self.supervisor.unpark();
        }
        self.dispatch(state, event, None);
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

    /// The jobs that are remembered, newest first, at most so many.
    pub fn jobs(&self, limit: usize) -> Vec<JobStatus> {
        let state = self.lock();
        state
            .jobs
            .values()
            .rev()
            .take(limit)
            .map(|record| record.status.borrow().clone())
            .collect()
    }

    /// Stops a job. One that has ended stays as it is.
    ///
    /// # Errors
    /// There is none of that name.
    pub fn cancel(self: &Arc<Self>, id: &str, reason: &str) -> Result<JobStatus, JobError> {
        let mut state = self.lock();
        let job = state.number(id)?;
        if let Some(record) = state.jobs.get_mut(&job)
            && !record.status.borrow().state.ended()
        {
            record
                .status
                .send_modify(|status| status.note(with_reason("cancel requested", reason)));
            record.kept.cancelled = true;
            self.save(job, record);
        }
        self.dispatch(&mut state, Event::Cancel { job }, None);
        state.status(job)
    }

    /// Lets a job rest. One that rests or has ended stays as it is.
    ///
    /// # Errors
    /// There is none of that name, or it is a build that runs or a picture that is being written.
    pub fn pause(self: &Arc<Self>, id: &str, reason: &str) -> Result<JobStatus, JobError> {
        let mut state = self.lock();
        let job = state.number(id)?;
        let status = state.status(job)?;
        if status.state.ended() || status.options.paused {
            return Ok(status);
        }
        if !state.scheduler.can_pause(job) {
            let text = format!(
                "job {id:?} is {} and cannot be paused any more; it can be cancelled",
                status.stage
            );
            return Err(JobError::new(JobErrorKind::Precondition, text));
        }
        if let Some(record) = state.jobs.get(&job) {
            record.status.send_modify(|status| {
                status.options.paused = true;
                status.stage = if status.state == JobState::Queued {
                    "paused"
                } else {
                    "pausing"
                }
                .into();
                status.note(with_reason("paused", reason));
            });
            self.save(job, record);
        }
        self.dispatch(&mut state, Event::Pause { job }, None);
        state.status(job)
    }

    /// Lets a paused job go on.
    ///
    /// # Errors
    /// There is none of that name.
    pub fn resume(self: &Arc<Self>, id: &str) -> Result<JobStatus, JobError> {
        let mut state = self.lock();
        let job = state.number(id)?;
        let status = state.status(job)?;
        if status.state.ended() || !status.options.paused {
            return Ok(status);
        }
        if let Some(record) = state.jobs.get(&job) {
            record.status.send_modify(|status| {
                status.options.paused = false;
                status.stage = if status.state == JobState::Queued {
                    "waiting"
                } else {
                    "shading"
                }
                .into();
                status.note("resumed");
            });
            self.save(job, record);
        }
        self.enqueue(&mut state, Event::Resume { job });
        state.status(job)
    }

    /// Puts a job that failed or was cancelled back in line. Any other stays as it is.
    ///
    /// # Errors
    /// There is none of that name, another job makes its output, or the daemon takes no jobs.
    pub fn retry(self: &Arc<Self>, id: &str) -> Result<JobStatus, JobError> {
        let mut state = self.lock();
        let job = state.number(id)?;
        let status = state.status(job)?;
        if !matches!(status.state, JobState::Failed | JobState::Cancelled) {
            return Ok(status);
        }
        if state.draining {
            return Err(JobError::new(JobErrorKind::Unavailable, DRAINING));
        }
        let after = state.before(&status.options.after)?;
        let Some(request) = state.jobs.get(&job).map(|record| record.request.clone()) else {
            return Err(no_such_job(id));
        };
        state.claim_output(&request, job)?;
        state.ended.retain(|ended| *ended != job);
        state.failed.retain(|failed| *failed != job);
        if let Some(record) = state.jobs.get_mut(&job) {
            record.abort.send_replace(false);
            record.span = span(&status);
            (record.kept.cancelled, record.kept.daemon_deaths) = (false, 0);
            record.status.send_modify(|status| {
                (status.state, status.error) = (JobState::Queued, String::new());
                status.stage = waiting(&status.options).into();
                (status.done, status.total) = (0, 0);
                status.note("tried again");
            });
            self.save(job, record);
        }
        let order = Order {
            priority: status.options.priority,
            user: user_number(&status.options.user),
            after,
            paused: status.options.paused,
        };
        let kind = request.kind();
        self.enqueue(&mut state, Event::Submit { job, kind, order });
        state.status(job)
    }

    /// Opens, mounts and describes a scene.
    ///
    /// # Errors
    /// It is none, or damaged.
    pub async fn scene(self: &Arc<Self>, path: PathBuf) -> Result<SceneInfo, JobError> {
        self.roots().check("scene", &path, Want::Read)?;
        let this = self.clone();
        let opened = tokio::task::spawn_blocking(move || this.open_scene(&path)).await;
        let opened = opened.map_err(|error| JobError::new(JobErrorKind::Internal, error.to_string()))?;
        opened.map(|mounted| mounted.scene().info().clone())
    }

    /// Counts the nodes of a scene by level. Blocks.
    ///
    /// # Errors
    /// As `open_scene`, and a node page that is damaged.
    pub fn scene_shape(&self, path: &Path) -> Result<SceneShape, JobError> {
        let shape = self.open_scene(path)?.scene().shape();
        shape.map_err(|error| JobError::new(JobErrorKind::Corrupt, error.to_string()))
    }

    /// Opens and mounts a scene that a client names. Blocks.
    ///
    /// # Errors
    /// It is none, or damaged, or may not be read.
    pub(crate) fn open_scene(&self, path: &Path) -> Result<Mounted, JobError> {
        let place = self.roots().read(path)?;
        self.mounts.open(&place.path).map_err(|error| JobError {
            text: place.hide(&error.text),
            ..error
        })
    }

    /// Reads an environment map that a client names. Blocks.
    ///
    /// # Errors
    /// It is none, or may not be read.
    pub(crate) fn read_environment(&self, path: &Path) -> Result<Arc<Environment>, JobError> {
        let place = self.roots().read(path)?;
        let environment = pbgi_points::read_environment(&place.path).map_err(|error| {
            let text = place.hide(&error.to_string());
            JobError::new(JobErrorKind::Precondition, text)
        })?;
        Ok(Arc::new(crate::environment::shrink(environment)))
    }

    /// Closes a scene; whether it was open. Blocks.
    ///
    /// # Errors
    /// A job uses it.
    pub(crate) fn drop_scene(&self, path: &Path) -> Result<bool, JobError> {
        self.roots().check("scene", path, Want::Read)?;
        let place = self.roots().read(path)?;
        self.mounts.close(&place.path)
    }

    /// Reads and verifies every page of a scene; returns how many pages and bytes. Blocks.
    ///
    /// # Errors
    /// It is none, or damaged.
    pub(crate) fn warm_scene(&self, path: &Path) -> Result<(u64, u64), JobError> {
        let mounted = self.open_scene(path)?;
        let (scene, mut pages, mut bytes) = (mounted.scene(), 0, 0);
        let info = scene.info();
        let settings = &info.settings;
        let kinds = [
            (
                PageKind::Node,
                info.node_slots,
                settings.nodes_per_page,
                size_of::<NodeRecord>(),
            ),
            (
                PageKind::Point,
                info.point_count,
                settings.points_per_page,
                size_of::<PointRecord>(),
            ),
        ];
        for (kind, records, per_page, record_bytes) in kinds {
            let mut page = vec![0; per_page as usize * record_bytes];
            for number in 0..records.div_ceil(u64::from(per_page)) {
                let read = scene.read_page(kind, PageNo(number as u32), &mut page);
                read.map_err(|error| crate::mounts::store_error(&error))?;
                pages += 1;
                bytes += page.len() as u64;
            }
        }
        Ok((pages, bytes))
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

    /// The page cache.
    pub fn cache_report(&self) -> CacheReport {
        let counted = |mount: MountStatus| {
            let counters = self.cache.scene_counters(mount.id)?;
            Some((mount, counters))
        };
        let (cache, scenes) = (self.cache.counters(), self.mounts.list());
        let state = self.lock();
        let pins = |sitting: &super::Sitting| {
            let slot = sitting.birth.seat.slot;
            let held = [PageKind::Node, PageKind::Point].map(|kind| self.cache.pins(slot, kind));
            (sitting.birth, held)
        };
        CacheReport {
            layout: *self.cache.layout(),
            cache,
            scenes: scenes.into_iter().filter_map(counted).collect(),
            workers: state.seats.iter().flatten().map(pins).collect(),
            lookups: state.totals.counters,
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
    pub(crate) fn progress(&self, job: JobNo, stage: impl Into<Cow<'static, str>>, done: u64, total: u64) {
        if let Some(record) = self.lock().jobs.get(&job) {
            record
                .status
                .send_modify(|status| (status.stage, status.done, status.total) = (stage.into(), done, total));
        }
    }

    /// What is wanted of a job beside its task.
    pub(crate) fn options_of(&self, job: JobNo) -> JobOptions {
        let state = self.lock();
        let record = state.jobs.get(&job);
        record.map_or_else(JobOptions::default, |record| record.status.borrow().options.clone())
    }

    /// Adds a line to a job's history.
    pub(crate) fn note(&self, job: JobNo, text: String) {
        self.lock().note(job, text);
    }
}

fn with_reason(what: &str, reason: &str) -> String {
    let reason: String = reason
        .chars()
        .filter(|c| !c.is_control())
        .take(limits::LABEL_CHARS_MAX)
        .collect();
    if reason.is_empty() {
        what.to_owned()
    } else {
        format!("{what}: {reason}")
    }
}

pub(super) fn waiting(options: &JobOptions) -> &'static str {
    match options.paused {
        true => "paused",
        false => "waiting",
    }
}

impl State {
    fn number(&self, id: &str) -> Result<JobNo, JobError> {
        self.names.get(id).copied().ok_or_else(|| no_such_job(id))
    }

    fn status(&self, job: JobNo) -> Result<JobStatus, JobError> {
        let record = self.jobs.get(&job);
        record
            .map(|record| record.status.borrow().clone())
            .ok_or_else(|| no_such_job(&job.0.to_string()))
    }

    /// The job that a submission means, if it is there.
    fn find_same(&self, submission: &Submission) -> Result<Option<JobNo>, JobError> {
        let Submission {
            id, request, options, ..
        } = submission;
        if let Some((&job, record)) = self.names.get(id).and_then(|job| Some((job, self.jobs.get(job)?))) {
            let known = &record.status.borrow().options;
            let same_options = (&known.user, &known.labels, known.priority, &known.after)
                == (&options.user, &options.labels, options.priority, &options.after);
            if *record.request == *request && same_options {
                return Ok(Some(job));
            }
            let text = format!("job {id:?} exists with another request; choose another name");
            return Err(JobError::new(JobErrorKind::Exists, text));
        }
        let same = self.outputs.get(request.output()).filter(|job| {
            let record = self.jobs.get(job);
            record.is_some_and(|record| submission.attach && *record.request == *request)
        });
        Ok(same.copied())
    }

    /// Numbers of the jobs that must succeed first.
    fn before(&self, ids: &[String]) -> Result<Vec<JobNo>, JobError> {
        let mut numbers = Vec::new();
        for id in ids {
            let job = self.number(id)?;
            match self.status(job)?.state {
                JobState::Succeeded => {}
                JobState::Queued | JobState::Running => numbers.push(job),
                JobState::Failed | JobState::Cancelled => {
                    let text = format!("job {id:?}, which it comes after, did not succeed; retry that one first");
                    return Err(JobError::new(JobErrorKind::Precondition, text));
                }
            }
        }
        Ok(numbers)
    }

    fn claim_output(&mut self, request: &Request, job: JobNo) -> Result<(), JobError> {
        let output = request.output();
        if let Some(other) = self.outputs.get(output) {
            let id = self.status(*other).map(|status| status.id).unwrap_or_default();
            let text = format!("job {id:?} is making this output, at {}", output.display());
            return Err(JobError::new(JobErrorKind::Busy, text));
        }
        self.outputs.insert(output.to_owned(), job);
        Ok(())
    }
}
