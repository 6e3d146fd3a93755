//! What the program does to its own process.

use nix::fcntl::{FcntlArg, FdFlag, fcntl};
use nix::sys::stat::{Mode, umask};
use nix::unistd::{close, dup2_stderr, dup2_stdin, dup2_stdout, setsid};
use pbgi_server::{Life, ServerError};
use sd_notify::NotifyState;
use std::fs::{self, File, OpenOptions};
use std::os::unix::fs::OpenOptionsExt;
use std::os::unix::net::UnixListener;
use std::path::Path;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// A log longer than this is put aside when the daemon starts.
const LOG_BYTES_MAX: u64 = 16 << 20;
/// Signs of life within the time after which the service manager takes us for dead.
const WATCHDOG_CALLS: u32 = 4;

/// New session, nothing inherited but the three standard streams. To be called before anything is opened.
pub(crate) fn leave_the_session() {
    // Fails only for the leader of a group, which is on its own already.
    let _ = setsid();
    let Ok(entries) = fs::read_dir("/proc/self/fd") else {
        return;
    };
    let number = |entry: std::io::Result<fs::DirEntry>| entry.ok()?.file_name().to_str()?.parse::<i32>().ok();
    let inherited: Vec<i32> = entries
        .filter_map(number)
        .filter(|&descriptor| descriptor > 2)
        .collect();
    for descriptor in inherited {
        // The listing's own descriptor is closed by now.
        let _ = close(descriptor);
    }
}

/// Whatever we make is ours alone.
pub(crate) fn make_files_private() {
    umask(Mode::from_bits_truncate(0o077));
}

/// From now on outputs are made, which the user's group may read; what must stay ours says so itself.
pub(crate) fn make_outputs_readable() {
    umask(Mode::from_bits_truncate(0o027));
}

/// Asks the kernel to take others first when memory runs out; only the privileged may.
pub(crate) fn prefer_to_live() {
    // Refused for most, and then nothing is lost.
    let _ = fs::write("/proc/self/oom_score_adj", "-500");
}

/// Sends standard error to a file and takes standard input away.
pub(crate) fn log_to(path: &Path) -> Result<(), ServerError> {
    let io = |source| ServerError::Io {
        action: "open log",
        path: path.to_owned(),
        source,
    };
    if fs::metadata(path).is_ok_and(|metadata| metadata.len() > LOG_BYTES_MAX) {
        fs::rename(path, path.with_extension("log.1")).map_err(io)?;
    }
    let log = OpenOptions::new()
        .create(true)
        .append(true)
        .mode(0o600)
        .open(path)
        .map_err(io)?;
    dup2_stderr(&log).map_err(|errno| io(errno.into()))?;
    let null = File::open("/dev/null").map_err(io)?;
    dup2_stdin(&null).map_err(|errno| io(errno.into()))
}

/// The clients' socket, if a service manager has bound it for us.
pub(crate) fn activated_socket() -> Result<Option<UnixListener>, ServerError> {
    let setup = |reason: String| ServerError::Setup {
        action: "take the service manager's socket",
        reason,
    };
    let mut given = listenfd::ListenFd::from_env();
    let listener = given.take_unix_listener(0).map_err(|error| setup(error.to_string()))?;
    if given.len() > 1 {
        let text = format!("{} sockets given, one is taken: that of clients", given.len());
        return Err(setup(text));
    }
    if let Some(listener) = &listener {
        // Workers must not inherit it.
        fcntl(listener, FcntlArg::F_SETFD(FdFlag::FD_CLOEXEC)).map_err(|errno| setup(errno.to_string()))?;
    }
    Ok(listener)
}

/// What systemd wants to hear; nobody, if it did not start us.
pub(crate) fn tell_service_manager(life: Life) {
    let told = match life {
        Life::Ready => sd_notify::notify(&[NotifyState::Ready, NotifyState::Status("serving")]),
        Life::Alive => match sd_notify::watchdog_enabled() {
            Some(patience) if is_due(patience / WATCHDOG_CALLS) => sd_notify::notify(&[NotifyState::Watchdog]),
            _ => return,
        },
        Life::Stopping => sd_notify::notify(&[NotifyState::Stopping, NotifyState::Status("finishing leased tiles")]),
    };
    if let Err(error) = told {
        tracing::warn!(%error, "the service manager does not listen");
    }
}

/// Whether so much time has passed since this last said so. A manager that is behind must not be overrun: its socket holds a
/// few messages only, and waits when it is full.
fn is_due(interval: Duration) -> bool {
    static LAST: Mutex<Option<Instant>> = Mutex::new(None);
    let mut last = LAST.lock().unwrap_or_else(PoisonError::into_inner);
    let due = last.is_none_or(|last| last.elapsed() >= interval);
    if due {
        *last = Some(Instant::now());
    }
    due
}

/// Lets whoever started us see the end of our output.
pub(crate) fn detach_stdout() {
    let null = OpenOptions::new().write(true).open("/dev/null");
    if let Err(error) = null.and_then(|null| Ok(dup2_stdout(&null)?)) {
        tracing::warn!(%error, "cannot detach standard output");
    }
}
