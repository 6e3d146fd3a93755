//! The shared page cache: octree pages in POSIX shared memory, written by one daemon, read by many worker processes.
//!
//! The daemon's side is [`CacheOwner`] over a [`Segment`]: it loads pages, evicts them and repairs what a dead worker
//! leaves. A worker's side is [`LocalCache`] over a [`CacheView`]: it finds pages and pins them without a call and
//! without a lock. What a worker does not find it asks for over the miss channel ([`channel`]).
//!
//! The access rules are numbered in this crate's `README.md`; code cites them by number. This is the crate with
//! `unsafe`, and it is confined to the modules below that say so. The crate knows no files: whoever calls
//! [`CacheOwner::fetch`] reads them.

pub mod protocol;

mod flight;
mod frame;
mod sync;

pub use flight::{Flight, Flights, Role};
pub use frame::{FrameId, Tag, TagState};

// The model checker cannot place its atomics in a mapping, so its build leaves out everything that touches one.
#[cfg(not(loom))]
#[expect(unsafe_code, reason = "maps and unmaps shared memory: README rules 1, 2 and 9")]
mod attach;
#[cfg(not(loom))]
pub mod channel;
#[cfg(not(loom))]
mod counters;
#[cfg(not(loom))]
mod error;
#[cfg(not(loom))]
mod layout;
#[cfg(not(loom))]
mod ledger;
#[cfg(not(loom))]
#[expect(unsafe_code, reason = "turns pinned frames into slices: README rule 4")]
mod local;
#[cfg(not(loom))]
#[expect(unsafe_code, reason = "the accessors of the segment: README rules 1, 2 and 9")]
mod map;
#[cfg(not(loom))]
#[expect(
    unsafe_code,
    reason = "hands a frame that nobody can read to its loader: README rule 6"
)]
mod owner;
#[cfg(not(loom))]
mod page_table;
#[cfg(not(loom))]
mod plan;
#[cfg(not(loom))]
mod pool;
#[cfg(not(loom))]
mod quota;
#[cfg(not(loom))]
#[expect(unsafe_code, reason = "creates the mapping: README rules 1 and 9")]
mod segment;
#[cfg(not(loom))]
mod victim;
#[cfg(not(loom))]
mod wire;

#[cfg(not(loom))]
pub use {
    attach::{CacheView, PagePin},
    counters::{CacheCounters, JobCounters, PoolCounters, SceneCounters},
    error::{CacheError, LoadError, LoadErrorKind},
    layout::{PoolLayout, SegmentLayout},
    local::{LocalCache, LocalCounters},
    owner::{CacheOwner, Fetched, JOBS_MAX, Origin, Seat},
    plan::CacheBudget,
    segment::Segment,
};
