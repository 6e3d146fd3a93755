//! [`Ordered`]: the points of a cloud along the Z-curve, in memory or in a nameless file of scratch, and their cells found
//! again.
//!
//! Points are counted by coarse cells, dealt out to buckets of consecutive cells that fit the memory, and each bucket is
//! sorted by itself: the input is read twice, scratch is written twice, and read once before the points are handed out.

use super::outward::Cells;
use crate::error::PointsError;
use bytemuck::Zeroable;
use pbgi_core::limits::MORTON_BITS;
use pbgi_core::{PointRecord, Quantizer};
use pbgi_store::{OsVolume, StoreError, Volume};
use std::fs::File;
use std::ops::Range;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

/// Levels of the octree that one counting pass resolves: 2^18 cells, a few hundred points each in a scan of ten million.
const COUNT_LEVELS: u32 = 6;
const CELLS: usize = 1 << (3 * COUNT_LEVELS);
/// Levels that are resolved at once where a coarse cell holds too many points: 512 cells.
const DEEPER_LEVELS: u32 = 3;
const RECORD_BYTES: u64 = size_of::<PointRecord>() as u64;
/// Of a point while a bucket is sorted: itself twice, and its key.
const SORT_BYTES: u64 = 2 * RECORD_BYTES + 16;
/// Points per entry of the index, at least.
const INDEX_STRIDE_MIN: u64 = 64;
/// Points of a bucket that wait to be written together, at least.
const WAITING_MIN: usize = 32;

/// How many points are in each coarse cell.
pub(super) struct Census {
    quantizer: Quantizer,
    cells: Vec<u32>,
    pub(super) points: u64,
}

/// Points on their way to their buckets.
pub(super) struct Dealer {
    quantizer: Quantizer,
    /// Bucket of each coarse cell.
    bucket_of: Vec<u16>,
    buckets: Vec<Bucket>,
    waiting_max: usize,
    storage: Storage,
    bucket_points: u64,
    marks: Marks,
}

/// What is noted of the finished order.
struct Marks {
    /// Codes of the points, one every `stride`.
    codes: Vec<u64>,
    stride: u64,
    cells: Cells,
}

struct Bucket {
    /// Records of the finished order.
    range: Range<u64>,
    next: u64,
    waiting: Vec<PointRecord>,
}

/// All points in order.
pub(super) struct Ordered {
    quantizer: Quantizer,
    storage: Storage,
    marks: Marks,
    len: u64,
}

enum Storage {
    Memory(Vec<PointRecord>),
    Scratch { file: File, folder: PathBuf },
}

impl Census {
    pub(super) fn new(quantizer: Quantizer) -> Self {
        Self {
            quantizer,
            cells: vec![0; CELLS],
            points: 0,
        }
    }

    pub(super) fn add(&mut self, points: &[PointRecord]) {
        for point in points {
            let cell = self.quantizer.code(point.position).prefix(COUNT_LEVELS);
            let count = &mut self.cells[cell as usize];
            *count = count.saturating_add(1);
        }
        self.points += points.len() as u64;
    }

    /// Makes room for the points.
    pub(super) fn deal(self, folder: &Path, memory_bytes: u64) -> Result<Dealer, PointsError> {
        let all = self.points * SORT_BYTES;
        let storage = if all <= memory_bytes {
            Storage::Memory(vec![PointRecord::zeroed(); self.points as usize])
        } else {
            Storage::scratch(folder, self.points)?
        };
        let bucket_points = (memory_bytes / 2 / SORT_BYTES).max(1);
        let ranges = consecutive(&self.cells, bucket_points, 0);
        let mut bucket_of = vec![0u16; CELLS];
        let mut buckets = Vec::with_capacity(ranges.len());
        for (cells, range) in ranges {
            let number = u16::try_from(buckets.len()).map_err(|_| {
                let points = self.points;
                PointsError::Request(format!(
                    "{memory_bytes} bytes are too few to bring {points} points into order: give more --memory"
                ))
            })?;
            bucket_of[cells].fill(number);
            buckets.push(Bucket {
                next: range.start,
                range,
                waiting: Vec::new(),
            });
        }
        let waiting_max = (memory_bytes / 4 / RECORD_BYTES) as usize / buckets.len().max(1);
        Ok(Dealer {
            quantizer: self.quantizer,
            bucket_of,
            buckets,
            waiting_max: waiting_max.clamp(WAITING_MIN, 4096),
            storage,
            bucket_points,
            marks: Marks::new(self.points, memory_bytes / 8),
        })
    }
}

/// Runs of consecutive cells that hold at most `points_max` together, or are one cell; and the records they come to.
fn consecutive(cells: &[u32], points_max: u64, start: u64) -> Vec<(Range<usize>, Range<u64>)> {
    let mut runs = Vec::new();
    let (mut first, mut from, mut next) = (0, start, start);
    for (cell, &count) in cells.iter().enumerate() {
        let after = next + u64::from(count);
        if after - from > points_max && next > from {
            runs.push((first..cell, from..next));
            (first, from) = (cell, next);
        }
        next = after;
    }
    runs.push((first..cells.len(), from..next));
    runs
}

impl Dealer {
    pub(super) fn add(&mut self, points: &[PointRecord]) -> Result<(), PointsError> {
        for point in points {
            let cell = self.quantizer.code(point.position).prefix(COUNT_LEVELS);
            let bucket = &mut self.buckets[usize::from(self.bucket_of[cell as usize])];
            bucket.add(point, self.waiting_max, &mut self.storage)?;
        }
        Ok(())
    }

    pub(super) fn bucket_count(&self) -> usize {
        self.buckets.len()
    }

    /// Sorts one bucket; one after another.
    pub(super) fn sort(&mut self, bucket: usize) -> Result<(), PointsError> {
        let bucket = &mut self.buckets[bucket];
        bucket.flush(&mut self.storage)?;
        let range = bucket.range.clone();
        let mut sort = Sort {
            quantizer: &self.quantizer,
            points_max: self.bucket_points,
            marks: &mut self.marks,
        };
        sort.range(&mut self.storage, range, COUNT_LEVELS)
    }

    /// Once every bucket is sorted.
    pub(super) fn finish(self) -> Ordered {
        Ordered {
            quantizer: self.quantizer,
            storage: self.storage,
            marks: self.marks,
            len: self.buckets.last().map_or(0, |bucket| bucket.range.end),
        }
    }
}

impl Marks {
    fn new(points: u64, memory_bytes: u64) -> Self {
        let most = memory_bytes / size_of::<u64>() as u64;
        let mut stride = INDEX_STRIDE_MIN;
        while points / stride > most.max(1) {
            stride *= 2;
        }
        Self {
            codes: vec![0; points.div_ceil(stride) as usize],
            stride,
            cells: Cells::new(),
        }
    }

    /// Notes points that are in their places, from `at` on: all of them, one after another.
    fn note(&mut self, at: u64, points: &[PointRecord], quantizer: &Quantizer) {
        let ahead = at.next_multiple_of(self.stride) - at;
        let marked = points.iter().skip(ahead as usize).step_by(self.stride as usize);
        let places = self.codes.iter_mut().skip(((at + ahead) / self.stride) as usize);
        for (code, point) in places.zip(marked) {
            *code = quantizer.code(point.position).0;
        }
        self.cells.note(at, points, quantizer);
    }
}

/// Points read from scratch at once while a range is counted or dealt out.
const READ_POINTS: u64 = 1 << 14;

impl Bucket {
    fn add(&mut self, point: &PointRecord, waiting_max: usize, storage: &mut Storage) -> Result<(), PointsError> {
        self.waiting.push(*point);
        if self.waiting.len() < waiting_max {
            return Ok(());
        }
        self.flush(storage)
    }

    fn flush(&mut self, storage: &mut Storage) -> Result<(), PointsError> {
        // The input is the same at every reading, so a bucket is never given more than was counted.
        debug_assert!(self.next + self.waiting.len() as u64 <= self.range.end);
        storage.write(self.next, &self.waiting)?;
        self.next += self.waiting.len() as u64;
        self.waiting.clear();
        Ok(())
    }
}

/// How ranges of records are sorted.
struct Sort<'a> {
    quantizer: &'a Quantizer,
    points_max: u64,
    marks: &'a mut Marks,
}

impl Sort<'_> {
    /// Sorts a range of records whose codes agree in the first `level` levels. What does not fit the memory is dealt out
    /// once more by the next levels; points of one code are in order already.
    fn range(&mut self, storage: &mut Storage, range: Range<u64>, level: u32) -> Result<(), PointsError> {
        let quantizer = self.quantizer;
        if range.end - range.start <= self.points_max {
            let mut points = Vec::with_capacity((range.end - range.start) as usize);
            storage.read(range.clone(), &mut points)?;
            // Stable: ties keep the order of the input.
            points.sort_by_cached_key(|point| quantizer.code(point.position).0);
            self.marks.note(range.start, &points, quantizer);
            return storage.write(range.start, &points);
        }
        if level >= MORTON_BITS {
            let mut at = range.start;
            return storage.scan(range, &mut |points| {
                self.marks.note(at, points, quantizer);
                at += points.len() as u64;
                Ok(())
            });
        }
        let (cells, deeper) = deal_again(storage, quantizer, range.clone(), level)?;
        for (_, range) in consecutive(&cells, self.points_max, range.start) {
            self.range(storage, range, deeper)?;
        }
        Ok(())
    }
}

/// Brings the records of a range into the order of their cells some levels further down; how many each cell has, and the
/// level of those.
fn deal_again(
    storage: &mut Storage,
    quantizer: &Quantizer,
    range: Range<u64>,
    level: u32,
) -> Result<(Vec<u32>, u32), PointsError> {
    let count = range.end - range.start;
    let deeper = (level + DEEPER_LEVELS).min(MORTON_BITS);
    let cell_of = |point: &PointRecord| {
        let below = quantizer.code(point.position).prefix(deeper);
        (below & ((1 << (3 * (deeper - level))) - 1)) as usize
    };
    let mut cells = vec![0u32; 1 << (3 * (deeper - level))];
    storage.scan(range.clone(), &mut |points| {
        points.iter().for_each(|point| cells[cell_of(point)] += 1);
        Ok(())
    })?;
    let mut copy = storage.like(count)?;
    let mut children = Vec::with_capacity(cells.len());
    let mut sum = 0;
    for &count in &cells {
        let range = sum..sum + u64::from(count);
        sum = range.end;
        children.push(Bucket {
            next: range.start,
            range,
            waiting: Vec::new(),
        });
    }
    storage.scan(range.clone(), &mut |points| {
        for point in points {
            children[cell_of(point)].add(point, WAITING_MIN, &mut copy)?;
        }
        Ok(())
    })?;
    children.iter_mut().try_for_each(|child| child.flush(&mut copy))?;
    let mut to = range.start;
    copy.scan(0..count, &mut |points| {
        storage.write(to, points)?;
        to += points.len() as u64;
        Ok(())
    })?;
    Ok((cells, deeper))
}

impl Storage {
    /// A file without a name, so that it goes when the process does.
    fn scratch(folder: &Path, points: u64) -> Result<Self, PointsError> {
        let needed = points * RECORD_BYTES;
        let free = OsVolume
            .free_bytes(folder)
            .map_err(PointsError::io("read the free space of", folder))?;
        if free < needed {
            return Err(PointsError::Store(StoreError::NoSpace {
                needed,
                free,
                path: folder.to_owned(),
            }));
        }
        let file = tempfile::tempfile_in(folder).map_err(PointsError::io("make a scratch file in", folder))?;
        Ok(Self::Scratch {
            file,
            folder: folder.to_owned(),
        })
    }

    /// Another one of the same kind.
    fn like(&self, points: u64) -> Result<Self, PointsError> {
        match self {
            Self::Memory(_) => Ok(Self::Memory(vec![PointRecord::zeroed(); points as usize])),
            Self::Scratch { folder, .. } => Self::scratch(folder, points),
        }
    }

    fn write(&mut self, at: u64, points: &[PointRecord]) -> Result<(), PointsError> {
        match self {
            Self::Memory(all) => {
                let at = at as usize;
                all[at..at + points.len()].copy_from_slice(points);
                Ok(())
            }
            Self::Scratch { file, folder } => file
                .write_all_at(bytemuck::cast_slice(points), at * RECORD_BYTES)
                .map_err(PointsError::io("write scratch in", folder)),
        }
    }

    /// Appends the records of `range`.
    fn read(&self, range: Range<u64>, points: &mut Vec<PointRecord>) -> Result<(), PointsError> {
        match self {
            Self::Memory(all) => {
                points.extend_from_slice(&all[range.start as usize..range.end as usize]);
                Ok(())
            }
            Self::Scratch { file, folder } => {
                let before = points.len();
                points.resize(before + (range.end - range.start) as usize, PointRecord::zeroed());
                file.read_exact_at(
                    bytemuck::cast_slice_mut(&mut points[before..]),
                    range.start * RECORD_BYTES,
                )
                .map_err(PointsError::io("read scratch in", folder))
            }
        }
    }

    /// Shows the records of `range`, some thousands at a time.
    fn scan(
        &self,
        range: Range<u64>,
        show: &mut dyn FnMut(&[PointRecord]) -> Result<(), PointsError>,
    ) -> Result<(), PointsError> {
        let mut points = Vec::new();
        for start in range.clone().step_by(READ_POINTS as usize) {
            points.clear();
            self.read(start..(start + READ_POINTS).min(range.end), &mut points)?;
            show(&points)?;
        }
        Ok(())
    }
}

impl Ordered {
    pub(super) fn len(&self) -> u64 {
        self.len
    }

    pub(super) fn quantizer(&self) -> &Quantizer {
        &self.quantizer
    }

    pub(super) fn cells(&self) -> &Cells {
        &self.marks.cells
    }

    /// Appends the records of `range`.
    pub(super) fn read(&self, range: Range<u64>, points: &mut Vec<PointRecord>) -> Result<(), PointsError> {
        self.storage.read(range, points)
    }

    /// Records among which are all those whose code is in `codes`, and few others.
    pub(super) fn records_around(&self, codes: Range<u64>) -> Range<u64> {
        // The entry before the first one that is not below: points of the range may come before the next entry.
        let Marks {
            codes: marks, stride, ..
        } = &self.marks;
        let first = marks.partition_point(|&code| code < codes.start).saturating_sub(1) as u64;
        let end = marks.partition_point(|&code| code < codes.end) as u64;
        let start = first * stride;
        start..(end * stride).min(self.len).max(start)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pbgi_core::Bounds;
    use pbgi_core::point::Sides;

    fn point(position: [f32; 3], mark: f32) -> PointRecord {
        PointRecord::new(position, [0.0, 1.0, 0.0], mark, Sides::default()).unwrap()
    }

    fn ordered(points: &[PointRecord], memory_bytes: u64) -> Vec<PointRecord> {
        let folder = tempfile::tempdir().unwrap();
        let bounds = Bounds {
            min: [0.0; 3],
            max: [1.0; 3],
        };
        let mut census = Census::new(Quantizer::from_bounds(&bounds).unwrap());
        census.add(points);
        let mut dealer = census.deal(folder.path(), memory_bytes).unwrap();
        points.chunks(100).for_each(|chunk| dealer.add(chunk).unwrap());
        (0..dealer.bucket_count()).for_each(|bucket| dealer.sort(bucket).unwrap());
        let ordered = dealer.finish();
        let mut all = Vec::new();
        ordered.read(0..ordered.len(), &mut all).unwrap();
        assert_eq!(
            std::fs::read_dir(folder.path()).unwrap().count(),
            0,
            "scratch has no name"
        );
        all
    }

    #[test]
    fn points_are_in_order_whatever_the_memory() {
        let spread = |i: u32| (f64::from(i) * 0.754_877_666).fract() as f32;
        let mut points: Vec<PointRecord> = (0..5000)
            .map(|i| point([spread(i), spread(i * 7), spread(i * 31)], (i + 1) as f32))
            .collect();
        // A crowd at one place, and one in a cell that a counting pass does not resolve.
        points.extend((0..3000).map(|i| point([0.3; 3], (10_000 + i) as f32)));
        points.extend((0..3000).map(|i| point([0.7 + spread(i) * 1e-4, 0.7, 0.7], (20_000 + i) as f32)));
        let bounds = Bounds {
            min: [0.0; 3],
            max: [1.0; 3],
        };
        let quantizer = Quantizer::from_bounds(&bounds).unwrap();
        let mut expected = points.clone();
        expected.sort_by_key(|point| quantizer.code(point.position));
        for memory in [u64::MAX, 200_000, 60_000] {
            assert!(ordered(&points, memory) == expected, "{memory} bytes");
        }
    }
}
