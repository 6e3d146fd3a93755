//! The seam between this crate and the operating system: [`Storage`] for the bytes of a file, [`Volume`] for names.
//!
//! Verbs are positional and answer with plain [`io::Error`]; context, retries and the refusal to go on after a failed
//! write are added by [`crate::DataFile`], so they hold for every implementation.

use std::any::Any;
use std::ffi::OsString;
use std::io;
use std::path::Path;
use std::time::Duration;

/// The bytes of one open file.
pub trait Storage: Send + Sync {
    /// Length in bytes.
    ///
    /// # Errors
    /// As the system says.
    fn byte_len(&self) -> io::Result<u64>;

    /// Fills `out` from `offset`.
    ///
    /// # Errors
    /// [`io::ErrorKind::UnexpectedEof`] if the file ends before `out` is full.
    fn read_at(&self, offset: u64, out: &mut [u8]) -> io::Result<()>;

    /// Begins to read what will be read soon, if it can; returns at once.
    fn will_need(&self, offset: u64, bytes: u64) {
        let _ = (offset, bytes);
    }

    /// Writes all of `data` at `offset`; the file grows where needed.
    ///
    /// # Errors
    /// As the system says; an unknown part of `data` may then have been written.
    fn write_at(&self, offset: u64, data: &[u8]) -> io::Result<()>;

    /// Cuts or extends with zeroes.
    ///
    /// # Errors
    /// As the system says.
    fn set_len(&self, len: u64) -> io::Result<()>;

    /// Returns once content and length would survive a power loss.
    ///
    /// # Errors
    /// As the system says; the content is then unknown for good.
    fn sync(&self) -> io::Result<()>;
}

/// How the bytes of a new file travel between memory and disk. Content is the same either way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum IoMode {
    /// Through the system's page cache, where they stay while there is room: for what is soon read again.
    Buffered,
    /// Past the page cache, wherever memory, offset and length are whole sectors and the file system can: for streams longer
    /// than memory, which would push out everything else and come out again before they are read.
    Direct,
}

/// What a rename does when the new name is taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RenameMode {
    /// Fails with [`io::ErrorKind::AlreadyExists`].
    NoReplace,
    /// Swaps the two names; both must exist.
    Exchange,
}

/// What a name stands for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EntryKind {
    /// A regular file.
    File,
    /// A folder.
    Folder,
    /// A symbolic link, a device, a socket, ...
    Other,
}

/// One name in a folder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Entry {
    /// The name.
    pub name: OsString,
    /// What it stands for.
    pub kind: EntryKind,
}

/// Held while a temporary is in use; dropping it, or dying, releases it.
pub type Lock = Box<dyn Any + Send + Sync>;

/// Names, and the files behind them.
pub trait Volume: Send + Sync {
    /// Creates a file that may be read and written.
    ///
    /// # Errors
    /// [`io::ErrorKind::AlreadyExists`] if the name is taken by anything.
    fn create_new(&self, path: &Path, mode: IoMode) -> io::Result<Box<dyn Storage>>;

    /// Opens a regular file for reading. Symbolic links in the last component are refused.
    ///
    /// # Errors
    /// As the system says; [`io::ErrorKind::InvalidInput`] if it is no regular file.
    fn open(&self, path: &Path) -> io::Result<Box<dyn Storage>>;

    /// Creates a folder with these permissions.
    ///
    /// # Errors
    /// [`io::ErrorKind::AlreadyExists`] if the name is taken by anything.
    fn create_dir(&self, path: &Path, mode: u32) -> io::Result<()>;

    /// What the name stands for, `None` if it is free. Does not follow symbolic links.
    ///
    /// # Errors
    /// As the system says.
    fn kind(&self, path: &Path) -> io::Result<Option<EntryKind>>;

    /// Gives a file or folder another name in the same folder, in one step.
    ///
    /// # Errors
    /// As [`RenameMode`] says, and as the system says.
    fn rename(&self, from: &Path, to: &Path, mode: RenameMode) -> io::Result<()>;

    /// Removes a file.
    ///
    /// # Errors
    /// As the system says.
    fn remove_file(&self, path: &Path) -> io::Result<()>;

    /// Removes an empty folder.
    ///
    /// # Errors
    /// As the system says.
    fn remove_dir(&self, path: &Path) -> io::Result<()>;

    /// Everything in a folder, sorted by name.
    ///
    /// # Errors
    /// As the system says.
    fn list(&self, dir: &Path) -> io::Result<Vec<Entry>>;

    /// Returns once all names in the folder would survive a power loss.
    ///
    /// # Errors
    /// As the system says.
    fn sync_dir(&self, dir: &Path) -> io::Result<()>;

    /// Bytes that an unprivileged user may still write there.
    ///
    /// # Errors
    /// As the system says.
    fn free_bytes(&self, dir: &Path) -> io::Result<u64>;

    /// Time since the folder last changed: since a name was made or removed in it.
    ///
    /// # Errors
    /// As the system says.
    fn age(&self, dir: &Path) -> io::Result<Duration>;

    /// Marks a file or folder as in use by a living process; `None` if another one has it.
    ///
    /// # Errors
    /// As the system says.
    fn try_lock(&self, path: &Path) -> io::Result<Option<Lock>>;
}

/// The folder that holds `path`; `.` for a bare name.
pub(crate) fn parent(path: &Path) -> &Path {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    }
}
