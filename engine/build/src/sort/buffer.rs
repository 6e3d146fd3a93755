//! [`PointBuffer`]: points in memory, sorted by keys of code and index and gathered through them.

use crate::error::BuildError;
use crate::sort::{Feed, Piece};
use pbgi_core::{PointRecord, Quantizer};
use rdst::{RadixKey, RadixSort};
use std::ops::Range;
use std::sync::Arc;

/// Memory a point needs while it waits to be sorted.
pub const POINT_BYTES: u64 = size_of::<PointRecord>() as u64;

/// Memory a point needs on top while it is sorted: its key, and the sort's second copy of the key.
pub const KEY_BYTES: u64 = 2 * size_of::<SortKey>() as u64;

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
#[derive(Clone, Copy, Default)]
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

    /// Most points it holds.
    pub fn capacity(&self) -> usize {
        self.capacity
    }

    /// How many more there is room for.
    pub fn room(&self) -> usize {
        self.capacity - self.len
    }

    /// Appends points; the caller sees to the room.
    pub fn extend(&mut self, mut points: &[PointRecord]) {
        debug_assert!(points.len() <= self.room());
        while !points.is_empty() {
            let chunk = self.len / CHUNK_POINTS;
            if chunk == self.chunks.len() {
                let room = CHUNK_POINTS.min(self.capacity - self.len);
                self.chunks.push(Vec::with_capacity(room));
            }
            let chunk = &mut self.chunks[chunk];
            let (head, tail) = points.split_at((CHUNK_POINTS - chunk.len()).min(points.len()));
            chunk.extend_from_slice(head);
            self.len += head.len();
            points = tail;
        }
    }

    /// Forgets the points, keeps the memory.
    pub fn clear(&mut self) {
        self.chunks.iter_mut().for_each(Vec::clear);
        self.len = 0;
    }

    /// Sorts, on `threads` threads.
    pub fn sorted(&self, quantizer: &Quantizer, threads: usize) -> Order {
        let mut keys = vec![SortKey::default(); self.len];
        let chunks_each = self.chunks.len().div_ceil(threads.max(1)).max(1);
        std::thread::scope(|scope| {
            let shares = keys.chunks_mut(chunks_each * CHUNK_POINTS);
            for (share, (keys, chunks)) in shares.zip(self.chunks.chunks(chunks_each)).enumerate() {
                let first = (share * chunks_each * CHUNK_POINTS) as u32;
                scope.spawn(move || {
                    for ((key, point), index) in keys.iter_mut().zip(chunks.iter().flatten()).zip(first..) {
                        key.code = quantizer.code(point.position).0;
                        key.index = index;
                    }
                });
            }
        });
        keys.radix_sort_builder().with_parallel(threads > 1).sort();
        Order { keys }
    }

    #[inline]
    fn point(&self, key: SortKey) -> PointRecord {
        let index = key.index as usize;
        self.chunks[index / CHUNK_POINTS][index % CHUNK_POINTS]
    }
}

/// The order of the points of a buffer.
pub struct Order {
    keys: Vec<SortKey>,
}

impl Order {
    /// The points of the buffer that this is the order of.
    pub fn iter<'a>(&'a self, buffer: &'a PointBuffer) -> impl Iterator<Item = PointRecord> + 'a {
        self.keys.iter().map(|&key| buffer.point(key))
    }
}

/// A buffer in its order.
struct Sorted {
    buffer: PointBuffer,
    order: Order,
}

/// A part of a sorted buffer.
pub struct Stretch {
    sorted: Arc<Sorted>,
    range: Range<usize>,
}

impl Stretch {
    /// Replaces the content of `codes` and `points` by these.
    pub fn read(&self, codes: &mut Vec<u64>, points: &mut Vec<PointRecord>) {
        codes.clear();
        points.clear();
        let Sorted { buffer, order } = self.sorted.as_ref();
        let keys = &order.keys[self.range.clone()];
        codes.extend(keys.iter().map(|key| key.code));
        points.extend(keys.iter().map(|&key| buffer.point(key)));
    }
}

/// Feeds a sorted buffer.
pub struct BufferFeed {
    sorted: Arc<Sorted>,
    /// Codes from `next` on, as far as they were looked at.
    window: Vec<u64>,
    next: usize,
}

impl BufferFeed {
    /// Feeds `buffer` in `order`.
    pub fn new(buffer: PointBuffer, order: Order) -> Self {
        Self {
            sorted: Arc::new(Sorted { buffer, order }),
            window: Vec::new(),
            next: 0,
        }
    }
}

impl Feed for BufferFeed {
    fn codes(&mut self, count: usize) -> Result<&[u64], BuildError> {
        if self.window.len() < count {
            let keys = &self.sorted.order.keys;
            let from = self.next + self.window.len();
            // Twice as many, so that keys are looked at in longer strides.
            let to = (self.next + 2 * count).min(keys.len());
            self.window.extend(keys[from..to].iter().map(|key| key.code));
        }
        Ok(&self.window)
    }

    fn take(&mut self, count: usize) -> Piece {
        self.window.drain(..count);
        let range = self.next..self.next + count;
        self.next = range.end;
        Piece::Stretch(Stretch {
            sorted: self.sorted.clone(),
            range,
        })
    }
}
