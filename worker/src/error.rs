//! How a worker can end other than by being told to.

use std::path::PathBuf;

/// Why the process ends.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WorkerError {
    /// Standard input is no socket.
    #[error("standard input is not the daemon's page channel; pbgi-server starts this program, people do not")]
    NoChannel,
    /// The daemon died before this process could tie itself to it.
    #[error("the daemon that started this worker is gone")]
    Orphan,
    /// The daemon closed its sockets: the ordinary end.
    #[error("the daemon closed the queue")]
    Gone,
    /// Programs of different builds.
    #[error("cannot work with this daemon: {0}")]
    Mismatch(String),
    /// The shared cache or the miss channel.
    #[error("page cache: {0}")]
    Cache(String),
    /// Nobody serves the queue.
    #[error("cannot reach the queue at {path:?}: {reason}")]
    Connect {
        /// The socket.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// The daemon refused a request.
    #[error("the queue refused to {action}: {reason}")]
    Refused {
        /// What was wanted.
        action: &'static str,
        /// The daemon's words.
        reason: String,
    },
    /// The operating system said no.
    #[error("cannot {action}: {reason}")]
    Os {
        /// What was wanted.
        action: &'static str,
        /// The system's answer.
        reason: String,
    },
    /// A mistake in this program.
    #[error("defect: {0}")]
    Defect(String),
}

impl WorkerError {
    /// What the process exits with: 3 where starting it again cannot help.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Mismatch(_) => 3,
            Self::NoChannel => 2,
            _ => 1,
        }
    }
}
