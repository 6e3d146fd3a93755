//! What outlives the daemon: every change of a job goes to the table, and the next daemon goes on from there.

use super::{Dispatcher, Record, State};
use crate::error::JobError;
use crate::job::{JobState, JobStatus, Request};
use crate::limits;
use crate::scheduler::{Event, JobNo, Order, UserNo};
use crate::shade_job::Counters;
use crate::table::Row;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::Arc;
use tokio::sync::watch;
use tracing::Span;

/// What is kept of a job beside its status.
#[derive(Clone, Debug, Default)]
pub(super) struct Kept {
    /// The request, as it came over the wire.
    pub(super) wire: Arc<[u8]>,
    /// Daemons that died while it ran, one after the other, without a tile finished.
    pub(super) daemon_deaths: u32,
    /// What its tiles were made from.
    pub(super) fingerprint: Option<String>,
    /// Somebody asked to cancel it.
    pub(super) cancelled: bool,
}

/// A job's row, but for the request.
#[derive(Serialize, Deserialize)]
struct Stored {
    status: JobStatus,
    daemon_deaths: u32,
    fingerprint: Option<String>,
    cancelled: bool,
}

impl Dispatcher {
    /// Leaves a job's state to the table.
    pub(super) fn save(&self, job: JobNo, record: &Record) {
        let kept = &record.kept;
        let stored = Stored {
            status: record.status.borrow().clone(),
            daemon_deaths: kept.daemon_deaths,
            fingerprint: kept.fingerprint.clone(),
            cancelled: kept.cancelled,
        };
        match serde_json::to_vec(&stored) {
            Ok(bytes) => {
                let request = kept.wire.clone();
                self.table.put(job, Row { request, record: bytes });
            }
            Err(error) => tracing::error!(%error, job = job.0, "a job cannot be stored"),
        }
    }

    /// Takes a tile into the picture and into the table.
    pub(super) fn accept(&self, state: &mut State, job: JobNo, tile: u32, values: Vec<u8>, counters: &Counters) {
        state.totals.tiles += 1;
        state.totals.counters.add(counters);
        if let Some(live) = state.lives.get_mut(&job) {
            state.scenes.entry(live.mounted.id()).or_default().add(counters);
            live.tiles.remove(&tile);
            live.counters.add(counters);
            // It has room for every tile; a client that left does not listen.
            let _ = live.results.try_send(Ok((tile, values)));
            return;
        }
        let Some(record) = state.jobs.get_mut(&job) else { return };
        if let Some(shading) = &mut record.shading {
            state.scenes.entry(shading.mounted.id()).or_default().add(counters);
            shading.frame.fill(tile, &values);
            shading.counters.add(counters);
        }
        record.status.send_modify(|status| status.done += 1);
        let mut bytes = counters.to_bytes();
        bytes.extend_from_slice(&values);
        self.table.put_tile(job, tile, bytes);
        if record.kept.daemon_deaths > 0 {
            // It gets ahead, so it is not what kills daemons.
            record.kept.daemon_deaths = 0;
            self.save(job, record);
        }
    }

    /// An ended job makes room: finished tiles are of no use, except to a retry, and old jobs are forgotten.
    pub(super) fn retire(&self, state: &mut State, job: JobNo, ended: JobState) {
        if ended == JobState::Failed {
            state.failed.push_back(job);
            if state.failed.len() > limits::FAILED_JOBS_KEPT_MAX
                && let Some(oldest) = state.failed.pop_front()
            {
                self.table.drop_tiles(oldest);
            }
        } else {
            self.table.drop_tiles(job);
        }
        state.ended.push_back(job);
        if let Some(older) = state.ended.iter().rev().nth(limits::PREVIEWS_MAX).copied()
            && let Some(record) = state.jobs.get_mut(&older)
        {
            record.preview = None;
        }
        while state.ended.len() > limits::JOBS_ENDED_MAX {
            let Some(oldest) = state.ended.pop_front() else { return };
            state.failed.retain(|failed| *failed != oldest);
            if let Some(record) = state.jobs.remove(&oldest) {
                let name = record.status.borrow().id.clone();
                state.names.remove(&name);
            }
            self.table.forget(oldest);
        }
    }

    /// Takes over the jobs of the last daemon; `read` understands their requests.
    pub fn restore(self: &Arc<Self>, rows: BTreeMap<u64, Row>, read: impl Fn(&[u8]) -> Result<Request, JobError>) {
        let mut state = self.lock();
        let mut unfinished = 0;
        for (number, row) in rows {
            let job = JobNo(number);
            state.number_last = state.number_last.max(number);
            let stored = serde_json::from_slice::<Stored>(&row.record).map_err(|error| error.to_string());
            let request = read(&row.request).map_err(|error| error.to_string());
            let (stored, request) = match (stored, request) {
                (Ok(stored), Ok(request)) => (stored, request),
                (Err(error), _) | (_, Err(error)) => {
                    tracing::error!(job = number, error, "a stored job cannot be read, and is forgotten");
                    self.table.forget(job);
                    continue;
                }
            };
            unfinished += usize::from(!stored.status.state.ended());
            self.restore_one(&mut state, job, stored, row.request, request);
        }
        if unfinished > 0 {
            tracing::info!(unfinished, "going on with the last daemon's jobs");
        }
    }

    fn restore_one(self: &Arc<Self>, state: &mut State, job: JobNo, stored: Stored, wire: Arc<[u8]>, request: Request) {
        let Stored {
            mut status,
            mut daemon_deaths,
            fingerprint,
            cancelled,
        } = stored;
        let died = status.state == JobState::Running;
        let goes_on = !status.state.ended();
        if died {
            daemon_deaths += 1;
            status.note("the daemon died");
        }
        if goes_on {
            (status.state, status.stage) = (JobState::Queued, super::clients::waiting(&status.options).into());
        }
        let (kind, options) = (request.kind(), status.options.clone());
        state.names.insert(status.id.clone(), job);
        let ended = status.state;
        let record = Record {
            span: match goes_on {
                true => super::clients::span(&status),
                false => Span::none(),
            },
            request: Arc::new(request),
            kept: Kept {
                wire,
                daemon_deaths,
                fingerprint,
                cancelled,
            },
            status: watch::Sender::new(status),
            abort: watch::Sender::new(false),
            shading: None,
            preview: None,
            memory_peak_bytes: 0,
            cache_peak_bytes: 0,
        };
        if goes_on {
            state.outputs.insert(record.request.output().to_owned(), job);
            self.save(job, &record);
        }
        state.jobs.insert(job, record);
        if !goes_on {
            self.retire(state, job, ended);
            return;
        }
        // A job before it that has failed or is forgotten has taken it along already.
        let after = options.after.iter().filter_map(|id| state.names.get(id).copied());
        let order = Order {
            priority: options.priority,
            user: user_number(&options.user),
            after: after.collect(),
            paused: options.paused,
        };
        self.dispatch(state, Event::Submit { job, kind, order }, None);
        if cancelled {
            self.dispatch(state, Event::Cancel { job }, None);
        } else if daemon_deaths >= limits::DAEMON_DEATHS_MAX {
            let reason = format!("{daemon_deaths} daemons died while it ran, before it finished a tile");
            self.dispatch(state, Event::Fail { job, reason }, None);
        }
    }
}

/// A user's number: the same for the same name.
pub(super) fn user_number(name: &str) -> UserNo {
    // FNV-1a; users whose numbers fall together share a share.
    let step = |hash: u32, byte: u8| (hash ^ u32::from(byte)).wrapping_mul(0x0100_0193);
    UserNo(name.bytes().fold(0x811c_9dc5, step))
}
