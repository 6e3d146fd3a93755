//! What the daemon's clock does: leases that ran out, memory, workers that scribble, a segment that somebody removed.

use super::{Dispatcher, State};
use crate::job::JobState;
use crate::memory::anonymous_bytes;
use crate::scheduler::{Event, JobNo, Seat};
use std::sync::Arc;
use std::time::Duration;

impl Dispatcher {
    /// To be called a few times a second.
    pub fn tick(self: &Arc<Self>) {
        if let Some(seat) = self.cache.overrun() {
            tracing::error!(slot = seat.slot, "worker holds more pins than it may");
            self.supervisor.kill(Seat {
                slot: seat.slot,
                epoch: seat.epoch,
            });
        }
        {
            let mut state = self.lock();
            self.dispatch(&mut state, Event::Tick, None);
        }
        self.sample_memory();
    }

    /// Stops if the segment's name is gone: no new worker could attach.
    pub fn check_segment(&self) {
        if let Ok(false) = self.cache.segment().linked() {
            tracing::error!("somebody removed the shared memory segment; stopping");
            self.healthy.send_replace(false);
            self.request_stop();
        }
    }

    /// Updates the peaks of all running jobs.
    pub(crate) fn sample_memory(&self) {
        let pids = {
            let state = self.lock();
            if state.scheduler.is_idle() {
                return;
            }
            self.pids(&state)
        };
        let private: u64 = pids.into_iter().filter_map(anonymous_bytes).sum();
        let memory = private + self.cache.layout().total_bytes();
        let cache = self.cache.counters().resident_bytes;
        let mut state = self.lock();
        for live in state.lives.values_mut() {
            live.peaks = (live.peaks.0.max(memory), live.peaks.1.max(cache));
        }
        for record in state.jobs.values_mut() {
            if record.status.borrow().state == JobState::Running {
                record.memory_peak_bytes = record.memory_peak_bytes.max(memory);
                record.cache_peak_bytes = record.cache_peak_bytes.max(cache);
            }
        }
    }

    pub(super) fn pids(&self, state: &State) -> Vec<u32> {
        let workers = state.seats.iter().flatten().map(|sitting| sitting.birth.pid);
        let builds = state.build_pids.values().copied();
        workers.chain(builds).chain([std::process::id()]).collect()
    }

    /// Most memory of all processes and of the cache's pages since a job runs, now included.
    pub(crate) fn peaks(&self, job: JobNo) -> (u64, u64) {
        self.sample_memory();
        let state = self.lock();
        state
            .jobs
            .get(&job)
            .map_or((0, 0), |record| (record.memory_peak_bytes, record.cache_peak_bytes))
    }

    pub(crate) fn build_started(&self, job: JobNo, pid: u32) {
        self.lock().build_pids.insert(job, pid);
    }

    pub(crate) fn build_ended(&self, job: JobNo) {
        self.lock().build_pids.remove(&job);
    }

    /// Nothing new is begun from now on; what is leased is finished.
    pub fn drain(self: &Arc<Self>) {
        let mut state = self.lock();
        state.draining = true;
        self.healthy.send_replace(false);
        self.dispatch(&mut state, Event::Drain, None);
    }

    /// Whether no job is left.
    pub fn is_idle(&self) -> bool {
        self.lock().scheduler.is_idle()
    }

    /// Time since the last job, while there is none.
    pub fn idle_time(&self) -> Option<Duration> {
        let state = self.lock();
        state.scheduler.is_idle().then(|| state.active.elapsed())
    }
}
