//! [`ScratchDir`]: a job's private folder for runs, deleted when the job ends, taken over or swept when its process died.

use crate::data_file::write_error;
use crate::error::StoreError;
use crate::limits::{RUNS_KEPT, SCRATCH_MODE};
use crate::run::{Run, is_run_name, sealed_number};
use crate::temporary::{create_locked, is_suffix, remove_files, remove_folder, unique_suffix};
use crate::volume::{EntryKind, Lock, Volume};
use std::ffi::OsStr;
use std::io;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Scratch folders are this and sixteen hexadecimal digits.
const PREFIX: &str = "pbgi-scratch-";

/// A folder of this process alone, mode 0700, locked while it lives. Deleted on drop with the runs in it.
pub struct ScratchDir {
    volume: Arc<dyn Volume>,
    path: PathBuf,
    _lock: Lock,
}

impl ScratchDir {
    /// Creates a folder `pbgi-scratch-<hex>` in `parent`, which must exist.
    ///
    /// # Errors
    /// [`StoreError::NoSpace`], [`StoreError::Io`].
    pub fn create(volume: &Arc<dyn Volume>, parent: &Path) -> Result<Self, StoreError> {
        let (path, lock, ()) = create_locked(
            volume.as_ref(),
            || Ok(parent.join(format!("{PREFIX}{}", unique_suffix()))),
            |path| volume.create_dir(path, SCRATCH_MODE),
        )?;
        Ok(Self {
            volume: volume.clone(),
            path,
            _lock: lock,
        })
    }

    /// The folder of the work that `key` stands for, with the runs that a killed process left in it, or an empty one.
    /// While another process has it, a folder as [`Self::create`] makes.
    ///
    /// # Errors
    /// As [`Self::create`].
    pub fn create_or_adopt(volume: &Arc<dyn Volume>, parent: &Path, key: u64) -> Result<Self, StoreError> {
        let path = parent.join(format!("{PREFIX}{key:016x}"));
        match volume.create_dir(&path, SCRATCH_MODE) {
            Ok(()) => {}
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
            Err(error) => return Err(write_error(volume.as_ref(), "create folder", &path, 0, error)),
        }
        let locked = volume.try_lock(&path).and_then(|lock| Ok((lock, volume.kind(&path)?)));
        match locked {
            Ok((Some(lock), Some(_))) => Ok(Self {
                volume: volume.clone(),
                path,
                _lock: lock,
            }),
            // Somebody else has it, or swept it in between.
            Ok(_) => Self::create(volume, parent),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Self::create(volume, parent),
            Err(error) => Err(StoreError::io("lock scratch", &path, error)),
        }
    }

    /// The sealed runs in it by number, each with what its writer noted. Every other file goes.
    ///
    /// # Errors
    /// [`StoreError::Io`] if the folder cannot be read or cleaned.
    pub fn sealed_runs(&self) -> Result<Vec<(Run, Vec<u8>)>, StoreError> {
        let entries = self.volume.list(&self.path);
        let entries = entries.map_err(|error| StoreError::io("list folder", &self.path, error))?;
        let numbers = entries.iter().filter_map(|entry| sealed_number(&entry.name));
        let mut runs: Vec<_> = numbers.filter_map(|number| Run::reopen(self, number)).collect();
        runs.sort_unstable_by_key(|(run, _)| run.number());
        let keep: Vec<_> = runs.iter().flat_map(|(run, _)| run.names()).collect();
        let other = |name: &OsStr| is_run_name(name) && !keep.contains(&self.path.join(name));
        let cleaned = remove_files(self.volume.as_ref(), &self.path, &other);
        cleaned.map_err(|error| StoreError::io("clean scratch", &self.path, error))?;
        Ok(runs)
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    pub(crate) fn volume(&self) -> &Arc<dyn Volume> {
        &self.volume
    }

    /// Bytes that may still be written here.
    ///
    /// # Errors
    /// [`StoreError::Io`].
    pub fn free_bytes(&self) -> Result<u64, StoreError> {
        self.volume
            .free_bytes(&self.path)
            .map_err(|error| StoreError::io("read free space", &self.path, error))
    }
}

impl Drop for ScratchDir {
    fn drop(&mut self) {
        // A leftover is swept at the next start.
        let _ = remove_folder(self.volume.as_ref(), &self.path, &is_run_name);
    }
}

/// What a sweep did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Sweep {
    /// Folders removed.
    pub folders: usize,
    /// Bytes removed.
    pub bytes: u64,
    /// Folders that stay because a build can go on from the runs in them.
    pub kept: usize,
}

/// Removes the scratch folders of dead processes in `parent`: our pattern, not locked, nothing else in them. Folders with
/// sealed runs stay for [`RUNS_KEPT`]: the build that is submitted again goes on from them.
///
/// # Errors
/// [`StoreError::Io`] if `parent` cannot be listed; folders that resist are skipped.
pub fn sweep_scratch(volume: &dyn Volume, parent: &Path) -> Result<Sweep, StoreError> {
    let entries = volume
        .list(parent)
        .map_err(|error| StoreError::io("list folder", parent, error))?;
    let mut sweep = Sweep::default();
    for entry in entries {
        let path = parent.join(&entry.name);
        if entry.kind == EntryKind::Folder
            && is_scratch_name(&entry.name)
            && let Ok(Some(_lock)) = volume.try_lock(&path)
        {
            if is_resumable(volume, &path) {
                sweep.kept += 1;
            } else if let Ok(bytes) = remove_folder(volume, &path, &is_run_name) {
                sweep.folders += 1;
                sweep.bytes += bytes;
            }
        }
    }
    Ok(sweep)
}

fn is_resumable(volume: &dyn Volume, path: &Path) -> bool {
    let sealed = || {
        Ok(volume
            .list(path)?
            .iter()
            .any(|entry| sealed_number(&entry.name).is_some()))
    };
    let young = || Ok(volume.age(path)? < RUNS_KEPT);
    let holds = |answer: io::Result<bool>| answer.unwrap_or(false);
    holds(sealed()) && holds(young())
}

fn is_scratch_name(name: &OsStr) -> bool {
    name.as_bytes().strip_prefix(PREFIX.as_bytes()).is_some_and(is_suffix)
}
