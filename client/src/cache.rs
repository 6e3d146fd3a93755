//! What the daemon's page cache holds, as plain types.

use pbgi_proto::v1;
use serde::Serialize;

/// The page cache: what it holds, for whom, and how well it does.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct CacheStatus {
    /// Bytes of the shared segment.
    pub segment_bytes: u64,
    /// Bytes of the pages held.
    pub resident_bytes: u64,
    /// Most bytes of pages held at a time.
    pub resident_bytes_peak: u64,
    /// Frames of node pages.
    pub nodes: CachePool,
    /// Frames of point pages.
    pub points: CachePool,
    /// Open scenes.
    pub scenes: Vec<CachedScene>,
    /// Worker processes.
    pub workers: Vec<CachePins>,
    /// What all tiles found since the daemon started.
    pub lookups: Lookups,
}

/// Where pages were found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Lookups {
    /// In a worker's own cache.
    pub local_hits: u64,
    /// In the shared cache.
    pub shared_hits: u64,
    /// Of these, pages that another job loaded.
    pub shared_hits_other_job: u64,
    /// On disk.
    pub misses: u64,
}

/// The frames of one kind of page, and what was done with them since the daemon started.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct CachePool {
    /// Frames.
    pub frames: u64,
    /// Bytes of a frame.
    pub frame_bytes: u64,
    /// Most frames that one worker may hold.
    pub local_frames: u64,
    /// Frames that hold a page of an open scene.
    pub resident: u64,
    /// Frames of closed scenes that somebody holds.
    pub doomed: u64,
    /// Frames being loaded.
    pub loading: u64,
    /// Pages that workers asked the daemon for.
    pub fetches: u64,
    /// Pages loaded.
    pub loads: u64,
    /// Bytes loaded.
    pub bytes_loaded: u64,
    /// Loads that failed.
    pub failed_loads: u64,
    /// Pages loaded again after they were evicted.
    pub reloads: u64,
    /// Loads of a page that was resident or pinned: always 0.
    pub redundant_reads: u64,
    /// Pages evicted.
    pub evictions: u64,
}

/// An open scene.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct CachedScene {
    /// Its path.
    pub scene: String,
    /// What is open.
    pub build_id: String,
    /// Its file of nodes.
    pub nodes: CachedFile,
    /// Its file of points.
    pub points: CachedFile,
}

/// One file of an open scene.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct CachedFile {
    /// Pages.
    pub pages: u64,
    /// Of these, pages held.
    pub resident: u64,
    /// Pages asked for.
    pub fetches: u64,
    /// Pages loaded.
    pub loads: u64,
    /// Pages loaded again after they were evicted.
    pub reloads: u64,
    /// Pages evicted.
    pub evictions: u64,
}

/// What a worker holds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct CachePins {
    /// Its seat.
    pub slot: u32,
    /// Its process id.
    pub pid: u32,
    /// Node pages.
    pub node_frames: u32,
    /// Point pages.
    pub point_frames: u32,
}

impl From<v1::CacheStatus> for CacheStatus {
    fn from(wire: v1::CacheStatus) -> Self {
        let pool = |pool: Option<v1::CachePool>| {
            let pool = pool.unwrap_or_default();
            CachePool {
                frames: pool.frames,
                frame_bytes: pool.frame_bytes,
                local_frames: pool.local_frames,
                resident: pool.resident,
                doomed: pool.doomed,
                loading: pool.loading,
                fetches: pool.fetches,
                loads: pool.loads,
                bytes_loaded: pool.bytes_loaded,
                failed_loads: pool.failed_loads,
                reloads: pool.reloads,
                redundant_reads: pool.redundant_reads,
                evictions: pool.evictions,
            }
        };
        let file = |file: Option<v1::CachedFile>| {
            let file = file.unwrap_or_default();
            CachedFile {
                pages: file.pages,
                resident: file.resident,
                fetches: file.fetches,
                loads: file.loads,
                reloads: file.reloads,
                evictions: file.evictions,
            }
        };
        let scene = |scene: v1::CachedScene| CachedScene {
            scene: scene.scene,
            build_id: scene.build_id,
            nodes: file(scene.nodes),
            points: file(scene.points),
        };
        let pins = |pins: v1::CachePins| CachePins {
            slot: pins.slot,
            pid: pins.pid,
            node_frames: pins.node_frames,
            point_frames: pins.point_frames,
        };
        Self {
            segment_bytes: wire.segment_bytes,
            resident_bytes: wire.resident_bytes,
            resident_bytes_peak: wire.resident_bytes_peak,
            nodes: pool(wire.nodes),
            points: pool(wire.points),
            scenes: wire.scenes.into_iter().map(scene).collect(),
            workers: wire.workers.into_iter().map(pins).collect(),
            lookups: Lookups {
                local_hits: wire.local_hits,
                shared_hits: wire.shared_hits,
                shared_hits_other_job: wire.shared_hits_other_job,
                misses: wire.misses,
            },
        }
    }
}
