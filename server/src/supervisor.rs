//! The one thread that makes, signals and reaps processes.
//!
//! It never ends while the daemon lives: a child's parent-death signal follows the thread that forked it. Workers get one end of
//! a socket pair as their standard input; the other end is served by a [`crate::loader`] thread, which also tells at once when
//! a worker is gone. A seat is reaped in the cache only after `wait` returned for its process.
//!
//! Entry points: [`Supervisor::start`], [`Handle`].

mod children;
mod slot;

use crate::error::ServerError;
use crate::limits;
use crate::scheduler::{Death, Seat};
use children::{Builds, kill};
use nix::sys::signal::Signal;
use slot::Slot;
use std::io;
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::process::{self, ChildStderr, ChildStdin, ChildStdout, ExitStatus};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use tokio::sync::oneshot;

/// What a worker is told of itself.
#[derive(Clone, Copy, Debug)]
pub struct WorkerBirth {
    /// Its seat.
    pub seat: Seat,
    /// Its process id.
    pub pid: u32,
    /// What it proves itself with on the queue.
    pub token: [u8; 16],
}

/// Who is told about workers. Called from the supervisor's thread.
pub trait Nursery: Send {
    /// The seat that the next worker of a slot takes.
    fn seat(&mut self, slot: u8) -> Seat;
    /// A worker was started; `channel` is the daemon's end of its page channel.
    ///
    /// # Errors
    /// It cannot be served, and is killed.
    fn born(&mut self, birth: WorkerBirth, channel: UnixStream) -> Result<(), ServerError>;
    /// A worker is dead and waited for. Afterwards [`Self::seat`] gives another one.
    fn dead(&mut self, seat: Seat, death: Death);
    /// How many slots are parked now, and why the last one is.
    fn parked(&mut self, slots: usize, reason: &str);
}

/// What the supervisor can be asked to do.
#[derive(Debug)]
enum Command {
    /// The worker asked for its first tile.
    Ready(Seat),
    /// Kill a worker.
    Kill(Seat),
    /// The worker's page channel closed.
    Hangup(Seat),
    /// Start a build child.
    Build(BuildOrder),
    /// End a build child.
    StopBuild(u64),
    /// A child seems to have ended: look now.
    Look,
    /// Try parked slots again.
    Unpark,
    /// Kill and reap everything; no more is started.
    Stop(SyncSender<()>),
}

#[derive(Debug)]
struct BuildOrder {
    id: u64,
    reply: oneshot::Sender<io::Result<BuildChild>>,
    exit: oneshot::Sender<ExitStatus>,
}

/// The pipes of a started build child.
#[derive(Debug)]
pub struct BuildChild {
    /// Process id.
    pub pid: u32,
    /// For the spec.
    pub stdin: ChildStdin,
    /// Progress.
    pub stdout: ChildStdout,
    /// Last words.
    pub stderr: ChildStderr,
    /// How it ended, once waited for.
    pub exit: oneshot::Receiver<ExitStatus>,
}

/// What the supervisor needs to know.
#[derive(Clone, Debug)]
pub struct Plan {
    /// Worker processes.
    pub workers: u8,
    /// The worker program.
    pub worker_binary: PathBuf,
    /// The socket that workers call.
    pub queue_socket: PathBuf,
    /// This program, for build children.
    pub server_binary: PathBuf,
    /// How a process is made: [`std::process::Command::spawn`], unless a test refuses it.
    pub spawn: fn(&mut process::Command) -> io::Result<process::Child>,
}

/// How others talk to the supervisor.
#[derive(Clone, Debug)]
pub struct Handle {
    commands: SyncSender<Command>,
}

impl Handle {
    fn send(&self, command: Command) {
        // The bound is far above what workers and jobs can cause; a supervisor that is gone ends the process.
        if let Err(TrySendError::Full(command)) = self.commands.try_send(command) {
            tracing::error!(?command, "supervisor is overrun");
        }
    }

    /// A worker showed that it works.
    pub fn ready(&self, seat: Seat) {
        self.send(Command::Ready(seat));
    }

    /// Kills a worker.
    pub fn kill(&self, seat: Seat) {
        self.send(Command::Kill(seat));
    }

    /// A worker's page channel closed.
    pub fn hangup(&self, seat: Seat) {
        self.send(Command::Hangup(seat));
    }

    /// Tries slots again that were parked long enough.
    pub fn unpark(&self) {
        self.send(Command::Unpark);
    }

    /// Starts a build child known by `id`.
    ///
    /// # Errors
    /// The process cannot be made.
    pub async fn build(&self, id: u64) -> io::Result<BuildChild> {
        let (reply, answer) = oneshot::channel();
        let (exit, exit_receiver) = oneshot::channel();
        self.send(Command::Build(BuildOrder { id, reply, exit }));
        let mut child = answer.await.map_err(std::io::Error::other)??;
        child.exit = exit_receiver;
        Ok(child)
    }

    /// Ends a build child: SIGTERM, and SIGKILL if that does not help.
    pub fn stop_build(&self, id: u64) {
        self.send(Command::StopBuild(id));
    }

    /// A build child's output closed: it is about to end.
    pub fn look(&self) {
        self.send(Command::Look);
    }

    /// Kills and reaps every child; returns when that is done.
    pub fn stop(&self) {
        let (done, wait) = sync_channel(1);
        self.send(Command::Stop(done));
        // An error means that the supervisor is gone, and its children with it.
        let _ = wait.recv();
    }
}

/// The thread's state.
pub struct Supervisor<N> {
    plan: Plan,
    nursery: N,
    slots: Vec<Slot>,
    builds: Builds,
    parked: usize,
}

impl<N: Nursery + 'static> Supervisor<N> {
    /// Starts the thread. `nursery` is made with the handle, so that it can hand it on.
    ///
    /// # Errors
    /// No thread to be had.
    pub fn start(plan: Plan, nursery: impl FnOnce(Handle) -> N) -> Result<(Handle, JoinHandle<()>), ServerError> {
        let (commands, receiver) = sync_channel(limits::SUPERVISOR_QUEUE_MAX);
        let handle = Handle { commands };
        let slots = (0..plan.workers).map(Slot::new).collect();
        let supervisor = Self {
            nursery: nursery(handle.clone()),
            plan,
            slots,
            builds: Builds::default(),
            parked: 0,
        };
        let thread = std::thread::Builder::new()
            .name("supervisor".into())
            .spawn(move || supervisor.run(&receiver))
            .map_err(ServerError::setup("start the supervisor thread"))?;
        Ok((handle, thread))
    }

    fn run(mut self, commands: &Receiver<Command>) {
        loop {
            let now = Instant::now();
            self.reap(now);
            self.spawn_due(now);
            match commands.recv_timeout(self.pause(now)) {
                Ok(Command::Stop(done)) => {
                    self.stop();
                    // Nobody waits any more: they gave up.
                    let _ = done.send(());
                    return;
                }
                Ok(command) => self.obey(command),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return self.stop(),
            }
        }
    }

    fn pause(&self, now: Instant) -> Duration {
        let spawn = self.slots.iter().filter_map(Slot::spawn_at).min();
        spawn.map_or(limits::REAP_POLL, |at| {
            at.saturating_duration_since(now).min(limits::REAP_POLL)
        })
    }

    fn obey(&mut self, command: Command) {
        match command {
            Command::Ready(seat) => {
                if let Some(slot) = self.slots.get_mut(usize::from(seat.slot)) {
                    slot.ready(seat);
                }
            }
            Command::Kill(seat) => {
                if let Some(slot) = self.slots.get_mut(usize::from(seat.slot)) {
                    slot.kill(seat);
                }
            }
            Command::Hangup(seat) => {
                if let Some(slot) = self.slots.get_mut(usize::from(seat.slot)) {
                    slot.hung_up(seat, Instant::now());
                }
            }
            Command::Build(order) => self.builds.start(&self.plan, order),
            Command::StopBuild(id) => self.builds.stop(id, Instant::now()),
            Command::Unpark => {
                let now = Instant::now();
                self.slots.iter_mut().for_each(|slot| slot.unpark(now));
            }
            Command::Look | Command::Stop(_) => {}
        }
    }

    fn spawn_due(&mut self, now: Instant) {
        for slot in &mut self.slots {
            if slot.spawn_at().is_some_and(|at| at <= now) {
                slot.spawn(&self.plan, &mut self.nursery, now);
            }
        }
        let reasons: Vec<&str> = self.slots.iter().filter_map(Slot::parked).collect();
        if reasons.len() != self.parked {
            self.parked = reasons.len();
            self.nursery.parked(reasons.len(), reasons.last().unwrap_or(&""));
        }
    }

    fn reap(&mut self, now: Instant) {
        for slot in &mut self.slots {
            slot.reap(&mut self.nursery, now);
        }
        self.builds.reap(now);
    }

    fn stop(&mut self) {
        self.builds.stop_all();
        for slot in &mut self.slots {
            slot.stop(&mut self.nursery);
        }
    }
}

/// A panic in the threads that everything rests on ends the process: a supervisor starts it anew, the next start cleans up.
pub fn abort_on_core_panic() {
    let report = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        report(info);
        let thread = std::thread::current();
        let name = thread.name().unwrap_or_default();
        if name == "supervisor" || name.starts_with("loader-") {
            std::process::abort();
        }
    }));
}

/// Sends SIGKILL to a child that is not yet waited for.
fn kill_now(pid: u32) {
    kill(pid, Signal::SIGKILL);
}

#[cfg(test)]
mod tests;
