//! [`PointBuffer`]: points in memory, sorted by keys of code and index and gathered through them.

use crate::limits::BATCH_POINTS;
use crate::sort::{SortedBatch, SortedPoints};
use pbgi_core::{PointRecord, Quantizer};
use pbgi_store::StoreError;
use rdst::{RadixKey, RadixSort};

/// Memory a point needs while it is sorted: itself, its key, and the sort's second copy of the key.
pub const BYTES_PER_POINT: u64 = (size_of::<PointRecord>() + 2 * size_of::<SortKey>()) as u64;

/// Points in a chunk of the buffer, a power of two: 2 MiB, so that the buffer grows without copying and its end wastes
/// little.
const CHUNK_POINTS: usize = 1 << 16;

/// Points in the order of arrival, never more than `capacity`.
pub struct PointBuffer {
    chunks: Vec<Vec<PointRecord>>,
    len: usize,
    capacity: usize,
}

/// Bytes 0 to 3 of a key are the index, 4 to 11 the code: no two keys are equal, so any radix sort is stable.
#[derive(Clone, Copy)]
struct SortKey {
    code: u64,
    index: u32,
}

impl RadixKey for SortKey {
    const LEVELS: usize = 12;

    #[inline]
    fn get_level(&self, level: usize) -> u8 {
        if level < 4 {
            (self.index >> (8 * level)) as u8
        } else {
            (self.code >> (8 * (level - 4))) as u8
        }
    }
}

impl PointBuffer {
    /// An empty buffer. Memory is taken as points arrive.
    pub fn new(capacity: usize) -> Self {
        Self {
            chunks: Vec::new(),
            len: 0,
            capacity: capacity.clamp(1, u32::MAX as usize),
        }
    }

    /// Points in it.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Whether there is no room for another one.
    pub fn is_full(&self) -> bool {
        self.len == self.capacity
    }

    /// Appends a point; the caller sees to the room.
    #[inline]
    pub fn push(&mut self, point: PointRecord) {
        debug_assert!(!self.is_full());
        let chunk = self.len / CHUNK_POINTS;
        if chunk == self.chunks.len() {
            let room = CHUNK_POINTS.min(self.capacity - self.len);
            self.chunks.push(Vec::with_capacity(room));
        }
        self.chunks[chunk].push(point);
        self.len += 1;
    }

    /// Forgets the points, keeps the memory.
    pub fn clear(&mut self) {
        self.chunks.iter_mut().for_each(Vec::clear);
        self.len = 0;
    }

    /// Sorts, and reads in order.
    pub fn sorted(&self, quantizer: &Quantizer) -> Sorted<'_> {
        let mut keys = Vec::with_capacity(self.len);
        // The capacity is an index.
        for (index, point) in (0u32..).zip(self.chunks.iter().flatten()) {
            let code = quantizer.code(point.position).0;
            keys.push(SortKey { code, index });
        }
        keys.radix_sort_unstable();
        Sorted {
            buffer: self,
            keys,
            next: 0,
        }
    }
}

/// The points of a buffer in order.
pub struct Sorted<'a> {
    buffer: &'a PointBuffer,
    keys: Vec<SortKey>,
    next: usize,
}

impl Sorted<'_> {
    /// The points, each with its code.
    pub fn iter(&self) -> impl Iterator<Item = (u64, PointRecord)> {
        self.keys.iter().map(|&key| self.point(key))
    }

    #[inline]
    fn point(&self, key: SortKey) -> (u64, PointRecord) {
        let index = key.index as usize;
        (key.code, self.buffer.chunks[index / CHUNK_POINTS][index % CHUNK_POINTS])
    }
}

impl SortedPoints for Sorted<'_> {
    fn next_sorted(&mut self, batch: &mut SortedBatch) -> Result<(), StoreError> {
        batch.clear();
        let end = (self.next + BATCH_POINTS).min(self.keys.len());
        for &key in &self.keys[self.next..end] {
            let (code, point) = self.point(key);
            batch.push(code, point);
        }
        self.next = end;
        Ok(())
    }
}
