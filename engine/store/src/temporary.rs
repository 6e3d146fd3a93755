//! Names of things that are not finished, how they become final, and how leftovers are found.
//!
//! A temporary is `NAME.tmp-` and sixteen hexadecimal digits beside its target, locked by its owner while that one
//! lives.

use crate::atomic_file::Overwrite;
use crate::data_file::{retry, write_error};
use crate::error::StoreError;
use crate::limits::RACE_ATTEMPTS;
use crate::manifest::MANIFEST_NAME;
use crate::scene::{NODES_NAME, POINTS_NAME};
use crate::volume::{EntryKind, Lock, RenameMode, Volume, parent};
use std::collections::hash_map::RandomState;
use std::ffi::{OsStr, OsString};
use std::hash::{BuildHasher, Hasher};
use std::io;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};

const MARK: &str = ".tmp-";
const DIGITS: usize = 16;

/// Sixteen digits that no two calls share, save by a chance of 2^-64.
pub(crate) fn unique_suffix() -> String {
    let mut hasher = RandomState::new().build_hasher();
    hasher.write_u32(std::process::id());
    format!("{:016x}", hasher.finish())
}

/// A temporary name beside `target`.
pub(crate) fn temporary_path(target: &Path) -> Result<PathBuf, StoreError> {
    let Some(name) = target.file_name() else {
        return Err(StoreError::Invalid(format!("{} names no file", target.display())));
    };
    let mut temporary = OsString::from(name);
    temporary.push(MARK);
    temporary.push(unique_suffix());
    Ok(target.with_file_name(temporary))
}

/// Whether `name` is a temporary of `target_name`.
fn is_temporary_of(name: &OsStr, target_name: &OsStr) -> bool {
    name.as_bytes()
        .strip_prefix(target_name.as_bytes())
        .and_then(|rest| rest.strip_prefix(MARK.as_bytes()))
        .is_some_and(is_suffix)
}

pub(crate) fn is_suffix(digits: &[u8]) -> bool {
    digits.len() == DIGITS && digits.iter().all(|d| matches!(d, b'0'..=b'9' | b'a'..=b'f'))
}

/// Creates something under a fresh temporary name and locks it. The sweep of another process may remove it in between:
/// then the next name is tried.
pub(crate) fn create_locked<T>(
    volume: &dyn Volume,
    mut name: impl FnMut() -> Result<PathBuf, StoreError>,
    mut create: impl FnMut(&Path) -> io::Result<T>,
) -> Result<(PathBuf, Lock, T), StoreError> {
    for _ in 0..RACE_ATTEMPTS {
        let path = name()?;
        let created = match create(&path) {
            Ok(created) => created,
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => continue,
            Err(error) => return Err(write_error(volume, "create temporary", &path, 0, error)),
        };
        let locked = retry(|| volume.try_lock(&path)).and_then(|lock| Ok((lock, retry(|| volume.kind(&path))?)));
        match locked {
            Ok((Some(lock), Some(_))) => return Ok((path, lock, created)),
            Ok(_) => {}
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) => {
                // Nothing is in it yet; an unlocked leftover is swept later if this fails as well.
                let _ = volume.remove_file(&path).or_else(|_| volume.remove_dir(&path));
                return Err(StoreError::io("lock temporary", &path, error));
            }
        }
    }
    let path = name()?;
    Err(StoreError::Foreign {
        reason: "no temporary can be created: every one was taken away".to_owned(),
        path,
    })
}

/// Gives a finished and synced temporary its final name. On success the old content, if there was any, has the
/// temporary name.
///
/// # Errors
/// [`StoreError::Exists`] and others; the final name is then as it was before.
pub(crate) fn publish(
    volume: &dyn Volume,
    temporary: &Path,
    target: &Path,
    overwrite: Overwrite,
) -> Result<(), StoreError> {
    let exists = || StoreError::Exists {
        path: target.to_owned(),
    };
    for _ in 0..RACE_ATTEMPTS {
        match volume.rename(temporary, target, RenameMode::NoReplace) {
            Ok(()) => return settle(volume, temporary, target, RenameMode::NoReplace),
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
            Err(error) => return Err(write_error(volume, "publish", target, 0, error)),
        }
        if overwrite == Overwrite::Refuse {
            return Err(exists());
        }
        check_replaceable(volume, temporary, target)?;
        match volume.rename(temporary, target, RenameMode::Exchange) {
            Ok(()) => return settle(volume, temporary, target, RenameMode::Exchange),
            // The old one vanished in between.
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) => return Err(write_error(volume, "publish", target, 0, error)),
        }
    }
    Err(exists())
}

/// Makes the new name durable, or takes it back.
fn settle(volume: &dyn Volume, temporary: &Path, target: &Path, mode: RenameMode) -> Result<(), StoreError> {
    volume.sync_dir(parent(target)).map_err(|error| {
        // If this fails too, a complete and checked result stays visible, which is the lesser evil.
        let _ = volume.rename(target, temporary, mode);
        write_error(volume, "sync folder", parent(target), 0, error)
    })
}

/// Refuses to replace, hence to delete, anything that is not of our own making.
pub(crate) fn check_replaceable(volume: &dyn Volume, like: &Path, target: &Path) -> Result<(), StoreError> {
    let kind = |path: &Path| retry(|| volume.kind(path)).map_err(|error| StoreError::io("inspect", path, error));
    let foreign = |reason: &str| {
        Err(StoreError::Foreign {
            reason: reason.to_owned(),
            path: target.to_owned(),
        })
    };
    let Some(target_kind) = kind(target)? else {
        return Ok(());
    };
    if Some(target_kind) != kind(like)? {
        return foreign("not replaced, because it is not of the kind that is written");
    }
    if target_kind == EntryKind::Folder {
        let entries = retry(|| volume.list(target)).map_err(|error| StoreError::io("list folder", target, error))?;
        if !entries.iter().all(|entry| is_scene_file(&entry.name)) {
            return foreign("not replaced, because the folder holds files that no scene has");
        }
    }
    Ok(())
}

fn is_scene_file(name: &OsStr) -> bool {
    [MANIFEST_NAME, NODES_NAME, POINTS_NAME]
        .iter()
        .any(|known| name == OsStr::new(known))
}

/// Removes a temporary file, or a temporary folder of a scene; what is gone already is fine.
pub(crate) fn remove_temporary(volume: &dyn Volume, path: &Path) -> io::Result<()> {
    match retry(|| volume.kind(path))? {
        None => Ok(()),
        Some(EntryKind::Folder) => remove_folder(volume, path, &is_scene_file).map(drop),
        Some(_) => gone_is_fine(retry(|| volume.remove_file(path))),
    }
}

/// Removes a folder and the files in it that `ours` knows; one with other content stays. Returns the bytes freed.
pub(crate) fn remove_folder(volume: &dyn Volume, path: &Path, ours: &dyn Fn(&OsStr) -> bool) -> io::Result<u64> {
    let freed = remove_files(volume, path, ours)?;
    gone_is_fine(retry(|| volume.remove_dir(path)))?;
    Ok(freed)
}

/// Removes the files in a folder that `ours` knows. Returns the bytes freed.
pub(crate) fn remove_files(volume: &dyn Volume, path: &Path, ours: &dyn Fn(&OsStr) -> bool) -> io::Result<u64> {
    let mut freed = 0;
    for entry in retry(|| volume.list(path))? {
        if entry.kind == EntryKind::File && ours(&entry.name) {
            let file = path.join(&entry.name);
            let bytes = volume.open(&file).and_then(|storage| storage.byte_len()).unwrap_or(0);
            gone_is_fine(retry(|| volume.remove_file(&file)))?;
            freed += bytes;
        }
    }
    Ok(freed)
}

fn gone_is_fine(result: io::Result<()>) -> io::Result<()> {
    match result {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        result => result,
    }
}

/// Removes what dead processes left of `target` beside it: our pattern, not locked, nothing else. Returns how many.
///
/// # Errors
/// [`StoreError::Io`] if the folder cannot be listed; leftovers that resist are skipped.
pub fn sweep_temporaries(volume: &dyn Volume, target: &Path) -> Result<usize, StoreError> {
    let (dir, Some(name)) = (parent(target), target.file_name()) else {
        return Ok(0);
    };
    let entries = retry(|| volume.list(dir)).map_err(|error| StoreError::io("list folder", dir, error))?;
    let mut removed = 0;
    for entry in entries.iter().filter(|entry| is_temporary_of(&entry.name, name)) {
        let path = dir.join(&entry.name);
        if entry.kind != EntryKind::Other
            && let Ok(Some(_lock)) = volume.try_lock(&path)
            && remove_temporary(volume, &path).is_ok()
        {
            removed += 1;
        }
    }
    Ok(removed)
}
