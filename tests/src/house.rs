//! A house of its own for every test: fresh folders, a private daemon, and a look around when it is over.

use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::OnceLock;

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
        let mut command = Command::new(program("pbgi-client"));
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

    /// Ends every daemon of the house in good order.
    pub fn shutdown(&self) {
        for (pid, command) in self.processes() {
            if command.contains("pbgi-server") && !command.contains("build-child") {
                let _ = nix::sys::signal::kill(nix::unistd::Pid::from_raw(pid), nix::sys::signal::Signal::SIGTERM);
            }
        }
        for _ in 0..1_000 {
            if self.processes().is_empty() {
                return;
            }
            std::thread::sleep(std::time::Duration::from_millis(10));
        }
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
            let _ = nix::sys::signal::kill(nix::unistd::Pid::from_raw(*pid), nix::sys::signal::Signal::SIGKILL);
        }
        if !std::thread::panicking() {
            assert!(left.is_empty(), "processes outlived the test: {left:?}");
        }
    }
}
