//! Typed client of the shading server: [`Client`] submits build and shade jobs over the daemon's socket, watches them and asks
//! about scenes; [`private`] finds or starts the daemon that a user without one gets.
//!
//! gRPC stays inside: requests and answers are plain types, every request has a deadline, every error says what was wanted.
//! The `pbgi-client` command line is built on this crate.
#![forbid(unsafe_code)]

mod cache;
mod client;
mod convert;
mod error;
mod job;
mod live;
pub mod private;
mod shape;
pub mod size;

pub use cache::{CachePins, CachePool, CacheStatus, CachedFile, CachedScene, Lookups};
pub use client::Client;
pub use error::{ClientError, Refusal};
pub use job::{
    BuildJob, DaemonStatus, Job, JobEvent, JobOptions, JobState, MountStatus, Pool, ShadeJob, WorkerStatus,
    serialize_statistics,
};
pub use live::{LIVE_RECEIVERS_MAX, LiveJob};
pub use pbgi_points::{CloudOptions, Density};
pub use shape::{LevelShape, SceneShape};
