//! How the memory limit is split.

use crate::error::BuildError;
use crate::limits::{
    BLOCKS_PER_READ_MAX, JOB_MEMORY_SHARE, JOB_POINTS_MAX, JOB_POINTS_MIN, MEMORY_MIN_BYTES, MEMORY_RESERVE_BYTES,
    SORT_MIN_BYTES, THREADS_MAX,
};
use crate::octree::construction::Gang;
use crate::octree::subtree::nodes_max;
use crate::sort::radix::SortedPoints;
use pbgi_core::limits::MORTON_BITS;
use pbgi_core::{BuildSettings, NodeRecord, PointRecord};
use pbgi_store::limits::{PAGE_WRITER_BYTES, RUN_BLOCK_BYTES, RUN_WRITER_BYTES};

/// One for nodes, one for points.
const PAGE_BUFFER_BYTES: u64 = 2 * PAGE_WRITER_BYTES as u64;

/// The part of a run that points are taken from, and the one behind it, which is read meanwhile.
const PARTS_PER_RUN: u64 = 2;

/// What each part of a build may use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Budget {
    /// Points that are sorted in memory without any run.
    pub core_points: usize,
    /// Points of a run: as many again are collected while one is sorted and written.
    pub run_points: usize,
    /// Runs merged at once.
    pub fan_in: usize,
    /// Threads, and the size of their jobs.
    pub gang: Gang,
    sort_bytes: u64,
}

impl Budget {
    /// Splits `memory_bytes` for a build on `threads` threads.
    ///
    /// # Errors
    /// [`BuildError::Memory`] if the settings need more.
    pub fn new(memory_bytes: u64, threads: usize, settings: &BuildSettings) -> Result<Self, BuildError> {
        let fixed = MEMORY_RESERVE_BYTES + PAGE_BUFFER_BYTES + queue_bytes(settings);
        let gang = gang(memory_bytes, fixed, threads, settings);
        let fixed = fixed + job_bytes(gang, settings);
        let needed = MEMORY_MIN_BYTES.max(fixed + SORT_MIN_BYTES);
        if memory_bytes < needed {
            return Err(BuildError::Memory {
                given: memory_bytes,
                needed,
            });
        }
        let sort_bytes = memory_bytes - fixed;
        let points = |bytes_each: u64| usize::try_from((sort_bytes / bytes_each).min(u64::from(u32::MAX)));
        let fan_in = (merge_blocks(sort_bytes) / PARTS_PER_RUN).max(2);
        Ok(Self {
            core_points: points(SortedPoints::bytes(1)).unwrap_or(usize::MAX),
            run_points: points(2 * SortedPoints::bytes(1)).unwrap_or(usize::MAX),
            fan_in: usize::try_from(fan_in).unwrap_or(usize::MAX),
            gang,
            sort_bytes,
        })
    }

    /// Blocks that each of `runs` reads at once.
    pub fn blocks_per_read(&self, runs: usize) -> usize {
        let blocks = merge_blocks(self.sort_bytes) / PARTS_PER_RUN / (runs as u64).max(1);
        usize::try_from(blocks)
            .unwrap_or(usize::MAX)
            .clamp(1, BLOCKS_PER_READ_MAX)
    }
}

/// Blocks that runs may be read to while one is written.
fn merge_blocks(sort_bytes: u64) -> u64 {
    sort_bytes.saturating_sub(RUN_WRITER_BYTES as u64) / RUN_BLOCK_BYTES as u64
}

/// All write-out queues full: `8^1 + .. + 8^chunk_levels` nodes in each.
fn queue_bytes(settings: &BuildSettings) -> u64 {
    if settings.chunk_levels == 0 {
        return 0;
    }
    let nodes: u64 = (1..=settings.chunk_levels).map(|level| 8u64.pow(level)).sum();
    let queues = u64::from(MORTON_BITS.div_ceil(settings.chunk_levels));
    nodes * queues * size_of::<NodeRecord>() as u64
}

/// Jobs as large as their share of the memory allows, and what is left when `fixed` bytes are taken.
fn gang(memory_bytes: u64, fixed: u64, threads: usize, settings: &BuildSettings) -> Gang {
    let smallest = Gang {
        threads: threads.clamp(1, THREADS_MAX),
        job_points: JOB_POINTS_MIN.max(settings.leaf_max as usize),
    };
    let left = memory_bytes.saturating_sub(fixed + SORT_MIN_BYTES);
    let share = left.min(memory_bytes / JOB_MEMORY_SHARE);
    let fitting = smallest.job_points as u64 * share / job_bytes(smallest, settings).max(1);
    Gang {
        job_points: (fitting as usize).clamp(smallest.job_points, JOB_POINTS_MAX.max(smallest.job_points)),
        ..smallest
    }
}

/// All jobs in flight, each with the most nodes that its points can make.
fn job_bytes(gang: Gang, settings: &BuildSettings) -> u64 {
    let points = 2 * gang.job_points;
    let point_bytes = points * (size_of::<PointRecord>() + size_of::<u64>());
    let node_bytes = nodes_max(points, settings) * size_of::<NodeRecord>();
    (gang.jobs_in_flight() * (point_bytes + node_bytes)) as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_settings_fit_the_least_memory() {
        let budget = Budget::new(MEMORY_MIN_BYTES, 2, &BuildSettings::default()).unwrap();
        assert!(budget.core_points > 550_000, "{budget:?}");
        assert!(budget.fan_in > 55, "{budget:?}");
    }

    #[test]
    fn what_does_not_fit_is_refused_naming_what_would() {
        let settings = BuildSettings {
            chunk_levels: 5,
            leaf_max: 1024,
            ..BuildSettings::default()
        };
        let threads = THREADS_MAX;
        let error = Budget::new(MEMORY_MIN_BYTES, threads, &settings).unwrap_err();
        let BuildError::Memory { needed, .. } = error else {
            panic!("{error}")
        };
        Budget::new(needed, threads, &settings).unwrap();
        assert!(Budget::new(needed - 1, threads, &settings).is_err());
    }

    #[test]
    fn reads_stay_within_the_budget_for_any_number_of_runs() {
        let budget = Budget::new(1 << 28, 2, &BuildSettings::default()).unwrap();
        for runs in 1..=budget.fan_in {
            let blocks = budget.blocks_per_read(runs) as u64 * runs as u64 * PARTS_PER_RUN;
            let bytes = blocks * RUN_BLOCK_BYTES as u64 + RUN_WRITER_BYTES as u64;
            assert!(bytes <= budget.sort_bytes, "{runs} runs take {bytes}");
        }
    }
}
