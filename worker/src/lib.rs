//! One shading process: pulls tiles from the daemon's queue, reads pages from the shared cache, shades.
//!
//! [`run`] is all of it. The process's standard input is the miss channel to the daemon; the queue is gRPC over a Unix socket.
//! One thread speaks to the queue and keeps leases alive, the other shades. This crate opens no scene file: [`pages`] is where
//! pages come from. It never links the builder.
#![forbid(unsafe_code)]

mod ahead;
mod attach;
mod error;
pub mod pages;
mod queue;
mod shading;
mod task;
mod tile;
mod tile_loop;
mod view;

pub use attach::die_with_parent;
pub use error::WorkerError;
pub use shading::FailureKind;

use std::path::PathBuf;
use tracing_subscriber::EnvFilter;

/// Command line of the program.
#[derive(clap::Parser, Debug)]
#[command(
    name = "pbgi-worker",
    version,
    about = "Shades tiles for pbgi-server, which starts it; nothing for people"
)]
pub struct Options {
    /// Descriptor of the page channel: 0, standard input
    #[arg(long, value_name = "FD", default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=0))]
    pub page_channel: u32,
    /// The daemon's queue socket
    #[arg(long, value_name = "SOCKET")]
    pub queue: PathBuf,
}

/// Variable that says what is logged, as `tracing-subscriber` reads it.
const LOG_VARIABLE: &str = "PBGI_LOG";

/// Logs to standard error: warnings, and what `PBGI_LOG` asks for.
pub fn init_tracing() {
    let filter = EnvFilter::try_from_env(LOG_VARIABLE).unwrap_or_else(|_| EnvFilter::new("warn"));
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_ansi(false)
        .init();
}

/// Shades until the daemon closes the sockets.
///
/// # Errors
/// No channel, a daemon of another build, a refusal, a defect.
pub fn run(options: &Options) -> Result<(), WorkerError> {
    let attached = attach::attach()?;
    let seat = attached.seat();
    let token = attached.token();
    let (shader, thread) = shading::start(attached)?;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let runtime = runtime.map_err(|error| WorkerError::Os {
        action: "start the asynchronous runtime",
        reason: error.to_string(),
    })?;
    let result = runtime.block_on(async {
        let queue = queue::Queue::connect(&options.queue, seat, token).await?;
        tile_loop::serve(queue, shader).await
    });
    // The channel to the thread is closed by now; it gives up its pins and ends.
    if thread.join().is_err() {
        return Err(WorkerError::Defect("the shading thread panicked".to_owned()));
    }
    match result {
        Err(WorkerError::Gone) => Ok(()),
        other => other,
    }
}
