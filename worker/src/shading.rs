//! The thread that shades: owns the local cache and the miss channel, takes one tile at a time.

use crate::attach::Attached;
use crate::error::WorkerError;
use crate::pages::{PageSource, Pages, SceneView};
use crate::task::Task;
use crate::tile::{Tile, values};
use nix::time::{ClockId, clock_gettime};
use pbgi_proto::v1;
use pbgi_proto::v1::complete_tile_request::Outcome;
use pbgi_shade::{Hit, ShadeCounters, ShadeError, Shaded, Shader, SourceError, Tracer};
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;
use std::thread::JoinHandle;
use tokio::sync::oneshot;

/// Tasks whose shaders are kept: tiles of several jobs arrive by turns.
pub(crate) const TASKS_KEPT: usize = 4;

/// A tile to shade.
pub(crate) struct Order {
    pub(crate) task: Arc<Task>,
    pub(crate) tile: Tile,
    /// Set when the lease has ended: the result would be dropped.
    pub(crate) abandoned: Arc<AtomicBool>,
    pub(crate) reply: oneshot::Sender<Option<Outcome>>,
}

/// Starts the thread. It ends when the sender is dropped.
pub(crate) fn start(attached: Attached) -> Result<(mpsc::SyncSender<Order>, JoinHandle<()>), WorkerError> {
    let (sender, orders) = mpsc::sync_channel(1);
    let thread = std::thread::Builder::new().name("shade".to_owned()).spawn(move || {
        let mut bench = Bench {
            pages: attached.into_pages(),
            scenes: Vec::new(),
        };
        while let Ok(order) = orders.recv() {
            let Order {
                task,
                tile,
                abandoned,
                reply,
            } = order;
            // A receiver that is gone means that the process ends.
            let _ = reply.send(bench.shade(&task, &tile, &abandoned));
        }
    });
    let thread = thread.map_err(|error| WorkerError::Os {
        action: "start the shading thread",
        reason: error.to_string(),
    })?;
    Ok((sender, thread))
}

/// What the thread works with.
struct Bench {
    pages: Pages,
    /// Most recently used first.
    scenes: Vec<Prepared>,
}

/// A task made ready.
struct Prepared {
    task_id: u64,
    tool: Tool,
    view: SceneView,
}

/// What a task's tiles are worked on with.
enum Tool {
    Shader(Box<Shader>),
    Tracer(Box<Tracer>),
}

impl Tool {
    fn counters(&self) -> ShadeCounters {
        match self {
            Self::Shader(shader) => shader.counters(),
            Self::Tracer(tracer) => tracer.counters(),
        }
    }

    /// Works on a group of a tile; its values are appended to `bytes`.
    fn work(
        &mut self,
        tile: &Tile,
        group: Range<usize>,
        source: &mut PageSource<'_>,
        bytes: &mut Vec<u8>,
    ) -> Result<(), ShadeError> {
        match self {
            Self::Shader(shader) => {
                let mut shaded = vec![Shaded::default(); group.len()];
                shader.shade_group(&tile.receivers[group], source, &mut shaded)?;
                bytes.extend(values(&shaded));
            }
            Self::Tracer(tracer) => {
                let mut hits = vec![Hit::default(); group.len()];
                tracer.trace_group(tile.rays(group), source, &mut hits)?;
                bytes.extend(values(&hits));
            }
        }
        Ok(())
    }
}

impl Bench {
    /// `None` if the tile was abandoned.
    fn shade(&mut self, task: &Task, tile: &Tile, abandoned: &AtomicBool) -> Option<Outcome> {
        let span = tracing::debug_span!("tile", task = tile.task_id, tile = tile.number, lease = tile.lease_id);
        let _entered = span.enter();
        if let Err(error) = self.prepare(task) {
            return Some(failure(&error, None));
        }
        let prepared = self.scenes.first_mut()?;
        let before = prepared.tool.counters();
        let cpu_before = thread_cpu_nanos();
        let mut bytes = Vec::new();
        let mut source = PageSource::new(&mut self.pages, &mut prepared.view, task.id);
        for group in &tile.groups {
            if abandoned.load(Ordering::Relaxed) {
                return None;
            }
            if let Err(error) = prepared.tool.work(tile, group.clone(), &mut source, &mut bytes) {
                return Some(failure(&error, source.take_fault()));
            }
        }
        let mut counters = source.counters();
        counters.cpu_nanos = thread_cpu_nanos().saturating_sub(cpu_before);
        add_shading(&mut counters, &before, &prepared.tool.counters());
        Some(Outcome::Result(v1::TileResult {
            values: bytes,
            counters: Some(counters),
        }))
    }

    /// Brings the task's shader to the front.
    fn prepare(&mut self, task: &Task) -> Result<(), ShadeError> {
        if let Some(index) = self.scenes.iter().position(|prepared| prepared.task_id == task.id) {
            self.scenes[..=index].rotate_right(1);
            return Ok(());
        }
        let tool = match task.pixel_angle {
            None => {
                let shader = Shader::new(&task.scene, task.settings, task.environment.as_ref())?;
                Tool::Shader(Box::new(shader))
            }
            Some(angle) => Tool::Tracer(Box::new(Tracer::new(&task.scene, angle))),
        };
        self.scenes.truncate(TASKS_KEPT - 1);
        self.scenes.insert(
            0,
            Prepared {
                task_id: task.id,
                tool,
                view: SceneView::new(&task.scene, task.mount),
            },
        );
        Ok(())
    }
}

/// Kind and text of a failed tile; what the page source knows is more exact than what the shader could say.
fn failure(error: &ShadeError, fault: Option<(FailureKind, String)>) -> Outcome {
    let (kind, message) = fault.unwrap_or_else(|| {
        let kind = match error {
            ShadeError::Source(SourceError::Corrupt(_)) => FailureKind::Corrupt,
            ShadeError::Source(SourceError::Io(_)) => FailureKind::Io,
            ShadeError::Budget { .. } => FailureKind::Limit,
            _ => FailureKind::Internal,
        };
        (kind, error.to_string())
    });
    tracing::warn!(kind = kind.name(), message, "tile failed");
    Outcome::Failure(v1::TileFailure {
        kind: kind.name().to_owned(),
        message,
    })
}

/// The closed list of why a tile fails.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FailureKind {
    /// The scene's bytes are not what they should be.
    Corrupt,
    /// The scene cannot be read.
    Io,
    /// The scene asks for more work than any honest one.
    Limit,
    /// A defect.
    Internal,
}

impl FailureKind {
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Corrupt => "corrupt",
            Self::Io => "io",
            Self::Limit => "limit",
            Self::Internal => "internal",
        }
    }
}

fn add_shading(counters: &mut v1::TileCounters, before: &ShadeCounters, after: &ShadeCounters) {
    counters.receivers = after.receivers - before.receivers;
    counters.cut_elements = after.cut_elements - before.cut_elements;
    counters.nodes_visited = after.nodes_visited - before.nodes_visited;
}

/// Processor time of this thread; 0 where the system does not tell.
fn thread_cpu_nanos() -> u64 {
    const NANOS: u64 = 1_000_000_000;
    let time = clock_gettime(ClockId::CLOCK_THREAD_CPUTIME_ID).ok();
    time.map_or(0, |time| time.tv_sec() as u64 * NANOS + time.tv_nsec() as u64)
}
