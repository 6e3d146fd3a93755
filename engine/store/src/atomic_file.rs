//! [`AtomicFile`]: an output file that appears under its name complete, or not at all.

use crate::data_file::DataFile;
use crate::error::StoreError;
use crate::os_volume::OsVolume;
use crate::temporary::{
    check_replaceable, create_locked, publish, remove_temporary, sweep_temporaries, temporary_path,
};
use crate::volume::{IoMode, Lock, Volume};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// What happens if the output's name is taken.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Overwrite {
    /// It is an error, and what is there stays.
    #[default]
    Refuse,
    /// The new content takes the name in one step, then the old one is deleted.
    Replace,
}

/// A file under a temporary name beside its target, with mode 0640. Writes are not buffered: wrap `&mut file` in a
/// [`std::io::BufWriter`]. Dropping it unpublished deletes it.
pub struct AtomicFile {
    file: DataFile,
    volume: Arc<dyn Volume>,
    temporary: PathBuf,
    target: PathBuf,
    overwrite: Overwrite,
    position: u64,
    end: u64,
    _lock: Lock,
}

impl AtomicFile {
    /// Opens a temporary beside `path`.
    ///
    /// # Errors
    /// [`StoreError::Exists`] if the name is taken and `overwrite` refuses, [`StoreError::Foreign`] if it is taken by
    /// something that is no file, [`StoreError::NoSpace`], [`StoreError::Io`].
    pub fn create(path: &Path, overwrite: Overwrite) -> Result<Self, StoreError> {
        Self::create_on(&(Arc::new(OsVolume) as Arc<dyn Volume>), path, overwrite)
    }

    /// As [`Self::create`], on any volume.
    ///
    /// # Errors
    /// As [`Self::create`].
    pub fn create_on(volume: &Arc<dyn Volume>, path: &Path, overwrite: Overwrite) -> Result<Self, StoreError> {
        let taken = volume
            .kind(path)
            .map_err(|error| StoreError::io("inspect", path, error))?
            .is_some();
        if taken && overwrite == Overwrite::Refuse {
            return Err(StoreError::Exists { path: path.to_owned() });
        }
        sweep_temporaries(volume.as_ref(), path)?;
        let (temporary, lock, storage) = create_locked(
            volume.as_ref(),
            || temporary_path(path),
            |temporary| volume.create_new(temporary, IoMode::Buffered),
        )?;
        let file = Self {
            file: DataFile::new(volume, &temporary, storage),
            volume: volume.clone(),
            temporary,
            target: path.to_owned(),
            overwrite,
            position: 0,
            end: 0,
            _lock: lock,
        };
        // Says now what publishing would say after the work is done; on failure the drop cleans up.
        check_replaceable(volume.as_ref(), &file.temporary, path)?;
        Ok(file)
    }

    /// Where the file will be.
    pub fn target(&self) -> &Path {
        &self.target
    }

    /// Makes the content durable and gives it its name.
    ///
    /// # Errors
    /// [`StoreError::Exists`] if the name was taken meanwhile and `overwrite` refuses; [`StoreError::Io`],
    /// [`StoreError::NoSpace`], [`StoreError::Abandoned`]. Nothing is left behind then.
    pub fn publish(self) -> Result<(), StoreError> {
        self.file.sync()?;
        publish(self.volume.as_ref(), &self.temporary, &self.target, self.overwrite)
        // The drop deletes what has the temporary name now: the old content, or nothing.
    }
}

impl Drop for AtomicFile {
    fn drop(&mut self) {
        // A leftover is swept by the next writer of the same name.
        let _ = remove_temporary(self.volume.as_ref(), &self.temporary);
    }
}

impl Write for AtomicFile {
    fn write(&mut self, data: &[u8]) -> io::Result<usize> {
        self.file.write_at(self.position, data).map_err(into_io)?;
        self.position += data.len() as u64;
        self.end = self.end.max(self.position);
        Ok(data.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Read for AtomicFile {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let left = usize::try_from(self.end.saturating_sub(self.position)).unwrap_or(usize::MAX);
        let count = out.len().min(left);
        self.file
            .read_at(self.position, &mut out[..count], &|| "temporary file".to_owned())
            .map_err(into_io)?;
        self.position += count as u64;
        Ok(count)
    }
}

impl Seek for AtomicFile {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let position = match to {
            SeekFrom::Start(offset) => Some(offset),
            SeekFrom::End(offset) => self.end.checked_add_signed(offset),
            SeekFrom::Current(offset) => self.position.checked_add_signed(offset),
        };
        self.position =
            position.ok_or_else(|| io::Error::new(io::ErrorKind::InvalidInput, "seek before the start of the file"))?;
        Ok(self.position)
    }
}

/// For the traits of the standard library: keeps the system's own error where there is one.
fn into_io(error: StoreError) -> io::Error {
    match error {
        StoreError::Io { source, .. } => source,
        StoreError::Exists { .. } => io::Error::new(io::ErrorKind::AlreadyExists, error),
        StoreError::NoSpace { .. } => io::Error::new(io::ErrorKind::StorageFull, error),
        error => io::Error::other(error),
    }
}
