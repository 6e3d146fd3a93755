//! Build children, and what is done to any process.

use super::{BuildChild, BuildOrder, Plan};
use crate::limits;
use nix::sys::signal::Signal;
use nix::unistd::Pid;
use std::collections::HashMap;
use std::io;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::Instant;
use tokio::sync::oneshot;

/// The build children that run.
#[derive(Default)]
pub(super) struct Builds {
    children: HashMap<u64, Build>,
}

struct Build {
    child: Child,
    exit: Option<oneshot::Sender<ExitStatus>>,
    kill_at: Option<Instant>,
}

impl Builds {
    pub(super) fn start(&mut self, plan: &Plan, order: BuildOrder) {
        let BuildOrder { id, reply, exit } = order;
        let started = start(plan);
        let (child, pipes) = match started {
            Ok(started) => started,
            Err(error) => {
                // The job that asked is gone.
                let _ = reply.send(Err(error));
                return;
            }
        };
        let exit = Some(exit);
        let kill_at = None;
        let build = Build { child, exit, kill_at };
        self.children.insert(id, build);
        if reply.send(Ok(pipes)).is_err() {
            self.stop(id, Instant::now());
        }
    }

    pub(super) fn stop(&mut self, id: u64, now: Instant) {
        if let Some(build) = self.children.get_mut(&id)
            && build.kill_at.is_none()
        {
            build.kill_at = Some(now + limits::TERM_GRACE);
            kill(build.child.id(), Signal::SIGTERM);
        }
    }

    pub(super) fn reap(&mut self, now: Instant) {
        self.children.retain(|_, build| {
            if build.kill_at.is_some_and(|at| at <= now) {
                kill(build.child.id(), Signal::SIGKILL);
            }
            match build.child.try_wait() {
                Ok(None) => return true,
                Ok(Some(status)) => {
                    if let Some(exit) = build.exit.take() {
                        // Nobody asks any more.
                        let _ = exit.send(status);
                    }
                }
                Err(error) => tracing::error!(%error, pid = build.child.id(), "cannot wait for build child"),
            }
            false
        });
    }

    pub(super) fn stop_all(&mut self) {
        for (_, mut build) in self.children.drain() {
            kill(build.child.id(), Signal::SIGKILL);
            if let (Ok(status), Some(exit)) = (build.child.wait(), build.exit.take()) {
                // Nobody asks any more.
                let _ = exit.send(status);
            }
        }
    }
}

fn start(plan: &Plan) -> io::Result<(Child, BuildChild)> {
    let mut command = Command::new(&plan.server_binary);
    command
        .arg("build-child")
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    let mut child = (plan.spawn)(&mut command)?;
    let pid = child.id();
    exempt_daemon(pid);
    let (Some(stdin), Some(stdout), Some(stderr)) = (child.stdin.take(), child.stdout.take(), child.stderr.take())
    else {
        kill(pid, Signal::SIGKILL);
        child.wait()?;
        return Err(io::Error::other("build child has no pipes"));
    };
    // The caller puts the real one in.
    let (_, exit) = oneshot::channel();
    let pipes = BuildChild {
        pid,
        stdin,
        stdout,
        stderr,
        exit,
    };
    Ok((child, pipes))
}

/// Signals a child that is not yet waited for, so its process id is its own.
pub(super) fn kill(pid: u32, signal: Signal) {
    if let Err(error) = nix::sys::signal::kill(Pid::from_raw(pid as i32), signal) {
        tracing::debug!(%error, pid, "cannot signal child");
    }
}

/// Makes the kernel take this child before the daemon when memory runs out.
pub(super) fn exempt_daemon(pid: u32) {
    if let Err(error) = std::fs::write(format!("/proc/{pid}/oom_score_adj"), "500") {
        tracing::debug!(%error, pid, "cannot raise the child's oom score");
    }
}
