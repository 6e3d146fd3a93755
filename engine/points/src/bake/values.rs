//! What was shaded, by place in the cloud: [`BakedValues`].

use super::Baked;
use crate::error::PointsError;
use pbgi_store::{OsVolume, StoreError, Volume};
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::ops::ControlFlow;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

const RECORD_BYTES: u64 = size_of::<Baked>() as u64;

/// Values that wait to be written in the order of their places: runs of a scan line are written at once.
const WAITING_MAX: usize = 1 << 16;

/// Points between two words to the observer.
const OBSERVED_POINTS: u64 = 1 << 14;

/// Seven numbers for every point of a cloud, in a file without a name, so that it goes when the process does. Points that
/// were never written have zeros.
pub struct BakedValues {
    file: File,
    folder: PathBuf,
    waiting: Vec<(u64, Baked)>,
    bytes: Vec<u8>,
}

impl BakedValues {
    /// Makes room for `count` points in `folder`.
    ///
    /// # Errors
    /// No room, or a failing disk.
    pub fn create(folder: &Path, count: u64) -> Result<Self, PointsError> {
        let free = OsVolume
            .free_bytes(folder)
            .map_err(PointsError::io("read the free space of", folder))?;
        let needed = count * RECORD_BYTES;
        if free < needed {
            let path = folder.to_owned();
            return Err(PointsError::Store(StoreError::NoSpace { needed, free, path }));
        }
        let file = tempfile::tempfile_in(folder).map_err(PointsError::io("make a scratch file in", folder))?;
        file.set_len(needed)
            .map_err(PointsError::io("write scratch in", folder))?;
        Ok(Self {
            file,
            folder: folder.to_owned(),
            waiting: Vec::new(),
            bytes: Vec::new(),
        })
    }

    /// Takes the values of the point at `place`.
    ///
    /// # Errors
    /// A failing disk.
    pub fn put(&mut self, place: u64, values: Baked) -> Result<(), PointsError> {
        self.waiting.push((place, values));
        if self.waiting.len() < WAITING_MAX {
            return Ok(());
        }
        self.flush()
    }

    /// Writes what waits; before the values are read.
    ///
    /// # Errors
    /// A failing disk.
    pub fn flush(&mut self) -> Result<(), PointsError> {
        self.waiting.sort_unstable_by_key(|&(place, _)| place);
        for run in self.waiting.chunk_by(|(a, _), (b, _)| a + 1 == *b) {
            let Some(&(first, _)) = run.first() else { continue };
            self.bytes.clear();
            for (_, values) in run {
                self.bytes.extend_from_slice(bytemuck::bytes_of(values));
            }
            let written = self.file.write_all_at(&self.bytes, first * RECORD_BYTES);
            written.map_err(PointsError::io("write scratch in", &self.folder))?;
        }
        self.waiting.clear();
        Ok(())
    }

    /// Reads the values from the first point on.
    pub(super) fn rows<'a>(
        &'a self,
        observer: &'a mut dyn FnMut(u64) -> ControlFlow<()>,
    ) -> Result<Rows<'a>, PointsError> {
        debug_assert!(self.waiting.is_empty(), "what waits is written first");
        let mut reader = BufReader::with_capacity(1 << 18, &self.file);
        let start = reader.seek(SeekFrom::Start(0));
        start.map_err(PointsError::io("read scratch in", &self.folder))?;
        Ok(Rows {
            reader,
            folder: &self.folder,
            next: 0,
            observer,
        })
    }
}

/// The values of one point after the other.
pub(super) struct Rows<'a> {
    reader: BufReader<&'a File>,
    folder: &'a Path,
    next: u64,
    observer: &'a mut dyn FnMut(u64) -> ControlFlow<()>,
}

impl Rows<'_> {
    /// Those of the next point.
    pub(super) fn next(&mut self) -> Result<Baked, PointsError> {
        let mut values = Baked::default();
        let read = self.reader.read_exact(bytemuck::bytes_of_mut(&mut values));
        read.map_err(PointsError::io("read scratch in", self.folder))?;
        self.next += 1;
        if self.next.is_multiple_of(OBSERVED_POINTS) && (self.observer)(self.next).is_break() {
            return Err(PointsError::Cancelled);
        }
        Ok(values)
    }

    /// Those of the point at `place`, which is not behind.
    pub(super) fn seek(&mut self, place: u64) -> Result<Baked, PointsError> {
        while self.next < place {
            self.next()?;
        }
        self.next()
    }

    /// Points so far.
    pub(super) fn count(&self) -> u64 {
        self.next
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_come_back_by_place_whatever_the_order_they_came_in() {
        let folder = tempfile::tempdir().unwrap();
        let count = 200_000u64;
        let mut values = BakedValues::create(folder.path(), count).unwrap();
        assert_eq!(
            std::fs::read_dir(folder.path()).unwrap().count(),
            0,
            "scratch has no name"
        );
        for step in 0..count {
            // A permutation; every tenth place stays empty.
            let place = step * 7_919 % count;
            if place % 10 != 3 {
                values.put(place, [place as f32; 7]).unwrap();
            }
        }
        values.flush().unwrap();
        let mut heard = 0;
        let mut observer = |points| {
            heard = points;
            ControlFlow::Continue(())
        };
        let mut rows = values.rows(&mut observer).unwrap();
        for place in 0..count {
            let expected = if place % 10 == 3 { 0.0 } else { place as f32 };
            assert_eq!(rows.next().unwrap(), [expected; 7]);
        }
        assert!(heard > count - OBSERVED_POINTS);
    }
}
