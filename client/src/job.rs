//! Jobs and daemon in plain types.

use pbgi_core::{BuildSettings, ShadeSettings, Statistics};
use pbgi_points::{CloudOptions, Density, GBufferOptions};
use serde::{Serialize, Serializer};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Points or meshes in, a scene directory out.
#[derive(Clone, Debug)]
pub struct BuildJob {
    /// Input files, absolute.
    pub inputs: Vec<PathBuf>,
    /// The scene directory, absolute.
    pub output: PathBuf,
    /// Whether an existing output is replaced.
    pub overwrite: bool,
    /// How the octree is built.
    pub settings: BuildSettings,
    /// How densely meshes are sampled; `None` for the default.
    pub density: Option<Density>,
    /// How point clouds are read.
    pub cloud: CloudOptions,
}

/// A scene and a G-buffer in, an image out.
#[derive(Clone, Debug)]
pub struct ShadeJob {
    /// The scene directory, absolute.
    pub scene: PathBuf,
    /// The G-buffer, absolute.
    pub gbuffer: PathBuf,
    /// How it is read.
    pub passes: GBufferOptions,
    /// The image, absolute.
    pub output: PathBuf,
    /// Whether an existing output is replaced.
    pub overwrite: bool,
    /// How receivers are shaded.
    pub settings: ShadeSettings,
    /// Environment map, absolute; `None` for black.
    pub environment: Option<PathBuf>,
    /// Most workers for this job; `None` for all.
    pub workers: Option<u32>,
}

/// What is wanted beside the task.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct JobOptions {
    /// For whom; empty for the calling user.
    pub user: String,
    /// Free words: show, shot, department.
    pub labels: BTreeMap<String, String>,
    /// Higher ones go first.
    pub priority: i32,
    /// Jobs that must succeed first.
    pub after: Vec<String>,
    /// Whether it waits to be resumed.
    pub paused: bool,
    /// Whether an unfinished job with the same task, under whatever id, will do.
    #[serde(skip)]
    pub attach: bool,
}

/// A line of a job's history.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct JobEvent {
    /// Milliseconds since the Unix epoch.
    pub unix_millis: i64,
    /// What happened.
    pub text: String,
}

/// Where a job stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum JobState {
    /// Waits.
    Queued,
    /// Works.
    Running,
    /// Done, the output is there.
    Succeeded,
    /// Over, without output.
    Failed,
    /// Cancelled, without output.
    Cancelled,
}

impl JobState {
    /// Whether nothing will change any more.
    pub fn ended(self) -> bool {
        matches!(self, Self::Succeeded | Self::Failed | Self::Cancelled)
    }

    /// One word.
    pub fn name(self) -> &'static str {
        match self {
            Self::Queued => "queued",
            Self::Running => "running",
            Self::Succeeded => "succeeded",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
        }
    }
}

/// A job as the daemon reports it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Job {
    /// The caller's name for it.
    pub id: String,
    /// Where it stands.
    pub state: JobState,
    /// What it is doing, for people.
    pub stage: String,
    /// Units of the stage that are done.
    pub done: u64,
    /// Units of the stage; 0 where unknown.
    pub total: u64,
    /// Why it failed; empty otherwise.
    pub error: String,
    /// Complete when the job is.
    #[serde(serialize_with = "serialize_statistics")]
    pub statistics: Statistics,
    /// What the job does, for people.
    pub title: String,
    /// What was wanted beside the task.
    pub options: JobOptions,
    /// What happened to it, oldest first.
    pub history: Vec<JobEvent>,
}

/// Largest integer that a JSON number holds exactly.
const EXACT_MAX: f64 = 9_007_199_254_740_992.0;

/// Every row by name, in the table's order: counts without a fraction, `null` where a row does not apply.
///
/// # Errors
/// Those of the serializer.
pub fn serialize_statistics<S: Serializer>(statistics: &Statistics, serializer: S) -> Result<S::Ok, S::Error> {
    let number = |value: Option<f64>| match value {
        Some(value) if value.fract() == 0.0 && (0.0..=EXACT_MAX).contains(&value) => {
            serde_json::Value::from(value as u64)
        }
        // What is not a number does not apply.
        Some(value) => serde_json::Value::from(value),
        None => serde_json::Value::Null,
    };
    serializer.collect_map(statistics.rows().iter().map(|row| (row.name, number(row.value))))
}

/// The daemon as it reports itself.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DaemonStatus {
    /// Version of the program.
    pub version: String,
    /// Process id.
    pub pid: u32,
    /// Memory cap, bytes.
    pub memory_bytes: u64,
    /// Bytes of the shared segment.
    pub segment_bytes: u64,
    /// Frames of node pages.
    pub nodes: Pool,
    /// Frames of point pages.
    pub points: Pool,
    /// Worker processes.
    pub workers: Vec<WorkerStatus>,
    /// Open scenes.
    pub mounts: Vec<MountStatus>,
    /// Jobs that wait.
    pub jobs_queued: u32,
    /// Jobs that work.
    pub jobs_running: u32,
}

/// Frames of one kind.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Pool {
    /// All.
    pub frames: u32,
    /// Those that hold a page.
    pub resident: u32,
}

/// A worker process.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct WorkerStatus {
    /// Its seat.
    pub slot: u32,
    /// How often the seat was taken.
    pub epoch: u32,
    /// Process id.
    pub pid: u32,
    /// Whether it shades a tile.
    pub busy: bool,
    /// Frames it holds.
    pub frames_pinned: u32,
}

/// An open scene.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct MountStatus {
    /// Its directory.
    pub scene: String,
    /// Identity of its content.
    pub build_id: String,
    /// Pages read so far.
    pub pages_loaded: u64,
}
