//! [`RunWriter`]: writes a run, block by block.

use crate::error::StoreError;
use crate::file_writer::FileWriter;
use crate::limits::RUN_BLOCK_BYTES;
use crate::run::Run;
use crate::scratch::ScratchDir;
use pbgi_core::PointRecord;

/// Writes a run while its caller goes on.
pub struct RunWriter {
    // Before the run, so that nothing is written any more when its file is removed.
    writer: FileWriter,
    run: Run,
    /// Of the blocks that have been handed over.
    checksums: Vec<u32>,
}

impl RunWriter {
    /// Creates run `number` in `scratch`; numbers are used once.
    ///
    /// # Errors
    /// [`StoreError::NoSpace`], [`StoreError::Io`].
    pub fn create(scratch: &ScratchDir, number: u64) -> Result<Self, StoreError> {
        let run = Run::create(scratch, number)?;
        Ok(Self {
            writer: FileWriter::new(run.file(), 0, RUN_BLOCK_BYTES),
            run,
            checksums: Vec::new(),
        })
    }

    /// Appends points; the caller sees to the order.
    ///
    /// # Errors
    /// [`StoreError::NoSpace`], [`StoreError::Io`], [`StoreError::Abandoned`]; those of earlier points may come late.
    pub fn append(&mut self, points: &[PointRecord]) -> Result<(), StoreError> {
        let mut bytes: &[u8] = bytemuck::cast_slice(points);
        while !bytes.is_empty() {
            // A block is a whole number of points.
            bytes = self.writer.buffer().append(bytes);
            if self.writer.buffer().room() == 0 {
                self.sum_block();
                self.writer.hand_over()?;
            }
        }
        Ok(())
    }

    fn sum_block(&mut self) {
        self.checksums.push(crc32c::crc32c(self.writer.buffer().bytes()));
    }

    /// Writes what is left.
    ///
    /// # Errors
    /// As [`Self::append`].
    pub fn finish(mut self) -> Result<Run, StoreError> {
        if !self.writer.buffer().bytes().is_empty() {
            self.sum_block();
        }
        self.writer.finish()?;
        self.run.complete(self.writer.end(), self.checksums);
        Ok(self.run)
    }

    /// As [`Self::finish`], and seals the run, so that [`ScratchDir::sealed_runs`] finds it after the death of this
    /// process. The system's memory outlives the process; a power loss is told by the checksums.
    ///
    /// # Errors
    /// As [`Self::append`].
    pub fn finish_sealed(self, note: &[u8]) -> Result<Run, StoreError> {
        let mut run = self.finish()?;
        run.seal(note)?;
        Ok(run)
    }
}
