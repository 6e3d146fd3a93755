//! What can go wrong on disk, sorted by what a caller can do about it.

use pbgi_core::PageKind;
use std::io;
use std::path::{Path, PathBuf};

/// Why a file could not be read, written or trusted.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StoreError {
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
    /// The disk or the quota is full.
    #[error(
        "no space left: {needed} bytes needed, {free} bytes free; make room or choose another disk, at {}",
        .path.display()
    )]
    NoSpace {
        /// Bytes that had to be written.
        needed: u64,
        /// Bytes that were free.
        free: u64,
        /// Where.
        path: PathBuf,
    },
    /// Something else has the name.
    #[error("output exists: pass --overwrite or choose another name, at {}", .path.display())]
    Exists {
        /// The name.
        path: PathBuf,
    },
    /// Nothing has the name.
    #[error("no scene found: check the path, or build it first, at {}", .path.display())]
    Missing {
        /// The name.
        path: PathBuf,
    },
    /// What has the name is something that may not be read or replaced as asked.
    #[error("{reason}, at {}", .path.display())]
    Foreign {
        /// What it is instead.
        reason: String,
        /// The name.
        path: PathBuf,
    },
    /// The bytes are not those that were written.
    #[error(
        "corrupt {place}: expected {expected}, found {actual}; restore the file or build the scene again, in {}",
        .path.display()
    )]
    Corrupt {
        /// Which part.
        place: String,
        /// What was written there, as far as known.
        expected: String,
        /// What is there.
        actual: String,
        /// The file.
        path: PathBuf,
    },
    /// The file is whole but not for this program, or not for its neighbours.
    #[error(
        "unusable {what}: this program needs {expected}, the file has {actual}; build the scene again, in {}",
        .path.display()
    )]
    Mismatch {
        /// Which property.
        what: &'static str,
        /// What would fit.
        expected: String,
        /// What is there.
        actual: String,
        /// The file.
        path: PathBuf,
    },
    /// A page that the file does not have.
    #[error("no such page: {kind} page {page} of {count}, in {}", .path.display())]
    PageRange {
        /// Which file of the scene.
        kind: PageKind,
        /// The page asked for.
        page: u32,
        /// Pages there are.
        count: u64,
        /// The file.
        path: PathBuf,
    },
    /// A number that does not fit the format.
    #[error("too many {what}: {count}, the format holds {max}")]
    Limit {
        /// What was counted.
        what: &'static str,
        /// How many.
        count: u64,
        /// How many fit.
        max: u64,
    },
    /// A mistake of the caller.
    #[error("invalid request: {0}")]
    Invalid(String),
    /// An earlier write or sync failed, so the file's content is unknown.
    #[error("file abandoned after an earlier write failed, at {}", .path.display())]
    Abandoned {
        /// The file.
        path: PathBuf,
    },
}

impl StoreError {
    pub(crate) fn io(action: &'static str, path: &Path, source: io::Error) -> Self {
        Self::Io {
            action,
            path: path.to_owned(),
            source,
        }
    }

    pub(crate) fn corrupt(
        path: &Path,
        place: impl ToString,
        expected: impl std::fmt::Display,
        actual: impl std::fmt::Display,
    ) -> Self {
        Self::Corrupt {
            place: place.to_string(),
            expected: expected.to_string(),
            actual: actual.to_string(),
            path: path.to_owned(),
        }
    }

    pub(crate) fn mismatch(
        path: &Path,
        what: &'static str,
        expected: impl std::fmt::Display,
        actual: impl std::fmt::Display,
    ) -> Self {
        Self::Mismatch {
            what,
            expected: expected.to_string(),
            actual: actual.to_string(),
            path: path.to_owned(),
        }
    }
}
