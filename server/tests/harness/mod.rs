//! A real daemon in a folder of its own, ended and checked for leftovers when dropped.
#![allow(dead_code, reason = "each test program uses a part")]

pub(crate) mod site;

use hyper_util::rt::TokioIo;
use pbgi_proto::v1;
use pbgi_proto::v1::daemon_service_client::DaemonServiceClient;
use pbgi_proto::v1::job_service_client::JobServiceClient;
use std::io::{BufRead, BufReader, ErrorKind, Read};
use std::net::TcpListener;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicU16, Ordering};
use std::time::{Duration, Instant};
use tempfile::TempDir;
use tokio::net::UnixStream;
use tonic::transport::{Channel, Endpoint};

pub(crate) const SERVER: &str = env!("CARGO_BIN_EXE_pbgi-server");

/// How long anything is waited for that must come: far longer than it takes, for a machine that does much else.
pub(crate) const PATIENCE: Duration = Duration::from_secs(60);

/// Waits until something holds.
#[track_caller]
pub(crate) fn wait_until(what: &str, mut holds: impl FnMut() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !holds() {
        assert!(Instant::now() < deadline, "not within {PATIENCE:?}: {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// A port for a daemon to listen on: free now, and none that the system gives to whoever asks for any.
pub(crate) fn free_port() -> u16 {
    static NEXT: AtomicU16 = AtomicU16::new(0);
    let first = 16_000 + (std::process::id() % 1_000) as u16 * 16;
    loop {
        let port = first + NEXT.fetch_add(1, Ordering::Relaxed);
        if TcpListener::bind(("127.0.0.1", port)).is_ok() {
            return port;
        }
    }
}

/// Connects however many wait in the socket's queue.
async fn connect(path: &Path) -> std::io::Result<UnixStream> {
    let deadline = Instant::now() + PATIENCE;
    loop {
        match UnixStream::connect(path).await {
            Err(error) if error.kind() == ErrorKind::WouldBlock && Instant::now() < deadline => {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
            outcome => return outcome,
        }
    }
}

pub(crate) struct Daemon {
    pub(crate) child: Child,
    pub(crate) folder: TempDir,
    worker: PathBuf,
}

/// A worker that sleeps.
pub(crate) fn sleeper(folder: &Path) -> PathBuf {
    script(folder, "sleeper", "exec sleep 1000")
}

pub(crate) fn script(folder: &Path, name: &str, body: &str) -> PathBuf {
    let path = folder.join(name);
    std::fs::write(&path, format!("#!/bin/sh\n{body}\n")).unwrap();
    std::fs::set_permissions(&path, PermissionsExt::from_mode(0o755)).unwrap();
    path
}

pub(crate) fn command(folder: &Path, worker: &Path) -> Command {
    let mut command = Command::new(SERVER);
    command
        .args(["--memory", "256M", "--workers", "2", "--log", "pbgi_server=debug"])
        .arg("--runtime-dir")
        .arg(folder.join("run"))
        .arg("--state-dir")
        .arg(folder.join("state"))
        .arg("--scratch-dir")
        .arg(folder.join("scratch"))
        .arg("--worker-binary")
        .arg(worker)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    command
}

/// The first line on standard output.
pub(crate) fn first_line(child: &mut Child) -> String {
    let mut line = String::new();
    BufReader::new(child.stdout.take().unwrap())
        .read_line(&mut line)
        .unwrap();
    line.trim().to_owned()
}

impl Daemon {
    pub(crate) fn start(worker: impl FnOnce(&Path) -> PathBuf, change: impl FnOnce(&mut Command)) -> Self {
        let folder = tempfile::Builder::new().prefix("pbgi").tempdir().unwrap();
        let worker = worker(folder.path());
        let mut command = command(folder.path(), &worker);
        let log = std::fs::File::create(folder.path().join("log")).unwrap();
        command.stderr(log);
        change(&mut command);
        let mut child = command.spawn().unwrap();
        let line = first_line(&mut child);
        let daemon = Self { child, folder, worker };
        assert_eq!(line, "READY", "{}", daemon.log());
        daemon
    }

    /// Kills the daemon without warning and starts another one in the same folders; returns how long that took to be ready.
    pub(crate) fn kill_and_restart(&mut self) -> Duration {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
        self.restart()
    }

    /// Starts another daemon where one has ended.
    pub(crate) fn restart(&mut self) -> Duration {
        let begun = Instant::now();
        let log = std::fs::File::options()
            .append(true)
            .open(self.folder.path().join("log"))
            .unwrap();
        self.child = command(self.folder.path(), &self.worker).stderr(log).spawn().unwrap();
        assert_eq!(first_line(&mut self.child), "READY", "{}", self.log());
        begun.elapsed()
    }

    pub(crate) fn log(&self) -> String {
        std::fs::read_to_string(self.folder.path().join("log")).unwrap_or_default()
    }

    /// The segment that the daemon noted, `None` if it has none.
    pub(crate) fn noted_segment(&self) -> Option<PathBuf> {
        let name = std::fs::read_to_string(self.folder.path().join("state/segment")).ok()?;
        Some(Path::new("/dev/shm").join(name.trim().trim_start_matches('/')))
    }

    pub(crate) fn segment(&self) -> PathBuf {
        self.noted_segment().unwrap()
    }

    pub(crate) fn signal(&self, signal: &str) {
        let pid = self.child.id().to_string();
        assert!(Command::new("kill").args([signal, &pid]).status().unwrap().success());
    }

    pub(crate) fn wait(&mut self) -> ExitStatus {
        let deadline = Instant::now() + PATIENCE;
        loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                return status;
            }
            assert!(Instant::now() < deadline, "daemon does not end: {}", self.log());
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    /// Ends the daemon and checks that nothing is left.
    pub(crate) fn stop(mut self) {
        let segment = self.segment();
        assert!(segment.metadata().is_ok(), "{segment:?}");
        let children = children(self.child.id());
        self.signal("-TERM");
        let status = self.wait();
        assert!(status.success(), "{status}: {}", self.log());
        assert!(segment.metadata().is_err(), "segment left");
        for name in ["run/jobs.sock", "run/queue.sock", "run/http.sock", "state/segment"] {
            assert!(self.folder.path().join(name).symlink_metadata().is_err(), "{name} left");
        }
        // Whole scenes of further bounces are kept, and nothing else.
        let scratch = self.folder.path().join("scratch");
        let names = |folder: &Path| {
            let entries = std::fs::read_dir(folder).into_iter().flatten();
            entries.map(|entry| entry.unwrap().path()).collect::<Vec<_>>()
        };
        let bounces = scratch.join("bounces");
        assert!(names(&scratch).iter().all(|left| *left == bounces), "scratch left");
        let whole = |path: &std::path::PathBuf| path.extension().is_some_and(|extension| extension == "pbgi");
        assert!(names(&bounces).iter().all(whole), "half-made bounces left");
        for pid in children {
            assert!(!Path::new("/proc").join(pid.to_string()).is_dir(), "child {pid} left");
        }
    }

    pub(crate) async fn channel(&self, socket: &str) -> Channel {
        let path = self.folder.path().join("run").join(socket);
        let connector = tower::service_fn(move |_| {
            let path = path.clone();
            async move { connect(&path).await.map(TokioIo::new) }
        });
        Endpoint::from_static("http://localhost")
            .connect_with_connector(connector)
            .await
            .unwrap()
    }

    pub(crate) async fn jobs(&self) -> JobServiceClient<Channel> {
        JobServiceClient::new(self.channel("jobs.sock").await)
    }

    pub(crate) async fn status(&self) -> v1::DaemonStatus {
        let mut client = DaemonServiceClient::new(self.channel("jobs.sock").await);
        client.get_status(v1::GetStatusRequest {}).await.unwrap().into_inner()
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        // Its children end with it; its segment is removed here if a test failed.
        if self.child.try_wait().is_ok_and(|status| status.is_none()) {
            let _ = self.child.kill();
            let _ = self.child.wait();
            let _ = self.noted_segment().map(std::fs::remove_file);
        }
    }
}

/// Process ids of the children that run another program by now.
pub(crate) fn children(pid: u32) -> Vec<u32> {
    let line = |pid: u32| std::fs::read(format!("/proc/{pid}/cmdline")).ok();
    let parent = |pid: u32| {
        let mut stat = String::new();
        std::fs::File::open(format!("/proc/{pid}/stat"))
            .ok()?
            .read_to_string(&mut stat)
            .ok()?;
        stat.rsplit(')').next()?.split_whitespace().nth(1)?.parse::<u32>().ok()
    };
    let entries = std::fs::read_dir("/proc").unwrap().flatten();
    let pids = entries.filter_map(|entry| entry.file_name().to_str()?.parse().ok());
    // Between fork and exec a child is its parent in all but name.
    let own = line(pid);
    pids.filter(|&child| parent(child) == Some(pid) && line(child) != own)
        .collect()
}
