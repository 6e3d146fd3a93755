//! One seat for a worker: who sits there, how often somebody died there, and when the next one may come.

use super::children::exempt_daemon;
use super::{Nursery, Plan, WorkerBirth, kill_now};
use crate::limits;
use crate::memory;
use crate::scheduler::{Death, Seat};
use nix::sys::signal::Signal;
use std::collections::VecDeque;
use std::fs::File;
use std::io::{self, Read};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::os::unix::process::ExitStatusExt;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

pub(super) struct Slot {
    number: u8,
    state: State,
    /// Deaths before being ready, the last ones.
    failures: VecDeque<Instant>,
    backoff: Duration,
}

enum State {
    Empty {
        spawn_at: Instant,
    },
    Taken {
        worker: Worker,
    },
    Parked {
        since: Instant,
        reason: String,
    },
    /// Nobody comes any more.
    Closed,
}

struct Worker {
    seat: Seat,
    child: Child,
    ready: bool,
    killed: bool,
    /// Its page channel closed: when it is killed unless it has ended by then.
    kill_at: Option<Instant>,
    /// It was killed for that.
    useless: bool,
    /// Processes that the kernel had killed for want of memory when this one started.
    oom_kills: Option<u64>,
}

impl Worker {
    /// Whose doing its end was. A signal from outside is told from one that the worker earned: faults raise others, and the
    /// kernel counts the processes that it kills for want of memory.
    fn death(&self, status: Option<ExitStatus>) -> Death {
        const SENT: [i32; 5] = [
            Signal::SIGKILL as i32,
            Signal::SIGTERM as i32,
            Signal::SIGINT as i32,
            Signal::SIGHUP as i32,
            Signal::SIGQUIT as i32,
        ];
        let sent = status
            .and_then(|status| status.signal())
            .is_some_and(|signal| SENT.contains(&signal));
        // Where the kernel does not count, nothing is known: the tile stays a suspect.
        let out_of_memory = self.oom_kills.is_none() || self.oom_kills != memory::oom_kills();
        match (self.killed, sent && !self.useless && !out_of_memory) {
            (true, _) => Death::Killed,
            (false, true) => Death::Outside,
            (false, false) => Death::Own,
        }
    }
}

impl Slot {
    pub(super) fn new(number: u8) -> Self {
        Self {
            number,
            state: State::Empty {
                spawn_at: Instant::now(),
            },
            failures: VecDeque::new(),
            backoff: limits::BACKOFF[0],
        }
    }

    pub(super) fn spawn_at(&self) -> Option<Instant> {
        match self.state {
            State::Empty { spawn_at } => Some(spawn_at),
            _ => None,
        }
    }

    /// Why the slot is parked, if it is.
    pub(super) fn parked(&self) -> Option<&str> {
        match &self.state {
            State::Parked { reason, .. } => Some(reason),
            _ => None,
        }
    }

    pub(super) fn unpark(&mut self, now: Instant) {
        if let State::Parked { since, .. } = self.state
            && now.duration_since(since) >= limits::PARK_WINDOW
        {
            self.failures.clear();
            self.backoff = limits::BACKOFF[0];
            self.state = State::Empty { spawn_at: now };
        }
    }

    pub(super) fn ready(&mut self, seat: Seat) {
        if let State::Taken { worker } = &mut self.state
            && worker.seat == seat
        {
            worker.ready = true;
            self.failures.clear();
            self.backoff = limits::BACKOFF[0];
        }
    }

    /// Kills whoever sits in `seat`.
    pub(super) fn kill(&mut self, seat: Seat) {
        if let State::Taken { worker } = &mut self.state
            && worker.seat == seat
        {
            worker.killed = true;
            tracing::warn!(
                slot = seat.slot,
                epoch = seat.epoch,
                pid = worker.child.id(),
                "killing worker"
            );
            kill_now(worker.child.id());
        }
    }

    /// A worker that closed its channel is dead or useless. It gets a moment, so that a dead one's status tells why.
    pub(super) fn hung_up(&mut self, seat: Seat, now: Instant) {
        if let State::Taken { worker } = &mut self.state
            && worker.seat == seat
        {
            worker.kill_at.get_or_insert(now + limits::HANGUP_GRACE);
        }
    }

    pub(super) fn spawn(&mut self, plan: &Plan, nursery: &mut impl Nursery, now: Instant) {
        let seat = nursery.seat(self.number);
        let oom_kills = memory::oom_kills();
        match start(plan, seat, nursery) {
            Ok(child) => {
                tracing::debug!(slot = seat.slot, epoch = seat.epoch, pid = child.id(), "worker started");
                let worker = Worker {
                    seat,
                    child,
                    ready: false,
                    killed: false,
                    kill_at: None,
                    useless: false,
                    oom_kills,
                };
                self.state = State::Taken { worker };
            }
            Err(error) => {
                let reason = format!("cannot start {}: {error}", plan.worker_binary.display());
                tracing::error!(slot = seat.slot, reason, "no worker");
                self.failed(now, reason);
            }
        }
    }

    /// A worker died before it was ready, or could not be made.
    fn failed(&mut self, now: Instant, reason: String) {
        self.failures.push_back(now);
        while self
            .failures
            .front()
            .is_some_and(|&first| now.duration_since(first) > limits::PARK_WINDOW)
        {
            self.failures.pop_front();
        }
        if self.failures.len() >= limits::PARK_DEATHS {
            tracing::error!(slot = self.number, deaths = self.failures.len(), "slot parked");
            self.state = State::Parked { since: now, reason };
            return;
        }
        self.state = State::Empty {
            spawn_at: now + self.backoff,
        };
        self.backoff = (self.backoff * 2).min(limits::BACKOFF[1]);
    }

    pub(super) fn reap(&mut self, nursery: &mut impl Nursery, now: Instant) {
        let State::Taken { worker } = &mut self.state else {
            return;
        };
        let status = match worker.child.try_wait() {
            Ok(None) => {
                if worker.kill_at.is_some_and(|at| at <= now) && !worker.useless {
                    worker.useless = true;
                    kill_now(worker.child.id());
                }
                return;
            }
            Ok(Some(status)) => Some(status),
            Err(error) => {
                tracing::error!(%error, pid = worker.child.id(), "cannot wait for worker");
                None
            }
        };
        self.buried(nursery, status, now);
    }

    fn buried(&mut self, nursery: &mut impl Nursery, status: Option<ExitStatus>, now: Instant) {
        let empty = State::Empty { spawn_at: now };
        let State::Taken { worker } = std::mem::replace(&mut self.state, empty) else {
            return;
        };
        let death = worker.death(status);
        let status = status.map_or_else(|| "unknown".to_owned(), |status| status.to_string());
        tracing::warn!(
            slot = worker.seat.slot,
            epoch = worker.seat.epoch,
            status,
            ?death,
            "worker died"
        );
        nursery.dead(worker.seat, death);
        if !worker.ready {
            self.failed(now, format!("the worker ended before it was ready: {status}"));
        }
    }

    /// Kills and waits; nobody comes after.
    pub(super) fn stop(&mut self, nursery: &mut impl Nursery) {
        if let State::Taken { worker } = &mut self.state {
            worker.killed = true;
            kill_now(worker.child.id());
            let status = worker.child.wait().ok();
            self.buried(nursery, status, Instant::now());
        }
        self.state = State::Closed;
    }
}

fn start(plan: &Plan, seat: Seat, nursery: &mut impl Nursery) -> io::Result<Child> {
    let token = random_token()?;
    let (ours, theirs) = UnixStream::pair()?;
    let mut command = Command::new(&plan.worker_binary);
    command
        .arg("--page-channel")
        .arg("0")
        .arg("--queue")
        .arg(&plan.queue_socket)
        .stdin(OwnedFd::from(theirs))
        .stdout(Stdio::null());
    let mut child = (plan.spawn)(&mut command)?;
    let pid = child.id();
    exempt_daemon(pid);
    let birth = WorkerBirth { seat, pid, token };
    if let Err(error) = nursery.born(birth, ours) {
        kill_now(pid);
        child.wait()?;
        nursery.dead(seat, Death::Killed);
        return Err(io::Error::other(error));
    }
    Ok(child)
}

fn random_token() -> io::Result<[u8; 16]> {
    let mut token = [0; 16];
    File::open("/dev/urandom")?.read_exact(&mut token)?;
    Ok(token)
}
