//! One private daemon's place: its folders, the lock that keeps it single, and how it is started.

use super::{Folders, PrivateOptions};
use crate::error::ClientError;
use nix::fcntl::{Flock, FlockArg};
use std::fs::{self, DirBuilder, File, OpenOptions};
use std::io::{BufRead, BufReader, Read};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant};

/// Until a daemon that starts says READY: it reserves its memory first.
const START_TIMEOUT: Duration = Duration::from_secs(60);
/// Between two looks at a lock that another client holds.
const LOCK_POLL: Duration = Duration::from_millis(50);
/// Bytes of a daemon's last words that an error shows.
const LAST_WORDS_MAX: usize = 2000;

/// One daemon's folders and how it is started.
pub(super) struct Seat<'a> {
    runtime: PathBuf,
    state: PathBuf,
    scratch: PathBuf,
    program: &'a Path,
    options: &'a PrivateOptions,
}

impl<'a> Seat<'a> {
    pub(super) fn new(
        folders: &Folders,
        name: &str,
        program: &'a Path,
        options: &'a PrivateOptions,
    ) -> Result<Self, ClientError> {
        let seat = Self {
            runtime: folders.runtime.join(name),
            state: folders.state.join(name),
            scratch: folders.cache.join("scratch").join(name),
            program,
            options,
        };
        make_private(&folders.runtime)?;
        for folder in [&seat.runtime, &seat.state, &seat.scratch] {
            make_private(folder)?;
        }
        Ok(seat)
    }

    pub(super) fn socket(&self) -> PathBuf {
        self.runtime.join("jobs.sock")
    }

    fn log(&self) -> PathBuf {
        self.state.join("start.log")
    }

    /// Keeps other clients from starting the same daemon.
    pub(super) async fn lock(&self) -> Result<Flock<File>, ClientError> {
        let path = self.runtime.join("start.lock");
        let failed = |source: std::io::Error| ClientError::Io {
            action: "lock",
            path: path.clone(),
            source,
        };
        let open = OpenOptions::new().create(true).append(true).mode(0o600).open(&path);
        let mut file = open.map_err(failed)?;
        let deadline = Instant::now() + 2 * START_TIMEOUT;
        loop {
            match Flock::lock(file, FlockArg::LockExclusiveNonblock) {
                Ok(lock) => return Ok(lock),
                Err((back, nix::errno::Errno::EWOULDBLOCK)) if Instant::now() < deadline => file = back,
                Err((_, errno)) => return Err(failed(errno.into())),
            }
            tokio::time::sleep(LOCK_POLL).await;
        }
    }

    /// Starts the daemon and waits until it is ready; returns its process id.
    pub(super) async fn start(&self) -> Result<u32, ClientError> {
        let mut child = self.spawn()?;
        let stdout = child.stdout.take();
        let (sender, answer) = tokio::sync::oneshot::channel();
        std::thread::spawn(move || {
            // Nobody waits any more if the client gave up.
            let _ = sender.send(first_line(stdout));
        });
        let line = match tokio::time::timeout(START_TIMEOUT, answer).await {
            Ok(line) => line.unwrap_or_default(),
            Err(_) => {
                let _ = child.kill();
                let _ = child.wait();
                return Err(ClientError::Start(format!(
                    "{:?} was not ready within {} s; see {:?}",
                    self.program,
                    START_TIMEOUT.as_secs(),
                    self.log()
                )));
            }
        };
        if line == "READY" {
            return Ok(child.id());
        }
        let _ = child.wait();
        Err(ClientError::Start(match line.strip_prefix("ERROR ") {
            Some(text) => text.to_owned(),
            None => {
                let words = last_words(&self.log());
                let words = if words.is_empty() { "it said nothing" } else { &words };
                format!("{:?} stopped while starting: {words}", self.program)
            }
        }))
    }

    fn spawn(&self) -> Result<Child, ClientError> {
        let log = OpenOptions::new()
            .create(true)
            .write(true)
            .truncate(true)
            .mode(0o600)
            .open(self.log());
        let log = log.map_err(|source| ClientError::Io {
            action: "write",
            path: self.log(),
            source,
        })?;
        let mut command = Command::new(self.program);
        command.arg("--private");
        command.arg("--runtime-dir").arg(&self.runtime);
        command.arg("--state-dir").arg(&self.state);
        command.arg("--scratch-dir").arg(&self.scratch);
        if let Some(bytes) = self.options.memory_bytes {
            command.arg("--memory").arg(bytes.to_string());
        }
        if let Some(workers) = self.options.workers {
            command.arg("--workers").arg(workers.to_string());
        }
        // It outlives this command: it must hold neither the terminal nor a pipe of ours, nor the folder we stand in.
        command
            .current_dir("/")
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(log);
        command.spawn().map_err(|source| ClientError::Io {
            action: "run",
            path: self.program.to_owned(),
            source,
        })
    }
}

fn first_line(stdout: Option<ChildStdout>) -> String {
    /// Enough for any error text.
    const LINE_MAX: u64 = 16 << 10;
    let mut line = String::new();
    if let Some(stdout) = stdout {
        // A daemon that dies closes the pipe: the line stays empty, and its log tells why.
        let _ = BufReader::new(stdout.take(LINE_MAX)).read_line(&mut line);
    }
    line.trim_end().to_owned()
}

fn last_words(log: &Path) -> String {
    let bytes = fs::read(log).unwrap_or_default();
    let tail = &bytes[bytes.len().saturating_sub(LAST_WORDS_MAX)..];
    String::from_utf8_lossy(tail).trim().to_owned()
}

/// Makes a folder that only we can use, and makes sure that it is one.
pub(super) fn make_private(folder: &Path) -> Result<(), ClientError> {
    let failed = |source| ClientError::Io {
        action: "make folder",
        path: folder.to_owned(),
        source,
    };
    DirBuilder::new()
        .recursive(true)
        .mode(0o700)
        .create(folder)
        .map_err(failed)?;
    let metadata = fs::symlink_metadata(folder).map_err(failed)?;
    let ours = metadata.is_dir() && metadata.uid() == nix::unistd::getuid().as_raw();
    if ours && metadata.mode() & 0o022 == 0 {
        return Ok(());
    }
    Err(ClientError::Start(format!(
        "folder {folder:?} can be changed by others; remove it, or set PBGI_RUNTIME_DIR to a folder of your own"
    )))
}
