//! From a memory budget to a layout.

use crate::error::CacheError;
use crate::layout::{ALIGN, FRAMES_MAX, LOCAL_FRAMES_MIN, PoolLayout, SegmentLayout};
use pbgi_core::limits::NODE_MEMORY_SHARE;

/// What a cache may use.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CacheBudget {
    /// Bytes of the whole segment, ledgers and tables included.
    pub bytes: u64,
    /// Workers that attach.
    pub workers: u32,
    /// Bytes of the largest node page that will be cached.
    pub node_page_bytes: usize,
    /// Bytes of the largest point page that will be cached.
    pub point_page_bytes: usize,
    /// Loads in flight at a time, per pool.
    pub loads_in_flight_max: u32,
    /// Share of the page memory given to node pages, above 0 and below 1; the paper's is [`NODE_MEMORY_SHARE`].
    pub node_share: f64,
}

impl CacheBudget {
    /// A budget with the paper's split.
    pub fn new(
        bytes: u64,
        workers: u32,
        node_page_bytes: usize,
        point_page_bytes: usize,
        loads_in_flight_max: u32,
    ) -> Self {
        Self {
            bytes,
            workers,
            node_page_bytes,
            point_page_bytes,
            loads_in_flight_max,
            node_share: NODE_MEMORY_SHARE,
        }
    }

    /// Splits the budget: node and point pools by `node_share`, half of each pool to the workers' local caches in
    /// equal parts.
    pub fn plan(&self) -> Result<SegmentLayout, CacheError> {
        if !(self.node_share > 0.0 && self.node_share < 1.0) {
            return Err(CacheError::Layout {
                what: format!("a node share of {}, above 0 and below 1 allowed", self.node_share),
            });
        }
        let fits = |frames: [u32; 2]| {
            self.layout(frames)
                .is_ok_and(|layout| layout.total_bytes() <= self.bytes)
        };
        let smallest = self.frames_min();
        // The numbers themselves are checked here, so that what is left to fail is the budget.
        let needed = self.layout([smallest; 2])?.total_bytes();
        if needed > self.bytes {
            return Err(CacheError::BudgetTooSmall {
                given: self.bytes,
                needed,
                workers: self.workers,
                node_page_bytes: self.node_page_bytes,
                point_page_bytes: self.point_page_bytes,
            });
        }
        let frames_of = |page_bytes: u64| {
            let node = page_bytes as f64 * self.node_share;
            let frames = |bytes: f64, page: usize| {
                ((bytes / page.next_multiple_of(ALIGN) as f64) as u32).clamp(smallest, FRAMES_MAX)
            };
            [
                frames(node, self.node_page_bytes),
                frames(page_bytes as f64 - node, self.point_page_bytes),
            ]
        };
        // The bytes left for pages follow from the bytes of the tables, which follow from the pages: search the border.
        // Both pools grow with `page_bytes`; at 0 both are smallest, which fits.
        let (mut low, mut high) = (0, self.bytes);
        while low + 1 < high {
            let middle = low + (high - low) / 2;
            if fits(frames_of(middle)) {
                low = middle
            } else {
                high = middle
            }
        }
        self.layout(frames_of(low))
    }

    fn layout(&self, frames: [u32; 2]) -> Result<SegmentLayout, CacheError> {
        let pool = |frame_bytes, frames: u32| PoolLayout {
            frame_bytes,
            frames,
            local_frames: frames / 2 / self.workers.max(1),
        };
        SegmentLayout::new(
            self.workers,
            self.loads_in_flight_max,
            pool(self.node_page_bytes, frames[0]),
            pool(self.point_page_bytes, frames[1]),
        )
    }

    /// Fewest frames of a pool: every worker has its least, and as many plus the loads in flight and one more are
    /// evictable.
    fn frames_min(&self) -> u32 {
        let local = self.workers.saturating_mul(LOCAL_FRAMES_MIN);
        let in_flight = self.loads_in_flight_max.saturating_add(1);
        // `local_frames` grows with the frames, up to half of them; the other half must exceed the loads in flight.
        local.max(in_flight).saturating_mul(2)
    }
}
