//! [`ReadOnce`]: a long file that is read from end to end and leaves nothing of itself in the system's memory.

use crate::limits::{DROP_BEHIND_BYTES, DROP_BEHIND_MIN};
use nix::fcntl::{PosixFadviseAdvice, posix_fadvise};
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};

/// A file, of which the system may forget what was read where that is told ([`Self::for_the_last_time`]). Shorter files than
/// [`DROP_BEHIND_MIN`] stay: they may be wanted again, and nobody needs their room.
pub(crate) struct ReadOnce {
    file: File,
    at: u64,
    forgotten: u64,
    forgets: bool,
}

impl ReadOnce {
    pub(crate) fn new(file: File) -> Self {
        Self {
            file,
            at: 0,
            forgotten: 0,
            forgets: false,
        }
    }

    /// What is read from now on will not be read again.
    pub(crate) fn for_the_last_time(&mut self) {
        let length = self.file.metadata().map_or(0, |file| file.len());
        self.forgets = length >= DROP_BEHIND_MIN;
    }
}

impl Read for ReadOnce {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let read = self.file.read(out)?;
        self.at += read as u64;
        let behind = self.at - self.forgotten;
        if self.forgets && behind >= DROP_BEHIND_BYTES {
            // A hint: a file system that knows none keeps what it likes.
            let advice = PosixFadviseAdvice::POSIX_FADV_DONTNEED;
            let _ = posix_fadvise(&self.file, self.forgotten as i64, behind as i64, advice);
            self.forgotten = self.at;
        }
        Ok(read)
    }
}

impl Seek for ReadOnce {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.at = self.file.seek(to)?;
        self.forgotten = self.at;
        Ok(self.at)
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests assert")]
mod tests {
    use super::*;
    use std::io::Write;

    #[test]
    fn what_is_forgotten_can_be_read_again() {
        let mut file = tempfile::tempfile().unwrap();
        let tail: Vec<u8> = (0..3 * DROP_BEHIND_BYTES).map(|i| (i % 251) as u8).collect();
        // All but the tail is a hole.
        let start = DROP_BEHIND_MIN - DROP_BEHIND_BYTES;
        file.seek(SeekFrom::Start(start)).unwrap();
        file.write_all(&tail).unwrap();
        let mut reader = ReadOnce::new(file);
        for _ in 0..2 {
            reader.seek(SeekFrom::Start(start)).unwrap();
            reader.for_the_last_time();
            let mut read = Vec::new();
            reader.read_to_end(&mut read).unwrap();
            assert!(read == tail);
            assert!(reader.forgets && reader.at - reader.forgotten < DROP_BEHIND_BYTES);
        }
    }
}
