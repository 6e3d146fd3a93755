//! What can go wrong, by what a caller can do about it.

use pbgi_core::{MountId, PageKind};
use std::sync::Arc;
use thiserror::Error;

/// Everything this crate reports.
#[derive(Clone, Debug, Error)]
#[non_exhaustive]
pub enum CacheError {
    /// The shared memory file system cannot hold the segment. Nothing was left behind.
    #[error(
        "not enough shared memory: the cache needs {needed} bytes, /dev/shm has {available} available; \
         give less memory to the cache or enlarge /dev/shm"
    )]
    NoSpace {
        /// Bytes of the segment.
        needed: u64,
        /// Bytes the file system has.
        available: u64,
    },
    /// The budget does not hold the smallest cache for so many workers.
    #[error(
        "memory budget too small: {given} bytes given, {needed} needed for {workers} workers and pages of \
         {node_page_bytes} and {point_page_bytes} bytes; give more memory or fewer workers"
    )]
    BudgetTooSmall {
        /// Bytes given.
        given: u64,
        /// Smallest number of bytes that is accepted.
        needed: u64,
        /// Workers asked for.
        workers: u32,
        /// Bytes of a node page.
        node_page_bytes: usize,
        /// Bytes of a point page.
        point_page_bytes: usize,
    },
    /// A layout that breaks a bound or the rule that an evictable frame always exists.
    #[error("invalid cache layout: {what}")]
    Layout {
        /// Which bound, with its values.
        what: String,
    },
    /// A segment of that name exists.
    #[error("shared memory segment \"{name}\" exists already; choose another name")]
    Exists {
        /// The name.
        name: String,
    },
    /// Not a name that [`crate::Segment::unique_name`] gives.
    #[error("not a segment name of this program: \"{name}\"")]
    Name {
        /// The name.
        name: String,
    },
    /// A system call failed.
    #[error("cannot {action} shared memory segment \"{name}\": {reason}")]
    Os {
        /// What was being done.
        action: &'static str,
        /// The segment.
        name: String,
        /// The system's answer.
        reason: String,
    },
    /// The segment or message was made by another build of this program.
    #[error("shared memory {what} mismatch: expected {expected:#x}, found {found:#x}; use programs of the same build")]
    Mismatch {
        /// Which field.
        what: &'static str,
        /// The value of this build.
        expected: u64,
        /// The value found.
        found: u64,
    },
    /// Another process is attached to this slot.
    #[error("worker slot {slot} is taken")]
    SlotTaken {
        /// The slot.
        slot: u8,
    },
    /// The slot was reaped, or never existed: its worker is no more.
    #[error("worker slot {slot} has no epoch {epoch}; the worker was replaced")]
    StaleSeat {
        /// The slot.
        slot: u8,
        /// The epoch that the caller has.
        epoch: u32,
    },
    /// A worker holds as many pins as it may, or more.
    #[error("worker slot {slot} holds {pins} of {limit} {kind} pages; unpin before asking for more")]
    LedgerFull {
        /// The slot.
        slot: u8,
        /// Which pool.
        kind: PageKind,
        /// Pins held.
        pins: u32,
        /// Pins allowed.
        limit: u32,
    },
    /// No frame could be freed in time: some worker holds more pins than it may.
    #[error("no {kind} frame to evict after {waited_ms} ms; a worker holds more pins than it may")]
    Exhausted {
        /// Which pool.
        kind: PageKind,
        /// How long was waited, in milliseconds.
        waited_ms: u64,
    },
    /// The scene is not mounted, or no longer.
    #[error("scene is not mounted: slot {}, generation {}", .0.slot, .0.generation)]
    NotMounted(MountId),
    /// The mount slot is in use, or pages of an earlier scene with that very id are still pinned.
    #[error("mount slot {} is taken, or generation {} is still in use", .0.slot, .0.generation)]
    MountTaken(MountId),
    /// The scene's pages are larger than the frames of this segment.
    #[error("{kind} pages of {page_bytes} bytes exceed the cache's frames of {frame_bytes} bytes")]
    PageTooLarge {
        /// Which pool.
        kind: PageKind,
        /// Bytes of a page of the scene.
        page_bytes: usize,
        /// Bytes of a frame.
        frame_bytes: usize,
    },
    /// The scene has no such page.
    #[error("{kind} page {page} does not exist: the scene has {pages}")]
    PageOutOfRange {
        /// Which file.
        kind: PageKind,
        /// Page asked for.
        page: u32,
        /// Pages of that file.
        pages: u64,
    },
    /// Counters of as many jobs are kept as can be.
    #[error("more than {limit} jobs use the cache at once; end some before starting more")]
    TooManyJobs {
        /// Jobs kept.
        limit: usize,
    },
    /// A page could not be loaded.
    #[error(transparent)]
    Load(#[from] LoadError),
    /// The peer on the miss channel sent something that is not a message.
    #[error("malformed {message} on the miss channel: {what}")]
    Malformed {
        /// Which message was expected.
        message: &'static str,
        /// What is wrong with it.
        what: String,
    },
    /// The peer on the miss channel went away in the middle of a message, or the socket failed.
    #[error("miss channel failed: {reason}")]
    Channel {
        /// The system's answer.
        reason: String,
    },
}

impl CacheError {
    /// The code that goes over the miss channel.
    pub fn kind(&self) -> LoadErrorKind {
        match self {
            Self::Load(error) => error.kind,
            Self::Exhausted { .. } => LoadErrorKind::Internal,
            _ => LoadErrorKind::Refused,
        }
    }
}

/// Why a page could not be loaded; everyone who waited for it gets a copy.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("{text}")]
pub struct LoadError {
    /// What a caller can do about it.
    pub kind: LoadErrorKind,
    /// For people.
    pub text: Arc<str>,
}

impl LoadError {
    /// An error of this kind.
    pub fn new(kind: LoadErrorKind, text: impl Into<Arc<str>>) -> Self {
        Self {
            kind,
            text: text.into(),
        }
    }
}

/// Kinds of [`LoadError`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum LoadErrorKind {
    /// The bytes on disk are not what they should be: asking again does not help.
    Corrupt = 1,
    /// The file could not be read.
    Io = 2,
    /// The request was not one that can be served.
    Refused = 3,
    /// A fault of the daemon.
    Internal = 4,
}

impl TryFrom<u8> for LoadErrorKind {
    type Error = u8;

    fn try_from(code: u8) -> Result<Self, u8> {
        Ok(match code {
            1 => Self::Corrupt,
            2 => Self::Io,
            3 => Self::Refused,
            4 => Self::Internal,
            other => return Err(other),
        })
    }
}
