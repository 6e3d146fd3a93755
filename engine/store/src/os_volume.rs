//! [`OsVolume`]: the operating system's own files.

use crate::limits::{FILE_MODE, SECTOR_BYTES};
use crate::volume::{Entry, EntryKind, IoMode, Lock, RenameMode, Storage, Volume};
use nix::fcntl::{AT_FDCWD, OFlag, PosixFadviseAdvice, RenameFlags, posix_fadvise, renameat2};
use std::fs::{self, DirBuilder, File, FileType, OpenOptions, TryLockError};
use std::io;
use std::os::unix::fs::{DirBuilderExt, FileExt, OpenOptionsExt};
use std::path::Path;
use std::time::Duration;

/// Files of the operating system. Linux only: publishing needs `renameat2`.
#[derive(Clone, Copy, Debug, Default)]
pub struct OsVolume;

struct OsFile {
    file: File,
    /// The same file, opened with O_DIRECT, for whole sectors.
    direct: Option<File>,
}

impl OsFile {
    fn buffered(file: File) -> Self {
        Self { file, direct: None }
    }

    /// Runs `transfer` past the page cache where it can be, else through it.
    fn transfer(
        &self,
        offset: u64,
        sectors: bool,
        mut transfer: impl FnMut(&File) -> io::Result<()>,
    ) -> io::Result<()> {
        if let Some(direct) = self
            .direct
            .as_ref()
            .filter(|_| sectors && offset.is_multiple_of(SECTOR_BYTES as u64))
        {
            match transfer(direct) {
                // Larger sectors than ours, or a part of a transfer that ended amid one.
                Err(error) if error.kind() == io::ErrorKind::InvalidInput => {}
                result => return result,
            }
        }
        transfer(&self.file)
    }
}

fn are_sectors(bytes: &[u8]) -> bool {
    bytes.len().is_multiple_of(SECTOR_BYTES) && bytes.as_ptr().addr().is_multiple_of(SECTOR_BYTES)
}

impl Storage for OsFile {
    fn byte_len(&self) -> io::Result<u64> {
        Ok(self.file.metadata()?.len())
    }

    fn read_at(&self, offset: u64, out: &mut [u8]) -> io::Result<()> {
        self.transfer(offset, are_sectors(out), |file| file.read_exact_at(out, offset))
    }

    fn will_need(&self, offset: u64, bytes: u64) {
        let advice = PosixFadviseAdvice::POSIX_FADV_WILLNEED;
        // A hint: a file system that knows none does as it likes.
        let _ = posix_fadvise(&self.file, offset as i64, bytes as i64, advice);
    }

    fn write_at(&self, offset: u64, data: &[u8]) -> io::Result<()> {
        self.transfer(offset, are_sectors(data), |file| file.write_all_at(data, offset))
    }

    fn set_len(&self, len: u64) -> io::Result<()> {
        self.file.set_len(len)
    }

    fn sync(&self) -> io::Result<()> {
        self.file.sync_all()
    }
}

impl Volume for OsVolume {
    fn create_new(&self, path: &Path, mode: IoMode) -> io::Result<Box<dyn Storage>> {
        let file = OpenOptions::new()
            .read(true)
            .write(true)
            .create_new(true)
            .mode(FILE_MODE)
            .open(path)?;
        let mut file = OsFile::buffered(file);
        if mode == IoMode::Direct {
            let flags = OFlag::O_DIRECT | OFlag::O_NOFOLLOW | OFlag::O_CLOEXEC;
            let direct = OpenOptions::new()
                .read(true)
                .write(true)
                .custom_flags(flags.bits())
                .open(path);
            // A file system that has no such thing is used through the page cache.
            file.direct = direct.ok();
        }
        Ok(Box::new(file))
    }

    fn open(&self, path: &Path) -> io::Result<Box<dyn Storage>> {
        // Without O_NONBLOCK a FIFO in the file's place would hang the caller.
        let flags = OFlag::O_NOFOLLOW | OFlag::O_NONBLOCK | OFlag::O_CLOEXEC;
        let file = OpenOptions::new().read(true).custom_flags(flags.bits()).open(path)?;
        if !file.metadata()?.is_file() {
            return Err(io::Error::new(io::ErrorKind::InvalidInput, "not a regular file"));
        }
        Ok(Box::new(OsFile::buffered(file)))
    }

    fn create_dir(&self, path: &Path, mode: u32) -> io::Result<()> {
        DirBuilder::new().mode(mode).create(path)
    }

    fn kind(&self, path: &Path) -> io::Result<Option<EntryKind>> {
        match fs::symlink_metadata(path) {
            Ok(metadata) => Ok(Some(entry_kind(metadata.file_type()))),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        }
    }

    fn rename(&self, from: &Path, to: &Path, mode: RenameMode) -> io::Result<()> {
        let flags = match mode {
            RenameMode::NoReplace => RenameFlags::RENAME_NOREPLACE,
            RenameMode::Exchange => RenameFlags::RENAME_EXCHANGE,
        };
        Ok(renameat2(AT_FDCWD, from, AT_FDCWD, to, flags)?)
    }

    fn remove_file(&self, path: &Path) -> io::Result<()> {
        fs::remove_file(path)
    }

    fn remove_dir(&self, path: &Path) -> io::Result<()> {
        fs::remove_dir(path)
    }

    fn list(&self, dir: &Path) -> io::Result<Vec<Entry>> {
        let mut entries = Vec::new();
        for entry in fs::read_dir(dir)? {
            let entry = entry?;
            entries.push(Entry {
                name: entry.file_name(),
                kind: entry_kind(entry.file_type()?),
            });
        }
        entries.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(entries)
    }

    fn sync_dir(&self, dir: &Path) -> io::Result<()> {
        File::open(dir)?.sync_all()
    }

    fn free_bytes(&self, dir: &Path) -> io::Result<u64> {
        let stat = nix::sys::statvfs::statvfs(dir)?;
        Ok(stat.blocks_available().saturating_mul(stat.fragment_size()))
    }

    fn age(&self, dir: &Path) -> io::Result<Duration> {
        // A clock that was set back makes everything new.
        Ok(fs::metadata(dir)?.modified()?.elapsed().unwrap_or_default())
    }

    fn try_lock(&self, path: &Path) -> io::Result<Option<Lock>> {
        let file = File::open(path)?;
        match file.try_lock() {
            Ok(()) => Ok(Some(Box::new(file))),
            Err(TryLockError::WouldBlock) => Ok(None),
            Err(TryLockError::Error(error)) => Err(error),
        }
    }
}

fn entry_kind(kind: FileType) -> EntryKind {
    if kind.is_file() {
        EntryKind::File
    } else if kind.is_dir() {
        EntryKind::Folder
    } else {
        EntryKind::Other
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests assert")]
mod tests {
    use super::*;
    use crate::sector_buffer::SectorBuffer;

    #[test]
    fn whole_sectors_and_parts_of_them_make_the_same_file_in_either_mode() {
        let dir = tempfile::tempdir().unwrap();
        let content: Vec<u8> = (0..3 * SECTOR_BYTES + 5).map(|i| (i % 251) as u8).collect();
        for mode in [IoMode::Buffered, IoMode::Direct] {
            let path = dir.path().join(format!("{mode:?}"));
            let file = OsVolume.create_new(&path, mode).unwrap();
            let (sectors, tail) = content.split_at(3 * SECTOR_BYTES);
            let mut memory = SectorBuffer::with_capacity(sectors.len());
            assert!(memory.append(sectors).is_empty());
            file.write_at(sectors.len() as u64, tail).unwrap();
            file.write_at(0, memory.bytes()).unwrap();
            file.write_at(100, &content[100..110]).unwrap();
            file.sync().unwrap();
            assert!(fs::read(&path).unwrap() == content, "{mode:?}");
            file.read_at(SECTOR_BYTES as u64, memory.resize(2 * SECTOR_BYTES))
                .unwrap();
            assert!(memory.bytes() == &content[SECTOR_BYTES..3 * SECTOR_BYTES], "{mode:?}");
            let past = file.read_at(3 * SECTOR_BYTES as u64, memory.resize(SECTOR_BYTES));
            assert_eq!(past.unwrap_err().kind(), io::ErrorKind::UnexpectedEof, "{mode:?}");
        }
    }
}
