//! [`WriteBehind`]: makes a long file durable while it is still being written, so that the disk never waits for its end.

use crate::data_file::DataFile;
use crate::error::StoreError;
use crate::limits::SYNC_BEHIND_BYTES;
use std::sync::Arc;
use std::sync::mpsc::{SyncSender, TrySendError, sync_channel};
use std::thread::{Builder, JoinHandle};

/// Syncs a file on a thread of its own whenever so much has been written. Files that are shorter never start it.
pub(crate) struct WriteBehind {
    file: Arc<DataFile>,
    /// Bytes written since the thread was last told.
    since: u64,
    thread: Option<Thread>,
}

struct Thread {
    wake: SyncSender<()>,
    handle: JoinHandle<Result<(), StoreError>>,
}

impl WriteBehind {
    pub(crate) fn new(file: &Arc<DataFile>) -> Self {
        Self {
            file: file.clone(),
            since: 0,
            thread: None,
        }
    }

    /// Counts bytes that were written.
    ///
    /// # Errors
    /// That of a sync which failed meanwhile.
    pub(crate) fn wrote(&mut self, bytes: u64) -> Result<(), StoreError> {
        self.since += bytes;
        if self.since < SYNC_BEHIND_BYTES {
            return Ok(());
        }
        self.since = 0;
        if self.thread.is_none() {
            self.thread = start(&self.file);
        }
        let woken = self.thread.as_ref().map(|thread| thread.wake.try_send(()));
        match woken {
            Some(Err(TrySendError::Disconnected(()))) => self.settle(),
            // It is at it, and syncs again what came since; without a thread the end of the file takes longer.
            _ => Ok(()),
        }
    }

    /// Waits for the thread's end.
    ///
    /// # Errors
    /// That of a sync which failed.
    pub(crate) fn settle(&mut self) -> Result<(), StoreError> {
        let Some(Thread { wake, handle }) = self.thread.take() else {
            return Ok(());
        };
        drop(wake);
        match handle.join() {
            Ok(result) => result,
            Err(panic) => std::panic::resume_unwind(panic),
        }
    }
}

impl Drop for WriteBehind {
    fn drop(&mut self) {
        // The file goes unfinished: how it fared does not matter any more.
        let _ = self.settle();
    }
}

fn start(file: &Arc<DataFile>) -> Option<Thread> {
    let (wake, wakes) = sync_channel(1);
    let file = file.clone();
    let body = move || wakes.iter().try_for_each(|()| file.sync());
    let handle = Builder::new().name("pbgi-sync".to_owned()).spawn(body).ok()?;
    Some(Thread { wake, handle })
}
