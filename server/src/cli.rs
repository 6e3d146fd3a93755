//! The command line.

use clap::{Args, Parser, Subcommand, ValueEnum};
use pbgi_core::limits::{NODES_PER_PAGE_DEFAULT, POINTS_PER_PAGE_DEFAULT};
use pbgi_server::budget::parse_bytes;
use pbgi_server::{Options, ServerError};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Threads that carry requests; blocking work has its own.
pub(crate) const RUNTIME_THREADS: usize = 2;
/// Seconds after which a private daemon without jobs exits.
const PRIVATE_IDLE_SECONDS: u64 = 300;

/// Shading server for out-of-core point-based global illumination.
#[derive(Debug, Parser)]
#[command(
    name = "pbgi-server",
    version,
    args_conflicts_with_subcommands = true,
    args_override_self = true
)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    pub(crate) command: Option<Command>,
    #[command(flatten)]
    pub(crate) serve: ServeArguments,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Serve until stopped (the default)
    Serve(ServeArguments),
    /// Build one scene for a daemon
    #[command(hide = true)]
    BuildChild,
}

#[derive(Clone, Debug, Args)]
pub(crate) struct ServeArguments {
    /// Serve one user without supervision: leave the session, log to STATE_DIR/server.log, exit when idle
    #[arg(long)]
    pub(crate) private: bool,
    /// Where the sockets jobs.sock and queue.sock are made [default: $PBGI_RUNTIME_DIR, $XDG_RUNTIME_DIR/pbgi or /tmp/pbgi-UID]
    #[arg(long, value_name = "DIR")]
    runtime_dir: Option<PathBuf>,
    /// Where lock, state and log are [default: $XDG_STATE_HOME/pbgi or ~/.local/state/pbgi]
    #[arg(long, value_name = "DIR")]
    state_dir: Option<PathBuf>,
    /// Where builds put temporary files [default: $XDG_CACHE_HOME/pbgi/scratch or ~/.cache/pbgi/scratch]
    #[arg(long, value_name = "DIR")]
    scratch_dir: Option<PathBuf>,
    /// All memory: cache, workers, builds, pictures [default: 2G, or less where the machine has less]
    #[arg(long, value_name = "SIZE", value_parser = parse_bytes)]
    memory: Option<u64>,
    /// Worker processes [default: one a core]
    #[arg(long, value_name = "N")]
    workers: Option<usize>,
    /// Exit after so many seconds without jobs [default: 300 with --private, else never]
    #[arg(long, value_name = "SECONDS")]
    idle_seconds: Option<u64>,
    /// The worker program [default: pbgi-worker beside this one]
    #[arg(long, value_name = "PATH")]
    worker_binary: Option<PathBuf>,
    /// Nodes in the largest node page that the cache holds
    #[arg(long, value_name = "N", default_value_t = NODES_PER_PAGE_DEFAULT)]
    nodes_per_page: u32,
    /// Points in the largest point page that the cache holds
    #[arg(long, value_name = "N", default_value_t = POINTS_PER_PAGE_DEFAULT)]
    points_per_page: u32,
    /// What is logged: a level or a filter like pbgi_server=debug
    #[arg(long, value_name = "FILTER", default_value = "info")]
    pub(crate) log: String,
    /// How it is logged
    #[arg(long, value_name = "FORMAT", default_value = "text")]
    pub(crate) log_format: LogFormat,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
pub(crate) enum LogFormat {
    /// Lines for people
    Text,
    /// A JSON object a line
    Json,
}

impl ServeArguments {
    /// With the environment's defaults filled in.
    pub(crate) fn options(&self) -> Result<Options, ServerError> {
        let own = std::env::current_exe().map_err(|error| ServerError::Setup {
            action: "find this program",
            reason: error.to_string(),
        })?;
        let folders = Folders::from_environment();
        let absolute = |path: &Path| {
            std::path::absolute(path).map_err(|error| ServerError::Setup {
                action: "find the current directory",
                reason: error.to_string(),
            })
        };
        let idle = self.idle_seconds.or(self.private.then_some(PRIVATE_IDLE_SECONDS));
        Ok(Options {
            runtime_dir: absolute(self.runtime_dir.as_ref().unwrap_or(&folders.runtime))?,
            state_dir: absolute(self.state_dir.as_ref().unwrap_or(&folders.state))?,
            scratch_dir: absolute(self.scratch_dir.as_ref().unwrap_or(&folders.scratch))?,
            memory_bytes: self.memory,
            workers: self.workers.unwrap_or_else(cores),
            idle: idle.map(Duration::from_secs),
            worker_binary: match &self.worker_binary {
                Some(path) => absolute(path)?,
                None => own.with_file_name("pbgi-worker"),
            },
            server_binary: own,
            nodes_per_page: self.nodes_per_page,
            points_per_page: self.points_per_page,
        })
    }
}

fn cores() -> usize {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    cores.min(pbgi_core::limits::WORKERS_MAX)
}

struct Folders {
    runtime: PathBuf,
    state: PathBuf,
    scratch: PathBuf,
}

impl Folders {
    fn from_environment() -> Self {
        let variable = |name| {
            std::env::var_os(name)
                .map(PathBuf::from)
                .filter(|path| path.is_absolute())
        };
        let temporary = PathBuf::from(format!("/tmp/pbgi-{}", nix::unistd::geteuid()));
        let home = variable("HOME");
        let below = |name, default: &str| {
            let base = variable(name).or_else(|| home.as_ref().map(|home| home.join(default)));
            base.map(|base| base.join("pbgi"))
        };
        Self {
            runtime: variable("PBGI_RUNTIME_DIR")
                .or_else(|| variable("XDG_RUNTIME_DIR").map(|path| path.join("pbgi")))
                .unwrap_or_else(|| temporary.clone()),
            state: below("XDG_STATE_HOME", ".local/state").unwrap_or_else(|| temporary.join("state")),
            scratch: below("XDG_CACHE_HOME", ".cache")
                .map_or_else(|| temporary.join("scratch"), |path| path.join("scratch")),
        }
    }
}
