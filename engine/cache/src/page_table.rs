//! The page table: from a page to the frame that holds it. Open addressing with linear probing over words of the
//! segment, written by the owner, searched by everyone (Rule 2).
//!
//! A slot is `hash << 32 | frame + 1`, or 0. The frame's tag is the truth, the slot only a hint: a search that runs
//! while the owner moves slots may miss a page, and then asks the owner, who never does.

use crate::frame::FrameId;
use std::sync::atomic::{AtomicU64, Ordering};

/// The frame that `holds` accepts among those filed under `hash`.
#[inline]
pub(crate) fn find(table: &[AtomicU64], hash: u32, mut holds: impl FnMut(FrameId) -> bool) -> Option<FrameId> {
    let mask = table.len() - 1;
    let mut at = hash as usize & mask;
    // Bounded although an empty slot always comes sooner: a search never depends on another process for its end.
    for _ in 0..table.len() {
        let slot = table[at].load(Ordering::Relaxed);
        if slot == 0 {
            return None;
        }
        if (slot >> 32) as u32 == hash {
            let frame = FrameId((slot as u32).wrapping_sub(1));
            if holds(frame) {
                return Some(frame);
            }
        }
        at = (at + 1) & mask;
    }
    None
}

/// Files a frame. The table has at least twice as many slots as frames, so there is room.
pub(crate) fn insert(table: &[AtomicU64], hash: u32, frame: FrameId) {
    let mask = table.len() - 1;
    let mut at = hash as usize & mask;
    let mut probes = 0;
    while table[at].load(Ordering::Relaxed) != 0 {
        at = (at + 1) & mask;
        probes += 1;
        assert!(probes < table.len(), "the page table is full");
    }
    table[at].store(u64::from(hash) << 32 | u64::from(frame.0 + 1), Ordering::Relaxed);
}

/// Takes a frame out, and moves later slots of its run up, so that no search passes over a gap.
pub(crate) fn remove(table: &[AtomicU64], hash: u32, frame: FrameId) {
    let mask = table.len() - 1;
    let entry = u64::from(hash) << 32 | u64::from(frame.0 + 1);
    let mut gap = hash as usize & mask;
    loop {
        match table[gap].load(Ordering::Relaxed) {
            0 => return,
            found if found == entry => break,
            _ => gap = (gap + 1) & mask,
        }
    }
    let mut at = gap;
    loop {
        at = (at + 1) & mask;
        let slot = table[at].load(Ordering::Relaxed);
        if slot == 0 {
            break;
        }
        let home = (slot >> 32) as usize & mask;
        // The slot may fill the gap if its home is not between the two (cyclically).
        if (at.wrapping_sub(home) & mask) >= (at.wrapping_sub(gap) & mask) {
            table[gap].store(slot, Ordering::Relaxed);
            gap = at;
        }
    }
    table[gap].store(0, Ordering::Relaxed);
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::HashMap;

    proptest! {
        #[test]
        fn table_agrees_with_a_map(operations in prop::collection::vec((0u32..32, 0u32..24), 0..400)) {
            // Few hashes, so that runs grow, wrap around and merge.
            let table: Vec<AtomicU64> = (0..64).map(|_| AtomicU64::new(0)).collect();
            let mut model: HashMap<u32, u32> = HashMap::new();
            for (frame, hash) in operations {
                let hash = hash.wrapping_mul(0x1000_0003) | 56;
                if let Some(hash) = model.remove(&frame) {
                    remove(&table, hash, FrameId(frame));
                } else {
                    model.insert(frame, hash);
                    insert(&table, hash, FrameId(frame));
                }
                for frame in 0..32 {
                    for (&other, &hash) in &model {
                        let found = find(&table, hash, |found| found.0 == frame);
                        let expected = (model.get(&frame) == Some(&hash)).then_some(FrameId(frame));
                        prop_assert_eq!(found, expected, "frame {} under the hash of {}", frame, other);
                    }
                }
            }
        }
    }
}
