//! What the daemon runs with: one value, checked once.

use crate::access::{Access, Auth, Token};
use crate::budget::{Machine, MemoryPlan};
use crate::config_file::NO_ROOTS;
use crate::error::ServerError;
use crate::limits;
use pbgi_cache::{CacheBudget, SegmentLayout};
use pbgi_core::limits::{NODES_PER_PAGE_DEFAULT, POINTS_PER_PAGE_DEFAULT, RECORDS_PER_PAGE_RANGE, WORKERS_MAX};
use pbgi_core::{NodeRecord, PointRecord};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// What was asked for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Options {
    /// Where the sockets are made.
    pub runtime_dir: PathBuf,
    /// Where lock, state file and log are.
    pub state_dir: PathBuf,
    /// Where builds put their temporary files.
    pub scratch_dir: PathBuf,
    /// All memory; `None` lets the machine decide.
    pub memory_bytes: Option<u64>,
    /// Worker processes.
    pub workers: usize,
    /// Exit after so long without jobs.
    pub idle: Option<Duration>,
    /// The worker program.
    pub worker_binary: PathBuf,
    /// This program, for build children.
    pub server_binary: PathBuf,
    /// Largest node page that will be cached, in records.
    pub nodes_per_page: u32,
    /// Largest point page that will be cached, in records.
    pub points_per_page: u32,
    /// Who may call, and what they may name.
    pub access: Access,
    /// The collector that spans go to, `http://HOST:PORT`.
    pub otlp: Option<String>,
    /// The file that said so, if there is one.
    pub config_file: Option<PathBuf>,
}

impl Options {
    /// Defaults below one directory, for tests and embedders.
    pub fn below(directory: &Path, worker_binary: PathBuf, server_binary: PathBuf) -> Self {
        Self {
            runtime_dir: directory.join("run"),
            state_dir: directory.join("state"),
            scratch_dir: directory.join("scratch"),
            memory_bytes: Some(256 << 20),
            workers: 1,
            idle: None,
            worker_binary,
            server_binary,
            nodes_per_page: NODES_PER_PAGE_DEFAULT,
            points_per_page: POINTS_PER_PAGE_DEFAULT,
            access: Access::default(),
            otlp: None,
            config_file: None,
        }
    }

    /// Checks that clients can name none of our own files, whatever links lead there.
    ///
    /// # Errors
    /// [`ServerError::Configuration`] with a line for each root that overlaps with one of them.
    pub fn check_roots(&self) -> Result<(), ServerError> {
        let mut own = vec![&self.runtime_dir, &self.state_dir, &self.scratch_dir];
        own.extend(&self.config_file);
        if let Some(Auth::MutualTls {
            cert, key, client_ca, ..
        }) = self.access.tcp.as_ref().map(|tcp| &tcp.auth)
        {
            own.extend([cert, key, client_ca]);
        }
        own.extend(self.access.tokens().iter().map(|token| &token.file));
        let mut problems = Vec::new();
        if self.access.roots.is_empty() && self.access.others_may_call() {
            problems.push(NO_ROOTS.to_owned());
        }
        for (name, root) in &self.access.roots {
            let path = real(&root.path);
            let near = |own: &&&PathBuf| real(own).starts_with(&path) || path.starts_with(real(own));
            problems.extend(own.iter().filter(near).map(|own| {
                format!(
                    "roots.{name}.path overlaps with the daemon's own {}, at {}",
                    own.display(),
                    root.path.display()
                )
            }));
        }
        if problems.is_empty() {
            Ok(())
        } else {
            Err(ServerError::Configuration(problems))
        }
    }

    /// Takes over from other options what can change while the daemon runs.
    pub fn take_over(&mut self, new: &Self) -> Changes {
        let (mut taken, mut left) = (Vec::new(), Vec::new());
        let note = |changed: bool, notes: &mut Vec<&'static str>, key| notes.extend(changed.then_some(key));
        note(self.idle != new.idle, &mut taken, "idle_seconds");
        note(self.access.users != new.access.users, &mut taken, "allow_users");
        note(self.access.roots != new.access.roots, &mut taken, "roots");
        note(self.runtime_dir != new.runtime_dir, &mut left, "runtime_dir");
        note(self.state_dir != new.state_dir, &mut left, "state_dir");
        note(self.scratch_dir != new.scratch_dir, &mut left, "scratch_dir");
        note(self.memory_bytes != new.memory_bytes, &mut left, "memory");
        note(self.workers != new.workers, &mut left, "workers");
        note(self.nodes_per_page != new.nodes_per_page, &mut left, "nodes_per_page");
        note(
            self.points_per_page != new.points_per_page,
            &mut left,
            "points_per_page",
        );
        note(self.access.group != new.access.group, &mut left, "group");
        note(self.access.http != new.access.http, &mut left, "http");
        note(self.otlp != new.otlp, &mut left, "otlp");
        self.idle = new.idle;
        self.access.users.clone_from(&new.access.users);
        self.access.roots.clone_from(&new.access.roots);
        let (own, other) = (&mut self.access.tcp, &new.access.tcp);
        if let (Some(own), Some(other)) = (own.as_mut(), other)
            && let (Auth::MutualTls { tokens, .. }, Auth::MutualTls { tokens: others, .. }) =
                (&mut own.auth, &other.auth)
        {
            tokens.clone_from(others);
        }
        note(own != other, &mut left, "tcp");
        Changes { taken, left }
    }
}

/// What another configuration changed, by key.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Changes {
    /// What holds from now on.
    pub taken: Vec<&'static str>,
    /// What holds after a restart.
    pub left: Vec<&'static str>,
}

/// Where a path leads, links followed as far as it is there.
fn real(path: &Path) -> PathBuf {
    let known = path
        .ancestors()
        .find_map(|known| Some((known, known.canonicalize().ok()?)));
    match known {
        Some((known, real)) => real.join(path.strip_prefix(known).unwrap_or(path)),
        None => path.to_owned(),
    }
}

/// Options that hold on this machine.
#[derive(Clone, Debug)]
pub struct Config {
    /// What was asked for.
    pub options: Options,
    /// How the memory is divided.
    pub memory: MemoryPlan,
    /// The cache.
    pub layout: SegmentLayout,
}

impl Config {
    /// Checks every option.
    ///
    /// # Errors
    /// The first option that cannot be, named; or memory that is not there.
    pub fn new(options: Options, machine: &Machine) -> Result<Self, ServerError> {
        let workers = range("--workers", options.workers as u64, 1..=WORKERS_MAX as u64)? as u32;
        let records = u64::from(*RECORDS_PER_PAGE_RANGE.start())..=u64::from(*RECORDS_PER_PAGE_RANGE.end());
        range("--nodes-per-page", u64::from(options.nodes_per_page), records.clone())?;
        range("--points-per-page", u64::from(options.points_per_page), records)?;
        for socket in [options.jobs_socket(), options.queue_socket()] {
            let bytes = socket.as_os_str().len();
            if bytes >= limits::SOCKET_PATH_BYTES_MAX {
                return Err(ServerError::Option {
                    name: "--runtime-dir",
                    value: format!("{bytes} bytes long with the socket's name"),
                    expected: format!("shorter than {}", limits::SOCKET_PATH_BYTES_MAX),
                });
            }
        }
        options.check_roots()?;
        let memory = MemoryPlan::new(options.memory_bytes, workers, machine)?;
        let node_page = options.nodes_per_page as usize * size_of::<NodeRecord>();
        let point_page = options.points_per_page as usize * size_of::<PointRecord>();
        let loads = workers * limits::LOADS_PER_WORKER;
        let layout = CacheBudget::new(memory.segment_bytes, workers, node_page, point_page, loads).plan()?;
        Ok(Self {
            options,
            memory,
            layout,
        })
    }
}

impl Config {
    /// What the daemon will do and why, a line for each matter.
    pub fn explain(&self) -> Vec<String> {
        let (options, memory, access) = (&self.options, &self.memory, &self.options.access);
        let megabytes = |bytes: u64| bytes >> 20;
        let mut lines = vec![
            format!(
                "memory: {} MiB{}; {} MiB page cache, {} MiB builds and pictures, the rest for {} workers and the daemon",
                megabytes(memory.total_bytes),
                match options.memory_bytes {
                    Some(_) => "",
                    None => " (the smaller of 2G and four fifths of what the machine has to give)",
                },
                megabytes(memory.segment_bytes),
                megabytes(memory.work_bytes),
                options.workers,
            ),
            format!("clients: {}", options.jobs_socket().display()),
            format!("page and metrics: {}", options.http_socket().display()),
            format!("state: {}", options.state_dir.display()),
            format!("scratch: {}", options.scratch_dir.display()),
        ];
        let users: Vec<String> = access.users.iter().map(ToString::to_string).collect();
        if !users.is_empty() {
            lines.push(format!("users that may call besides ours: {}", users.join(" ")));
        }
        for (name, root) in &access.roots {
            let mut grants = Vec::new();
            for (granted, what) in [
                (root.read, "read"),
                (root.write, "write"),
                (root.overwrite, "overwrite"),
            ] {
                grants.extend(granted.then_some(what));
            }
            lines.push(format!("root {name}: {} ({})", root.path.display(), grants.join(", ")));
        }
        match &access.tcp {
            Some(tcp) if tcp.auth == Auth::DangerouslyInsecure => {
                lines.push(format!(
                    "TCP: {}, DANGEROUSLY INSECURE: anybody on this machine may call",
                    tcp.address
                ));
            }
            Some(tcp) => {
                let calls = |token: &Token| token.calls.iter().map(|call| call.name()).collect::<Vec<_>>().join("+");
                let tokens: Vec<String> = access.tokens().iter().map(calls).collect();
                let tokens = match tokens.as_slice() {
                    [] => String::new(),
                    tokens => format!(" and a token, which allows to {}", tokens.join(" or ")),
                };
                lines.push(format!("TCP: {}, mutual TLS{tokens}", tcp.address));
            }
            None => lines.push("TCP: off".to_owned()),
        }
        lines.extend(
            access
                .http
                .map(|address| format!("page and metrics also: http://{address}/")),
        );
        lines.extend(options.otlp.as_ref().map(|endpoint| format!("spans go to: {endpoint}")));
        lines.extend(
            options
                .idle
                .map(|idle| format!("exits after {} s without jobs", idle.as_secs())),
        );
        lines
    }
}

impl Options {
    /// The socket of the page and the metrics.
    pub fn http_socket(&self) -> PathBuf {
        self.runtime_dir.join("http.sock")
    }

    /// The socket of clients.
    pub fn jobs_socket(&self) -> PathBuf {
        self.runtime_dir.join("jobs.sock")
    }

    /// The socket of workers.
    pub fn queue_socket(&self) -> PathBuf {
        self.runtime_dir.join("queue.sock")
    }

    /// The log of a private daemon.
    pub fn log_file(&self) -> PathBuf {
        self.state_dir.join("server.log")
    }
}

fn range(name: &'static str, value: u64, allowed: std::ops::RangeInclusive<u64>) -> Result<u64, ServerError> {
    if allowed.contains(&value) {
        return Ok(value);
    }
    Err(ServerError::Option {
        name,
        value: value.to_string(),
        expected: format!("from {} to {}", allowed.start(), allowed.end()),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::access::{Call, Root, Tcp};

    const MACHINE: Machine = Machine {
        shared_free_bytes: 100 << 30,
        limit_bytes: None,
    };

    fn options() -> Options {
        Options::below(Path::new("/tmp/p"), "worker".into(), "server".into())
    }

    #[test]
    fn nonsense_is_refused_by_name() {
        type Change = fn(&mut Options);
        let cases: [(Change, &str); 4] = [
            (|o| o.workers = 0, "--workers is 0, must be from 1 to 64"),
            (|o| o.workers = 65, "--workers is 65"),
            (|o| o.nodes_per_page = 1, "--nodes-per-page is 1"),
            (
                |o| o.runtime_dir = "/tmp".repeat(30).into(),
                "--runtime-dir is 130 bytes long",
            ),
        ];
        for (change, text) in cases {
            let mut options = options();
            change(&mut options);
            let error = Config::new(options, &MACHINE).unwrap_err();
            assert!(error.to_string().contains(text), "{error}");
            assert_eq!(error.exit_code(), 2);
        }
    }

    #[test]
    fn budget_too_small_for_the_cache_is_refused_with_both_numbers() {
        let mut options = options();
        options.memory_bytes = Some(48 << 20);
        options.points_per_page = 131_072;
        let error = Config::new(options, &MACHINE).unwrap_err();
        assert_eq!(error.exit_code(), 78, "{error}");
    }

    #[test]
    fn root_that_overlaps_with_our_own_files_is_refused_whatever_link_leads_there() {
        let folder = tempfile::tempdir().unwrap();
        let shots = folder.path().join("shots");
        std::fs::create_dir(&shots).unwrap();
        std::os::unix::fs::symlink(folder.path(), folder.path().join("link")).unwrap();
        let mut options = Options::below(&folder.path().join("own"), "worker".into(), "server".into());
        let mut told = |root: &Path, change: fn(&mut Options, &Path)| {
            let root = Root {
                path: root.to_owned(),
                read: true,
                write: false,
                overwrite: false,
            };
            options.access.roots.insert("a".into(), root);
            change(&mut options, folder.path());
            let checked = Config::new(options.clone(), &MACHINE);
            checked.map_or_else(|error| error.to_string(), |_| String::new())
        };
        assert_eq!(told(&shots, |_, _| {}), "");
        // Above all three of our folders, below one, by a link; the state is in none of the keys of a file.
        assert_eq!(told(folder.path(), |_, _| {}).lines().count(), 3);
        assert!(told(&folder.path().join("own/state/deep"), |_, _| {}).contains("overlaps"));
        assert!(told(&folder.path().join("link/own/scratch"), |_, _| {}).contains("scratch"));
        let config = told(&shots, |options, folder| {
            options.config_file = Some(folder.join("link/shots/server.toml"));
        });
        assert!(config.contains("server.toml"), "{config}");
    }

    #[test]
    fn what_can_change_while_running_is_taken_over_and_the_rest_is_named() {
        let tls = |file: &str, address: &str| Tcp {
            address: address.parse().unwrap(),
            auth: Auth::MutualTls {
                cert: "/c".into(),
                key: "/k".into(),
                client_ca: "/a".into(),
                tokens: vec![Token {
                    file: file.into(),
                    calls: [Call::Look].into(),
                }],
            },
        };
        let mut old = options();
        old.access.tcp = Some(tls("/t", "127.0.0.1:1"));
        let mut new = old.clone();
        assert_eq!(old.take_over(&new), Changes::default());
        new.idle = Some(Duration::from_secs(1));
        new.access.tcp = Some(tls("/u", "127.0.0.1:1"));
        let changes = old.take_over(&new);
        assert_eq!(
            (changes.taken.as_slice(), changes.left.len()),
            (&["idle_seconds"][..], 0)
        );
        assert_eq!(old, new);
        (new.workers, new.memory_bytes) = (7, None);
        new.access.tcp = Some(tls("/u", "127.0.0.1:2"));
        let changes = old.take_over(&new);
        assert_eq!(changes.left, ["memory", "workers", "tcp"]);
        assert_eq!(old.workers, 1);
    }

    #[test]
    fn segment_stays_within_its_share() {
        let config = Config::new(options(), &MACHINE).unwrap();
        assert!(config.layout.total_bytes() <= config.memory.segment_bytes);
        assert!(config.layout.total_bytes() * 10 > config.memory.segment_bytes * 9);
    }
}
