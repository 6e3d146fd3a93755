//! [`SortedPoints`]: the points of a buffer in their order, by a radix sort from the leading digit that moves whole points.
//!
//! Points are distributed to buckets by leading bits of their codes, buckets that are still large once more, and those that
//! fit a core's cache are put in order by keys. Blocks that have been distributed are filled again, so that it takes little
//! memory beside that of the points; and what is read is read front to back, which a sort of keys alone, whose points are
//! fetched from anywhere, cannot say of itself.

use crate::error::BuildError;
use crate::sort::SortedStream;
use crate::sort::buffer::{BLOCK_POINTS, Block, PointBuffer, SpareBlocks};
use pbgi_core::limits::MORTON_BITS;
use pbgi_core::{PointRecord, Quantizer};

/// Bits of a code.
const CODE_BITS: u32 = 3 * MORTON_BITS;

/// Points of a bucket that is sorted by keys: with them, 2 MB.
const BUCKET_POINTS_MAX: usize = 1 << 15;

/// Leading bits that points are distributed by, at most: the ends of so many buckets stay in a core's caches.
const DISTRIBUTION_BITS_MAX: u32 = 10;

/// At least: a cloud with all points in one place is through its codes after few rounds.
const DISTRIBUTION_BITS_MIN: u32 = 5;

/// Points that a thread is worth.
const SHARE_POINTS_MIN: usize = 1 << 16;

/// Bits of a digit of the sort by keys; two digits are sorted by.
const DIGIT_BITS: u32 = 11;

/// Points with the same two digits, up to which an insertion sort is faster than any other.
const INSERTION_POINTS_MAX: usize = 16;

/// Points whose codes are equal but for the trailing `bits`, in the order of the input.
struct Bucket {
    blocks: Vec<Block>,
    bits: u32,
}

impl Bucket {
    fn len(&self) -> usize {
        self.blocks.iter().map(Vec::len).sum()
    }
}

/// A code, and where in the bucket its point is: the block's number, then the point's in it.
#[derive(Clone, Copy, Default)]
struct Key {
    code: u64,
    place: u32,
}

/// Gives the points of a buffer in the order of the Z-curve, of equal codes in that of the input.
pub struct SortedPoints {
    quantizer: Quantizer,
    /// What is left, the next one last.
    buckets: Vec<Bucket>,
    spare: SpareBlocks,
    keys: Vec<Key>,
    other_keys: Vec<Key>,
}

impl SortedPoints {
    /// Memory for `points` points while they are sorted: the ends of buckets waste an eighth at most.
    pub const fn bytes(points: u64) -> u64 {
        let bytes = points * size_of::<PointRecord>() as u64;
        bytes + bytes / 8
    }

    /// Starts to sort, on `threads` threads.
    pub fn new(buffer: PointBuffer, quantizer: &Quantizer, threads: usize) -> Self {
        let threads = threads.min(buffer.len() / SHARE_POINTS_MIN).max(1);
        let bits = distribution_bits(buffer.len() / threads, CODE_BITS);
        let (mut blocks, mut spare) = buffer.into_blocks();
        let share = blocks.len().div_ceil(threads).max(1);
        let mut shares = Vec::new();
        while !blocks.is_empty() {
            let rest = blocks.split_off(share.min(blocks.len()));
            shares.push(std::mem::replace(&mut blocks, rest));
        }
        let mut parts = no_blocks(bits);
        std::thread::scope(|scope| {
            let start = |share| {
                scope.spawn(move || {
                    let mut spare = SpareBlocks::default();
                    (distribute(share, CODE_BITS - bits, bits, quantizer, &mut spare), spare)
                })
            };
            let helpers: Vec<_> = shares.into_iter().map(start).collect();
            for helper in helpers {
                let (some, its_spare) = helper.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
                parts.iter_mut().zip(some).for_each(|(part, some)| part.extend(some));
                spare.merge(its_spare);
            }
        });
        let mut sorted = Self {
            quantizer: *quantizer,
            buckets: Vec::new(),
            spare,
            keys: Vec::new(),
            other_keys: Vec::new(),
        };
        sorted.push(parts, CODE_BITS - bits);
        sorted
    }

    /// The memory of the points that have been given.
    pub fn into_spare(self) -> SpareBlocks {
        self.spare
    }

    fn push(&mut self, parts: Vec<Vec<Block>>, bits: u32) {
        let filled = parts.into_iter().rev().filter(|blocks| !blocks.is_empty());
        self.buckets.extend(filled.map(|blocks| Bucket { blocks, bits }));
    }

    /// Appends the points of a bucket, and their codes.
    fn sort(&mut self, bucket: Bucket, codes: &mut Vec<u64>, points: &mut Vec<PointRecord>) {
        self.keys.clear();
        for (number, block) in (0..).zip(&bucket.blocks) {
            self.keys.extend(block.iter().zip(0..).map(|(point, offset)| Key {
                code: self.quantizer.code(point.position).0,
                place: number * BLOCK_POINTS as u32 + offset,
            }));
        }
        if bucket.bits > 0 {
            sort_keys(&mut self.keys, &mut self.other_keys, bucket.bits);
        }
        codes.extend(self.keys.iter().map(|key| key.code));
        points.extend(self.keys.iter().map(|key| {
            let place = key.place as usize;
            bucket.blocks[place / BLOCK_POINTS][place % BLOCK_POINTS]
        }));
        bucket.blocks.into_iter().for_each(|block| self.spare.give(block));
    }
}

impl SortedStream for SortedPoints {
    fn next_batch(&mut self, codes: &mut Vec<u64>, points: &mut Vec<PointRecord>) -> Result<bool, BuildError> {
        while let Some(mut bucket) = self.buckets.pop() {
            let count = bucket.len();
            if count <= BUCKET_POINTS_MAX {
                self.sort(bucket, codes, points);
                return Ok(true);
            }
            if bucket.bits == 0 {
                // One code, any number of points: they are in order.
                let rest = bucket.blocks.split_off(1);
                self.buckets.push(Bucket { blocks: rest, bits: 0 });
                self.sort(bucket, codes, points);
                return Ok(true);
            }
            let bits = distribution_bits(count, bucket.bits);
            let rest = bucket.bits - bits;
            let parts = distribute(bucket.blocks, rest, bits, &self.quantizer, &mut self.spare);
            self.push(parts, rest);
        }
        Ok(false)
    }
}

/// Bits to distribute by, so that most buckets of `points` points are small enough and their ends waste little.
fn distribution_bits(points: usize, bits: u32) -> u32 {
    let buckets = points / (8 * BLOCK_POINTS);
    let wanted = buckets.max(1).ilog2();
    wanted.clamp(DISTRIBUTION_BITS_MIN, DISTRIBUTION_BITS_MAX).min(bits)
}

fn no_blocks(bits: u32) -> Vec<Vec<Block>> {
    (0..1usize << bits).map(|_| Vec::new()).collect()
}

/// Distributes points by the `bits` bits of their codes above the trailing `rest`, in their order.
fn distribute(
    blocks: Vec<Block>,
    rest: u32,
    bits: u32,
    quantizer: &Quantizer,
    spare: &mut SpareBlocks,
) -> Vec<Vec<Block>> {
    let mask = (1usize << bits) - 1;
    let mut parts = no_blocks(bits);
    let mut ends: Vec<Block> = parts.iter().map(|_| Vec::new()).collect();
    for block in blocks {
        for point in &block {
            let bucket = (quantizer.code(point.position).0 >> rest) as usize & mask;
            let end = &mut ends[bucket];
            // One that has never been filled has no room either.
            if end.len() == end.capacity() {
                let full = std::mem::replace(end, spare.take());
                parts[bucket].push(full);
            }
            end.push(*point);
        }
        spare.give(block);
    }
    for (part, end) in parts.iter_mut().zip(ends) {
        part.push(end);
        part.retain(|block| !block.is_empty());
    }
    parts
}

/// Sorts keys that are equal but for the trailing `bits` of their codes, those of equal codes by place, in which order they
/// come: by the two leading digits from the second on, then each group of equal digits.
fn sort_keys(keys: &mut Vec<Key>, other: &mut Vec<Key>, bits: u32) {
    let shifts = [bits.saturating_sub(2 * DIGIT_BITS), bits.saturating_sub(DIGIT_BITS)];
    let digit = |key: &Key, shift: u32| (key.code >> shift) as usize & ((1 << DIGIT_BITS) - 1);
    let mut starts = [[0u32; 1 << DIGIT_BITS]; 2];
    for key in keys.iter() {
        starts[0][digit(key, shifts[0])] += 1;
        starts[1][digit(key, shifts[1])] += 1;
    }
    other.resize(keys.len(), Key::default());
    for (starts, shift) in starts.iter_mut().zip(shifts) {
        let mut sum = 0;
        for start in starts.iter_mut() {
            sum += std::mem::replace(start, sum);
        }
        for key in keys.iter() {
            let start = &mut starts[digit(key, shift)];
            other[*start as usize] = *key;
            *start += 1;
        }
        std::mem::swap(keys, other);
    }
    for group in keys.chunk_by_mut(|a, b| a.code >> shifts[0] == b.code >> shifts[0]) {
        if group.len() <= INSERTION_POINTS_MAX {
            insertion_sort(group);
        } else {
            group.sort_unstable_by_key(|key| (key.code, key.place));
        }
    }
}

fn insertion_sort(keys: &mut [Key]) {
    for sorted in 1..keys.len() {
        let key = keys[sorted];
        let mut place = sorted;
        while place > 0 && keys[place - 1].code > key.code {
            keys[place] = keys[place - 1];
            place -= 1;
        }
        keys[place] = key;
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests assert")]
mod tests {
    use super::*;
    use pbgi_core::Bounds;
    use pbgi_core::point::Sides;

    const POINTS: u32 = 300_000;

    /// Points at `position(i % period)`. Their place in the input is told by the radius.
    fn cloud(period: u32, position: impl Fn(u32) -> [f32; 3]) -> Vec<PointRecord> {
        let dark = Sides {
            front: [0.0; 3],
            back: [0.0; 3],
        };
        let record = |i| PointRecord::new(position(i % period), [0.0, 0.0, 1.0], (i + 1) as f32, dark).unwrap();
        (0..POINTS).map(record).collect()
    }

    fn noise(index: u32) -> f32 {
        (index.wrapping_mul(0x9e37_79b9) >> 8) as f32 / 16_777_216.0
    }

    #[test]
    fn any_cloud_comes_in_the_order_of_its_codes_and_then_of_its_input() {
        let anywhere = |i: u32| [noise(i), noise(i ^ 0x5555), noise(i ^ 0x1_2345)];
        let corner = |i: u32| {
            if i == 0 {
                [1.0; 3]
            } else {
                anywhere(i).map(|x| x * 1e-4)
            }
        };
        let line = |i: u32| [1.0 - i as f32 / POINTS as f32, 0.0, 0.0];
        let clouds = [
            ("anywhere, each place often", cloud(60_000, anywhere)),
            ("in one place", cloud(1, anywhere)),
            ("in two places", cloud(2, anywhere)),
            ("in a small corner, and one far away", cloud(POINTS, corner)),
            ("on a line, backwards", cloud(POINTS, line)),
            ("few", cloud(POINTS, anywhere).split_off(299_990)),
        ];
        for (name, points) in clouds {
            let mut bounds = Bounds::EMPTY;
            points.iter().for_each(|point| bounds.include(point.position));
            let quantizer = Quantizer::from_bounds(&bounds).unwrap();
            let mut expected: Vec<_> = points
                .iter()
                .map(|point| (quantizer.code(point.position).0, *point))
                .collect();
            expected.sort_by_key(|(code, _)| *code);
            for threads in [1, 2, 3] {
                let mut buffer = PointBuffer::new(points.len());
                points.chunks(1000).for_each(|some| buffer.extend(some));
                let mut sorted = SortedPoints::new(buffer, &quantizer, threads);
                let (mut codes, mut found) = (Vec::new(), Vec::new());
                while sorted.next_batch(&mut codes, &mut found).unwrap() {}
                let found: Vec<_> = codes.into_iter().zip(found).collect();
                assert!(found == expected, "{name}, {threads} threads");
                // Memory: that of the points, and of the ends of buckets.
                let (blocks, room) = (sorted.into_spare().count(), SortedPoints::bytes(points.len() as u64));
                let bytes = blocks * BLOCK_POINTS * size_of::<PointRecord>();
                assert!(
                    bytes as u64 <= room.max(1 << 20),
                    "{name}, {threads} threads: {bytes} of {room}"
                );
            }
        }
    }
}
