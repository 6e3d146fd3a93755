//! The accessors of the segment: from a base address and a layout to atomics and frames, each checked against its
//! bound.

use crate::frame::FrameId;
use crate::layout::{FrameHeader, Header, Offsets, SegmentLayout};
use pbgi_core::PageKind;
use std::ptr::NonNull;
use std::slice;
use std::sync::atomic::AtomicU64;

/// A mapped segment. Whoever makes one keeps the mapping alive as long as it (Rule 9).
pub(crate) struct SegmentMap {
    base: NonNull<u8>,
    layout: SegmentLayout,
    at: Offsets,
}

// SAFETY: Rule 2: everything shared is reached as atomics; frames are handed out by `frame` and `frame_mut` alone,
// whose callers answer for who else looks at them (Rules 4 and 6).
unsafe impl Send for SegmentMap {}
// SAFETY: as above.
unsafe impl Sync for SegmentMap {}

impl SegmentMap {
    /// # Safety
    ///
    /// `base` is page-aligned and begins a mapping of at least `layout.total_bytes()` bytes that outlives the result
    /// (Rule 9), backed by reserved memory. Nobody writes to the mapping but through the accessors of this type (Rule
    /// 1).
    pub(crate) unsafe fn new(base: NonNull<u8>, layout: SegmentLayout) -> Self {
        let at = Offsets::new(&layout);
        Self { base, layout, at }
    }

    #[inline]
    pub(crate) fn layout(&self) -> &SegmentLayout {
        &self.layout
    }

    #[inline]
    pub(crate) fn offsets(&self) -> &Offsets {
        &self.at
    }

    /// Writes the header of a segment that nobody else has mapped yet.
    ///
    /// # Safety
    ///
    /// The mapping is writable, and no other process or thread uses it yet (Rule 9).
    pub(crate) unsafe fn write_header(&self, header: &Header) {
        // SAFETY: Rule 9: the mapping is larger than a header and, by this function's contract, ours alone.
        unsafe { self.base.cast::<Header>().write(*header) }
    }

    /// The headers of a pool's frames.
    #[inline]
    pub(crate) fn frame_headers(&self, kind: PageKind) -> &[FrameHeader] {
        let frames = self.layout.pool(kind).frames as usize;
        // SAFETY: Rules 2 and 9: `Offsets` keeps the part within the mapping and aligned, and its contents are
        // atomics only.
        unsafe {
            slice::from_raw_parts(
                self.base.add(self.at.frame_headers[kind as usize]).cast().as_ptr(),
                frames,
            )
        }
    }

    #[inline]
    pub(crate) fn frame_header(&self, kind: PageKind, frame: FrameId) -> &FrameHeader {
        &self.frame_headers(kind)[frame.0 as usize]
    }

    /// The page table of a pool.
    #[inline]
    pub(crate) fn table(&self, kind: PageKind) -> &[AtomicU64] {
        // SAFETY: Rules 2 and 9, as for `frame_headers`.
        unsafe { self.words(self.at.tables[kind as usize], self.at.table_slots[kind as usize]) }
    }

    /// A worker's pin bits.
    #[inline]
    pub(crate) fn pins(&self, slot: u8, kind: PageKind) -> &[AtomicU64] {
        self.ledger(slot, self.at.pins[kind as usize], self.at.words[kind as usize])
    }

    /// A worker's touched bits.
    #[inline]
    pub(crate) fn touched(&self, slot: u8, kind: PageKind) -> &[AtomicU64] {
        self.ledger(slot, self.at.touched[kind as usize], self.at.words[kind as usize])
    }

    /// The word that says whether a process is attached to a slot.
    pub(crate) fn attached(&self, slot: u8) -> &AtomicU64 {
        &self.ledger(slot, 0, 1)[0]
    }

    #[inline]
    fn ledger(&self, slot: u8, offset: usize, words: usize) -> &[AtomicU64] {
        assert!(
            u32::from(slot) < self.layout.workers(),
            "worker slot {slot} has no ledger"
        );
        // SAFETY: Rules 2 and 9: the slot was checked, and `Offsets` keeps every bitmap within its ledger.
        unsafe {
            self.words(
                self.at.ledgers + usize::from(slot) * self.at.ledger_bytes + offset,
                words,
            )
        }
    }

    /// # Safety
    ///
    /// `offset` is a multiple of 8, and `words` words from it lie in a part of the segment that is accessed as
    /// `AtomicU64` only (Rule 2).
    #[inline]
    unsafe fn words(&self, offset: usize, words: usize) -> &[AtomicU64] {
        // SAFETY: Rule 9: the mapping outlives `self`; the rest is this function's contract.
        unsafe { slice::from_raw_parts(self.base.add(offset).cast().as_ptr(), words) }
    }

    /// The bytes of a frame.
    ///
    /// # Safety
    ///
    /// The caller's process holds a pin on the frame, and goes on holding it for the lifetime of the result (Rule 4).
    #[inline]
    pub(crate) unsafe fn frame(&self, kind: PageKind, frame: FrameId) -> &[u8] {
        let bytes = self.layout.pool(kind).frame_bytes;
        // SAFETY: Rules 4 and 9: the address is within the mapping; while a pin is held nobody writes to the frame.
        unsafe { slice::from_raw_parts(self.frame_address(kind, frame), bytes) }
    }

    /// The bytes of a frame, for writing.
    ///
    /// # Safety
    ///
    /// The mapping is writable, and the caller claimed the frame: its tag is `Loading` on the caller's behalf and no
    /// ledger has its bit (Rule 6). The result is dropped before the frame is published or given up.
    #[expect(
        clippy::mut_from_ref,
        reason = "exclusive by the claim, which is this function's contract"
    )]
    pub(crate) unsafe fn frame_mut(&self, kind: PageKind, frame: FrameId, bytes: usize) -> &mut [u8] {
        assert!(bytes <= self.layout.pool(kind).frame_bytes);
        // SAFETY: Rules 6 and 9: the address is within the mapping and, by this function's contract, nobody else's.
        unsafe { slice::from_raw_parts_mut(self.frame_address(kind, frame), bytes) }
    }

    #[inline]
    fn frame_address(&self, kind: PageKind, frame: FrameId) -> *mut u8 {
        let pool = self.layout.pool(kind);
        assert!(frame.0 < pool.frames);
        // SAFETY: Rule 9: the frame was checked, so the address is within the mapping.
        unsafe {
            self.base
                .add(self.at.frames[kind as usize] + frame.0 as usize * pool.frame_bytes)
                .as_ptr()
        }
    }
}
