//! Harness for tests that need more than one process: a private daemon in a fresh directory, driven through the command
//! line as a user would, and the picture files it leaves.
//!
//! Start at [`House`]. Nothing here reaches into the daemon: what a test sees is what a user sees.
#![forbid(unsafe_code)]
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a harness fails by panicking"
)]

mod disk;
mod house;
mod picture;
mod scene;

pub use disk::forget;
pub use house::{DAEMON, House, Job, PATIENCE, Run, program, signal, wait_for, workspace_root};
pub use nix::sys::signal::Signal;
pub use picture::{Picture, SHADED, assert_same, assert_same_values, relative_rms, rms};
pub use scene::{flip_bit, load, page_count};

use std::path::PathBuf;

/// A file of the shared real-world data, or `None` with a loud word that the test was skipped.
pub fn shared(path: &str) -> Option<PathBuf> {
    // Beside the workspace, or beside a folder that it lies in.
    let root = workspace_root();
    let found = root.ancestors().skip(1).map(|folder| folder.join("shared").join(path));
    if let Some(file) = found.into_iter().find(|file| file.metadata().is_ok()) {
        return Some(file.canonicalize().unwrap());
    }
    eprintln!(
        "SKIPPED: shared/{path} is not there (looked beside {} and upwards)",
        root.display()
    );
    None
}
