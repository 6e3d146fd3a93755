//! Who works on what: a pure state machine, `on(event, now) -> effects`. It knows jobs, tiles and leases by number only, does
//! no I/O and reads no clock, so that a seed can drive it through thousands of histories.
//!
//! Jobs start by priority, then by how few jobs their user has running, then by arrival, builds in one lane and shading in
//! another. Tiles go out by the same order, users of equal priority taking turns, as long as a job's workers are fewer than it
//! allows. A lease ends by completion, by the death of its worker, by cancel of its job, or by time; the last has the worker
//! killed first, and only its confirmed death frees the tile. A job that is paused gives its place in the lane away.

mod event;

pub use event::{Death, Effect, End, Event, JobNo, Kind, LeaseId, Order, Seat, UserNo};

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet, VecDeque};
use std::time::{Duration, Instant};

/// Time without a sign of life after which a lease ends.
pub const HEARTBEAT_EXPIRY: Duration = Duration::from_secs(10);
/// Time after which a lease ends, whatever its worker says.
pub const LEASE_EXPIRY: Duration = Duration::from_secs(600);
/// Deaths in a row on one tile after which its job fails.
pub const TILE_DEATHS_MAX: u32 = 3;
/// Failures of one tile after which its job fails.
pub const TILE_FAILURES_MAX: u32 = 3;
/// Builds at once: each takes a fixed share of the memory.
pub const BUILDS_ACTIVE_MAX: usize = 1;
/// Shading jobs that hold pictures at once. One more may if its priority is above that of all of these.
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
    priority: i32,
    user: UserNo,
    paused: bool,
    /// Jobs that must succeed first.
    waits: BTreeSet<JobNo>,
    /// Tells a job that was submitted again under its number from its former life, whose leases may still be out.
    life: u64,
    phase: Phase,
    /// No more tiles come to a live job.
    closed: bool,
    pending: VecDeque<u32>,
    leased: usize,
    deaths: HashMap<u32, u32>,
    failures: HashMap<u32, u32>,
}

#[derive(Debug)]
struct Lease {
    seat: Seat,
    job: JobNo,
    life: u64,
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
    /// Jobs that are not queued, builds and others: the lanes.
    builds: BTreeSet<JobNo>,
    shades: BTreeSet<JobNo>,
    /// Live jobs, which need no lane.
    lives: BTreeSet<JobNo>,
    /// Who waits for a job.
    awaited: HashMap<JobNo, Vec<JobNo>>,
    leases: BTreeMap<LeaseId, Lease>,
    by_seat: HashMap<Seat, LeaseId>,
    doomed: HashSet<Seat>,
    /// The lease that a user got last.
    served: HashMap<UserNo, LeaseId>,
    lease_last: u64,
    life_last: u64,
    draining: bool,
    /// Why there are no workers, until one asks.
    workless: Option<String>,
}

impl Scheduler {
    /// Takes what happened and says what to do, in order.
    pub fn on(&mut self, event: Event, now: Instant) -> Vec<Effect> {
        let mut effects = Vec::new();
        match event {
            Event::Submit { job, kind, order } => self.submit(job, kind, order, &mut effects),
            Event::Feed { job, tile } => self.feed(job, tile, &mut effects),
            Event::Close { job } => self.close(job, &mut effects),
            Event::Prepared { job, tiles } => self.prepared(job, tiles, &mut effects),
            Event::Finished { job, outcome } => self.finished(job, outcome, &mut effects),
            Event::Cancel { job } => self.stop(job, End::Cancelled, &mut effects),
            Event::Fail { job, reason } => self.stop(job, End::Failed(reason), &mut effects),
            Event::Pause { job } => self.pause(job, &mut effects),
            Event::Resume { job } => self.resume(job, &mut effects),
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
        let running = self.builds.len() + self.shades.len() + self.lives.len();
        (self.jobs.len() - running, running)
    }

    /// Whether a worker holds a lease.
    pub fn is_busy(&self, seat: Seat) -> bool {
        self.by_seat.contains_key(&seat)
    }

    /// Whether a job can rest: it waits, or it is a picture whose tiles are not all there.
    pub fn can_pause(&self, job: JobNo) -> bool {
        self.jobs.get(&job).is_some_and(|job| match job.phase {
            Phase::Queued | Phase::Shading => job.kind != Kind::Live,
            Phase::Started => job.kind != Kind::Build,
            Phase::Writing | Phase::Stopping(_) => false,
        })
    }

    fn feed(&mut self, number: JobNo, tile: u32, effects: &mut Vec<Effect>) {
        let Some(job) = self
            .jobs
            .get_mut(&number)
            .filter(|job| job.kind == Kind::Live && !job.closed)
        else {
            return;
        };
        if let Some(reason) = &self.workless {
            let end = End::Failed(reason.clone());
            return self.end(number, end, effects);
        }
        job.pending.push_back(tile);
        effects.push(Effect::Wake);
    }

    fn close(&mut self, number: JobNo, effects: &mut Vec<Effect>) {
        if let Some(job) = self.jobs.get_mut(&number) {
            job.closed = true;
            self.settle(number, effects);
        }
    }

    fn submit(&mut self, number: JobNo, kind: Kind, order: Order, effects: &mut Vec<Effect>) {
        if self.draining {
            let end = End::Suspended;
            effects.push(Effect::Ended { job: number, end });
            return;
        }
        let waits: BTreeSet<JobNo> = order
            .after
            .into_iter()
            .filter(|job| self.jobs.contains_key(job))
            .collect();
        for &job in &waits {
            self.awaited.entry(job).or_default().push(number);
        }
        self.life_last += 1;
        let fresh = Job {
            kind,
            priority: order.priority,
            user: order.user,
            paused: order.paused,
            waits,
            life: self.life_last,
            phase: if kind == Kind::Live {
                Phase::Shading
            } else {
                Phase::Queued
            },
            closed: false,
            pending: VecDeque::new(),
            leased: 0,
            deaths: HashMap::new(),
            failures: HashMap::new(),
        };
        self.jobs.insert(number, fresh);
        if kind == Kind::Live {
            self.lives.insert(number);
        }
        self.fill_lanes(effects);
    }

    fn fill_lanes(&mut self, effects: &mut Vec<Effect>) {
        if self.draining {
            return;
        }
        while self.builds.len() < BUILDS_ACTIVE_MAX && self.start_next(true, i32::MIN, effects) {}
        while self.shades.len() < SHADES_ACTIVE_MAX && self.start_next(false, i32::MIN, effects) {}
        if self.shades.len() == SHADES_ACTIVE_MAX {
            let running = self.shades.iter().filter_map(|number| self.jobs.get(number));
            if let Some(above) = running.map(|job| job.priority).max()
                && let Some(above) = above.checked_add(1)
            {
                self.start_next(false, above, effects);
            }
        }
    }

    /// Starts the first in line whose priority is high enough; false if there is none.
    fn start_next(&mut self, build: bool, priority_min: i32, effects: &mut Vec<Effect>) -> bool {
        let lane = if build { &self.builds } else { &self.shades };
        let mut running: HashMap<UserNo, usize> = HashMap::new();
        for job in lane.iter().filter_map(|number| self.jobs.get(number)) {
            *running.entry(job.user).or_default() += 1;
        }
        let startable = |job: &Job| {
            job.phase == Phase::Queued
                && !job.paused
                && job.waits.is_empty()
                && (job.kind == Kind::Build) == build
                && job.priority >= priority_min
        };
        let first = self
            .jobs
            .iter()
            .filter(|(_, job)| startable(job))
            .min_by_key(|(number, job)| {
                let others = running.get(&job.user).copied().unwrap_or(0);
                (Reverse(job.priority), others, **number)
            })
            .map(|(&number, _)| number);
        let Some((number, job)) = first.and_then(|number| Some((number, self.jobs.get_mut(&number)?))) else {
            return false;
        };
        job.phase = Phase::Started;
        if build {
            self.builds.insert(number);
        } else {
            self.shades.insert(number);
        }
        effects.push(Effect::Start(number));
        true
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
            self.settle(number, effects);
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

    /// Forgets a job and its tiles, and those that could only come after it. Its leases stay as orphans until their workers
    /// let go, so that a hung one is still found.
    fn end(&mut self, number: JobNo, end: End, effects: &mut Vec<Effect>) {
        let mut ending = vec![(number, end)];
        while let Some((number, end)) = ending.pop() {
            let Some(job) = self.jobs.remove(&number) else { continue };
            self.builds.remove(&number);
            self.shades.remove(&number);
            self.lives.remove(&number);
            if !self.jobs.values().any(|other| other.user == job.user) {
                self.served.remove(&job.user);
            }
            for next in self.awaited.remove(&number).unwrap_or_default() {
                let Some(job) = self.jobs.get_mut(&next) else { continue };
                match end {
                    End::Succeeded => {
                        job.waits.remove(&number);
                    }
                    End::Suspended => {}
                    // What waits was never started, so there is nothing to stop.
                    _ => ending.push((next, End::Unmet(number))),
                }
            }
            effects.push(Effect::Ended { job: number, end });
        }
        self.fill_lanes(effects);
    }

    fn pause(&mut self, number: JobNo, effects: &mut Vec<Effect>) {
        if self.can_pause(number)
            && let Some(job) = self.jobs.get_mut(&number)
        {
            job.paused = true;
            self.settle(number, effects);
        }
    }

    fn resume(&mut self, number: JobNo, effects: &mut Vec<Effect>) {
        let Some(job) = self.jobs.get_mut(&number) else { return };
        job.paused = false;
        if job.phase == Phase::Shading {
            effects.push(Effect::Wake);
        }
        self.fill_lanes(effects);
    }

    fn workless(&mut self, reason: Option<String>, effects: &mut Vec<Effect>) {
        self.workless = reason.clone();
        let Some(reason) = reason else { return };
        let shading = |number: &JobNo| self.jobs.get(number).is_some_and(|job| job.phase == Phase::Shading);
        let numbers: Vec<JobNo> = self.shades.union(&self.lives).copied().filter(shading).collect();
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
            if let Some((number, _)) = self.release(held) {
                self.settle(number, effects);
            }
        }
        let Some(number) = self.next_in_turn() else { return };
        let Some(job) = self.jobs.get_mut(&number) else { return };
        let Some(tile) = job.pending.pop_front() else { return };
        job.leased += 1;
        self.lease_last += 1;
        let lease = LeaseId(self.lease_last);
        self.served.insert(job.user, lease);
        let record = Lease {
            seat,
            job: number,
            life: job.life,
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

    /// The job whose tile goes out next: highest priority; then the user with the fewest workers, then the one who waited
    /// longest; then the oldest job.
    fn next_in_turn(&self) -> Option<JobNo> {
        let lane = || {
            let job = |number: &JobNo| Some((*number, self.jobs.get(number)?));
            self.shades.union(&self.lives).filter_map(job)
        };
        let mut working: HashMap<UserNo, usize> = HashMap::new();
        for (_, job) in lane() {
            *working.entry(job.user).or_default() += job.leased;
        }
        let takes = |job: &Job| match job.kind {
            Kind::Shade { workers_max } => !job.paused && job.leased < workers_max && !job.pending.is_empty(),
            Kind::Live => !job.pending.is_empty(),
            Kind::Build => false,
        };
        lane()
            .filter(|(_, job)| takes(job))
            .min_by_key(|(number, job)| {
                let working = working.get(&job.user).copied().unwrap_or(0);
                (Reverse(job.priority), working, self.served.get(&job.user), *number)
            })
            .map(|(number, _)| number)
    }

    /// The job of a lease, unless it has ended since.
    fn job_of(&mut self, lease: &Lease) -> Option<&mut Job> {
        self.jobs.get_mut(&lease.job).filter(|job| job.life == lease.life)
    }

    /// Ends a lease and puts its tile first in line.
    fn release(&mut self, id: LeaseId) -> Option<(JobNo, u32)> {
        let lease = self.leases.remove(&id)?;
        self.by_seat.remove(&lease.seat);
        let job = self.job_of(&lease)?;
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
            if self.jobs.get(&lease.job).is_some_and(|job| job.life == lease.life) {
                effects.push(Effect::Alive);
            }
        }
    }

    fn complete(&mut self, seat: Seat, id: LeaseId, failure: Option<String>, effects: &mut Vec<Effect>) {
        let valid = |lease: &Lease| lease.seat == seat && !lease.revoked;
        if !self.leases.get(&id).is_some_and(valid) {
            effects.push(Effect::Drop);
            return;
        }
        self.by_seat.remove(&seat);
        let Some(lease) = self.leases.remove(&id) else { return };
        let (number, tile) = (lease.job, lease.tile);
        let Some(job) = self.job_of(&lease) else {
            effects.push(Effect::Drop);
            return;
        };
        job.leased -= 1;
        if let Some(failure) = failure {
            effects.push(Effect::Drop);
            let failures = job.failures.entry(tile).or_insert(0);
            *failures += 1;
            if *failures >= TILE_FAILURES_MAX {
                let text = format!("tile {tile}: {failure} ({failures} attempts)");
                self.stop(number, End::Failed(text), effects);
                return;
            }
            // Last in line: what is wrong may have passed by then.
            job.pending.push_back(tile);
            effects.push(Effect::Wake);
            self.settle(number, effects);
            return;
        }
        job.deaths.remove(&tile);
        let more = !job.pending.is_empty();
        effects.push(Effect::Accept { job: number, tile });
        if more {
            // A worker that was over the job's limit may take the place.
            effects.push(Effect::Wake);
        }
        self.settle(number, effects);
    }

    /// When the last lease is back: goes on to writing if that was the last tile; else rests if it is to rest.
    fn settle(&mut self, number: JobNo, effects: &mut Vec<Effect>) {
        let Some(job) = self.jobs.get_mut(&number) else { return };
        if job.phase != Phase::Shading || job.leased > 0 {
            return;
        }
        if job.kind == Kind::Live {
            if self.draining {
                self.end(number, End::Failed(DRAINING.into()), effects);
            } else if job.closed && job.pending.is_empty() {
                self.end(number, End::Succeeded, effects);
            }
            return;
        }
        if job.pending.is_empty() {
            job.phase = Phase::Writing;
            effects.push(Effect::Write(number));
        } else if self.draining {
            self.end(number, End::Suspended, effects);
        } else if job.paused {
            job.phase = Phase::Queued;
            job.pending.clear();
            self.shades.remove(&number);
            effects.push(Effect::Park(number));
            self.fill_lanes(effects);
        }
    }

    fn worker_gone(&mut self, seat: Seat, death: Death, effects: &mut Vec<Effect>) {
        self.doomed.remove(&seat);
        let Some(&id) = self.by_seat.get(&seat) else { return };
        let revoked = self.leases.get(&id).is_some_and(|lease| lease.revoked);
        let Some((number, tile)) = self.release(id) else { return };
        effects.push(Effect::Wake);
        // A tile that ran out of time is as suspect as one that crashed; kills by others are not its doing.
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
        self.settle(number, effects);
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
                Phase::Queued | Phase::Started => self.stop(number, End::Suspended, effects),
                Phase::Shading => self.settle(number, effects),
                Phase::Writing | Phase::Stopping(_) => {}
            }
        }
    }
}

/// Why nothing is taken any more when the daemon stops.
pub const DRAINING: &str = "the daemon is shutting down";

#[cfg(test)]
mod tests;
