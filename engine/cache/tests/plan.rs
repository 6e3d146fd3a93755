//! Every layout that is accepted keeps an evictable frame; every budget that is refused says what would do.
#![cfg(not(loom))]
#![allow(clippy::unwrap_used, reason = "a failed step of a test is a failed test")]

use pbgi_cache::{CacheBudget, CacheError, PoolLayout, SegmentLayout};
use pbgi_core::PageKind;
use proptest::prelude::*;

fn keeps_an_evictable_frame(layout: &SegmentLayout) {
    for kind in [PageKind::Node, PageKind::Point] {
        let pool = layout.pool(kind);
        let pinned = u64::from(layout.workers()) * u64::from(pool.local_frames);
        assert!(
            pinned + u64::from(layout.loads_in_flight_max()) < u64::from(pool.frames),
            "{layout:?}"
        );
        assert!(pinned <= u64::from(pool.frames) / 2, "{layout:?}");
        assert!(pool.local_frames > 0 && pool.frame_bytes.is_multiple_of(4096));
    }
}

fn budgets() -> impl Strategy<Value = CacheBudget> {
    let bytes = (10u32..38, 0.5f64..1.0).prop_map(|(bits, part)| ((1u64 << bits) as f64 * part) as u64);
    let page = || {
        prop_oneof![
            1usize..300_000,
            Just(28_672),
            Just(32_768),
            Just(245_760),
            Just(14 << 20)
        ]
    };
    (bytes, 1u32..=64, page(), page(), 1u32..=64, 0.05f64..0.95).prop_map(
        |(bytes, workers, node, point, loads, share)| CacheBudget {
            node_share: share,
            ..CacheBudget::new(bytes, workers, node, point, loads)
        },
    )
}

const CASES: u32 = 10_000;

#[test]
fn accepted_budget_keeps_an_evictable_frame() {
    let config = ProptestConfig {
        failure_persistence: None,
        ..ProptestConfig::with_cases(CASES)
    };
    proptest!(config, |(budget in budgets())| {
        match budget.plan() {
            Ok(layout) => {
                keeps_an_evictable_frame(&layout);
                prop_assert!(layout.total_bytes() <= budget.bytes);
                let pages = [(PageKind::Node, budget.node_page_bytes), (PageKind::Point, budget.point_page_bytes)];
                for (kind, bytes) in pages {
                    prop_assert!(layout.pool(kind).frame_bytes >= bytes);
                    prop_assert!(layout.pool(kind).local_frames >= 4);
                }
                // Nothing worth a frame of each kind and their tables is left over.
                let frame = |kind| layout.pool(kind).frame_bytes as u64;
                let slack = 4 * (frame(PageKind::Node) + frame(PageKind::Point));
                let frames = layout.pool(PageKind::Node).frames + layout.pool(PageKind::Point).frames;
                let tables = 4096 * 80 + 64 * u64::from(frames);
                let floor = (slack as f64 / budget.node_share.min(1.0 - budget.node_share)) as u64;
                let bounded = [PageKind::Node, PageKind::Point].iter().all(|&kind| layout.pool(kind).frames < 1 << 26);
                prop_assert!(!bounded || budget.bytes - layout.total_bytes() <= floor + tables, "{:?}", layout);
            }
            Err(CacheError::BudgetTooSmall { given, needed, .. }) => {
                prop_assert!(given == budget.bytes && needed > given);
                let layout = CacheBudget { bytes: needed, ..budget }.plan().unwrap();
                prop_assert_eq!(layout.total_bytes(), needed);
                keeps_an_evictable_frame(&layout);
            }
            Err(other) => prop_assert!(false, "{}", other),
        }
    });
    println!("RELIABILITY S9: {CASES} budgets, each with a frame to evict in every pool or refused");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(CASES))]

    #[test]
    fn accepted_numbers_keep_an_evictable_frame(
        workers in 0u32..70,
        loads in prop_oneof![0u32..70, Just(u32::MAX)],
        frames in prop_oneof![0u32..2000, Just(u32::MAX)],
        local_frames in prop_oneof![0u32..100, Just(u32::MAX)],
        frame_bytes in prop_oneof![0usize..100_000, Just(usize::MAX)],
    ) {
        let pool = PoolLayout { frame_bytes, frames, local_frames };
        if let Ok(layout) = SegmentLayout::new(workers, loads, pool, pool) {
            keeps_an_evictable_frame(&layout);
        }
    }
}

#[test]
fn two_gibibytes_split_as_in_the_paper() {
    let layout = CacheBudget::new(2 << 30, 8, 28_672, 32_768, 16).plan().unwrap();
    let bytes = |kind| f64::from(layout.pool(kind).frames) * layout.pool(kind).frame_bytes as f64;
    let (node, point) = (bytes(PageKind::Node), bytes(PageKind::Point));
    assert!((node / (node + point) - 0.75).abs() < 0.001);
    assert!(
        node + point > 0.99 * f64::from(1u32 << 31),
        "tables and ledgers take less than a hundredth"
    );
    let local = 8 * layout.pool(PageKind::Node).local_frames;
    assert!(layout.pool(PageKind::Node).frames / 2 - local < 8);
}

#[test]
fn budgets_that_make_no_sense_are_refused() {
    for share in [0.0, 1.0, -1.0, f64::NAN, f64::INFINITY] {
        let budget = CacheBudget {
            node_share: share,
            ..CacheBudget::new(1 << 30, 8, 4096, 4096, 16)
        };
        assert!(matches!(budget.plan(), Err(CacheError::Layout { .. })), "{share}");
    }
    for (workers, page, loads) in [
        (0, 4096, 4),
        (65, 4096, 4),
        (4, 0, 4),
        (4, 4096, 0),
        (4, 17 << 20, 4),
        (4, 4096, u32::MAX),
    ] {
        let refused = CacheBudget::new(u64::MAX, workers, page, 4096, loads).plan();
        assert!(
            matches!(refused, Err(CacheError::Layout { .. })),
            "{workers} {page} {loads}: {refused:?}"
        );
    }
}
