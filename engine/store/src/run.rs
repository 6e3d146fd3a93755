//! Sort runs: sorted points on scratch, written once, read once, front to back, then deleted.
//!
//! A run is a file of plain records. It never outlives the process that wrote it, so its length and the checksum of
//! every block stay in memory.

use crate::data_file::DataFile;
use crate::error::StoreError;
use crate::limits::RUN_BLOCK_RECORDS;
use crate::page_header::check_sum;
use crate::scratch::ScratchDir;
use crate::volume::Volume;
use bytemuck::Zeroable;
use pbgi_core::PointRecord;
use std::ffi::OsStr;
use std::os::unix::ffi::OsStrExt;
use std::sync::Arc;

const PREFIX: &str = "run-";
const DIGITS: usize = 6;
const RECORD_BYTES: u64 = size_of::<PointRecord>() as u64;

/// Whether a file in a scratch folder is a run.
pub(crate) fn is_run_name(name: &OsStr) -> bool {
    name.as_bytes()
        .strip_prefix(PREFIX.as_bytes())
        .is_some_and(|digits| digits.len() >= DIGITS && digits.iter().all(u8::is_ascii_digit))
}

/// A finished run. Dropping it deletes the file.
pub struct Run {
    file: DataFile,
    volume: Arc<dyn Volume>,
    records: u64,
    checksums: Vec<u32>,
}

impl Run {
    /// Points in it.
    pub fn records(&self) -> u64 {
        self.records
    }

    /// Bytes in it.
    pub fn bytes(&self) -> u64 {
        self.records * RECORD_BYTES
    }
}

impl Drop for Run {
    fn drop(&mut self) {
        // What stays behind goes with the scratch folder.
        let _ = self.volume.remove_file(self.file.path());
    }
}

/// Writes a run, block by block.
pub struct RunWriter {
    run: Run,
    block: Vec<PointRecord>,
}

impl RunWriter {
    /// Creates run `number` in `scratch`; numbers are used once.
    ///
    /// # Errors
    /// [`StoreError::NoSpace`], [`StoreError::Io`].
    pub fn create(scratch: &ScratchDir, number: u64) -> Result<Self, StoreError> {
        let path = scratch.path().join(format!("{PREFIX}{number:0DIGITS$}"));
        let run = Run {
            file: DataFile::create_new(scratch.volume(), &path)?,
            volume: scratch.volume().clone(),
            records: 0,
            checksums: Vec::new(),
        };
        Ok(Self {
            run,
            block: Vec::with_capacity(RUN_BLOCK_RECORDS),
        })
    }

    /// Appends one point; the caller sees to the order.
    ///
    /// # Errors
    /// [`StoreError::NoSpace`], [`StoreError::Io`], [`StoreError::Abandoned`].
    #[inline]
    pub fn push(&mut self, point: PointRecord) -> Result<(), StoreError> {
        self.block.push(point);
        if self.block.len() == RUN_BLOCK_RECORDS {
            self.write_block()?;
        }
        Ok(())
    }

    fn write_block(&mut self) -> Result<(), StoreError> {
        let bytes: &[u8] = bytemuck::cast_slice(&self.block);
        self.run.checksums.push(crc32c::crc32c(bytes));
        self.run.file.write_at(self.run.bytes(), bytes)?;
        self.run.records += self.block.len() as u64;
        self.block.clear();
        Ok(())
    }

    /// Writes what is left.
    ///
    /// # Errors
    /// As [`Self::push`].
    pub fn finish(mut self) -> Result<Run, StoreError> {
        if !self.block.is_empty() {
            self.write_block()?;
        }
        Ok(self.run)
    }
}

/// Reads a run from front to back, some blocks at a time, and deletes it on drop.
pub struct RunReader {
    run: Run,
    blocks_per_read: usize,
    blocks_read: usize,
}

impl RunReader {
    /// Starts at the first record. A read takes `blocks_per_read` blocks of [`RUN_BLOCK_RECORDS`].
    pub fn new(run: Run, blocks_per_read: usize) -> Self {
        Self {
            run,
            blocks_per_read: blocks_per_read.max(1),
            blocks_read: 0,
        }
    }

    /// Replaces the content of `out` by the next records; none at the end.
    ///
    /// # Errors
    /// [`StoreError::Corrupt`], [`StoreError::Io`].
    pub fn next_records(&mut self, out: &mut Vec<PointRecord>) -> Result<(), StoreError> {
        let first = self.blocks_read * RUN_BLOCK_RECORDS;
        let left = self
            .run
            .records
            .saturating_sub(first as u64)
            .min((self.blocks_per_read * RUN_BLOCK_RECORDS) as u64);
        out.resize(left as usize, PointRecord::zeroed());
        if out.is_empty() {
            return Ok(());
        }
        let place = || format!("run at record {first}");
        let bytes: &mut [u8] = bytemuck::cast_slice_mut(out);
        self.run.file.read_at(first as u64 * RECORD_BYTES, bytes, &place)?;
        let block_bytes = RUN_BLOCK_RECORDS * RECORD_BYTES as usize;
        for block in bytes.chunks(block_bytes) {
            let expected = self.run.checksums[self.blocks_read];
            if crc32c::crc32c(block) != expected {
                check_sum(self.run.file.path(), &place(), block, expected)?;
            }
            self.blocks_read += 1;
        }
        Ok(())
    }
}
