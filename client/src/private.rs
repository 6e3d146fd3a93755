//! The private daemon: found where this user's last command left it, or started.
//!
//! Its sockets lie in a folder of mode 0700 under `PBGI_RUNTIME_DIR`, `XDG_RUNTIME_DIR/pbgi` or `/tmp/pbgi-UID`, named after the
//! user's folders and what a daemon is keyed by: the program's build, its memory and its number of workers. State and log lie under
//! `XDG_STATE_HOME/pbgi`, scratch under `XDG_CACHE_HOME/pbgi`. Other folders therefore mean another daemon.

mod seat;

use crate::client::Client;
use crate::error::ClientError;
use seat::Seat;
use std::ffi::OsString;
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Longest path that fits a socket address, with its terminating zero left out.
const SOCKET_PATH_MAX: usize = 107;
/// A daemon that is going away holds its folders until what is leased is finished, for half a minute at most.
const LEAVE_TIMEOUT: Duration = Duration::from_secs(40);
const RETRY_WAIT: Duration = Duration::from_millis(300);
/// What a daemon says whose state folder is held.
const IN_USE: &str = "already in use";

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
        // Every folder counts: two daemons with one state folder and different sockets would be in each other's way.
        let folders = [&self.runtime, &self.state, &self.cache];
        let hash = fnv(folders.map(|folder| folder.as_os_str().as_encoded_bytes()));
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
        let deadline = Instant::now() + LEAVE_TIMEOUT;
        let mut waited = false;
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
                // Its predecessor has closed the sockets but not left the folder yet.
                Err(ClientError::Start(text)) if text.contains(IN_USE) && Instant::now() < deadline => {
                    if !waited {
                        say("waiting for the last daemon to leave");
                    }
                    waited = true;
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

#[cfg(test)]
mod tests {
    use super::seat::make_private;
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
