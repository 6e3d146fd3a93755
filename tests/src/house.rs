//! A house of its own for every test: fresh folders, a private daemon, and a look around when it is over.

use nix::sys::signal::Signal;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

/// Options of the daemon that most tests share: small, with two workers.
pub const DAEMON: &str = "--memory 256M --workers 2";
/// How long anything is waited for that must come: far longer than it takes, for a machine that does much else.
pub const PATIENCE: Duration = Duration::from_secs(60);

/// The workspace's root.
pub fn workspace_root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().to_path_buf()
}

/// A program of the workspace, built if need be: `cargo test` builds no programs for a crate that only tests.
pub fn program(name: &str) -> PathBuf {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    let folder = FOLDER.get_or_init(|| {
        // Test executables lie in target/PROFILE/deps.
        let test = std::env::current_exe().unwrap();
        let folder = test.parent().unwrap().parent().unwrap().to_path_buf();
        let mut cargo = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
        cargo
            .current_dir(workspace_root())
            .args(["build", "--workspace", "--bins", "--locked", "--quiet"]);
        if !cfg!(debug_assertions) {
            cargo.arg("--release");
        }
        // What cargo tells a test of its package would tell the build scripts of others that their surroundings changed:
        // they, and all that depends on them, would be built again.
        for (name, _) in std::env::vars_os() {
            if name.to_string_lossy().starts_with("CARGO_PKG_") || name.to_string_lossy().starts_with("CARGO_MANIFEST_")
            {
                cargo.env_remove(name);
            }
        }
        assert!(cargo.status().unwrap().success(), "the programs do not build");
        folder
    });
    folder.join(name)
}

/// Fresh folders for one test. Its daemons end and everything is looked over when it is dropped.
pub struct House {
    root: tempfile::TempDir,
}

/// How one command ended.
#[derive(Debug)]
pub struct Run {
    /// Exit code; `None` when a signal ended it.
    pub code: Option<i32>,
    /// Standard output.
    pub stdout: String,
    /// Standard error.
    pub stderr: String,
}

impl Run {
    /// Asserts success.
    #[track_caller]
    pub fn ok(self) -> Self {
        assert_eq!(self.code, Some(0), "{}\n{}", self.stdout, self.stderr);
        self
    }

    /// Asserts failure with one clear error that names every one of `words`.
    #[track_caller]
    pub fn fails_naming(self, words: &[&str]) -> Self {
        assert!(matches!(self.code, Some(code) if code != 0), "{self:?}");
        assert!(!self.stderr.contains("panicked"), "{}", self.stderr);
        for word in words {
            assert!(self.stderr.contains(word), "no {word:?} in: {}", self.stderr);
        }
        self
    }
}

/// A command that was started; it is waited for with [`Job::end`] and killed if it is dropped before.
#[derive(Debug)]
pub struct Job(Child);

impl Job {
    /// Whether it still runs.
    pub fn runs(&mut self) -> bool {
        self.0.try_wait().unwrap().is_none()
    }

    /// Waits for its end.
    pub fn end(mut self) -> Run {
        let read = |pipe: &mut dyn Read| {
            let mut bytes = vec![];
            pipe.read_to_end(&mut bytes).unwrap();
            String::from_utf8_lossy(&bytes).into_owned()
        };
        // What a command says fits a pipe, so one after the other will do.
        let stderr = read(self.0.stderr.as_mut().unwrap());
        let stdout = read(self.0.stdout.as_mut().unwrap());
        let code = self.0.wait().unwrap().code();
        Run { code, stdout, stderr }
    }
}

impl Drop for Job {
    fn drop(&mut self) {
        // It may have ended in good order.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Sends a signal; the process may be gone.
pub fn signal(pid: i32, signal: Signal) {
    let _ = nix::sys::signal::kill(nix::unistd::Pid::from_raw(pid), signal);
}

/// Looks every 10 ms whether something holds; false if it never did.
pub fn wait_for(most: Duration, mut holds: impl FnMut() -> bool) -> bool {
    let deadline = Instant::now() + most;
    loop {
        if holds() {
            return true;
        }
        if Instant::now() > deadline {
            return false;
        }
        std::thread::sleep(Duration::from_millis(10));
    }
}

impl From<Output> for Run {
    fn from(output: Output) -> Self {
        Self {
            code: output.status.code(),
            stdout: String::from_utf8_lossy(&output.stdout).into_owned(),
            stderr: String::from_utf8_lossy(&output.stderr).into_owned(),
        }
    }
}

impl House {
    /// A new house.
    pub fn new() -> Self {
        let root = tempfile::Builder::new().prefix("pbgi-test-").tempdir().unwrap();
        for folder in ["home", "run"] {
            std::fs::create_dir(root.path().join(folder)).unwrap();
        }
        Self { root }
    }

    /// A path in the house.
    pub fn path(&self, name: &str) -> PathBuf {
        self.root.path().join(name)
    }

    /// The command line, ready for arguments, with an environment that leads nowhere but here.
    pub fn client(&self) -> Command {
        self.command(program("pbgi-client"))
    }

    /// Another program in the same environment.
    pub fn command(&self, program: impl AsRef<std::ffi::OsStr>) -> Command {
        let mut command = Command::new(program);
        command.env_clear().current_dir(self.root.path()).stdin(Stdio::null());
        for variable in ["PATH", "RUST_LOG", "RUST_BACKTRACE"] {
            if let Some(value) = std::env::var_os(variable) {
                command.env(variable, value);
            }
        }
        command
            .env("HOME", self.path("home"))
            .env("PBGI_RUNTIME_DIR", self.path("run"));
        for variable in ["XDG_STATE_HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME"] {
            command.env(variable, self.path("home").join(variable));
        }
        command
    }

    /// Runs the command line to its end.
    pub fn run<S: AsRef<std::ffi::OsStr>>(&self, arguments: impl IntoIterator<Item = S>) -> Run {
        self.client().args(arguments).output().unwrap().into()
    }

    /// Runs the command line with arguments separated by blanks.
    pub fn line(&self, line: &str) -> Run {
        self.run(line.split_whitespace())
    }

    /// Starts the command line with arguments separated by blanks, and lets it run.
    pub fn start(&self, line: &str) -> Job {
        let mut command = self.client();
        command.args(line.split_whitespace());
        command.stdout(Stdio::piped()).stderr(Stdio::piped());
        Job(command.spawn().unwrap())
    }

    /// Makes the demo's room: `demo.glb`, its points `demo.ply`, its passes `g.exr`, and the octree `demo.pbgi`.
    pub fn furnish(&self, points: u32, size: &str) {
        pbgi_points::demo::write_glb(&self.path("demo.glb")).unwrap();
        self.line(&format!("sample demo.glb -o demo.ply --points {points}"))
            .ok();
        self.line(&format!("gbuffer demo.glb -o g.exr --size {size}")).ok();
        self.line(&format!("build demo.ply -o demo.pbgi {DAEMON}")).ok();
    }

    /// The statistics a command wrote with `--stats`.
    pub fn statistics(&self, name: &str) -> serde_json::Value {
        serde_json::from_str(&std::fs::read_to_string(self.path(name)).unwrap()).unwrap()
    }

    /// Ids of the processes that belong to this house: those with its path on their command line or in their environment.
    pub fn processes(&self) -> Vec<(i32, String)> {
        let mark = self.root.path().to_string_lossy().into_owned();
        let own = i32::try_from(std::process::id()).unwrap();
        let mut found = vec![];
        for entry in std::fs::read_dir("/proc").unwrap().flatten() {
            let Ok(pid) = entry.file_name().to_string_lossy().parse::<i32>() else {
                continue;
            };
            let text = |file: &str| {
                let bytes = std::fs::read(entry.path().join(file)).unwrap_or_default();
                String::from_utf8_lossy(&bytes).replace('\0', " ")
            };
            let command = text("cmdline");
            if pid != own && (command.contains(&mark) || text("environ").contains(&mark)) {
                found.push((pid, command));
            }
        }
        found
    }

    /// Ids of the house's processes that run this program for the long term: no build child, no command line.
    pub fn running(&self, program: &str) -> Vec<i32> {
        let found = self.processes().into_iter();
        let mine = |command: &String| {
            let name = command.split(' ').next().unwrap_or_default();
            name.ends_with(program) && !command.contains("build-child")
        };
        let found: Vec<i32> = found.filter(|(_, command)| mine(command)).map(|(pid, _)| pid).collect();
        let parent = |pid: i32| {
            let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
            stat.rsplit(')').next()?.split_whitespace().nth(1)?.parse::<i32>().ok()
        };
        // Between fork and exec a worker has the command line of its daemon.
        let child = |pid: i32| parent(pid).is_some_and(|parent| found.contains(&parent));
        found.iter().copied().filter(|&pid| !child(pid)).collect()
    }

    /// Shared memory segments that the house's state files name: state file and segment.
    pub fn segments(&self) -> Vec<(PathBuf, PathBuf)> {
        let state = self.path("home").join("XDG_STATE_HOME/pbgi");
        let notes = std::fs::read_dir(state).into_iter().flatten().flatten();
        let named = notes.filter_map(|seat| {
            let note = seat.path().join("segment");
            let name = std::fs::read_to_string(&note).ok()?;
            Some((note, Path::new("/dev/shm").join(name.trim().trim_start_matches('/'))))
        });
        named.collect()
    }

    /// Share of a running shading job, from 0 to 1: what `jobs` says; `None` if none runs.
    pub fn share(&self) -> Option<f64> {
        let jobs = self.line("jobs").ok().stdout;
        let mut fields = jobs.lines().map(|line| line.split_whitespace());
        let mut running = fields.find(|fields| {
            let mut fields = fields.clone();
            fields.next().is_some_and(|id| id.starts_with("shade-")) && fields.next() == Some("running")
        })?;
        let share = running.nth(2)?.trim_end_matches('%').parse::<f64>().ok()?;
        Some(share / 100.0)
    }

    /// Stops the workers if a shading job has some tiles done and others outstanding, and returns their process ids. They
    /// are stopped before we look, so that what is outstanding stays so; without such a job they go on.
    pub fn stop_workers(&self) -> Option<Vec<i32>> {
        let workers = self.running("pbgi-worker");
        for &pid in &workers {
            signal(pid, Signal::SIGSTOP);
        }
        if !workers.is_empty() && self.share().is_some_and(|share| share > 0.0 && share < 1.0) {
            return Some(workers);
        }
        for &pid in &workers {
            signal(pid, Signal::SIGCONT);
        }
        None
    }

    /// Kills workers while a shading job has tiles outstanding, one or all of them, and returns the process ids of those
    /// that there were. Nobody is killed without such a job.
    pub fn kill_workers(&self, all: bool) -> Option<Vec<i32>> {
        let workers = self.stop_workers()?;
        for (index, &pid) in workers.iter().enumerate() {
            signal(
                pid,
                if all || index == 0 {
                    Signal::SIGKILL
                } else {
                    Signal::SIGCONT
                },
            );
        }
        Some(workers)
    }

    /// Ends every daemon of the house in good order.
    pub fn shutdown(&self) {
        for pid in self.running("pbgi-server") {
            signal(pid, Signal::SIGTERM);
        }
        wait_for(PATIENCE, || self.processes().is_empty());
    }
}

impl Default for House {
    fn default() -> Self {
        Self::new()
    }
}

impl Drop for House {
    fn drop(&mut self) {
        self.shutdown();
        let left = self.processes();
        for (pid, _) in &left {
            signal(*pid, Signal::SIGKILL);
        }
        if !std::thread::panicking() {
            assert!(left.is_empty(), "processes outlived the test: {left:?}");
        }
    }
}
