//! Lease, shade, complete, until the daemon closes the queue.

use crate::error::WorkerError;
use crate::queue::Queue;
use crate::shading::{FailureKind, Order, TASKS_KEPT};
use crate::task::Task;
use crate::tile::Tile;
use pbgi_proto::v1;
use pbgi_proto::v1::complete_tile_request::Outcome;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::SyncSender;
use std::time::Duration;
use tokio::sync::oneshot;

/// A lease expires after ten seconds without one.
const HEARTBEAT: Duration = Duration::from_secs(2);

/// Serves the queue until it closes ([`WorkerError::Gone`]) or something fails.
pub(crate) async fn serve(mut queue: Queue, shader: SyncSender<Order>) -> Result<(), WorkerError> {
    let mut tasks = Tasks(Vec::new());
    loop {
        let Some(lease) = queue.lease().await? else { continue };
        let outcome = match work(&mut queue, &mut tasks, &lease).await? {
            Work::Tile(task, tile) => shade(&mut queue, &shader, task, tile).await?,
            Work::Ended => None,
            Work::Nonsense(message) => Some(Outcome::Failure(v1::TileFailure {
                kind: FailureKind::Internal.name().to_owned(),
                message,
            })),
        };
        if let Some(outcome) = outcome
            && !queue.complete(lease.lease_id, outcome).await?
        {
            tracing::info!(lease = lease.lease_id, "lease had ended, result dropped");
        }
    }
}

/// What a lease stands for.
enum Work {
    Tile(Arc<Task>, Tile),
    /// Its job is over, cancelled most likely.
    Ended,
    /// A message that makes no sense.
    Nonsense(String),
}

async fn work(queue: &mut Queue, tasks: &mut Tasks, lease: &v1::Lease) -> Result<Work, WorkerError> {
    let tile = match Tile::from_wire(lease) {
        Ok(tile) => tile,
        Err(fault) => return Ok(Work::Nonsense(fault)),
    };
    if let Some(task) = tasks.get(tile.task_id) {
        return Ok(Work::Tile(task, tile));
    }
    let Some(wire) = queue.task(tile.task_id).await? else {
        return Ok(Work::Ended);
    };
    Ok(match Task::from_wire(tile.task_id, wire) {
        Ok(task) => Work::Tile(tasks.keep(task), tile),
        Err(fault) => Work::Nonsense(fault),
    })
}

/// Has a tile shaded while its lease is kept alive; `None` if the lease ended meanwhile.
async fn shade(
    queue: &mut Queue,
    shader: &SyncSender<Order>,
    task: Arc<Task>,
    tile: Tile,
) -> Result<Option<Outcome>, WorkerError> {
    let lease_id = tile.lease_id;
    let abandoned = Arc::new(AtomicBool::new(false));
    let (reply, mut result) = oneshot::channel();
    let order = Order {
        task,
        tile,
        abandoned: Arc::clone(&abandoned),
        reply,
    };
    let died = |_| WorkerError::Defect("the shading thread is gone".to_owned());
    // Never blocks: the thread has answered the last order before this one is made.
    shader
        .send(order)
        .map_err(|_| WorkerError::Defect("the shading thread is gone".to_owned()))?;
    let mut beat = tokio::time::interval(HEARTBEAT);
    beat.tick().await;
    loop {
        tokio::select! {
            outcome = &mut result => return outcome.map_err(died),
            _ = beat.tick() => {
                if !queue.heartbeat(lease_id).await? {
                    abandoned.store(true, Ordering::Relaxed);
                    result.await.map_err(died)?;
                    return Ok(None);
                }
            }
        }
    }
}

/// The last few tasks, most recently used first.
struct Tasks(Vec<Arc<Task>>);

impl Tasks {
    fn get(&mut self, id: u64) -> Option<Arc<Task>> {
        let index = self.0.iter().position(|task| task.id == id)?;
        self.0[..=index].rotate_right(1);
        self.0.first().cloned()
    }

    fn keep(&mut self, task: Task) -> Arc<Task> {
        let task = Arc::new(task);
        self.0.truncate(TASKS_KEPT - 1);
        self.0.insert(0, Arc::clone(&task));
        task
    }
}
