//! The job table on disk: what jobs there are, how they stand, and the tiles that are finished, in one embedded database in the
//! state directory.
//!
//! Writers leave the latest state of a job and go on; one thread commits what has gathered, each commit with an fsync, so that a
//! thousand submits cost a few commits. Whoever must know that a change will survive waits for its [`Ticket`]. A tile is never
//! waited for: one that was not stored in time is shaded again, to the same values. After a failed commit nothing is written
//! any more, and every ticket says why.
//!
//! Start at [`JobTable::open`].

use crate::error::ServerError;
use crate::limits;
use crate::scheduler::JobNo;
use redb::{Database, ReadableDatabase, ReadableTable, TableDefinition};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use tokio::sync::oneshot;

/// By job number: the request as it came over the wire, and the rest as JSON.
const JOBS: TableDefinition<'_, u64, (&[u8], &[u8])> = TableDefinition::new("jobs");
/// By job number and tile: counters and values.
const TILES: TableDefinition<'_, (u64, u32), &[u8]> = TableDefinition::new("tiles");
/// Name of the file in the state directory.
const FILE: &str = "jobs.redb";

/// A job as it is kept.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Row {
    /// The request, as it came over the wire.
    pub request: Arc<[u8]>,
    /// Everything else, JSON.
    pub record: Vec<u8>,
}

/// Resolves when a change is on the disk, or cannot be.
pub type Ticket = oneshot::Receiver<Result<(), String>>;

/// The table. Dropping it commits what is left.
#[derive(Debug)]
pub struct JobTable {
    shared: Arc<Shared>,
    database: Arc<Database>,
    writer: Option<JoinHandle<()>>,
}

#[derive(Debug, Default)]
struct Shared {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    batch: Batch,
    /// Why nothing is written any more.
    broken: Option<String>,
    closing: bool,
}

/// What has gathered since the last commit; `None` is a job that is forgotten.
#[derive(Debug, Default)]
struct Batch {
    jobs: BTreeMap<u64, Option<Row>>,
    tiles: BTreeMap<(u64, u32), Vec<u8>>,
    tile_bytes: usize,
    tileless: BTreeSet<u64>,
    waiting: Vec<oneshot::Sender<Result<(), String>>>,
}

impl Batch {
    fn is_empty(&self) -> bool {
        self.jobs.is_empty() && self.tiles.is_empty() && self.tileless.is_empty() && self.waiting.is_empty()
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl JobTable {
    /// Opens or makes the table in a state directory; returns the rows that are there.
    ///
    /// # Errors
    /// A file that cannot be read, or is none of ours.
    pub fn open(directory: &Path) -> Result<(Self, BTreeMap<u64, Row>), ServerError> {
        let path = directory.join(FILE);
        let failed = |error: redb::Error| ServerError::Table {
            path: path.clone(),
            reason: error.to_string(),
        };
        let open = || {
            redb::Builder::new()
                .set_cache_size(limits::TABLE_CACHE_BYTES)
                .create(&path)
        };
        let mut database = open().map_err(|error| failed(error.into()))?;
        let rows = read_rows(&database).map_err(failed)?;
        let bytes = std::fs::metadata(&path).map_or(0, |metadata| metadata.len());
        // A crash left much, or much was deleted: the file gives nothing back by itself.
        if bytes > limits::TABLE_SLACK_BYTES_MAX {
            let compacted = database.compact().map_err(|error| error.to_string());
            tracing::info!(bytes, ?compacted, "job table compacted");
        }
        let (shared, database) = (Arc::new(Shared::default()), Arc::new(database));
        let (theirs, store) = (shared.clone(), database.clone());
        let writer = std::thread::Builder::new()
            .name("job-table".into())
            .spawn(move || write_batches(&theirs, &store))
            .map_err(ServerError::setup("start the job table's thread"))?;
        let writer = Some(writer);
        Ok((
            Self {
                shared,
                database,
                writer,
            },
            rows,
        ))
    }

    /// Leaves a job's latest state.
    pub fn put(&self, job: JobNo, row: Row) {
        self.shared.lock().batch.jobs.insert(job.0, Some(row));
        self.shared.changed.notify_one();
    }

    /// Forgets a job and its tiles.
    pub fn forget(&self, job: JobNo) {
        self.drop_tiles(job);
        self.shared.lock().batch.jobs.insert(job.0, None);
        self.shared.changed.notify_one();
    }

    /// Keeps a finished tile, if the disk keeps up.
    pub fn put_tile(&self, job: JobNo, tile: u32, bytes: Vec<u8>) {
        let mut state = self.shared.lock();
        if state.batch.tile_bytes + bytes.len() > limits::TILES_UNSTORED_BYTES_MAX || state.broken.is_some() {
            return;
        }
        state.batch.tile_bytes += bytes.len();
        state.batch.tiles.insert((job.0, tile), bytes);
        drop(state);
        self.shared.changed.notify_one();
    }

    /// Forgets a job's tiles.
    pub fn drop_tiles(&self, job: JobNo) {
        let mut state = self.shared.lock();
        state.batch.tiles.retain(|(number, _), _| *number != job.0);
        state.batch.tile_bytes = state.batch.tiles.values().map(Vec::len).sum();
        state.batch.tileless.insert(job.0);
        drop(state);
        self.shared.changed.notify_one();
    }

    /// Resolves when everything left so far is on the disk.
    pub fn ticket(&self) -> Ticket {
        let (sender, ticket) = oneshot::channel();
        let mut state = self.shared.lock();
        if let Some(reason) = &state.broken {
            // Nobody waits any more: they gave up.
            let _ = sender.send(Err(reason.clone()));
        } else {
            state.batch.waiting.push(sender);
        }
        drop(state);
        self.shared.changed.notify_one();
        ticket
    }

    /// The tiles of a job that are on the disk. Blocks.
    ///
    /// # Errors
    /// A text for people.
    pub fn tiles(&self, job: JobNo) -> Result<Vec<(u32, Vec<u8>)>, String> {
        let read = || -> Result<Vec<(u32, Vec<u8>)>, redb::Error> {
            let table = self.database.begin_read()?.open_table(TILES)?;
            let mut tiles = Vec::new();
            for entry in table.range((job.0, 0)..=(job.0, u32::MAX))? {
                let (key, value) = entry?;
                tiles.push((key.value().1, value.value().to_vec()));
            }
            Ok(tiles)
        };
        read().map_err(|error| error.to_string())
    }

    /// Why nothing is written any more, if that is so.
    pub fn broken(&self) -> Option<String> {
        self.shared.lock().broken.clone()
    }
}

impl Drop for JobTable {
    fn drop(&mut self) {
        self.shared.lock().closing = true;
        self.shared.changed.notify_one();
        if let Some(writer) = self.writer.take()
            && writer.join().is_err()
        {
            tracing::error!("the job table's thread panicked");
        }
    }
}

fn read_rows(database: &Database) -> Result<BTreeMap<u64, Row>, redb::Error> {
    let transaction = database.begin_write()?;
    let mut rows = BTreeMap::new();
    {
        transaction.open_table(TILES)?;
        let table = transaction.open_table(JOBS)?;
        for entry in table.iter()? {
            let (key, value) = entry?;
            let (request, record) = value.value();
            let row = Row {
                request: request.into(),
                record: record.to_vec(),
            };
            rows.insert(key.value(), row);
        }
    }
    transaction.commit()?;
    Ok(rows)
}

fn write_batches(shared: &Shared, database: &Database) {
    loop {
        let (batch, closing) = {
            let mut state = shared.lock();
            while state.batch.is_empty() && !state.closing {
                state = shared.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
            }
            (std::mem::take(&mut state.batch), state.closing)
        };
        if batch.is_empty() && closing {
            return;
        }
        let outcome = commit(database, &batch).map_err(|error| format!("the job table cannot be written: {error}"));
        if let Err(reason) = &outcome {
            tracing::error!(reason, "jobs are not durable any more");
            shared.lock().broken = Some(reason.clone());
        }
        for sender in batch.waiting {
            // Nobody waits any more: they gave up.
            let _ = sender.send(outcome.clone());
        }
        if outcome.is_err() {
            let mut state = shared.lock();
            let left = std::mem::take(&mut state.batch);
            drop(state);
            for sender in left.waiting {
                let _ = sender.send(outcome.clone());
            }
            return;
        }
    }
}

fn commit(database: &Database, batch: &Batch) -> Result<(), redb::Error> {
    let transaction = database.begin_write()?;
    {
        let mut tiles = transaction.open_table(TILES)?;
        for &job in &batch.tileless {
            tiles.retain_in((job, 0)..=(job, u32::MAX), |_, _| false)?;
        }
        for (key, bytes) in &batch.tiles {
            tiles.insert(key, bytes.as_slice())?;
        }
        let mut jobs = transaction.open_table(JOBS)?;
        for (number, row) in &batch.jobs {
            match row {
                Some(row) => jobs.insert(number, (&*row.request, row.record.as_slice()))?,
                None => jobs.remove(number)?,
            };
        }
    }
    transaction.commit()?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(text: &str) -> Row {
        Row {
            request: text.as_bytes().into(),
            record: text.to_uppercase().into_bytes(),
        }
    }

    #[test]
    fn rows_and_tiles_come_back_and_what_is_forgotten_does_not() {
        let folder = tempfile::tempdir().unwrap();
        let (table, rows) = JobTable::open(folder.path()).unwrap();
        assert!(rows.is_empty());
        for number in 1..=3 {
            table.put(JobNo(number), row("old"));
            table.put(JobNo(number), row("new"));
            table.put_tile(JobNo(number), 7, vec![number as u8; 100]);
        }
        table.ticket().blocking_recv().unwrap().unwrap();
        table.drop_tiles(JobNo(1));
        table.put_tile(JobNo(1), 8, vec![9]);
        table.forget(JobNo(2));
        drop(table);
        let (table, rows) = JobTable::open(folder.path()).unwrap();
        assert_eq!(rows.into_iter().collect::<Vec<_>>(), [(1, row("new")), (3, row("new"))]);
        assert_eq!(table.tiles(JobNo(1)).unwrap(), [(8, vec![9])]);
        assert_eq!(table.tiles(JobNo(2)).unwrap(), []);
        assert_eq!(table.tiles(JobNo(3)).unwrap(), [(7, vec![3; 100])]);
    }

    #[test]
    fn tiles_beyond_what_the_disk_takes_are_let_go() {
        let folder = tempfile::tempdir().unwrap();
        let (table, _) = JobTable::open(folder.path()).unwrap();
        for tile in 0..2_000 {
            table.put_tile(JobNo(1), tile, vec![0; 28 << 10]);
            assert!(table.shared.lock().batch.tile_bytes <= limits::TILES_UNSTORED_BYTES_MAX);
        }
        table.ticket().blocking_recv().unwrap().unwrap();
        assert!(!table.tiles(JobNo(1)).unwrap().is_empty());
    }

    #[test]
    fn file_that_is_no_table_is_named() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join(FILE), vec![7; 8192]).unwrap();
        let error = JobTable::open(folder.path()).unwrap_err();
        assert!(error.to_string().contains(FILE), "{error}");
    }
}
