//! The daemon: takes build and shade jobs from clients, hands tiles to worker processes, loads their pages into the shared cache,
//! and puts pictures together.
//!
//! Start at [`daemon::run`]. [`dispatcher`] is the middle: it holds the jobs and carries out what the pure [`scheduler`] says;
//! [`supervisor`] makes and reaps processes, [`loader`] answers page faults, [`builder`] runs builds in a child. gRPC stays
//! within [`rpc`]. This crate never shades: it does not link `pbgi-shade`.
#![forbid(unsafe_code)]

pub mod access;
mod bounce;
pub mod budget;
pub mod build_child;
pub mod builder;
pub mod config;
pub mod config_file;
pub mod confine;
pub mod daemon;
pub mod dispatcher;
pub mod environment;
pub mod error;
pub mod framebuffer;
pub mod http;
pub mod job;
pub mod limits;
pub mod live;
pub mod loader;
pub mod memory;
pub mod metrics;
pub mod mounts;
pub mod output;
pub mod roots;
pub mod rpc;
pub mod scheduler;
pub mod shade_job;
pub mod state;
pub mod supervisor;
pub mod table;
pub mod telemetry;

pub use config::{Config, Options};
pub use daemon::{Life, Listeners, Orders, Stop, run};
pub use error::ServerError;
