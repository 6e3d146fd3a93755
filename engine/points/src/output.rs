//! The one place where files are made: buffered, and published whole or not at all.

use crate::error::PointsError;
use pbgi_store::{AtomicFile, Overwrite};
use std::io::{self, BufWriter, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// Writes `path` through `write`. On any error the temporary is deleted and `path` is as it was before.
pub(crate) fn write_file<E>(
    path: &Path,
    write: impl FnOnce(&mut OutputFile) -> Result<(), E>,
) -> Result<(), PointsError>
where
    PointsError: From<WriteFailure<E>>,
{
    let mut file = OutputFile::create(path)?;
    write(&mut file).map_err(|error| WriteFailure {
        path: path.to_owned(),
        error,
    })?;
    file.publish()
}

/// A file on its way: it appears under its name when it is published, and not at all when it is dropped before.
pub(crate) struct OutputFile {
    file: BufWriter<AtomicFile>,
}

impl OutputFile {
    pub(crate) fn create(path: &Path) -> Result<Self, PointsError> {
        let file = AtomicFile::create(path, Overwrite::Replace)?;
        Ok(Self {
            file: BufWriter::with_capacity(BUFFER_BYTES, file),
        })
    }

    pub(crate) fn publish(mut self) -> Result<(), PointsError> {
        let path = self.file.get_ref().target().to_owned();
        self.file.flush().map_err(PointsError::io("write", &path))?;
        let file = self
            .file
            .into_inner()
            .map_err(|error| PointsError::io("write", &path)(error.into_error()))?;
        Ok(file.publish()?)
    }
}

impl Write for OutputFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.file.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

impl Seek for OutputFile {
    fn seek(&mut self, position: SeekFrom) -> io::Result<u64> {
        self.file.seek(position)
    }
}

const BUFFER_BYTES: usize = 1 << 18;

/// An error of a writer, with the file it happened to.
pub(crate) struct WriteFailure<E> {
    path: PathBuf,
    error: E,
}

impl From<WriteFailure<io::Error>> for PointsError {
    fn from(failure: WriteFailure<io::Error>) -> Self {
        Self::io("write", &failure.path)(failure.error)
    }
}

impl From<WriteFailure<PointsError>> for PointsError {
    fn from(failure: WriteFailure<PointsError>) -> Self {
        failure.error
    }
}

impl From<WriteFailure<exr::error::Error>> for PointsError {
    fn from(failure: WriteFailure<exr::error::Error>) -> Self {
        match failure.error {
            exr::error::Error::Io(error) => Self::io("write", &failure.path)(error),
            other => Self::invalid(&failure.path, format!("cannot write the image: {other}")),
        }
    }
}

impl From<WriteFailure<image::ImageError>> for PointsError {
    fn from(failure: WriteFailure<image::ImageError>) -> Self {
        match failure.error {
            image::ImageError::IoError(error) => Self::io("write", &failure.path)(error),
            other => Self::invalid(&failure.path, format!("cannot write the image: {other}")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn a_failed_write_leaves_the_old_file_and_no_temporary() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out.bin");
        write_file(&path, |file| file.write_all(b"old")).unwrap();
        let failed = write_file(&path, |file| {
            file.write_all(b"new")?;
            Err(io::Error::other("disc on fire"))
        });
        assert!(failed.unwrap_err().to_string().contains("disc on fire"));
        assert_eq!(fs::read(&path).unwrap(), b"old");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }
}
