//! [`ScratchDir`]: a job's private folder for runs, deleted when the job ends, swept when its process died.

use crate::error::StoreError;
use crate::limits::SCRATCH_MODE;
use crate::run::is_run_name;
use crate::temporary::{create_locked, is_suffix, remove_folder, unique_suffix};
use crate::volume::{EntryKind, Lock, Volume};
use std::ffi::OsStr;
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

/// What a sweep removed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Sweep {
    /// Folders.
    pub folders: usize,
    /// Bytes of the files in them.
    pub bytes: u64,
}

/// Removes the scratch folders of dead processes in `parent`: our pattern, not locked, nothing else in them.
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
            && let Ok(bytes) = remove_folder(volume, &path, &is_run_name)
        {
            sweep.folders += 1;
            sweep.bytes += bytes;
        }
    }
    Ok(sweep)
}

fn is_scratch_name(name: &OsStr) -> bool {
    name.as_bytes().strip_prefix(PREFIX.as_bytes()).is_some_and(is_suffix)
}
