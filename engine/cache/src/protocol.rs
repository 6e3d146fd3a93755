//! The pin and evict protocol, written once over the atomics of `sync` so that the model checker runs this very code.
//!
//! Entry points: [`try_pin`] and [`unpin`] for a worker; [`try_claim`], [`publish`], [`owner_pin`] and [`reap`] for
//! the daemon. README rules 3 to 7 are implemented here and nowhere else.

use crate::frame::{Tag, TagState};
use crate::sync::{AtomicU64, Ordering, fence};

/// The full barrier of rule 3; a parameter only so that the model can show what happens without it.
pub trait Barrier {
    /// Orders every access before it against every access after it.
    fn full();
}

/// The barrier in use.
#[derive(Debug)]
pub struct FullFence;

impl Barrier for FullFence {
    #[inline(always)]
    fn full() {
        fence(Ordering::SeqCst);
    }
}

/// Reads a tag and everything published with it.
///
/// A relaxed load and a fence: workers map tags read-only, where the standard library allows relaxed loads alone.
#[inline(always)]
pub fn load_tag(tag: &AtomicU64) -> Tag {
    let word = tag.load(Ordering::Relaxed);
    fence(Ordering::Acquire);
    Tag(word)
}

/// Pins a frame if it holds the page of `resident`: announce in `pins` (the caller's own ledger), then look again.
///
/// `mask` has the frame's one bit. On `true` the frame's bytes stay unchanged until [`unpin`]. On `false` the ledger
/// is as before.
#[inline(always)]
pub fn try_pin<B: Barrier>(tag: &AtomicU64, pins: &AtomicU64, mask: u64, resident: Tag) -> bool {
    if load_tag(tag) != resident {
        return false;
    }
    if pins.fetch_or(mask, Ordering::Relaxed) & mask != 0 {
        // The bit was there before the tag was read, so the tag cannot have moved to another page: nothing to look at
        // again, and nothing to take back while the owner only tries the frame (Rule 5).
        return true;
    }
    B::full(); // Rule 3: the pin is visible before the tag is read again.
    if load_tag(tag) == resident {
        return true;
    }
    pins.fetch_and(!mask, Ordering::Release);
    false
}

/// Takes a pin back. The caller's reads of the frame come before it (Rule 4).
#[inline(always)]
pub fn unpin(pins: &AtomicU64, mask: u64) {
    pins.fetch_and(!mask, Ordering::Release);
}

/// Claims a frame that holds `resident` for its owner: afterwards its tag is `claimed` and nobody holds or gets a pin.
///
/// `ledgers` yields the word of every ledger that has the frame's bit. Returns `false`, with the tag as before, if
/// one has it set. Only the owner calls this, one call at a time for a pool (Rule 1).
#[inline]
pub fn try_claim<'a, B: Barrier>(
    tag: &AtomicU64,
    resident: Tag,
    claimed: Tag,
    ledgers: impl IntoIterator<Item = &'a AtomicU64>,
    mask: u64,
) -> bool {
    tag.store(resident.with_state(TagState::Evicting).0, Ordering::Release);
    B::full(); // Rule 3: the tag is withdrawn before the ledgers are read.
    // Acquire pairs with the release of `unpin`: the last reader is done before the frame is written.
    let pinned = ledgers.into_iter().any(|word| word.load(Ordering::Acquire) & mask != 0);
    tag.store(if pinned { resident.0 } else { claimed.0 }, Ordering::Release);
    !pinned
}

/// Makes a loaded frame findable; its bytes were written before (Rule 6).
#[inline]
pub fn publish(tag: &AtomicU64, tag_value: Tag) {
    tag.store(tag_value.0, Ordering::Release);
}

/// Sets a worker's pin for it. The owner does so while no claim can run (Rule 7), so no second look is needed.
#[inline]
pub fn owner_pin(pins: &AtomicU64, mask: u64) {
    pins.fetch_or(mask, Ordering::Relaxed);
}

/// Forgets every pin in a dead worker's ledger and returns how many there were (Rule 8).
pub fn reap<'a>(ledger: impl IntoIterator<Item = &'a AtomicU64>) -> u32 {
    ledger
        .into_iter()
        .map(|word| word.swap(0, Ordering::AcqRel).count_ones())
        .sum()
}
