//! Pin ledgers: one bit a frame and worker. The reference count of a frame is the set of ledgers that have its bit.

use crate::frame::FrameId;
use crate::map::SegmentMap;
use crate::victim::Usage;
use pbgi_core::PageKind;
use std::sync::atomic::{AtomicU64, Ordering};

/// Index of a frame's word in a bitmap, and its bit there.
#[inline(always)]
pub(crate) fn word_and_mask(frame: FrameId) -> (usize, u64) {
    (frame.0 as usize / 64, 1 << (frame.0 % 64))
}

/// All ledgers' bits for one pool, as the owner reads them.
pub(crate) struct Ledgers<'a> {
    pub(crate) map: &'a SegmentMap,
    pub(crate) kind: PageKind,
    pub(crate) workers: u8,
}

impl<'a> Ledgers<'a> {
    /// The word of every ledger that has the bits of these 64 frames.
    pub(crate) fn pins(&self, word: usize) -> impl Iterator<Item = &'a AtomicU64> + use<'a> {
        let (map, kind) = (self.map, self.kind);
        (0..self.workers).map(move |slot| &map.pins(slot, kind)[word])
    }

    fn touched_words(&self, word: usize) -> impl Iterator<Item = &'a AtomicU64> + use<'a> {
        let (map, kind) = (self.map, self.kind);
        (0..self.workers).map(move |slot| &map.touched(slot, kind)[word])
    }
}

impl Usage for Ledgers<'_> {
    fn pinned(&self, word: usize) -> u64 {
        self.pins(word)
            .fold(0, |bits, word| bits | word.load(Ordering::Relaxed))
    }

    fn touched(&self, word: usize) -> u64 {
        self.touched_words(word)
            .fold(0, |bits, word| bits | word.load(Ordering::Relaxed))
    }

    fn clear_touched(&self, word: usize, frames: u64) {
        for word in self.touched_words(word) {
            // Most ledgers have none of the bits: leave their cache line alone.
            if word.load(Ordering::Relaxed) & frames != 0 {
                word.fetch_and(!frames, Ordering::Relaxed);
            }
        }
    }
}
