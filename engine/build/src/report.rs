//! What a build is asked for, what it says on the way, and what it reports at the end.

use crate::octree::construction::BusySeconds;
use pbgi_core::{BuildSettings, SceneInfo};
use pbgi_store::Overwrite;
use std::path::PathBuf;

/// What to build, where, and with how much.
#[derive(Clone, Debug)]
pub struct BuildRequest {
    /// Folder of the scene, `NAME.pbgi`.
    pub output: PathBuf,
    /// What happens if it exists.
    pub overwrite: Overwrite,
    /// Folder for sort runs; must exist. Used only if the points do not fit the memory.
    pub scratch_dir: PathBuf,
    /// Memory of the whole process, bytes; at least [`crate::limits::MEMORY_MIN_BYTES`].
    pub memory_bytes: u64,
    /// Shape and layout of the octree.
    pub settings: BuildSettings,
    /// Names the input, where the caller can: the runs of a build that is killed then wait in `scratch_dir`, and the next one
    /// with this value goes on from them, if it reads the same points in the same order, which is checked.
    pub input_key: Option<u64>,
}

/// What a build is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Stage {
    /// Takes points from the input; once more from the start where their bounds had to be found first.
    Reading,
    /// Sorts points in memory, writes runs.
    Sorting,
    /// Merges runs into longer ones, because there are too many to merge at once.
    Merging,
    /// Merges what is left, makes nodes and writes the scene.
    Building,
}

impl Stage {
    /// Name for people and records.
    pub fn name(self) -> &'static str {
        match self {
            Self::Reading => "reading",
            Self::Sorting => "sorting",
            Self::Merging => "merging",
            Self::Building => "building",
        }
    }
}

/// How far a build has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BuildProgress {
    /// What it is doing.
    pub stage: Stage,
    /// Points done in this stage.
    pub done: u64,
    /// Points to do in this stage, where known; may be an estimate while reading.
    pub total: Option<u64>,
}

/// Wall time of each stage, seconds.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StageSeconds {
    /// Waiting for the input.
    pub reading: f64,
    /// Sorting in memory and writing runs.
    pub sorting: f64,
    /// Merging runs into longer ones; 0 if the last merge could take them all.
    pub merging: f64,
    /// Construction and writing, with the last merge beside it on another thread.
    pub building: f64,
}

/// What a build did.
#[derive(Clone, Debug, PartialEq)]
pub struct BuildReport {
    /// The scene.
    pub info: SceneInfo,
    /// Wall time of reading, sorting and merging, up to the last merge.
    pub sort_seconds: f64,
    /// Wall time of the last merge, construction and writing.
    pub build_seconds: f64,
    /// The same in detail.
    pub stages: StageSeconds,
    /// Where the threads of the last stage spent their time.
    pub busy: BusySeconds,
    /// Most bytes that all write-out queues held at once.
    pub queue_peak_bytes: u64,
    /// Bytes read back from scratch; the input counts its own.
    pub bytes_read: u64,
    /// Bytes written to scratch and to the scene.
    pub bytes_written: u64,
    /// Sorted runs written to scratch, those of intermediate merges included; 0 if the points fit the memory.
    pub runs: u64,
    /// Runs among them that a killed build had left, so that they were not written again.
    pub runs_resumed: u64,
    /// Points with a radiance at the largest value a half-precision float holds: clamped, as far as one can tell.
    pub radiance_clamped: u64,
    /// Harmonics of nodes that left the range of a half-precision float and were clamped.
    pub harmonics_clamped: u64,
    /// Points in leaves of the deepest level that hold more than `leaf_max`.
    pub overflow_points: u64,
}
