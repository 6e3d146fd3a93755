//! The command line.

use clap::{Args, Parser, Subcommand, ValueEnum};
use pbgi_core::limits::{NODES_PER_PAGE_DEFAULT, POINTS_PER_PAGE_DEFAULT};
use pbgi_server::budget::parse_bytes;
use pbgi_server::config_file::ConfigFile;
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
    /// Check the options and the configuration file, and tell what the daemon would do
    Check(ServeArguments),
    /// Write the manual page into a directory
    Man {
        /// The directory
        directory: PathBuf,
    },
    /// Print completions for a shell
    Completions {
        /// The shell
        shell: clap_complete::Shell,
    },
    /// Build one scene for a daemon
    #[command(hide = true)]
    BuildChild,
}

#[derive(Clone, Debug, Args)]
pub(crate) struct ServeArguments {
    /// Options in a file (TOML); those on the command line win. SIGHUP reads it again
    #[arg(long, value_name = "FILE")]
    pub(crate) config: Option<PathBuf>,
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
    /// Nodes in the largest node page that the cache holds [default: 256]
    #[arg(long, value_name = "N")]
    nodes_per_page: Option<u32>,
    /// Points in the largest point page that the cache holds [default: 1024]
    #[arg(long, value_name = "N")]
    points_per_page: Option<u32>,
    /// What is logged: a level or a filter like pbgi_server=debug [default: info]
    #[arg(long, value_name = "FILTER")]
    log: Option<String>,
    /// How it is logged [default: text]
    #[arg(long, value_name = "FORMAT")]
    log_format: Option<LogFormat>,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
pub(crate) enum LogFormat {
    /// Lines for people
    Text,
    /// A JSON object a line
    Json,
}

impl ServeArguments {
    /// What the configuration file says; nothing if there is none.
    pub(crate) fn file(&self) -> Result<ConfigFile, ServerError> {
        let Some(path) = &self.config else {
            return Ok(ConfigFile::default());
        };
        let text = std::fs::read_to_string(path).map_err(|source| ServerError::Io {
            action: "read the configuration",
            path: path.clone(),
            source,
        })?;
        ConfigFile::parse(&text).map_err(|problems| {
            let line = |problem| format!("{problem}, in {}", path.display());
            ServerError::Configuration(problems.into_iter().map(line).collect())
        })
    }

    pub(crate) fn log<'a>(&'a self, file: &'a ConfigFile) -> &'a str {
        self.log.as_deref().or(file.log.as_deref()).unwrap_or("info")
    }

    pub(crate) fn log_format(&self, file: &ConfigFile) -> LogFormat {
        self.log_format.unwrap_or(match file.log_format.as_deref() {
            Some("json") => LogFormat::Json,
            _ => LogFormat::Text,
        })
    }

    /// With the file's values and the environment's defaults filled in.
    pub(crate) fn options(&self, file: &ConfigFile) -> Result<Options, ServerError> {
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
        let idle = self
            .idle_seconds
            .or(file.idle_seconds)
            .or(self.private.then_some(PRIVATE_IDLE_SECONDS));
        let folder = |given: &Option<PathBuf>, filed: &Option<PathBuf>, default: &PathBuf| {
            absolute(given.as_ref().or(filed.as_ref()).unwrap_or(default))
        };
        let filed_workers = file.workers.map(|count| usize::try_from(count).unwrap_or(usize::MAX));
        let small = |count: u64| u32::try_from(count).unwrap_or(u32::MAX);
        Ok(Options {
            runtime_dir: folder(&self.runtime_dir, &file.runtime_dir, &folders.runtime)?,
            state_dir: folder(&self.state_dir, &file.state_dir, &folders.state)?,
            scratch_dir: folder(&self.scratch_dir, &file.scratch_dir, &folders.scratch)?,
            memory_bytes: self.memory.or(file.memory),
            workers: self.workers.or(filed_workers).unwrap_or_else(cores),
            idle: idle.map(Duration::from_secs),
            worker_binary: match &self.worker_binary {
                Some(path) => absolute(path)?,
                None => own.with_file_name("pbgi-worker"),
            },
            server_binary: own,
            nodes_per_page: self
                .nodes_per_page
                .or(file.nodes_per_page.map(small))
                .unwrap_or(NODES_PER_PAGE_DEFAULT),
            points_per_page: self
                .points_per_page
                .or(file.points_per_page.map(small))
                .unwrap_or(POINTS_PER_PAGE_DEFAULT),
            access: file.access.clone(),
            otlp: file.otlp.clone(),
            config_file: self.config.as_deref().map(absolute).transpose()?,
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
