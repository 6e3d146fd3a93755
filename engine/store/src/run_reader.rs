//! [`RunReader`]: reads runs side by side, and ahead of whoever takes their points.

use crate::error::StoreError;
use crate::limits::{RUN_BLOCK_BYTES, RUN_BLOCK_RECORDS};
use crate::page_header::check_sum;
use crate::run::Run;
use crate::sector_buffer::SectorBuffer;
use pbgi_core::PointRecord;
use std::sync::mpsc::{Receiver, Sender, SyncSender, channel, sync_channel};
use std::thread::{Builder, JoinHandle};

/// Reads runs from front to back, some blocks at a time, and deletes them on drop. While the points of a part are taken,
/// a thread that all runs share reads the next part of the same run: each run has two parts in memory.
pub struct RunReader {
    lanes: Vec<Lane>,
    /// Takes the number of a run and memory for its next part.
    asks: Option<Sender<(usize, SectorBuffer)>>,
    thread: Option<JoinHandle<()>>,
}

/// The reading of one run.
struct Lane {
    /// The part that points are taken from; empty at the end of the run.
    front: SectorBuffer,
    ahead: Receiver<Result<SectorBuffer, StoreError>>,
}

/// A run, and how far it has been read.
struct Source {
    run: Run,
    blocks_read: usize,
    parts: SyncSender<Result<SectorBuffer, StoreError>>,
}

impl RunReader {
    /// Reads the first part of every run. A part is `blocks_per_read` blocks of [`RUN_BLOCK_RECORDS`].
    ///
    /// # Errors
    /// [`StoreError::Corrupt`], [`StoreError::Io`].
    pub fn new(runs: Vec<Run>, blocks_per_read: usize) -> Result<Self, StoreError> {
        let blocks_per_read = blocks_per_read.max(1);
        let part_bytes = (blocks_per_read * RUN_BLOCK_BYTES) as u64;
        let (asks, asked) = channel();
        let (mut sources, mut lanes) = (Vec::new(), Vec::new());
        let Some(path) = runs.first().map(|run| run.file().path().to_owned()) else {
            return Ok(Self {
                lanes,
                asks: None,
                thread: None,
            });
        };
        for (number, run) in runs.into_iter().enumerate() {
            // Memory is taken here, not on the thread: from what this one has given back to its allocator.
            let part = || SectorBuffer::with_capacity(run.bytes().min(part_bytes) as usize);
            // It is received once the thread runs.
            let _ = asks.send((number, part()));
            // One part is looked at, so that one at most waits here.
            let (parts, ahead) = sync_channel(1);
            lanes.push(Lane { front: part(), ahead });
            sources.push(Source {
                run,
                blocks_read: 0,
                parts,
            });
        }
        let thread = Builder::new()
            .name("pbgi-read".to_owned())
            .spawn(move || serve(sources, &asked, blocks_per_read))
            .map_err(|error| StoreError::io("start a thread to read file", &path, error))?;
        let mut reader = Self {
            lanes,
            asks: Some(asks),
            thread: Some(thread),
        };
        for run in 0..reader.lanes.len() {
            reader.receive(run)?;
        }
        Ok(reader)
    }

    /// The part of a run that is to be looked at; empty at its end.
    #[inline]
    pub fn records(&self, run: usize) -> &[PointRecord] {
        self.lanes[run].front.records()
    }

    /// Goes on to the next part of a run.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn advance(&mut self, run: usize) -> Result<(), StoreError> {
        if self.records(run).is_empty() {
            return Ok(());
        }
        self.receive(run)
    }

    /// Waits for the next part of a run and has the one after it read to the memory of the one before.
    fn receive(&mut self, run: usize) -> Result<(), StoreError> {
        let lane = &mut self.lanes[run];
        let memory = std::mem::take(&mut lane.front);
        match lane.ahead.recv() {
            Ok(part) => lane.front = part?,
            Err(_) => return self.end().map_err(|panic| std::panic::resume_unwind(panic)),
        }
        if let Some(asks) = self.asks.as_ref().filter(|_| !lane.front.bytes().is_empty()) {
            // Fails only when the thread panicked, which whoever waits for the part hears.
            let _ = asks.send((run, memory));
        }
        Ok(())
    }

    fn end(&mut self) -> std::thread::Result<()> {
        self.asks = None;
        self.thread.take().map_or(Ok(()), JoinHandle::join)
    }
}

impl Drop for RunReader {
    fn drop(&mut self) {
        // The runs are gone when the thread is.
        let _ = self.end();
    }
}

fn serve(mut sources: Vec<Source>, asked: &Receiver<(usize, SectorBuffer)>, blocks_per_read: usize) {
    for (run, memory) in asked {
        let source = &mut sources[run];
        let part = source.read(memory, blocks_per_read);
        // Nobody waits for it when the reader is being dropped.
        let _ = source.parts.send(part);
    }
}

impl Source {
    /// The next blocks, in `memory`; none at the end.
    fn read(&mut self, mut memory: SectorBuffer, blocks: usize) -> Result<SectorBuffer, StoreError> {
        let first = (self.blocks_read * RUN_BLOCK_RECORDS) as u64;
        let left = self.run.records().saturating_sub(first);
        let count = left.min((blocks * RUN_BLOCK_RECORDS) as u64) as usize;
        let bytes = memory.resize(count * size_of::<PointRecord>());
        if bytes.is_empty() {
            return Ok(memory);
        }
        let file = self.run.file();
        let place = || format!("run at record {first}");
        file.read_at(first * size_of::<PointRecord>() as u64, bytes, &place)?;
        for block in bytes.chunks(RUN_BLOCK_BYTES) {
            let expected = self.run.checksum(self.blocks_read);
            if crc32c::crc32c(block) != expected {
                check_sum(file.path(), &place(), block, expected)?;
            }
            self.blocks_read += 1;
        }
        Ok(memory)
    }
}
