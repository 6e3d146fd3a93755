//! The private daemon: found where this user's last command left it, or started.
//!
//! Its sockets lie in a folder of mode 0700 under `PBGI_RUNTIME_DIR`, `XDG_RUNTIME_DIR/pbgi` or `/tmp/pbgi-UID`, named after the
//! user's folders and what a daemon is keyed by: the program's build, its memory and its number of workers. State and log lie under
//! `XDG_STATE_HOME/pbgi`, scratch under `XDG_CACHE_HOME/pbgi`. Other folders therefore mean another daemon.

use crate::client::Client;
use crate::error::ClientError;
use nix::fcntl::{Flock, FlockArg};
use std::ffi::OsString;
use std::fs::{self, DirBuilder, File, OpenOptions};
use std::io::{BufRead, BufReader, Read};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant};

/// Longest path that fits a socket address, with its terminating zero left out.
const SOCKET_PATH_MAX: usize = 107;
/// Until a daemon that starts says READY: it reserves its memory first.
const START_TIMEOUT: Duration = Duration::from_secs(60);
/// Between two looks at a lock that another client holds.
const LOCK_POLL: Duration = Duration::from_millis(50);
/// A daemon that is going away holds its folders for a moment.
const RETRY_WAIT: Duration = Duration::from_millis(300);
const ATTEMPTS: u32 = 5;
/// Bytes of a daemon's last words that an error shows.
const LAST_WORDS_MAX: usize = 2000;

/// Where a user's daemons live.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Folders {
    /// Sockets and start locks.
    pub runtime: PathBuf,
    /// State and logs.
    pub state: PathBuf,
    /// Scratch, and whatever else can be made again.
    pub cache: PathBuf,
}

/// What a private daemon is keyed by, beside the program itself.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PrivateOptions {
    /// Memory cap, bytes; `None` for the daemon's default.
    pub memory_bytes: Option<u64>,
    /// Worker processes; `None` for the daemon's default.
    pub workers: Option<u32>,
}

impl Folders {
    /// Derives the folders from the environment's variables, as `variable` gives them.
    ///
    /// # Errors
    /// `PBGI_RUNTIME_DIR` is relative, or too long for a socket.
    pub fn from_environment(variable: impl Fn(&str) -> Option<OsString>) -> Result<Self, ClientError> {
        // The XDG specification: a relative path is to be ignored.
        let folder = |name: &str| variable(name).map(PathBuf::from).filter(|path| path.is_absolute());
        let temporary = PathBuf::from(format!("/tmp/pbgi-{}", nix::unistd::getuid()));
        let runtime = match variable("PBGI_RUNTIME_DIR").filter(|value| !value.is_empty()) {
            Some(explicit) => {
                let path = PathBuf::from(explicit);
                if !path.is_absolute() || !fits_a_socket(&path) {
                    return Err(ClientError::Start(format!(
                        "PBGI_RUNTIME_DIR is {path:?}, it must be an absolute path of at most {} bytes",
                        SOCKET_PATH_MAX - socket_tail_len()
                    )));
                }
                path
            }
            None => folder("XDG_RUNTIME_DIR")
                .map(|path| path.join("pbgi"))
                .filter(|path| fits_a_socket(path))
                .unwrap_or_else(|| temporary.clone()),
        };
        let home = folder("HOME");
        let under = |name: &str, default: &str| {
            let base = folder(name).or_else(|| home.as_ref().map(|home| home.join(default)));
            base.map(|base| base.join("pbgi"))
        };
        let state = under("XDG_STATE_HOME", ".local/state").unwrap_or_else(|| temporary.join("state"));
        let cache = under("XDG_CACHE_HOME", ".cache").unwrap_or_else(|| temporary.join("cache"));
        Ok(Self { runtime, state, cache })
    }

    /// What names of this user's daemons begin with.
    fn prefix(&self) -> String {
        let hash = fnv([self.state.as_os_str(), self.cache.as_os_str()].map(|part| part.as_encoded_bytes()));
        format!("{:08x}-", hash as u32)
    }

    /// Jobs sockets of this user's daemons, whether anybody listens there or not, in order of their names.
    ///
    /// # Errors
    /// The runtime folder cannot be read.
    pub fn sockets(&self) -> Result<Vec<PathBuf>, ClientError> {
        let failed = |source| ClientError::Io {
            action: "read folder",
            path: self.runtime.clone(),
            source,
        };
        let entries = match fs::read_dir(&self.runtime) {
            Ok(entries) => entries,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
            Err(error) => return Err(failed(error)),
        };
        let prefix = self.prefix();
        let mut sockets = Vec::new();
        for entry in entries {
            let entry = entry.map_err(failed)?;
            if entry.file_name().to_string_lossy().starts_with(&prefix) {
                sockets.push(entry.path().join("jobs.sock"));
            }
        }
        sockets.sort();
        Ok(sockets)
    }

    /// Clients of this user's daemons that run now.
    ///
    /// # Errors
    /// The runtime folder cannot be read.
    pub async fn running(&self) -> Result<Vec<Client>, ClientError> {
        let mut clients = Vec::new();
        for socket in self.sockets()? {
            if let Ok(client) = Client::connect_path(&socket).await {
                clients.push(client);
            }
        }
        Ok(clients)
    }

    /// The daemon for `options`, started from `program` if it does not run yet; `say` is told so.
    ///
    /// # Errors
    /// Folders that cannot be made or are not ours, no program, a daemon that refuses to start.
    pub async fn find_or_start(
        &self,
        program: &Path,
        options: &PrivateOptions,
        say: &mut (dyn FnMut(&str) + Send),
    ) -> Result<Client, ClientError> {
        let name = self.prefix() + &key(program, options)?;
        let seat = Seat::new(self, &name, program, options)?;
        if let Ok(client) = Client::connect_path(&seat.socket()).await {
            return Ok(client);
        }
        let _lock = seat.lock().await?;
        let mut attempt = 1;
        loop {
            // Another client may have started it while we waited.
            if let Ok(client) = Client::connect_path(&seat.socket()).await {
                return Ok(client);
            }
            match seat.start().await {
                Ok(pid) => {
                    let client = Client::connect_path(&seat.socket()).await?;
                    say(&format!(
                        "started a private daemon (pid {pid}); it exits when it has been idle"
                    ));
                    return Ok(client);
                }
                Err(ClientError::Start(_)) if attempt < ATTEMPTS && seat.is_leaving() => {
                    attempt += 1;
                    tokio::time::sleep(RETRY_WAIT).await;
                }
                Err(error) => return Err(error),
            }
        }
    }
}

/// The program beside the running one that is called `pbgi-server`.
///
/// # Errors
/// There is none.
pub fn server_program(own: &Path) -> Result<PathBuf, ClientError> {
    let program = own.with_file_name("pbgi-server");
    match fs::metadata(&program) {
        Ok(metadata) if metadata.is_file() => Ok(program),
        _ => Err(ClientError::Start(format!(
            "there is no {program:?}; install pbgi-server beside pbgi-client, or name a running daemon with --server"
        ))),
    }
}

/// One daemon's folders and how it is started.
struct Seat<'a> {
    runtime: PathBuf,
    state: PathBuf,
    scratch: PathBuf,
    program: &'a Path,
    options: &'a PrivateOptions,
}

impl<'a> Seat<'a> {
    fn new(folders: &Folders, name: &str, program: &'a Path, options: &'a PrivateOptions) -> Result<Self, ClientError> {
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

    fn socket(&self) -> PathBuf {
        self.runtime.join("jobs.sock")
    }

    fn log(&self) -> PathBuf {
        self.state.join("start.log")
    }

    /// Keeps other clients from starting the same daemon.
    async fn lock(&self) -> Result<Flock<File>, ClientError> {
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

    /// Whether a daemon whose socket is closed still holds the state folder.
    fn is_leaving(&self) -> bool {
        let words = last_words(&self.log());
        words.contains("another daemon") || words.contains("already")
    }

    /// Starts the daemon and waits until it is ready; returns its process id.
    async fn start(&self) -> Result<u32, ClientError> {
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

/// What tells this program's daemons from those of another build or with other limits.
fn key(program: &Path, options: &PrivateOptions) -> Result<String, ClientError> {
    let failed = |source| ClientError::Io {
        action: "find",
        path: program.to_owned(),
        source,
    };
    // A rebuilt program has the old version number but not the old time stamp.
    let program = program.canonicalize().map_err(failed)?;
    let metadata = fs::metadata(&program).map_err(failed)?;
    let build = format!(
        "{} {} {} {}",
        env!("CARGO_PKG_VERSION"),
        metadata.size(),
        metadata.mtime(),
        metadata.mtime_nsec()
    );
    let limits = format!("{:?} {:?}", options.memory_bytes, options.workers);
    let hash = fnv([
        program.as_os_str().as_encoded_bytes(),
        build.as_bytes(),
        limits.as_bytes(),
    ]);
    Ok(format!("{hash:016x}"))
}

/// FNV-1a over parts, each ended by a byte that occurs in none of them.
fn fnv<const N: usize>(parts: [&[u8]; N]) -> u64 {
    let step = |hash: u64, byte: u8| (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3);
    let offset = 0xcbf2_9ce4_8422_2325;
    parts.iter().fold(offset, |hash, part| {
        step(part.iter().fold(hash, |h, &byte| step(h, byte)), 0xff)
    })
}

/// Bytes that follow the runtime folder in the longest socket path.
fn socket_tail_len() -> usize {
    "/01234567-0123456789abcdef/queue.sock".len()
}

fn fits_a_socket(runtime: &Path) -> bool {
    runtime.as_os_str().len() + socket_tail_len() <= SOCKET_PATH_MAX
}

/// Makes a folder that only we can use, and makes sure that it is one.
fn make_private(folder: &Path) -> Result<(), ClientError> {
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

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    fn folders(variables: &[(&str, &str)]) -> Result<Folders, ClientError> {
        Folders::from_environment(|name| {
            let found = variables.iter().find(|(key, _)| *key == name);
            found.map(|(_, value)| OsString::from(value))
        })
    }

    #[test]
    fn folders_follow_the_xdg_variables() {
        let found = folders(&[
            ("HOME", "/home/a"),
            ("XDG_RUNTIME_DIR", "/run/user/7"),
            ("XDG_CACHE_HOME", "/c"),
        ])
        .unwrap();
        assert_eq!(found.runtime, PathBuf::from("/run/user/7/pbgi"));
        assert_eq!(found.state, PathBuf::from("/home/a/.local/state/pbgi"));
        assert_eq!(found.cache, PathBuf::from("/c/pbgi"));
    }

    #[test]
    fn without_xdg_variables_the_temporary_folder_serves() {
        let found = folders(&[]).unwrap();
        let uid = nix::unistd::getuid();
        assert_eq!(found.runtime, PathBuf::from(format!("/tmp/pbgi-{uid}")));
        assert!(found.state.starts_with(&found.runtime));
    }

    #[test]
    fn another_home_is_another_daemon() {
        let a = folders(&[("HOME", "/home/a")]).unwrap();
        let b = folders(&[("HOME", "/home/b")]).unwrap();
        assert_ne!(a.prefix(), b.prefix());
    }

    #[test]
    fn a_path_too_long_for_a_socket_is_avoided_or_refused() {
        let long = format!("/{}", "x".repeat(120));
        let found = folders(&[("XDG_RUNTIME_DIR", &long)]).unwrap();
        assert!(found.runtime.starts_with("/tmp"));
        let error = folders(&[("PBGI_RUNTIME_DIR", &long)]).unwrap_err().to_string();
        assert!(error.contains("PBGI_RUNTIME_DIR"), "{error}");
        assert!(folders(&[("PBGI_RUNTIME_DIR", "relative")]).is_err());
    }

    #[test]
    fn daemons_are_keyed_by_program_memory_and_workers() {
        let folder = tempfile::tempdir().unwrap();
        let program = folder.path().join("pbgi-server");
        fs::write(&program, "1").unwrap();
        let with = |memory_bytes, workers| {
            let options = PrivateOptions { memory_bytes, workers };
            key(&program, &options).unwrap()
        };
        let plain = with(None, None);
        assert_eq!(plain, with(None, None));
        assert_ne!(plain, with(Some(1 << 30), None));
        assert_ne!(plain, with(None, Some(2)));
        assert_eq!(plain.len() + 1 + 8, "01234567-0123456789abcdef".len());
        fs::write(&program, "22").unwrap();
        assert_ne!(plain, with(None, None));
    }

    #[test]
    fn a_folder_that_others_can_write_is_refused() {
        let parent = tempfile::tempdir().unwrap();
        let folder = parent.path().join("run");
        make_private(&folder).unwrap();
        assert_eq!(fs::metadata(&folder).unwrap().permissions().mode() & 0o777, 0o700);
        fs::set_permissions(&folder, fs::Permissions::from_mode(0o777)).unwrap();
        assert!(
            make_private(&folder)
                .unwrap_err()
                .to_string()
                .contains("PBGI_RUNTIME_DIR")
        );
    }

    fn script(folder: &Path, body: &str) -> PathBuf {
        let program = folder.join("pbgi-server");
        fs::write(&program, format!("#!/bin/sh\n{body}\n")).unwrap();
        fs::set_permissions(&program, fs::Permissions::from_mode(0o755)).unwrap();
        program
    }

    async fn failure(body: &str) -> String {
        let home = tempfile::tempdir().unwrap();
        let path = home.path().to_str().unwrap();
        let folders = folders(&[("HOME", path), ("PBGI_RUNTIME_DIR", path)]).unwrap();
        let program = script(home.path(), body);
        let found = folders
            .find_or_start(&program, &PrivateOptions::default(), &mut |_| {})
            .await;
        found.unwrap_err().to_string()
    }

    #[tokio::test]
    async fn a_daemon_that_refuses_to_start_says_why() {
        let text = failure("echo ERROR no memory left").await;
        assert_eq!(text, "cannot start a private daemon: no memory left");
    }

    #[tokio::test]
    async fn a_daemon_that_dies_leaves_its_last_words() {
        let text = failure("echo segment cannot be made >&2; exit 3").await;
        assert!(text.contains("segment cannot be made"), "{text}");
    }

    #[test]
    fn a_missing_program_is_named() {
        let text = server_program(Path::new("/nonexistent/pbgi-client"))
            .unwrap_err()
            .to_string();
        assert!(text.contains("/nonexistent/pbgi-server"), "{text}");
    }
}
