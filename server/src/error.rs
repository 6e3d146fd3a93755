//! What can go wrong before and around jobs, by what an operator can do about it.

use pbgi_cache::CacheError;
use std::io;
use std::path::{Path, PathBuf};

/// Why the daemon does not start, or stops.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ServerError {
    /// An option that makes no sense.
    #[error("{name} is {value}, must be {expected}")]
    Option {
        /// The option.
        name: &'static str,
        /// Its value.
        value: String,
        /// What is allowed.
        expected: String,
    },
    /// The machine has less memory than asked for, or the budget is too small to work with.
    #[error("not enough {what}: {needed} bytes needed, {available} bytes available; {remedy}")]
    Memory {
        /// Of which kind.
        what: &'static str,
        /// Bytes needed.
        needed: u64,
        /// Bytes available.
        available: u64,
        /// What to do.
        remedy: String,
    },
    /// Another daemon has this state directory.
    #[error("state directory is already in use by {holder}; stop that daemon or choose another --state-dir, at {}", .path.display())]
    InUse {
        /// Who.
        holder: String,
        /// Where.
        path: PathBuf,
    },
    /// Directories that cannot be used: all of them, one a line.
    #[error("{}", .0.join("\n"))]
    Directories(Vec<String>),
    /// A configuration that cannot be: all problems, one a line.
    #[error("{}", .0.join("\n"))]
    Configuration(Vec<String>),
    /// The operating system refused.
    #[error("cannot {action}: {source}, at {}", .path.display())]
    Io {
        /// What was tried.
        action: &'static str,
        /// Where.
        path: PathBuf,
        /// The system's answer.
        source: io::Error,
    },
    /// The job table cannot be used.
    #[error("cannot use the job table: {reason}; move it away to start without the jobs in it, at {}", .path.display())]
    Table {
        /// Where.
        path: PathBuf,
        /// Why not.
        reason: String,
    },
    /// The page cache cannot be set up.
    #[error(transparent)]
    Cache(#[from] CacheError),
    /// A socket or thread cannot be set up.
    #[error("cannot {action}: {reason}")]
    Setup {
        /// What was tried.
        action: &'static str,
        /// Why not.
        reason: String,
    },
}

impl ServerError {
    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { action, path, source }
    }

    pub(crate) fn setup(action: &'static str) -> impl FnOnce(io::Error) -> Self {
        move |error| Self::Setup {
            action,
            reason: error.to_string(),
        }
    }

    /// The exit status of a daemon that does not start: 2 for a call that cannot work, 78 (`EX_CONFIG`) for a machine that
    /// cannot hold it, 1 for the rest.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Option { .. } | Self::InUse { .. } | Self::Configuration(_) => 2,
            Self::Memory { .. } => 78,
            Self::Cache(CacheError::NoSpace { .. } | CacheError::BudgetTooSmall { .. }) => 78,
            _ => 1,
        }
    }
}

/// Why a request or a job failed; the closed list that [`crate::rpc::status`] maps to gRPC codes.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{text}")]
pub struct JobError {
    /// What the caller can do about it.
    pub kind: JobErrorKind,
    /// For people.
    pub text: String,
}

/// Kinds of [`JobError`]. Adding one changes the interface.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JobErrorKind {
    /// The request makes no sense: change it.
    Invalid,
    /// There is no such thing.
    NotFound,
    /// The name is taken by something else.
    Exists,
    /// Another job is at it: wait for that one.
    Busy,
    /// Something in the way: another state of the world is needed.
    Precondition,
    /// Too much is asked of this daemon.
    Exhausted,
    /// Stored bytes are not what was written.
    Corrupt,
    /// The caller is not who it must be.
    Unauthenticated,
    /// The caller may not do this.
    Denied,
    /// The daemon is stopping or cannot work.
    Unavailable,
    /// A bug.
    Internal,
}

impl JobError {
    /// An error.
    pub fn new(kind: JobErrorKind, text: impl Into<String>) -> Self {
        Self {
            kind,
            text: text.into(),
        }
    }

    /// Of kind [`JobErrorKind::Invalid`].
    pub fn invalid(text: impl Into<String>) -> Self {
        Self::new(JobErrorKind::Invalid, text)
    }
}
