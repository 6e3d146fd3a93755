//! Which frame to reuse: second chance (clock) over the frames that nobody pins, with the recency that workers leave
//! in their touched bits.

use crate::counters::Bitmap;
use crate::frame::FrameId;

/// Laps of the hand before giving up: one clears touched bits, one meets them cleared, one ignores them, in case
/// workers set them as fast as the hand clears them.
const LAPS: u32 = 3;

/// What the ledgers say of 64 frames at a time.
pub(crate) trait Usage {
    /// Frames of this word that some worker pins.
    fn pinned(&self, word: usize) -> u64;
    /// Frames of this word touched since the hand last passed.
    fn touched(&self, word: usize) -> u64;
    /// Forgets that they were touched.
    fn clear_touched(&self, word: usize, frames: u64);
}

/// Usage in which only some frames may go: the others count as pinned, so that they keep their touched bits.
pub(crate) struct Among<'a, U> {
    pub(crate) usage: &'a U,
    pub(crate) frames: &'a Bitmap,
}

impl<U: Usage> Usage for Among<'_, U> {
    fn pinned(&self, word: usize) -> u64 {
        match self.frames.word(word) {
            0 => !0,
            frames => !frames | self.usage.pinned(word),
        }
    }

    fn touched(&self, word: usize) -> u64 {
        self.usage.touched(word)
    }

    fn clear_touched(&self, word: usize, frames: u64) {
        self.usage.clear_touched(word, frames);
    }
}

/// The clock's hand over one pool.
#[derive(Debug, Default)]
pub(crate) struct Clock {
    hand: u32,
}

impl Clock {
    /// Moves the hand to the next frame that is unpinned, untouched and accepted by `claim`. Pinned frames keep their
    /// touched bit: whatever leaves a local cache has a whole turn of the hand left (Rule 11).
    pub(crate) fn victim(
        &mut self,
        frames: u32,
        usage: &impl Usage,
        mut claim: impl FnMut(FrameId) -> bool,
    ) -> Option<FrameId> {
        let words = frames.div_ceil(64);
        for visit in 0..=words * LAPS {
            let word = self.hand / 64;
            let open = in_range(self.hand, frames) & !usage.pinned(word as usize);
            let touched = if visit <= words * (LAPS - 1) {
                open & usage.touched(word as usize)
            } else {
                0
            };
            let mut candidates = open & !touched;
            while candidates != 0 {
                let bit = candidates.trailing_zeros();
                let frame = FrameId(word * 64 + bit);
                if claim(frame) {
                    usage.clear_touched(word as usize, touched & ((1 << bit) - 1));
                    self.hand = (frame.0 + 1) % frames;
                    return Some(frame);
                }
                candidates &= candidates - 1;
            }
            usage.clear_touched(word as usize, touched);
            self.hand = (word + 1) % words * 64;
        }
        None
    }
}

/// Bits of the hand's word from the hand on that are frames.
fn in_range(hand: u32, frames: u32) -> u64 {
    let from = !0 << (hand % 64);
    match frames - hand / 64 * 64 {
        left @ 0..64 => from & ((1 << left) - 1),
        _ => from,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::rngs::StdRng;
    use rand::{Rng, SeedableRng};
    use std::cell::RefCell;
    use std::collections::HashMap;

    #[derive(Default)]
    struct Bits {
        pinned: Vec<u64>,
        touched: RefCell<Vec<u64>>,
    }

    impl Bits {
        fn new(frames: u32) -> Self {
            let words = frames.div_ceil(64) as usize;
            Self {
                pinned: vec![0; words],
                touched: RefCell::new(vec![0; words]),
            }
        }

        fn touch(&self, frame: u32) {
            self.touched.borrow_mut()[frame as usize / 64] |= 1 << (frame % 64);
        }
    }

    impl Usage for Bits {
        fn pinned(&self, word: usize) -> u64 {
            self.pinned[word]
        }

        fn touched(&self, word: usize) -> u64 {
            self.touched.borrow()[word]
        }

        fn clear_touched(&self, word: usize, frames: u64) {
            self.touched.borrow_mut()[word] &= !frames;
        }
    }

    #[test]
    fn hand_spares_pinned_and_touched_frames() {
        let mut bits = Bits::new(130);
        bits.pinned = vec![!0, !0 ^ 0b1010, 0b10];
        bits.touch(65);
        bits.touch(129);
        let mut clock = Clock::default();
        let mut next = |bits: &Bits| clock.victim(130, bits, |_| true).map(|frame| frame.0);
        assert_eq!(next(&bits), Some(67), "65 has its second chance");
        assert_eq!(next(&bits), Some(128));
        assert_eq!(next(&bits), Some(65), "and no third");
        assert_eq!(bits.touched.borrow()[2], 0b10, "a pinned frame keeps its bit");
        bits.pinned = vec![!0, !0, !0];
        assert_eq!(next(&bits), None);
    }

    #[test]
    fn hand_ends_when_every_frame_is_touched_or_refused() {
        for frames in [1, 2, 63, 64, 65, 128, 129] {
            let bits = Bits::new(frames);
            (0..frames).for_each(|frame| bits.touch(frame));
            let mut clock = Clock { hand: frames - 1 };
            assert!(clock.victim(frames, &bits, |_| true).is_some(), "{frames}");
            assert_eq!(clock.victim(frames, &bits, |_| false), None, "{frames}");
            let mut seen: Vec<bool> = vec![false; frames as usize];
            for _ in 0..frames {
                let frame = clock.victim(frames, &bits, |frame| !seen[frame.0 as usize]).unwrap();
                seen[frame.0 as usize] = true;
            }
            assert!(seen.iter().all(|&seen| seen), "{frames}");
        }
    }

    /// A page trace like that of a traversal: a few pages always, neighbourhoods that drift, now and then anything.
    fn trace(length: usize) -> impl Iterator<Item = u32> {
        let mut random = StdRng::seed_from_u64(7);
        (0..length).map(move |step| match random.random_range(0..10) {
            0..4 => random.random_range(0..40),
            4..9 => 40 + (step / 40) as u32 % 1800 + random.random_range(0..160),
            _ => random.random_range(0..2000),
        })
    }

    #[test]
    fn second_chance_misses_at_most_a_fiftieth_more_of_the_lookups_than_exact_lru() {
        const FRAMES: u32 = 256;
        let mut lru = lru::LruCache::new(std::num::NonZeroUsize::new(FRAMES as usize).unwrap());
        let (bits, mut clock) = (Bits::new(FRAMES), Clock::default());
        let (mut frame_of, mut page_of) = (HashMap::new(), HashMap::new());
        let (mut clock_misses, mut lru_misses, mut lookups) = (0, 0, 0);
        for page in trace(200_000) {
            lookups += 1;
            lru_misses += usize::from(lru.put(page, ()).is_none());
            let frame = *frame_of.entry(page).or_insert_with(|| {
                clock_misses += 1;
                clock.victim(FRAMES, &bits, |_| true).unwrap().0
            });
            bits.touch(frame);
            match page_of.insert(frame, page) {
                Some(old) if old != page => drop(frame_of.remove(&old)),
                _ => {}
            }
        }
        assert!(
            clock_misses < lru_misses + lookups / 50,
            "{clock_misses} against {lru_misses} of {lookups}"
        );
    }
}
