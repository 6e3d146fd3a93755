//! Who works on what: a pure state machine, `on(event, now) -> effects`. It knows jobs, tiles and leases by number only, does
//! no I/O and reads no clock, so that a seed can drive it through thousands of histories.
//!
//! Jobs start in order of arrival, builds in one lane and shading in another. Tiles go out from the oldest job that has one
//! and whose workers are not yet as many as it allows. A lease ends by completion, by the death of its worker, by cancel of
//! its job, or by time; the last has the worker killed first, and only its confirmed death frees the tile.

mod event;

pub use event::{Death, Effect, End, Event, JobNo, Kind, LeaseId, Seat};

use std::collections::{BTreeMap, HashMap, HashSet, VecDeque};
use std::time::{Duration, Instant};

/// Time without a sign of life after which a lease ends.
pub const HEARTBEAT_EXPIRY: Duration = Duration::from_secs(10);
/// Time after which a lease ends, whatever its worker says.
pub const LEASE_EXPIRY: Duration = Duration::from_secs(600);
/// Deaths in a row on one tile after which its job fails.
pub const TILE_DEATHS_MAX: u32 = 3;
/// Builds at once: each takes a fixed share of the memory.
pub const BUILDS_ACTIVE_MAX: usize = 1;
/// Shading jobs that hold pictures at once.
pub const SHADES_ACTIVE_MAX: usize = 4;

#[derive(Debug, PartialEq)]
enum Phase {
    Queued,
    /// Building or preparing.
    Started,
    Shading,
    Writing,
    /// Cancelled or failed while something runs that cannot be left behind.
    Stopping(End),
}

#[derive(Debug)]
struct Job {
    kind: Kind,
    phase: Phase,
    pending: VecDeque<u32>,
    leased: usize,
    deaths: HashMap<u32, u32>,
}

#[derive(Debug)]
struct Lease {
    seat: Seat,
    job: JobNo,
    tile: u32,
    granted: Instant,
    heard: Instant,
    /// Ran out; its worker is being killed.
    revoked: bool,
}

/// The state machine.
#[derive(Debug, Default)]
pub struct Scheduler {
    jobs: BTreeMap<JobNo, Job>,
    leases: BTreeMap<LeaseId, Lease>,
    by_seat: HashMap<Seat, LeaseId>,
    doomed: HashSet<Seat>,
    lease_last: u64,
    draining: bool,
    /// Why there are no workers, until one asks.
    workless: Option<String>,
}

impl Scheduler {
    /// Takes what happened and says what to do, in order.
    pub fn on(&mut self, event: Event, now: Instant) -> Vec<Effect> {
        let mut effects = Vec::new();
        match event {
            Event::Submit { job, kind } => self.submit(job, kind, &mut effects),
            Event::Prepared { job, tiles } => self.prepared(job, tiles, &mut effects),
            Event::Finished { job, outcome } => self.finished(job, outcome, &mut effects),
            Event::Cancel { job } => self.stop(job, End::Cancelled, &mut effects),
            Event::Ask { seat } => self.ask(seat, now, &mut effects),
            Event::Heartbeat { seat, lease } => self.heartbeat(seat, lease, now, &mut effects),
            Event::Complete { seat, lease, failure } => self.complete(seat, lease, failure, &mut effects),
            Event::WorkerGone { seat, death } => self.worker_gone(seat, death, &mut effects),
            Event::Workless { reason } => self.workless(reason, &mut effects),
            Event::Tick => self.tick(now, &mut effects),
            Event::Drain => self.drain(&mut effects),
        }
        effects
    }

    /// No job is left.
    pub fn is_idle(&self) -> bool {
        self.jobs.is_empty()
    }

    /// Jobs that wait, and jobs that run.
    pub fn counts(&self) -> (usize, usize) {
        let queued = self.jobs.values().filter(|job| job.phase == Phase::Queued).count();
        (queued, self.jobs.len() - queued)
    }

    /// Whether a worker holds a lease.
    pub fn is_busy(&self, seat: Seat) -> bool {
        self.by_seat.contains_key(&seat)
    }

    fn submit(&mut self, job: JobNo, kind: Kind, effects: &mut Vec<Effect>) {
        if self.draining {
            let end = End::Failed(DRAINING.into());
            effects.push(Effect::Ended { job, end });
            return;
        }
        let fresh = Job {
            kind,
            phase: Phase::Queued,
            pending: VecDeque::new(),
            leased: 0,
            deaths: HashMap::new(),
        };
        self.jobs.insert(job, fresh);
        self.fill_lanes(effects);
    }

    fn fill_lanes(&mut self, effects: &mut Vec<Effect>) {
        let is_build = |job: &Job| job.kind == Kind::Build;
        let active = |build: bool| {
            let runs = |job: &&Job| job.phase != Phase::Queued && is_build(job) == build;
            self.jobs.values().filter(runs).count()
        };
        let mut free_builds = BUILDS_ACTIVE_MAX.saturating_sub(active(true));
        let mut free_shades = SHADES_ACTIVE_MAX.saturating_sub(active(false));
        for (&number, job) in self.jobs.iter_mut().filter(|(_, job)| job.phase == Phase::Queued) {
            let free = if is_build(job) {
                &mut free_builds
            } else {
                &mut free_shades
            };
            if *free > 0 {
                *free -= 1;
                job.phase = Phase::Started;
                effects.push(Effect::Start(number));
            }
        }
    }

    fn prepared(&mut self, number: JobNo, tiles: Vec<u32>, effects: &mut Vec<Effect>) {
        let Some(job) = self.jobs.get_mut(&number) else { return };
        if let Phase::Stopping(end) = &job.phase {
            let end = end.clone();
            self.end(number, end, effects);
        } else if job.phase == Phase::Started {
            job.pending = tiles.into();
            job.phase = Phase::Shading;
            if let (Some(reason), false) = (&self.workless, job.pending.is_empty()) {
                let end = End::Failed(reason.clone());
                return self.end(number, end, effects);
            }
            effects.push(Effect::Wake);
            self.check_done(number, effects);
        }
    }

    fn finished(&mut self, number: JobNo, outcome: Result<(), String>, effects: &mut Vec<Effect>) {
        let Some(job) = self.jobs.get(&number) else { return };
        let end = match (&job.phase, outcome) {
            (Phase::Queued | Phase::Shading, _) => return,
            // What was published before the request to stop arrived is there.
            (Phase::Started | Phase::Writing | Phase::Stopping(_), Ok(())) => End::Succeeded,
            (Phase::Stopping(end), Err(_)) => end.clone(),
            (Phase::Started | Phase::Writing, Err(error)) => End::Failed(error),
        };
        self.end(number, end, effects);
    }

    fn stop(&mut self, number: JobNo, end: End, effects: &mut Vec<Effect>) {
        let Some(job) = self.jobs.get_mut(&number) else { return };
        match job.phase {
            Phase::Queued | Phase::Shading => self.end(number, end, effects),
            Phase::Started | Phase::Writing => {
                job.phase = Phase::Stopping(end);
                effects.push(Effect::Abort(number));
            }
            Phase::Stopping(_) => {}
        }
    }

    /// Forgets a job and its tiles. Its leases stay as orphans until their workers let go, so that a hung one is still found.
    fn end(&mut self, number: JobNo, end: End, effects: &mut Vec<Effect>) {
        self.jobs.remove(&number);
        effects.push(Effect::Ended { job: number, end });
        self.fill_lanes(effects);
    }

    fn workless(&mut self, reason: Option<String>, effects: &mut Vec<Effect>) {
        self.workless = reason.clone();
        let Some(reason) = reason else { return };
        let shading = |(&number, job): (&JobNo, &Job)| (job.phase == Phase::Shading).then_some(number);
        let numbers: Vec<JobNo> = self.jobs.iter().filter_map(shading).collect();
        for number in numbers {
            self.end(number, End::Failed(reason.clone()), effects);
        }
    }

    fn ask(&mut self, seat: Seat, now: Instant, effects: &mut Vec<Effect>) {
        self.workless = None;
        if self.draining || self.doomed.contains(&seat) {
            return;
        }
        if let Some(&held) = self.by_seat.get(&seat) {
            // The answer to its last question was lost.
            self.release(held);
        }
        let takes = |job: &Job| match job.kind {
            Kind::Shade { workers_max } => job.leased < workers_max && !job.pending.is_empty(),
            Kind::Build => false,
        };
        let found = self
            .jobs
            .iter_mut()
            .map(|(&number, job)| (number, job))
            .find(|(_, job)| takes(job));
        let Some((number, job)) = found else { return };
        let Some(tile) = job.pending.pop_front() else { return };
        job.leased += 1;
        self.lease_last += 1;
        let lease = LeaseId(self.lease_last);
        let record = Lease {
            seat,
            job: number,
            tile,
            granted: now,
            heard: now,
            revoked: false,
        };
        self.leases.insert(lease, record);
        self.by_seat.insert(seat, lease);
        effects.push(Effect::Grant {
            seat,
            lease,
            job: number,
            tile,
        });
    }

    /// Ends a lease and puts its tile first in line.
    fn release(&mut self, id: LeaseId) -> Option<(JobNo, u32)> {
        let lease = self.leases.remove(&id)?;
        self.by_seat.remove(&lease.seat);
        let job = self.jobs.get_mut(&lease.job)?;
        job.leased -= 1;
        job.pending.push_front(lease.tile);
        Some((lease.job, lease.tile))
    }

    fn heartbeat(&mut self, seat: Seat, id: LeaseId, now: Instant, effects: &mut Vec<Effect>) {
        if let Some(lease) = self.leases.get_mut(&id)
            && lease.seat == seat
            && !lease.revoked
        {
            lease.heard = now;
            if self.jobs.contains_key(&lease.job) {
                effects.push(Effect::Alive);
            }
        }
    }

    fn complete(&mut self, seat: Seat, id: LeaseId, failure: Option<String>, effects: &mut Vec<Effect>) {
        let valid = |lease: &&Lease| lease.seat == seat && !lease.revoked;
        let Some((number, tile)) = self.leases.get(&id).filter(valid).map(|lease| (lease.job, lease.tile)) else {
            effects.push(Effect::Drop);
            return;
        };
        self.leases.remove(&id);
        self.by_seat.remove(&seat);
        let Some(job) = self.jobs.get_mut(&number) else {
            effects.push(Effect::Drop);
            return;
        };
        job.leased -= 1;
        if let Some(failure) = failure {
            effects.push(Effect::Drop);
            self.stop(number, End::Failed(format!("tile {tile}: {failure}")), effects);
            return;
        }
        job.deaths.remove(&tile);
        effects.push(Effect::Accept { job: number, tile });
        if !job.pending.is_empty() {
            // A worker that was over the job's limit may take the place.
            effects.push(Effect::Wake);
        }
        self.check_done(number, effects);
    }

    /// Goes on to writing when the last tile is there; when draining, gives up when the last lease is.
    fn check_done(&mut self, number: JobNo, effects: &mut Vec<Effect>) {
        let Some(job) = self.jobs.get_mut(&number) else { return };
        if job.phase != Phase::Shading || job.leased > 0 {
            return;
        }
        if job.pending.is_empty() {
            job.phase = Phase::Writing;
            effects.push(Effect::Write(number));
        } else if self.draining {
            self.end(number, End::Failed(DRAINING.into()), effects);
        }
    }

    fn worker_gone(&mut self, seat: Seat, death: Death, effects: &mut Vec<Effect>) {
        self.doomed.remove(&seat);
        let Some(&id) = self.by_seat.get(&seat) else { return };
        let revoked = self.leases.get(&id).is_some_and(|lease| lease.revoked);
        let Some((number, tile)) = self.release(id) else { return };
        effects.push(Effect::Wake);
        // A tile that ran out of time is as suspect as one that crashed; other kills are not its doing.
        if (revoked || death == Death::Own)
            && let Some(job) = self.jobs.get_mut(&number)
        {
            let deaths = job.deaths.entry(tile).or_insert(0);
            *deaths += 1;
            if *deaths >= TILE_DEATHS_MAX {
                let text = format!("tile {tile}: {deaths} workers died on it, one after the other");
                self.stop(number, End::Failed(text), effects);
                return;
            }
        }
        self.check_done(number, effects);
    }

    fn tick(&mut self, now: Instant, effects: &mut Vec<Effect>) {
        for lease in self.leases.values_mut().filter(|lease| !lease.revoked) {
            let silent = now.saturating_duration_since(lease.heard) >= HEARTBEAT_EXPIRY;
            let over = now.saturating_duration_since(lease.granted) >= LEASE_EXPIRY;
            if silent || over {
                lease.revoked = true;
                self.doomed.insert(lease.seat);
                effects.push(Effect::Kill(lease.seat));
            }
        }
    }

    fn drain(&mut self, effects: &mut Vec<Effect>) {
        self.draining = true;
        let numbers: Vec<JobNo> = self.jobs.keys().copied().collect();
        for number in numbers {
            let Some(job) = self.jobs.get(&number) else { continue };
            match job.phase {
                Phase::Queued | Phase::Started => self.stop(number, End::Failed(DRAINING.into()), effects),
                Phase::Shading => self.check_done(number, effects),
                Phase::Writing | Phase::Stopping(_) => {}
            }
        }
    }
}

/// Why jobs fail when the daemon stops.
pub const DRAINING: &str = "the daemon is shutting down";

#[cfg(test)]
mod tests;
