//! The state directory: proof that we are the only daemon, and the note that tells the next one what to clean up.
//!
//! The order is: lock, unlink the segment that the note names, write the new name, create the segment. So no death can leave
//! a segment that no note names.

use crate::error::ServerError;
use nix::fcntl::{Flock, FlockArg};
use pbgi_cache::Segment;
use std::fs::{self, DirBuilder, File, OpenOptions};
use std::io::{self, Read, Write};
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

/// The held state directory.
#[derive(Debug)]
pub struct StateDir {
    path: PathBuf,
    _lock: Flock<File>,
}

impl StateDir {
    /// Takes the directory, which must exist.
    ///
    /// # Errors
    /// [`ServerError::InUse`] if another daemon has it.
    pub fn take(path: &Path) -> Result<Self, ServerError> {
        let lock_path = path.join("lock");
        let file = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .mode(0o600)
            .open(&lock_path)
            .map_err(ServerError::io("open lock", &lock_path))?;
        let mut lock = match Flock::lock(file, FlockArg::LockExclusiveNonblock) {
            Ok(lock) => lock,
            Err((mut file, nix::errno::Errno::EWOULDBLOCK)) => {
                let mut pid = String::new();
                let read = Read::by_ref(&mut file).take(32).read_to_string(&mut pid);
                let known = read.is_ok() && !pid.trim().is_empty();
                let holder = if known {
                    format!("pbgi-server with process id {}", pid.trim())
                } else {
                    "another pbgi-server".into()
                };
                let path = path.to_owned();
                return Err(ServerError::InUse { holder, path });
            }
            Err((_, errno)) => return Err(ServerError::io("lock", &lock_path)(errno.into())),
        };
        lock.set_len(0)
            .and_then(|()| writeln!(lock, "{}", std::process::id()))
            .map_err(ServerError::io("write lock", &lock_path))?;
        Ok(Self {
            path: path.to_owned(),
            _lock: lock,
        })
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    fn note(&self) -> PathBuf {
        self.path.join("segment")
    }

    /// Removes the segment of a daemon that died, if the note names one. Returns its name.
    ///
    /// # Errors
    /// The note cannot be read or the segment not be removed. A note that names no segment of ours is ignored.
    pub fn sweep_segment(&self) -> Result<Option<String>, ServerError> {
        let note = self.note();
        let name = match fs::read_to_string(&note) {
            Ok(text) => text.trim().to_owned(),
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(error) if error.kind() == io::ErrorKind::InvalidData => return Ok(None),
            Err(error) => return Err(ServerError::io("read state", &note)(error)),
        };
        match Segment::unlink(&name) {
            Ok(true) => Ok(Some(name)),
            Ok(false) | Err(pbgi_cache::CacheError::Name { .. }) => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    /// Notes the name of the segment that is about to be created.
    ///
    /// # Errors
    /// A failing disk.
    pub fn note_segment(&self, name: &str) -> Result<(), ServerError> {
        let note = self.note();
        let written = OpenOptions::new()
            .write(true)
            .create(true)
            .truncate(true)
            .mode(0o600)
            .open(&note)
            .and_then(|mut file| {
                file.write_all(name.as_bytes())?;
                file.sync_all()
            });
        written.map_err(ServerError::io("write state", &note))
    }

    /// Removes the note: there is no segment any more.
    pub fn forget_segment(&self) {
        // A note that stays names a segment that is gone, which the next start finds out.
        let _ = fs::remove_file(self.note());
    }
}

/// Makes the directories, readable by us alone.
///
/// # Errors
/// [`ServerError::Directories`] with a line for each that cannot be used.
pub fn make_directories(paths: &[&Path]) -> Result<(), ServerError> {
    let mut problems = Vec::new();
    for path in paths {
        let made = DirBuilder::new().recursive(true).mode(0o700).create(path);
        let usable = made.and_then(|()| {
            let probe = path.join(format!(".probe-{}", std::process::id()));
            File::create(&probe)?;
            fs::remove_file(&probe)
        });
        if let Err(error) = usable {
            problems.push(format!("cannot use directory: {error}, at {}", path.display()));
        }
    }
    if problems.is_empty() {
        Ok(())
    } else {
        Err(ServerError::Directories(problems))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn second_holder_is_refused_and_told_who_the_first_is() {
        let folder = tempfile::tempdir().unwrap();
        let first = StateDir::take(folder.path()).unwrap();
        let error = StateDir::take(folder.path()).unwrap_err();
        assert_eq!(error.exit_code(), 2);
        assert!(
            error
                .to_string()
                .contains(&format!("process id {}", std::process::id())),
            "{error}"
        );
        drop(first);
        StateDir::take(folder.path()).unwrap();
    }

    #[test]
    fn note_that_names_no_segment_of_ours_is_ignored() {
        let folder = tempfile::tempdir().unwrap();
        let state = StateDir::take(folder.path()).unwrap();
        assert_eq!(state.sweep_segment().unwrap(), None);
        state.note_segment("../../etc/passwd").unwrap();
        assert_eq!(state.sweep_segment().unwrap(), None);
        state.note_segment(&Segment::unique_name().unwrap()).unwrap();
        assert_eq!(state.sweep_segment().unwrap(), None);
    }

    #[test]
    fn every_unusable_directory_is_named_at_once() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        fs::write(&file, "").unwrap();
        let below = file.join("below");
        let good = folder.path().join("good/deep");
        let error = make_directories(&[&file, &good, &below]).unwrap_err();
        assert_eq!(error.to_string().lines().count(), 2, "{error}");
        assert_eq!(fs::read_dir(good).unwrap().count(), 0);
    }
}
