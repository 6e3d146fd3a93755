//! Live sessions: opened by a client, fed with tiles, closed.

use super::Dispatcher;
use crate::bounce::{self, Wanted};
use crate::error::{JobError, JobErrorKind};
use crate::framebuffer::TileReceivers;
use crate::limits;
use crate::live::{Live, LiveResult, LiveTask, RECEIVER_BYTES, Session};
use crate::roots::Want;
use crate::scheduler::{DRAINING, Event, JobNo, Kind, Order};
use crate::shade_job::{Counters, tile_statistics};
use pbgi_core::Statistics;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;
use tokio::sync::{mpsc, watch};

impl Dispatcher {
    /// Opens a session. Its values come through the receiver, in whatever order they are done.
    ///
    /// # Errors
    /// A scene or an environment that cannot be used, settings out of range, too many sessions.
    pub async fn open_live(self: &Arc<Self>, task: LiveTask) -> Result<(JobNo, mpsc::Receiver<LiveResult>), JobError> {
        task.settings
            .validate()
            .map_err(|error| JobError::invalid(error.to_string()))?;
        if task.priority.abs() > limits::PRIORITY_MAX {
            let (priority, max) = (task.priority, limits::PRIORITY_MAX);
            let text = format!("priority is {priority}, must be from -{max} to {max}");
            return Err(JobError::invalid(text));
        }
        if let Some(angle) = task.pixel_angle.filter(|&angle| !(angle > 0.0 && angle < 1.0)) {
            let text = format!("pixel_angle is {angle}, must be above 0 and below 1");
            return Err(JobError::invalid(text));
        }
        self.roots().check("scene", &task.scene, Want::Read)?;
        if let Some(path) = &task.environment {
            self.roots().check("environment", path, Want::Read)?;
        }
        let (this, path) = (self.clone(), task.environment.clone());
        let read = tokio::task::spawn_blocking(move || path.map(|path| this.read_environment(&path)).transpose());
        let read = read
            .await
            .map_err(|error| JobError::new(JobErrorKind::Internal, error.to_string()))?;
        let number = {
            let mut state = self.lock();
            if state.lives.len() >= limits::LIVE_SESSIONS_MAX {
                let text = format!("{} clients are streaming already", limits::LIVE_SESSIONS_MAX);
                return Err(JobError::new(JobErrorKind::Exhausted, text));
            }
            state.number_last += 1;
            JobNo(state.number_last)
        };
        let wanted = Wanted {
            scene: task.scene,
            settings: task.settings,
            environment: read?,
            user: task.user.clone(),
            priority: task.priority,
            workers: task.workers,
        };
        // Dropped with this call, when its client leaves: nothing is made for nobody.
        let (_abort, aborted) = watch::channel(false);
        let mounted = bounce::lit_scene(self, number, &wanted, &aborted).await?;
        self.start_live(Session {
            mounted,
            settings: task.settings,
            environment: wanted.environment,
            user: task.user,
            priority: task.priority,
            pixel_angle: task.pixel_angle,
        })
    }

    /// Starts a session on a scene that is open.
    ///
    /// # Errors
    /// The daemon stops.
    pub(crate) fn start_live(
        self: &Arc<Self>,
        session: Session,
    ) -> Result<(JobNo, mpsc::Receiver<LiveResult>), JobError> {
        let (results, values) = mpsc::channel(limits::LIVE_TILES_MAX + 1);
        let mut state = self.lock();
        if state.draining {
            return Err(JobError::new(JobErrorKind::Unavailable, DRAINING));
        }
        state.number_last += 1;
        let (job, kind) = (JobNo(state.number_last), Kind::Live);
        let order = Order {
            priority: session.priority,
            user: super::durable::user_number(&session.user),
            ..Order::default()
        };
        let live = Live {
            mounted: session.mounted,
            settings: session.settings,
            environment: session.environment,
            pixel_angle: session.pixel_angle,
            tiles: BTreeMap::new(),
            counters: Counters::default(),
            receivers: 0,
            started: Instant::now(),
            peaks: (0, 0),
            results,
        };
        state.lives.insert(job, live);
        self.enqueue(&mut state, Event::Submit { job, kind, order });
        Ok((job, values))
    }

    /// Hands a session's tile out. The caller keeps to [`limits::LIVE_TILES_MAX`].
    pub fn feed(self: &Arc<Self>, job: JobNo, tile: u32, receivers: TileReceivers) {
        let mut state = self.lock();
        if let Some(live) = state.lives.get_mut(&job) {
            live.receivers += (receivers.bytes.len() / RECEIVER_BYTES) as u64;
            live.tiles.insert(tile, receivers);
            self.dispatch(&mut state, Event::Feed { job, tile }, None);
        }
    }

    /// What a session took so far.
    pub fn live_statistics(&self, job: JobNo) -> Option<Statistics> {
        self.sample_memory();
        let pages = self.cache.job_counters(job.0);
        let state = self.lock();
        let live = state.lives.get(&job)?;
        let info = live.mounted.scene().info();
        let seconds = live.started.elapsed().as_secs_f64();
        Some(Statistics {
            holes: Some((live.receivers - live.counters.receivers.min(live.receivers)) as f64),
            peak_memory_bytes: Some(live.peaks.0 as f64),
            cache_peak_bytes: Some(live.peaks.1 as f64),
            ..tile_statistics(info, &live.counters, &pages, seconds)
        })
    }

    /// Ends a session: what is not done is let go.
    pub fn close_live(self: &Arc<Self>, job: JobNo) {
        let mut state = self.lock();
        state.active = Instant::now();
        self.dispatch(&mut state, Event::Cancel { job }, None);
    }
}
