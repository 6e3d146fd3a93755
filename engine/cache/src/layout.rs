//! Where everything lies in the segment.
//!
//! ```text
//! 0                                                                   every part begins on a page of 4,096 bytes
//! +-----------------+
//! | header          |  magic, version, layout hash, numbers of the two pools; written once, before anyone attaches
//! +-----------------+
//! | node frames'    |  frames x [ tag u64 | job u64 ]           16 bytes a frame, written by the owner
//! | headers         |
//! +-----------------+
//! | node page table |  2^k x [ hash u32 | frame + 1 u32 ]       at most half full, written by the owner
//! +-----------------+
//! | point frames' headers, point page table                     likewise
//! +-----------------+
//! | ledger 0        |  [ attached u64 .. 64 bytes ]             mapped writable by the worker in slot 0 alone;
//! |                 |  [ node pins   | node touched  ]      bit f of a bitmap is frame f; padded to 64 bytes
//! |                 |  [ point pins  | point touched ]
//! +-----------------+
//! | ledger 1 ..     |
//! +-----------------+
//! | node frames     |  frames x frame_bytes (a multiple of 4,096)
//! +-----------------+
//! | point frames    |
//! +-----------------+
//! ```
//!
//! [`SegmentLayout`] holds the numbers and follows from the header; [`Offsets`] follows from it by arithmetic alone.

use crate::error::CacheError;
use bytemuck::{Pod, Zeroable};
use pbgi_core::limits::WORKERS_MAX;
use pbgi_core::{NodeRecord, PageKind, PointRecord};

/// Alignment of every part, and the page size the system must have.
pub(crate) const ALIGN: usize = 4096;
/// Alignment of a bitmap: a cache line, so that two workers never write the same one.
pub(crate) const LINE: usize = 64;
/// First bytes of the segment. The odd tail is that of PNG: a copy that mangles line ends cannot go unseen.
pub(crate) const MAGIC: [u8; 8] = *b"pbgi\x1a\n\xa9\n";
/// Version of this map; a change of any offset or meaning changes it.
pub(crate) const VERSION: u32 = 1;
/// Most frames in a pool: the page table's slots hold 32-bit frame numbers.
pub(crate) const FRAMES_MAX: u32 = 1 << 26;
/// Largest frame, in bytes (pbgi-core keeps pages below).
pub(crate) const FRAME_BYTES_MAX: usize = 16 << 20;
/// Fewest page frames of a worker's local cache that the planner accepts, per pool.
pub(crate) const LOCAL_FRAMES_MIN: u32 = 4;

/// A frame's header in the segment.
#[repr(C)]
pub(crate) struct FrameHeader {
    /// What the frame holds ([`crate::Tag`]).
    pub(crate) tag: std::sync::atomic::AtomicU64,
    /// Number of the job whose request loaded it.
    pub(crate) job: std::sync::atomic::AtomicU64,
}

const _: () = assert!(size_of::<FrameHeader>() == 16);
const _: () = assert!(size_of::<Header>() == 72 && size_of::<Header>() <= ALIGN);
const _: () = assert!(ALIGN.is_multiple_of(LINE));

/// The segment's first bytes.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct Header {
    pub(crate) magic: [u8; 8],
    pub(crate) version: u32,
    pub(crate) workers: u32,
    pub(crate) layout_hash: u64,
    pub(crate) total_bytes: u64,
    pub(crate) loads_in_flight_max: u64,
    pub(crate) pools: [PoolHeader; 2],
}

#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct PoolHeader {
    pub(crate) frame_bytes: u64,
    pub(crate) frames: u32,
    pub(crate) local_frames: u32,
}

/// One pool: the frames for pages of one kind.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PoolLayout {
    /// Bytes of a frame; made a multiple of 4,096.
    pub frame_bytes: usize,
    /// Frames.
    pub frames: u32,
    /// Frames that one worker may pin at a time.
    pub local_frames: u32,
}

/// The numbers a segment is made from. A value of this type satisfies README rule 10: an evictable frame always exists.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SegmentLayout {
    workers: u32,
    loads_in_flight_max: u32,
    pools: [PoolLayout; 2],
}

impl SegmentLayout {
    /// Checks the numbers. [`crate::CacheBudget::plan`] chooses them.
    pub fn new(
        workers: u32,
        loads_in_flight_max: u32,
        node: PoolLayout,
        point: PoolLayout,
    ) -> Result<Self, CacheError> {
        if workers == 0 || workers as usize > WORKERS_MAX {
            return Err(invalid(format!("{workers} workers, 1 to {WORKERS_MAX} allowed")));
        }
        if loads_in_flight_max == 0 {
            return Err(invalid("no load may be in flight".into()));
        }
        let mut pools = [node, point];
        for (pool, kind) in pools.iter_mut().zip(KINDS) {
            if pool.frame_bytes == 0 || pool.frame_bytes > FRAME_BYTES_MAX {
                return Err(invalid(format!(
                    "{kind} frames of {} bytes, 1 to {FRAME_BYTES_MAX} allowed",
                    pool.frame_bytes
                )));
            }
            pool.frame_bytes = pool.frame_bytes.next_multiple_of(ALIGN);
            let local = u64::from(workers) * u64::from(pool.local_frames);
            let (frames, loads) = (u64::from(pool.frames), u64::from(loads_in_flight_max));
            if pool.frames > FRAMES_MAX || pool.local_frames == 0 {
                return Err(invalid(format!(
                    "{frames} {kind} frames, {} local; at most {FRAMES_MAX}, at least 1 local",
                    pool.local_frames
                )));
            }
            // Rule 10, first half for progress, second half as the paper splits shared and local memory.
            if local + loads >= frames || local > frames / 2 {
                return Err(invalid(format!(
                    "{workers} workers x {} local {kind} frames + {loads} loads leave no evictable frame of {frames}",
                    pool.local_frames
                )));
            }
        }
        Ok(Self {
            workers,
            loads_in_flight_max,
            pools,
        })
    }

    /// Workers, each with a ledger.
    pub fn workers(&self) -> u32 {
        self.workers
    }

    /// Loads that may be in flight at a time, per pool.
    pub fn loads_in_flight_max(&self) -> u32 {
        self.loads_in_flight_max
    }

    /// The pool for pages of this kind.
    #[inline]
    pub fn pool(&self, kind: PageKind) -> &PoolLayout {
        &self.pools[kind as usize]
    }

    /// Bytes of the whole segment.
    pub fn total_bytes(&self) -> u64 {
        Offsets::new(self).total as u64
    }

    /// Identity of this layout in this build; a worker of another build, or another segment, has a different one.
    pub fn hash(&self) -> u64 {
        let mut hash = Fnv::new();
        hash.bytes(&MAGIC);
        hash.bytes(env!("CARGO_PKG_VERSION").as_bytes());
        let sizes = [
            size_of::<Header>(),
            size_of::<FrameHeader>(),
            size_of::<NodeRecord>(),
            size_of::<PointRecord>(),
        ];
        for size in sizes.into_iter().chain([ALIGN, LINE]) {
            hash.word(size as u64);
        }
        hash.word(u64::from(VERSION));
        hash.word(u64::from(self.workers));
        hash.word(u64::from(self.loads_in_flight_max));
        for pool in &self.pools {
            hash.word(pool.frame_bytes as u64);
            hash.word(u64::from(pool.frames));
            hash.word(u64::from(pool.local_frames));
        }
        hash.0
    }

    pub(crate) fn header(&self) -> Header {
        Header {
            magic: MAGIC,
            version: VERSION,
            workers: self.workers,
            layout_hash: self.hash(),
            total_bytes: self.total_bytes(),
            loads_in_flight_max: u64::from(self.loads_in_flight_max),
            pools: self.pools.map(|pool| PoolHeader {
                frame_bytes: pool.frame_bytes as u64,
                frames: pool.frames,
                local_frames: pool.local_frames,
            }),
        }
    }

    /// Reads a header that another process wrote; the hash was agreed on beforehand, on another way.
    pub(crate) fn from_header(header: &Header, agreed_hash: u64) -> Result<Self, CacheError> {
        let mismatch = |what, expected, found| Err(CacheError::Mismatch { what, expected, found });
        if header.magic != MAGIC {
            return mismatch("magic", u64::from_le_bytes(MAGIC), u64::from_le_bytes(header.magic));
        }
        if header.version != VERSION {
            return mismatch("version", u64::from(VERSION), u64::from(header.version));
        }
        let pool = |pool: &PoolHeader| PoolLayout {
            frame_bytes: usize::try_from(pool.frame_bytes).unwrap_or(usize::MAX),
            frames: pool.frames,
            local_frames: pool.local_frames,
        };
        let loads = u32::try_from(header.loads_in_flight_max).unwrap_or(u32::MAX);
        let [node, point] = &header.pools;
        let layout = Self::new(header.workers, loads, pool(node), pool(point))?;
        for found in [header.layout_hash, agreed_hash] {
            if found != layout.hash() {
                return mismatch("layout hash", layout.hash(), found);
            }
        }
        if header.total_bytes != layout.total_bytes() {
            return mismatch("size", layout.total_bytes(), header.total_bytes);
        }
        Ok(layout)
    }
}

/// The kinds in pool order.
pub(crate) const KINDS: [PageKind; 2] = [PageKind::Node, PageKind::Point];

/// Byte offsets of the parts, all multiples of [`ALIGN`] but for those within a ledger.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Offsets {
    pub(crate) frame_headers: [usize; 2],
    pub(crate) tables: [usize; 2],
    pub(crate) table_slots: [usize; 2],
    /// The first ledger, and the bytes of each.
    pub(crate) ledgers: usize,
    pub(crate) ledger_bytes: usize,
    /// Within a ledger: bitmaps of pins and of touched frames, and the words of each.
    pub(crate) pins: [usize; 2],
    pub(crate) touched: [usize; 2],
    pub(crate) words: [usize; 2],
    pub(crate) frames: [usize; 2],
    pub(crate) total: usize,
}

impl Offsets {
    pub(crate) fn new(layout: &SegmentLayout) -> Self {
        let frames = layout.pools.map(|pool| pool.frames as usize);
        let mut end = ALIGN;
        let mut part = |bytes: usize| {
            let start = end;
            end += bytes.next_multiple_of(ALIGN);
            start
        };
        let table_slots = frames.map(table_slots);
        let mut frame_headers = [0; 2];
        let mut tables = [0; 2];
        for pool in 0..2 {
            frame_headers[pool] = part(frames[pool] * size_of::<FrameHeader>());
            tables[pool] = part(table_slots[pool] * size_of::<u64>());
        }
        let words = frames.map(|frames| frames.div_ceil(64));
        let bitmap = words.map(|words| (words * size_of::<u64>()).next_multiple_of(LINE));
        let pins = [LINE, LINE + 2 * bitmap[0]];
        let touched = [pins[0] + bitmap[0], pins[1] + bitmap[1]];
        let ledger_bytes = (touched[1] + bitmap[1]).next_multiple_of(ALIGN);
        let ledgers = part(ledger_bytes * layout.workers as usize);
        let frames = [0, 1].map(|pool| part(frames[pool] * layout.pools[pool].frame_bytes));
        Self {
            frame_headers,
            tables,
            table_slots,
            ledgers,
            ledger_bytes,
            pins,
            touched,
            words,
            frames,
            total: end,
        }
    }
}

/// Slots of the page table for so many frames: at most half are used, so that a search ends soon.
fn table_slots(frames: usize) -> usize {
    (2 * frames).next_power_of_two()
}

fn invalid(what: String) -> CacheError {
    CacheError::Layout { what }
}

/// FNV-1a, 64 bits: against accident only.
struct Fnv(u64);

impl Fnv {
    const fn new() -> Self {
        Self(0xcbf2_9ce4_8422_2325)
    }

    fn bytes(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            self.0 = (self.0 ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3);
        }
    }

    fn word(&mut self, word: u64) {
        self.bytes(&word.to_le_bytes());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pool(frames: u32, local_frames: u32) -> PoolLayout {
        PoolLayout {
            frame_bytes: 5000,
            frames,
            local_frames,
        }
    }

    #[test]
    fn layout_without_an_evictable_frame_is_refused() {
        let good = pool(16, 4);
        assert!(SegmentLayout::new(2, 7, good, good).is_ok());
        for (workers, loads, bad) in [
            (2, 8, good),
            (3, 1, good),
            (2, 1, pool(15, 4)),
            (0, 1, good),
            (65, 1, good),
            (2, 0, good),
            (2, 1, pool(16, 0)),
        ] {
            assert!(matches!(
                SegmentLayout::new(workers, loads, pool(1000, 1), bad),
                Err(CacheError::Layout { .. })
            ));
        }
    }

    #[test]
    fn parts_are_aligned_and_do_not_overlap() {
        let layout = SegmentLayout::new(3, 2, pool(65, 5), pool(130, 7)).unwrap();
        let at = Offsets::new(&layout);
        let ends = [
            (0, size_of::<Header>()),
            (at.frame_headers[0], 65 * 16),
            (at.tables[0], at.table_slots[0] * 8),
            (at.frame_headers[1], 130 * 16),
            (at.tables[1], at.table_slots[1] * 8),
            (at.ledgers, 3 * at.ledger_bytes),
            (at.frames[0], 65 * 8192),
            (at.frames[1], 130 * 8192),
            (at.total, 0),
        ];
        for pair in ends.windows(2) {
            assert!(pair[0].0 + pair[0].1 <= pair[1].0, "{ends:?}");
            assert_eq!(pair[1].0 % ALIGN, 0);
        }
        assert_eq!(at.words, [2, 3]);
        let maps = [
            (LINE, 0),
            (at.pins[0], 16),
            (at.touched[0], 16),
            (at.pins[1], 24),
            (at.touched[1], 24),
            (at.ledger_bytes, 0),
        ];
        assert!(
            maps.windows(2)
                .all(|pair| pair[0].0 + pair[0].1 <= pair[1].0 && pair[1].0 % LINE == 0),
            "{maps:?}"
        );
    }

    #[test]
    fn header_of_another_build_or_segment_is_refused() {
        let layout = SegmentLayout::new(3, 2, pool(65, 5), pool(130, 7)).unwrap();
        let header = layout.header();
        assert_eq!(SegmentLayout::from_header(&header, layout.hash()).unwrap(), layout);
        assert!(SegmentLayout::from_header(&header, layout.hash() ^ 1).is_err());
        for byte in 0..size_of::<Header>() {
            let mut bytes = bytemuck::bytes_of(&header).to_vec();
            bytes[byte] ^= 0x20;
            let read: Header = bytemuck::pod_read_unaligned(&bytes);
            assert!(SegmentLayout::from_header(&read, layout.hash()).is_err(), "byte {byte}");
        }
    }
}
