//! [`DataFile`]: an open file with its name, that retries reads and never goes on after a failed write.

use crate::error::StoreError;
use crate::limits::{READ_ATTEMPTS, READ_BACKOFF};
use crate::volume::{IoMode, Storage, Volume, parent};
use nix::errno::Errno;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// An open file of any volume. Errors name it.
pub struct DataFile {
    storage: Box<dyn Storage>,
    volume: Arc<dyn Volume>,
    path: PathBuf,
    /// Set by the first write or sync that failed: what the file holds is unknown from then on (reliability rule F2).
    abandoned: AtomicBool,
}

impl DataFile {
    /// Creates a new file.
    ///
    /// # Errors
    /// [`StoreError::Exists`], [`StoreError::NoSpace`], [`StoreError::Io`].
    pub fn create_new(volume: &Arc<dyn Volume>, path: &Path, mode: IoMode) -> Result<Self, StoreError> {
        let storage = volume
            .create_new(path, mode)
            .map_err(|error| write_error(volume.as_ref(), "create file", path, 0, error))?;
        Ok(Self::new(volume, path, storage))
    }

    /// Opens a file for reading.
    ///
    /// # Errors
    /// [`StoreError::Io`].
    pub fn open(volume: &Arc<dyn Volume>, path: &Path) -> Result<Self, StoreError> {
        let storage = retry(|| volume.open(path)).map_err(|error| StoreError::io("open file", path, error))?;
        Ok(Self::new(volume, path, storage))
    }

    /// Wraps a file that `volume` opened or created as `path`.
    pub fn new(volume: &Arc<dyn Volume>, path: &Path, storage: Box<dyn Storage>) -> Self {
        Self {
            storage,
            volume: volume.clone(),
            path: path.to_owned(),
            abandoned: AtomicBool::new(false),
        }
    }

    /// The file's name when it was opened.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Length in bytes.
    ///
    /// # Errors
    /// [`StoreError::Io`].
    pub fn byte_len(&self) -> Result<u64, StoreError> {
        self.storage
            .byte_len()
            .map_err(|error| StoreError::io("read length of file", &self.path, error))
    }

    /// Fills `out` from `offset`, trying again where the failure may pass. `place` names the part for the error.
    ///
    /// # Errors
    /// [`StoreError::Corrupt`] if the file ends too early, [`StoreError::Io`].
    pub fn read_at(&self, offset: u64, out: &mut [u8], place: &dyn Fn() -> String) -> Result<(), StoreError> {
        retry(|| self.storage.read_at(offset, out)).map_err(|error| {
            if error.kind() == io::ErrorKind::UnexpectedEof {
                let expected = format!("at least {} bytes", offset + out.len() as u64);
                let actual = self
                    .storage
                    .byte_len()
                    .map_or("fewer".to_owned(), |len| len.to_string());
                StoreError::corrupt(&self.path, place(), expected, actual)
            } else {
                StoreError::io("read file", &self.path, error)
            }
        })
    }

    /// Has the operating system begin to read what will be read soon; returns at once.
    pub fn will_need(&self, offset: u64, bytes: u64) {
        self.storage.will_need(offset, bytes);
    }

    /// Writes all of `data` at `offset`.
    ///
    /// # Errors
    /// [`StoreError::NoSpace`], [`StoreError::Io`], and [`StoreError::Abandoned`] ever after.
    pub fn write_at(&self, offset: u64, data: &[u8]) -> Result<(), StoreError> {
        self.guarded("write file", data.len() as u64, || self.storage.write_at(offset, data))
    }

    /// Returns once the content would survive a power loss.
    ///
    /// # Errors
    /// As [`Self::write_at`].
    pub fn sync(&self) -> Result<(), StoreError> {
        self.guarded("sync file", 0, || self.storage.sync())
    }

    fn guarded(
        &self,
        action: &'static str,
        needed: u64,
        operation: impl FnOnce() -> io::Result<()>,
    ) -> Result<(), StoreError> {
        if self.abandoned.load(Ordering::Acquire) {
            return Err(StoreError::Abandoned {
                path: self.path.clone(),
            });
        }
        operation().map_err(|error| {
            self.abandoned.store(true, Ordering::Release);
            write_error(self.volume.as_ref(), action, &self.path, needed, error)
        })
    }
}

/// Turns the failure of an operation that makes or fills something into the error a caller can act on.
pub(crate) fn write_error(
    volume: &dyn Volume,
    action: &'static str,
    path: &Path,
    needed: u64,
    error: io::Error,
) -> StoreError {
    match error.kind() {
        io::ErrorKind::AlreadyExists => StoreError::Exists { path: path.to_owned() },
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => StoreError::NoSpace {
            needed,
            free: volume.free_bytes(parent(path)).unwrap_or(0),
            path: path.to_owned(),
        },
        _ => StoreError::io(action, path, error),
    }
}

/// Tries again after the three failures that may pass by themselves.
pub(crate) fn retry<T>(mut operation: impl FnMut() -> io::Result<T>) -> io::Result<T> {
    let mut pause = READ_BACKOFF;
    for _ in 1..READ_ATTEMPTS {
        match operation() {
            Err(error) if passes(&error) => std::thread::sleep(pause),
            result => return result,
        }
        pause *= 10;
    }
    operation()
}

fn passes(error: &io::Error) -> bool {
    error
        .raw_os_error()
        .map(Errno::from_raw)
        .is_some_and(|errno| matches!(errno, Errno::EIO | Errno::EINTR | Errno::ESTALE))
}
