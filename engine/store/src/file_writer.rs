//! [`FileWriter`]: writes a long file front to back while whoever fills it goes on.

use crate::data_file::DataFile;
use crate::error::StoreError;
use crate::limits::FILE_BUFFERS;
use crate::sector_buffer::SectorBuffer;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::{Builder, JoinHandle};

/// Writes full buffers on a thread of its own, in their order. Files of no more than one never start it.
pub(crate) struct FileWriter {
    file: Arc<DataFile>,
    buffer: SectorBuffer,
    buffer_bytes: usize,
    /// Where the buffer goes.
    offset: u64,
    thread: Option<Thread>,
}

struct Thread {
    full: SyncSender<(u64, SectorBuffer)>,
    written: Receiver<SectorBuffer>,
    handle: JoinHandle<Result<(), StoreError>>,
}

impl FileWriter {
    /// Writes from `offset` on, so many bytes at a time.
    pub(crate) fn new(file: &Arc<DataFile>, offset: u64, buffer_bytes: usize) -> Self {
        Self {
            file: file.clone(),
            buffer: SectorBuffer::with_capacity(buffer_bytes),
            buffer_bytes,
            offset,
            thread: None,
        }
    }

    /// What is to be filled and then [handed over](Self::hand_over).
    pub(crate) fn buffer(&mut self) -> &mut SectorBuffer {
        &mut self.buffer
    }

    /// Bytes of the file up to the end of what is in the buffer.
    pub(crate) fn end(&self) -> u64 {
        self.offset + self.buffer.bytes().len() as u64
    }

    /// Has the buffer written; there is an empty one then.
    ///
    /// # Errors
    /// [`StoreError::NoSpace`], [`StoreError::Io`], [`StoreError::Abandoned`]: those of earlier buffers.
    pub(crate) fn hand_over(&mut self) -> Result<(), StoreError> {
        let thread = match &mut self.thread {
            Some(thread) => thread,
            none => none.insert(start(&self.file, self.buffer_bytes)?),
        };
        let offset = self.offset;
        self.offset += self.buffer.bytes().len() as u64;
        let buffer = &mut self.buffer;
        let handed = thread.written.recv().ok().and_then(|empty| {
            let full = std::mem::replace(buffer, empty);
            thread.full.send((offset, full)).ok()
        });
        match handed {
            Some(()) => Ok(()),
            // It ends by itself only when it failed.
            None => self.settle(),
        }
    }

    /// Writes what is left, and returns when all is written.
    ///
    /// # Errors
    /// As [`Self::hand_over`].
    pub(crate) fn finish(&mut self) -> Result<(), StoreError> {
        self.settle()?;
        if !self.buffer.bytes().is_empty() {
            self.file.write_at(self.offset, self.buffer.bytes())?;
            self.offset = self.end();
            self.buffer.clear();
        }
        Ok(())
    }

    fn settle(&mut self) -> Result<(), StoreError> {
        let Some(Thread { full, handle, .. }) = self.thread.take() else {
            return Ok(());
        };
        drop(full);
        match handle.join() {
            Ok(result) => result,
            Err(panic) => std::panic::resume_unwind(panic),
        }
    }
}

impl Drop for FileWriter {
    fn drop(&mut self) {
        // The file goes unfinished: how it fared does not matter any more.
        let _ = self.settle();
    }
}

fn start(file: &Arc<DataFile>, buffer_bytes: usize) -> Result<Thread, StoreError> {
    let (full, buffers) = sync_channel(FILE_BUFFERS);
    let (empty, written) = sync_channel(FILE_BUFFERS);
    for _ in 1..FILE_BUFFERS {
        // There is room for all.
        let _ = empty.send(SectorBuffer::with_capacity(buffer_bytes));
    }
    let path = file.path().to_owned();
    let file = file.clone();
    let handle = Builder::new()
        .name("pbgi-write".to_owned())
        .spawn(move || write(&file, &buffers, &empty))
        .map_err(|error| StoreError::io("start a thread to write file", &path, error))?;
    Ok(Thread { full, written, handle })
}

fn write(
    file: &DataFile,
    buffers: &Receiver<(u64, SectorBuffer)>,
    empty: &SyncSender<SectorBuffer>,
) -> Result<(), StoreError> {
    for (offset, mut buffer) in buffers {
        file.write_at(offset, buffer.bytes())?;
        buffer.clear();
        // Nobody waits for the last ones.
        let _ = empty.send(buffer);
    }
    Ok(())
}
