//! The page cache on the wire.

use crate::dispatcher::CacheReport;
use pbgi_cache::{PoolCounters, PoolLayout, SceneCounters};
use pbgi_core::PageKind;
use pbgi_proto::v1;

/// What `GetCache` answers.
pub(super) fn status(report: CacheReport) -> v1::CacheStatus {
    let CacheReport {
        layout,
        cache,
        scenes,
        workers,
        lookups,
    } = report;
    let scene = |(mount, [nodes, points]): (crate::mounts::MountStatus, [SceneCounters; 2])| v1::CachedScene {
        scene: mount.path.to_string_lossy().into_owned(),
        build_id: mount.build_id.to_string(),
        nodes: Some(file(&nodes)),
        points: Some(file(&points)),
    };
    let pins = |(birth, [node_frames, point_frames]): (crate::supervisor::WorkerBirth, [u32; 2])| v1::CachePins {
        slot: birth.seat.slot.into(),
        pid: birth.pid,
        node_frames,
        point_frames,
    };
    v1::CacheStatus {
        segment_bytes: layout.total_bytes(),
        resident_bytes: cache.resident_bytes,
        resident_bytes_peak: cache.resident_bytes_peak,
        nodes: Some(pool(layout.pool(PageKind::Node), &cache.node)),
        points: Some(pool(layout.pool(PageKind::Point), &cache.point)),
        scenes: scenes.into_iter().map(scene).collect(),
        workers: workers.into_iter().map(pins).collect(),
        local_hits: lookups.local_hits,
        shared_hits: lookups.shared_hits,
        shared_hits_other_job: lookups.shared_hits_other_job,
        misses: lookups.cache_misses,
    }
}

fn pool(layout: &PoolLayout, counters: &PoolCounters) -> v1::CachePool {
    v1::CachePool {
        frames: counters.frames,
        frame_bytes: layout.frame_bytes as u64,
        local_frames: layout.local_frames.into(),
        resident: counters.resident,
        doomed: counters.doomed,
        loading: counters.loading,
        fetches: counters.fetches,
        loads: counters.loads,
        bytes_loaded: counters.bytes_loaded,
        failed_loads: counters.failed_loads,
        reloads: counters.reloads,
        redundant_reads: counters.redundant_reads,
        evictions: counters.evictions,
    }
}

fn file(counters: &SceneCounters) -> v1::CachedFile {
    v1::CachedFile {
        pages: counters.pages,
        resident: counters.resident,
        fetches: counters.fetches,
        loads: counters.loads,
        reloads: counters.reloads,
        evictions: counters.evictions,
    }
}
