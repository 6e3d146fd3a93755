//! Ties the process to its daemon: death signal, miss channel, welcome, segment.

use crate::error::WorkerError;
use crate::pages::Pages;
use nix::sys::signal::Signal;
use nix::sys::stat::{SFlag, fstat};
use pbgi_cache::channel::{self, Welcome};
use pbgi_cache::{CacheError, CacheView, LocalCache};
use pbgi_proto::v1;
use std::os::fd::AsFd;
use std::os::unix::net::UnixStream;

/// Asks the kernel to kill this process when the thread that started it ends. Call it first in `main`.
///
/// # Errors
/// The kernel refuses.
pub fn die_with_parent() -> Result<(), WorkerError> {
    nix::sys::prctl::set_pdeathsig(Signal::SIGKILL).map_err(|errno| WorkerError::Os {
        action: "arm the parent-death signal",
        reason: errno.to_string(),
    })
}

/// A welcomed worker.
pub(crate) struct Attached {
    channel: UnixStream,
    welcome: Welcome,
    cache: LocalCache,
}

/// Takes the channel from standard input, reads the welcome, attaches to the segment.
pub(crate) fn attach() -> Result<Attached, WorkerError> {
    let channel = channel_from_stdin()?;
    let welcome: Welcome = match channel::receive(&channel) {
        Ok(Some(welcome)) => welcome,
        Ok(None) => return Err(WorkerError::Orphan),
        Err(error) => return Err(explain(&error)),
    };
    // The parent may have died before the signal was armed; then another process is our parent now.
    let parent = nix::unistd::getppid();
    if u32::try_from(parent.as_raw()) != Ok(welcome.daemon_pid) {
        return Err(WorkerError::Orphan);
    }
    let view = CacheView::attach(&welcome.segment, welcome.layout_hash, welcome.seat.slot);
    let cache = LocalCache::new(view.map_err(|error| explain(&error))?);
    Ok(Attached {
        channel,
        welcome,
        cache,
    })
}

impl Attached {
    pub(crate) fn seat(&self) -> v1::WorkerSeat {
        v1::WorkerSeat {
            slot: u32::from(self.welcome.seat.slot),
            epoch: self.welcome.seat.epoch,
        }
    }

    /// The welcome's token as the queue wants it: lower-case hexadecimal digits.
    pub(crate) fn token(&self) -> String {
        self.welcome.token.iter().map(|byte| format!("{byte:02x}")).collect()
    }

    pub(crate) fn into_pages(self) -> Pages {
        Pages::new(self.cache, self.channel)
    }
}

fn channel_from_stdin() -> Result<UnixStream, WorkerError> {
    let stdin = std::io::stdin();
    let is_socket = |mode: u32| SFlag::from_bits_truncate(mode) & SFlag::S_IFMT == SFlag::S_IFSOCK;
    match fstat(&stdin) {
        Ok(stat) if is_socket(stat.st_mode) => {}
        _ => return Err(WorkerError::NoChannel),
    }
    let owned = stdin.as_fd().try_clone_to_owned();
    let owned = owned.map_err(|error| WorkerError::Os {
        action: "take over the page channel",
        reason: error.to_string(),
    })?;
    Ok(UnixStream::from(owned))
}

/// Another build's layout or messages cannot be helped by another try.
fn explain(error: &CacheError) -> WorkerError {
    match error {
        CacheError::Mismatch { .. } | CacheError::Malformed { .. } => WorkerError::Mismatch(error.to_string()),
        _ => WorkerError::Cache(error.to_string()),
    }
}
