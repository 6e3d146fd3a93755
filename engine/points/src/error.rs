//! What can go wrong with input and output: one error for the crate.

use std::io;
use std::path::{Path, PathBuf};

/// Why a file could not be read or written. Every text names the file, the place in it and, where there is one, the remedy.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PointsError {
    /// The operating system said no.
    #[error("cannot {action} {path:?}: {source}")]
    Io {
        /// What was tried: "open", "read", "write".
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// The system's answer.
        source: io::Error,
    },
    /// The file is of a kind, or uses a feature, that is not read here.
    #[error("{what} is not supported: {remedy}, in {path:?}")]
    Unsupported {
        /// The kind or feature.
        what: String,
        /// What to do instead.
        remedy: String,
        /// The file.
        path: PathBuf,
    },
    /// The file breaks the rules of its format, or of ours.
    #[error("{what}, in {path:?}")]
    Invalid {
        /// What is wrong, where in the file, and the remedy.
        what: String,
        /// The file.
        path: PathBuf,
    },
    /// The file ends early.
    #[error("file is truncated: expected {expected} bytes, found {actual}, in {path:?}")]
    Truncated {
        /// Bytes that the header announces.
        expected: u64,
        /// Bytes there are.
        actual: u64,
        /// The file.
        path: PathBuf,
    },
    /// A number in a header is larger than we are willing to read.
    #[error("{what} is {value}, at most {limit} are read, in {path:?}")]
    Limit {
        /// What is too large.
        what: &'static str,
        /// Its value.
        value: u64,
        /// The bound.
        limit: u64,
        /// The file.
        path: PathBuf,
    },
    /// Points with a number that cannot be used.
    #[error(
        "point {index} of {count}: {reason}; it is the first of {invalid} invalid points: repair them, or drop them with \
         --invalid-points skip, in {path:?}"
    )]
    InvalidPoint {
        /// Which point, from 0.
        index: u64,
        /// Points in the file.
        count: u64,
        /// The field and what is wrong with it.
        reason: String,
        /// How many there are.
        invalid: u64,
        /// The file.
        path: PathBuf,
    },
    /// An output file cannot be made.
    #[error(transparent)]
    Store(#[from] pbgi_store::StoreError),
    /// What an input must keep in memory does not fit.
    #[error("not enough memory: {what} needs {needed} bytes, {available} bytes are available; give more --memory")]
    Memory {
        /// What needs it.
        what: &'static str,
        /// Bytes needed.
        needed: u64,
        /// Bytes there are for it.
        available: u64,
    },
    /// What is wrong with a scene file, each with file, line and remedy.
    #[error("{}", .0.join("\n"))]
    Scene(Vec<String>),
    /// The caller stopped it.
    #[error("cancelled")]
    Cancelled,
    /// What the caller asked for makes no sense.
    #[error("{0}")]
    Request(String),
}

impl PointsError {
    /// Closure for `map_err`: `action` failed on `path`.
    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { action, path, source }
    }

    pub(crate) fn invalid(path: &Path, what: impl Into<String>) -> Self {
        Self::Invalid {
            what: what.into(),
            path: path.to_owned(),
        }
    }

    pub(crate) fn unsupported(path: &Path, what: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self::Unsupported {
            what: what.into(),
            remedy: remedy.into(),
            path: path.to_owned(),
        }
    }
}
