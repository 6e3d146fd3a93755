//! How the memory limit is split.

use crate::error::BuildError;
use crate::limits::{
    BATCH_POINTS, BATCHES_IN_FLIGHT, BLOCKS_PER_READ_MAX, MEMORY_MIN_BYTES, MEMORY_RESERVE_BYTES, SORT_MIN_BYTES,
};
use crate::sort::buffer::BYTES_PER_POINT;
use pbgi_core::limits::MORTON_BITS;
use pbgi_core::{BuildSettings, NodeRecord, PageKind, PointRecord};
use pbgi_store::PageLayout;
use pbgi_store::limits::{RUN_BLOCK_RECORDS, WRITE_BUFFER_BYTES};

const BLOCK_BYTES: u64 = (RUN_BLOCK_RECORDS * size_of::<PointRecord>()) as u64;

/// What each part of a build may use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Budget {
    /// Points sorted in memory at once.
    pub run_points: usize,
    /// Runs merged at once.
    pub fan_in: usize,
    sort_bytes: u64,
}

impl Budget {
    /// Splits `memory_bytes`.
    ///
    /// # Errors
    /// [`BuildError::Memory`] if the settings need more.
    pub fn new(memory_bytes: u64, settings: &BuildSettings) -> Result<Self, BuildError> {
        let fixed = MEMORY_RESERVE_BYTES + page_buffer_bytes(settings) + queue_bytes(settings) + batch_bytes();
        let needed = MEMORY_MIN_BYTES.max(fixed + SORT_MIN_BYTES);
        if memory_bytes < needed {
            return Err(BuildError::Memory {
                given: memory_bytes,
                needed,
            });
        }
        let sort_bytes = memory_bytes - fixed;
        // The index of a sort key is a u32.
        let run_points = (sort_bytes / BYTES_PER_POINT).min(u64::from(u32::MAX));
        // One block is the output of an intermediate merge.
        let fan_in = (sort_bytes / BLOCK_BYTES - 1).max(2);
        Ok(Self {
            run_points: usize::try_from(run_points).unwrap_or(usize::MAX),
            fan_in: usize::try_from(fan_in).unwrap_or(usize::MAX),
            sort_bytes,
        })
    }

    /// Blocks that each of `runs` reads at once.
    pub fn blocks_per_read(&self, runs: usize) -> usize {
        let blocks = self.sort_bytes / BLOCK_BYTES / (runs as u64).max(1);
        usize::try_from(blocks)
            .unwrap_or(usize::MAX)
            .clamp(1, BLOCKS_PER_READ_MAX)
    }
}

fn page_buffer_bytes(settings: &BuildSettings) -> u64 {
    [PageKind::Node, PageKind::Point]
        .map(|kind| PageLayout::new(kind, settings).page_bytes().max(WRITE_BUFFER_BYTES) as u64)
        .iter()
        .sum()
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

fn batch_bytes() -> u64 {
    // The two ends hold one each, and one is grown into.
    ((BATCHES_IN_FLIGHT + 3) * BATCH_POINTS * (size_of::<PointRecord>() + size_of::<u64>())) as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_settings_fit_the_least_memory() {
        let budget = Budget::new(MEMORY_MIN_BYTES, &BuildSettings::default()).unwrap();
        assert!(budget.run_points > 600_000, "{budget:?}");
        assert!(budget.fan_in > 150, "{budget:?}");
    }

    #[test]
    fn what_does_not_fit_is_refused_naming_what_would() {
        let settings = BuildSettings {
            chunk_levels: 5,
            nodes_per_page: 131_072,
            points_per_page: 131_072,
            ..BuildSettings::default()
        };
        let error = Budget::new(MEMORY_MIN_BYTES, &settings).unwrap_err();
        let BuildError::Memory { needed, .. } = error else {
            panic!("{error}")
        };
        Budget::new(needed, &settings).unwrap();
        assert!(Budget::new(needed - 1, &settings).is_err());
    }

    #[test]
    fn reads_stay_within_the_budget_for_any_number_of_runs() {
        let budget = Budget::new(1 << 28, &BuildSettings::default()).unwrap();
        for runs in 1..=budget.fan_in {
            let bytes = (budget.blocks_per_read(runs) * runs) as u64 * BLOCK_BYTES;
            assert!(bytes <= budget.sort_bytes, "{runs} runs take {bytes}");
        }
    }
}
