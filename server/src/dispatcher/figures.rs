//! What metrics and the page are made from.

use super::{Dispatcher, Record};
use crate::framebuffer::Preview;
use crate::job::{JobState, JobStatus, Request};
use crate::memory::anonymous_bytes;
use crate::mounts::MountStatus;
use crate::shade_job::{Counters, shading_statistics};
use pbgi_cache::SceneCounters;
use pbgi_core::Statistics;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Longer edge of the page's pictures, pixels.
const PREVIEW_EDGE: u32 = 512;

/// Sums since the daemon's start.
#[derive(Clone, Debug, Default)]
pub struct Totals {
    /// What tiles took.
    pub counters: Counters,
    /// Tiles.
    pub tiles: u64,
    /// Workers that died.
    pub worker_deaths: u64,
    /// Jobs that ended, by how.
    pub ended: BTreeMap<JobState, u64>,
    /// Clients that stream receivers now.
    pub live_sessions: usize,
    /// Private memory of all processes now.
    pub private_bytes: u64,
}

/// A job with its figures up to now.
#[derive(Clone, Debug)]
pub struct JobFigures {
    /// The job.
    pub status: JobStatus,
    /// Name of the scene that it shades or builds.
    pub scene: String,
    /// Its rows of the table; those of a running job are counted up to now.
    pub statistics: Statistics,
}

/// A mounted scene with its figures since it was mounted.
#[derive(Clone, Debug)]
pub struct SceneFigures {
    /// The scene.
    pub mount: MountStatus,
    /// Of its nodes and of its points.
    pub cache: [SceneCounters; 2],
    /// What its tiles took.
    pub counters: Counters,
}

impl Dispatcher {
    /// Mounted scenes.
    pub fn scene_figures(&self) -> Vec<SceneFigures> {
        let mounts = self.mounts.list();
        let mut state = self.lock();
        // A scene that is mounted again has another id.
        state.scenes.retain(|id, _| mounts.iter().any(|mount| mount.id == *id));
        let figures = |mount: MountStatus| {
            Some(SceneFigures {
                cache: self.cache.scene_counters(mount.id)?,
                counters: state.scenes.get(&mount.id).copied().unwrap_or_default(),
                mount,
            })
        };
        mounts.into_iter().filter_map(figures).collect()
    }

    /// Sums since the start.
    pub fn totals(&self) -> Totals {
        let (mut totals, pids) = {
            let state = self.lock();
            let mut totals = state.totals.clone();
            totals.live_sessions = state.lives.len();
            (totals, self.pids(&state))
        };
        totals.private_bytes = pids.into_iter().filter_map(anonymous_bytes).sum();
        totals
    }

    /// Running jobs, and the last that ended.
    pub fn figures(&self, ended_max: usize) -> Vec<JobFigures> {
        let state = self.lock();
        let running = state
            .jobs
            .iter()
            .filter(|(_, record)| record.status.borrow().state == JobState::Running);
        let ended = state.ended.iter().rev().take(ended_max);
        let ended = ended.filter_map(|job| Some((job, state.jobs.get(job)?)));
        running
            .chain(ended)
            .map(|(job, record)| self.figures_of(job.0, record))
            .collect()
    }

    fn figures_of(&self, number: u64, record: &Record) -> JobFigures {
        let status = record.status.borrow().clone();
        let statistics = match &record.shading {
            Some(shading) => shading_statistics(shading, &self.cache.job_counters(number), shading.seconds()),
            None => status.statistics.clone(),
        };
        let path = match &*record.request {
            Request::Build(task) => &task.output,
            Request::Shade(task) => &task.scene,
        };
        JobFigures {
            scene: path.file_name().unwrap_or_default().to_string_lossy().into_owned(),
            statistics,
            status,
        }
    }

    /// A small version of a job's picture as far as it is; `None` if it has none.
    pub fn preview(&self, id: &str) -> Option<Arc<Preview>> {
        let state = self.lock();
        let record = state.jobs.get(state.names.get(id)?)?;
        match &record.shading {
            Some(shading) => Some(Arc::new(shading.frame.preview(PREVIEW_EDGE))),
            None => record.preview.clone(),
        }
    }

    /// Keeps the last small version of a picture that is about to be written.
    pub(super) fn keep_preview(record: &mut Record) {
        if let Some(shading) = &record.shading {
            record.preview = Some(Arc::new(shading.frame.preview(PREVIEW_EDGE)));
        }
    }
}
