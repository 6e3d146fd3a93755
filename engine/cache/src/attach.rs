//! A worker's side of the segment: everything read-only, and one window, its own ledger, writable.

use crate::error::CacheError;
use crate::frame::{FrameId, Tag};
use crate::layout::{ALIGN, Header, SegmentLayout};
use crate::ledger::word_and_mask;
use crate::map::SegmentMap;
use crate::page_table;
use crate::protocol::{FullFence, load_tag, try_pin, unpin};
use crate::segment::{check_name, check_page_size, open, os};
use memmap2::{MmapOptions, MmapRaw};
use nix::fcntl::OFlag;
use nix::sys::stat::fstat;
use pbgi_core::{PageKey, PageKind};
use std::ops::Deref;
use std::ptr::NonNull;
use std::slice;
use std::sync::atomic::{AtomicU64, Ordering};

/// A worker's view of the cache: finds pages and pins them. At most one exists for a slot.
pub struct CacheView {
    map: SegmentMap,
    ledger: Ledger,
    slot: u8,
    // Unmapped after the map that points into it.
    _memory: MmapRaw,
}

impl CacheView {
    /// Attaches to the segment as the worker of `slot`; name, hash and slot come with the welcome message.
    pub fn attach(name: &str, layout_hash: u64, slot: u8) -> Result<Self, CacheError> {
        check_name(name)?;
        check_page_size(name)?;
        let readable = open(name, OFlag::O_RDONLY)?;
        let bytes = u64::try_from(fstat(&readable).map_err(|error| os("inspect", name, error))?.st_size).unwrap_or(0);
        if bytes < ALIGN as u64 {
            return Err(CacheError::Mismatch {
                what: "size",
                expected: ALIGN as u64,
                found: bytes,
            });
        }
        let header = read_header(name, &readable)?;
        let layout = SegmentLayout::from_header(&header, layout_hash)?;
        if bytes != layout.total_bytes() {
            return Err(CacheError::Mismatch {
                what: "size",
                expected: layout.total_bytes(),
                found: bytes,
            });
        }
        if u32::from(slot) >= layout.workers() {
            return Err(CacheError::StaleSeat { slot, epoch: 0 });
        }
        let memory = MmapOptions::new().len(bytes as usize).map_raw_read_only(&readable);
        let memory = memory.map_err(|error| os("map", name, error))?;
        let base = NonNull::new(memory.as_mut_ptr()).ok_or_else(|| os("map", name, "null address"))?;
        // SAFETY: Rules 1 and 9: mapped with the bytes that the layout says, reserved by the owner, kept in
        // `_memory`; this process cannot write to it.
        let map = unsafe { SegmentMap::new(base, layout) };
        let ledger = Ledger::map(name, &map, slot)?;
        // One view for a slot (Rule 4), or two of them could take back each other's pins.
        if ledger.attached().swap(1, Ordering::AcqRel) != 0 {
            return Err(CacheError::SlotTaken { slot });
        }
        Ok(Self {
            map,
            ledger,
            slot,
            _memory: memory,
        })
    }

    /// The segment's layout.
    #[inline]
    pub fn layout(&self) -> &SegmentLayout {
        self.map.layout()
    }

    /// The slot attached to.
    pub fn slot(&self) -> u8 {
        self.slot
    }

    /// Finds and pins a page, and unpins it when the result is dropped. [`crate::LocalCache`] keeps pins instead.
    pub fn pin(&mut self, key: PageKey) -> Option<PagePin<'_>> {
        let frame = self.find_and_pin(key)?;
        Some(PagePin {
            view: self,
            kind: key.kind,
            frame,
        })
    }

    /// Finds a page and sets this worker's pin. Touched is set here, once for the life of a pin (Rule 11).
    #[inline]
    pub(crate) fn find_and_pin(&self, key: PageKey) -> Option<FrameId> {
        let tag = Tag::resident(key);
        let headers = self.map.frame_headers(key.kind);
        page_table::find(self.map.table(key.kind), tag.hash32(), |frame| {
            let Some(header) = headers.get(frame.0 as usize) else {
                return false;
            };
            let (word, mask) = word_and_mask(frame);
            let pinned = try_pin::<FullFence>(&header.tag, &self.ledger.pins(key.kind)[word], mask, tag);
            if pinned {
                let touched = &self.ledger.touched(key.kind)[word];
                // Rule 11: look before writing; the bit is still set more often than not.
                if touched.load(Ordering::Relaxed) & mask == 0 {
                    touched.fetch_or(mask, Ordering::Relaxed);
                }
            }
            pinned
        })
    }

    /// Takes this worker's pin back. No slice of the frame is left (Rule 4): callers hold this view exclusively.
    #[inline]
    pub(crate) fn unpin(&mut self, kind: PageKind, frame: FrameId) {
        let (word, mask) = word_and_mask(frame);
        unpin(&self.ledger.pins(kind)[word], mask);
    }

    /// Whether this worker has a pin on the frame and the frame holds that page: what a reply of the owner promises
    /// (Rule 7).
    pub(crate) fn holds(&self, key: PageKey, frame: FrameId) -> bool {
        let Some(header) = self.map.frame_headers(key.kind).get(frame.0 as usize) else {
            return false;
        };
        let (word, mask) = word_and_mask(frame);
        // The owner may be trying the frame right now (Rule 5), so the state does not matter.
        self.ledger.pins(key.kind)[word].load(Ordering::Relaxed) & mask != 0
            && load_tag(&header.tag).same_page(Tag::resident(key))
    }

    /// Number of the job that loaded a pinned frame.
    pub(crate) fn job(&self, kind: PageKind, frame: FrameId) -> u64 {
        self.map.frame_header(kind, frame).job.load(Ordering::Relaxed)
    }

    /// # Safety
    ///
    /// As [`SegmentMap::frame`].
    #[inline]
    pub(crate) unsafe fn frame(&self, kind: PageKind, frame: FrameId) -> &[u8] {
        // SAFETY: passed on to the caller.
        unsafe { self.map.frame(kind, frame) }
    }
}

impl Drop for CacheView {
    fn drop(&mut self) {
        self.ledger.attached().store(0, Ordering::Release);
    }
}

impl std::fmt::Debug for CacheView {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("CacheView")
            .field("slot", &self.slot)
            .field("layout", self.layout())
            .finish_non_exhaustive()
    }
}

/// A pinned page. Its bytes are those of the whole frame: what lies behind the page's own bytes means nothing.
#[derive(Debug)]
pub struct PagePin<'a> {
    view: &'a mut CacheView,
    kind: PageKind,
    frame: FrameId,
}

impl Deref for PagePin<'_> {
    type Target = [u8];

    #[inline]
    fn deref(&self) -> &[u8] {
        // SAFETY: Rule 4: pinned when `self` was made, unpinned when it is dropped, and nobody else can unpin
        // meanwhile: the view is borrowed exclusively, and is the only one of its slot.
        unsafe { self.view.frame(self.kind, self.frame) }
    }
}

impl Drop for PagePin<'_> {
    #[inline]
    fn drop(&mut self) {
        self.view.unpin(self.kind, self.frame);
    }
}

/// The worker's own ledger, mapped writable on its own.
struct Ledger {
    memory: MmapRaw,
    pins: [usize; 2],
    touched: [usize; 2],
    words: [usize; 2],
}

impl Ledger {
    fn map(name: &str, map: &SegmentMap, slot: u8) -> Result<Self, CacheError> {
        let at = map.offsets();
        let writable = open(name, OFlag::O_RDWR)?;
        let offset = at.ledgers + usize::from(slot) * at.ledger_bytes;
        let memory = MmapOptions::new()
            .offset(offset as u64)
            .len(at.ledger_bytes)
            .map_raw(&writable);
        let memory = memory.map_err(|error| os("map", name, error))?;
        Ok(Self {
            memory,
            pins: at.pins,
            touched: at.touched,
            words: at.words,
        })
    }

    #[inline]
    fn pins(&self, kind: PageKind) -> &[AtomicU64] {
        self.words(self.pins[kind as usize], self.words[kind as usize])
    }

    #[inline]
    fn touched(&self, kind: PageKind) -> &[AtomicU64] {
        self.words(self.touched[kind as usize], self.words[kind as usize])
    }

    fn attached(&self) -> &AtomicU64 {
        &self.words(0, 1)[0]
    }

    #[inline]
    fn words(&self, offset: usize, words: usize) -> &[AtomicU64] {
        // SAFETY: Rules 2 and 9: `offset` and `words` are those that `Offsets` gives for a bitmap of this window,
        // which is as long as `Offsets` says, page-aligned, writable, accessed as `AtomicU64` only, and mapped as
        // long as `self.memory` lives.
        unsafe { slice::from_raw_parts(self.memory.as_mut_ptr().add(offset).cast(), words) }
    }
}

fn read_header(name: &str, descriptor: &impl std::os::fd::AsRawFd) -> Result<Header, CacheError> {
    let page = MmapOptions::new().len(ALIGN).map_raw_read_only(descriptor.as_raw_fd());
    let page = page.map_err(|error| os("map", name, error))?;
    // SAFETY: Rule 9: the object has at least a page, just mapped; the header is written once, before a worker learns
    // the name.
    Ok(unsafe { page.as_ptr().cast::<Header>().read() })
}
