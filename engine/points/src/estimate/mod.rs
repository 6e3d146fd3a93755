//! Normals and radii for clouds that have none: [`Estimated`].
//!
//! The points are brought into Z-order ([`order`]), through scratch where they do not fit the memory, and handed out in
//! blocks along the curve. Each block is looked at together with the cells around it, so that a point at its border has its
//! neighbours too. Blocks and what lies around them do not depend on the memory or on the number of threads.

mod neighbours;
mod order;
mod outward;
mod surface;

use crate::cloud::{Cloud, CloudOptions, Facing, Radius};
use crate::error::PointsError;
use crate::limits;
use glam::Vec3;
use neighbours::Neighbours;
use order::{Census, Dealer, Ordered};
use outward::Outward;
use pbgi_core::limits::MORTON_BITS;
use pbgi_core::{Bounds, MortonCode, PointRecord, PointStream, Quantizer, octahedral};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

/// Neighbours that make a normal: enough to smooth the noise of a scanner, few enough to follow an edge. The median error
/// on the dragon falls from 8 to 16 and rises slowly beyond.
const NEIGHBOURS: usize = 16;

/// Points of a block: 32 of the cells below on a side of a surface patch, so that what lies around adds an eighth.
const BLOCK_POINTS: u64 = 1 << 15;

/// Points in a cell of a block, on average: one ring of cells around it holds the neighbours of its border several times.
const CELL_POINTS: usize = 32;

/// Most points around a block; of more, evenly many are left out.
const AROUND_MAX: usize = 1 << 16;

/// A radius above this many times the median of its block belongs to a stray point.
const STRAY_RADII: f32 = 4.0;

/// Clouds that lack the same things, with those estimated.
pub(crate) struct Estimated {
    clouds: Vec<Box<dyn Cloud>>,
    wanted: Wanted,
    threads: usize,
    memory_bytes: u64,
    scratch_dir: PathBuf,
    stage: Stage,
    outside: Outside,
}

/// Points outside of the box that the headers declare.
#[derive(Clone, Copy, Debug, Default)]
struct Outside {
    count: u64,
    first: Option<[f32; 3]>,
}

/// What is estimated, and how.
#[derive(Clone, Copy)]
struct Wanted {
    facing: Option<Facing>,
    radius: Option<Radius>,
    /// Of all clouds together.
    bounds: Bounds,
}

enum Stage {
    /// Nothing is in order yet; the cloud that is read.
    Counting(Census, usize),
    Dealing(Box<Dealer>, usize),
    /// The bucket that comes next.
    Sorting(Box<Dealer>, usize),
    Blocks {
        ordered: Box<Ordered>,
        /// Where normals are to face out.
        outward: Option<Outward>,
        next: u64,
        ready: Vec<Vec<PointRecord>>,
    },
    /// A stage that failed; the stream is of no more use.
    Broken,
}

/// What estimating may use.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Means<'a> {
    pub(crate) threads: usize,
    pub(crate) memory_bytes: u64,
    pub(crate) scratch_dir: &'a Path,
}

impl Estimated {
    /// Over `clouds`, of which all lack normals or none does, and likewise radii. Reads them once where they do not
    /// declare their boxes.
    pub(crate) fn new(
        clouds: Vec<Box<dyn Cloud>>,
        options: &CloudOptions,
        means: &Means<'_>,
    ) -> Result<Self, PointsError> {
        let mut clouds = clouds;
        let mut bounds = Bounds::EMPTY;
        for cloud in &mut clouds {
            bounds.merge(&match cloud.bounds() {
                Some(bounds) => bounds,
                None => measure(cloud.as_mut())?,
            });
        }
        if means.memory_bytes < limits::ESTIMATE_MEMORY_MIN {
            return Err(PointsError::Memory {
                what: "estimating normals or radii",
                needed: limits::ESTIMATE_MEMORY_MIN,
                available: means.memory_bytes,
            });
        }
        let missing = clouds.first().map(|cloud| cloud.missing()).unwrap_or_default();
        let aerial = clouds.iter().all(|cloud| cloud.is_aerial());
        let facing = options
            .estimate_normals
            .filter(|_| missing.normals)
            .map(|facing| match facing {
                Facing::Auto if aerial => Facing::Up,
                Facing::Auto => Facing::Outward,
                chosen => chosen,
            });
        Ok(Self {
            clouds,
            stage: Stage::start(&bounds),
            wanted: Wanted {
                facing,
                radius: options.radius.filter(|_| missing.radii),
                bounds,
            },
            threads: means.threads.max(1),
            memory_bytes: means.memory_bytes,
            scratch_dir: means.scratch_dir.to_owned(),
            outside: Outside::default(),
        })
    }

    pub(crate) fn memory_bytes(&self) -> u64 {
        self.memory_bytes
    }

    pub(crate) fn skipped(&self) -> u64 {
        self.clouds.iter().map(|cloud| cloud.skipped()).sum()
    }

    /// Computes the next blocks, one a thread.
    fn blocks(
        &self,
        ordered: &Ordered,
        outward: Option<&Outward>,
        next: &mut u64,
    ) -> Result<Vec<Vec<PointRecord>>, PointsError> {
        let mut ranges = Vec::new();
        while ranges.len() < self.threads && *next < ordered.len() {
            let end = (*next + BLOCK_POINTS).min(ordered.len());
            ranges.push(*next..end);
            *next = end;
        }
        let done = Mutex::new(Vec::new());
        std::thread::scope(|scope| {
            for (number, range) in ranges.into_iter().enumerate() {
                let (done, wanted) = (&done, &self.wanted);
                scope.spawn(move || {
                    let block = wanted.block(ordered, outward, range);
                    done.lock()
                        .unwrap_or_else(std::sync::PoisonError::into_inner)
                        .push((number, block));
                });
            }
        });
        let mut done = done.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
        // Taken from the end.
        done.sort_by_key(|(number, _)| std::cmp::Reverse(*number));
        done.into_iter().map(|(_, block)| block).collect()
    }
}

impl Wanted {
    fn block(
        &self,
        ordered: &Ordered,
        outward: Option<&Outward>,
        range: Range<u64>,
    ) -> Result<Vec<PointRecord>, PointsError> {
        if self.facing.is_none() && self.radius.is_none() {
            let mut block = Vec::new();
            ordered.read(range, &mut block)?;
            return Ok(block);
        }
        let (points, own) = surroundings(ordered, range)?;
        let positions: Vec<Vec3> = points.iter().map(|point| Vec3::from(point.position)).collect();
        let neighbours = Neighbours::new(&positions);
        let mut sides = outward.map(Outward::sides);
        let cell = (ordered.quantizer().edge / f64::from(1u32 << MORTON_BITS)) as f32;
        let mut block = Vec::with_capacity(own.len());
        for index in own {
            let (point, position) = (points[index], positions[index]);
            let nearest = neighbours.nearest::<NEIGHBOURS>(index);
            let found = nearest.found();
            let normal = match self.facing {
                None => point.normal(),
                Some(facing) => {
                    let around = found.iter().map(|&(_, other)| positions[other as usize]);
                    let towards = match (facing, &mut sides) {
                        (Facing::Viewpoint(eye), _) => Vec3::from(eye) - position,
                        (Facing::Outward, Some(sides)) => sides.towards(position),
                        _ => Vec3::Y,
                    };
                    let normal = surface::least_spread(around.chain([position]), position);
                    let normal = normal.unwrap_or(towards.normalize_or(Vec3::Y));
                    if normal.dot(towards) < 0.0 { -normal } else { normal }
                }
            };
            let radius = match self.radius {
                None => point.radius,
                Some(Radius::Fixed(radius)) => radius,
                Some(Radius::Estimate) => found.last().map_or(cell, |&(squared, _)| {
                    surface::radius_of(squared.sqrt(), found.len()).max(cell)
                }),
            };
            block.push(PointRecord {
                normal_code: octahedral::encode(normal),
                radius,
                ..point
            });
        }
        if self.radius == Some(Radius::Estimate) {
            limit_radii(&mut block);
        }
        Ok(block)
    }
}

fn limit_radii(block: &mut [PointRecord]) {
    let mut radii: Vec<f32> = block.iter().map(|point| point.radius).collect();
    let middle = radii.len() / 2;
    if middle < radii.len() {
        let (_, &mut median, _) = radii.select_nth_unstable_by(middle, f32::total_cmp);
        for point in block {
            point.radius = point.radius.min(median * STRAY_RADII);
        }
    }
}

/// The points of a block and those around it, in order; and which are the block's own.
fn surroundings(ordered: &Ordered, range: Range<u64>) -> Result<(Vec<PointRecord>, Range<usize>), PointsError> {
    let mut own = Vec::new();
    ordered.read(range.clone(), &mut own)?;
    let quantizer = ordered.quantizer();
    let codes: Vec<MortonCode> = own.iter().map(|point| quantizer.code(point.position)).collect();
    let level = level_of(&codes);
    let cells = cells_around(&codes, level);
    let shift = 3 * (MORTON_BITS - level);
    // Records on either side of the block, each once, in order.
    let mut pieces: Vec<Range<u64>> = Vec::new();
    for &cell in &cells {
        let around = ordered.records_around(cell << shift..(cell + 1) << shift);
        for piece in [
            around.start..around.end.min(range.start),
            around.start.max(range.end)..around.end,
        ] {
            match pieces.last_mut() {
                _ if piece.is_empty() => {}
                Some(last) if piece.start <= last.end => last.end = last.end.max(piece.end),
                _ => pieces.push(piece),
            }
        }
    }
    let is_around = |point: &PointRecord| {
        cells
            .binary_search(&quantizer.code(point.position).prefix(level))
            .is_ok()
    };
    let (mut before, mut after, mut read) = (Vec::new(), Vec::new(), Vec::new());
    for piece in pieces {
        // A crowd around a block is read in parts.
        for start in piece.clone().step_by(BLOCK_POINTS as usize) {
            read.clear();
            ordered.read(start..(start + BLOCK_POINTS).min(piece.end), &mut read)?;
            let side = if start < range.start { &mut before } else { &mut after };
            side.extend(read.iter().filter(|point| is_around(point)));
            thin(side, AROUND_MAX);
        }
    }
    let first = before.len();
    let end = first + own.len();
    before.append(&mut own);
    before.append(&mut after);
    Ok((before, first..end))
}

/// Leaves out every other point while there are too many.
fn thin(points: &mut Vec<PointRecord>, points_max: usize) {
    while points.len() > points_max {
        let mut odd = false;
        points.retain(|_| {
            odd = !odd;
            odd
        });
    }
}

/// The finest level at which the cells of the points hold enough of them.
fn level_of(codes: &[MortonCode]) -> u32 {
    let cells = |level: u32| codes.chunk_by(|a, b| a.prefix(level) == b.prefix(level)).count();
    (1..=MORTON_BITS)
        .rev()
        .find(|&level| cells(level) * CELL_POINTS <= codes.len())
        .unwrap_or(1)
}

/// The cells that touch those of the points: all around inner ones, and those in which points of others may be too.
fn cells_around(codes: &[MortonCode], level: u32) -> Vec<u64> {
    let mut own: Vec<u64> = codes.iter().map(|code| code.prefix(level)).collect();
    own.dedup();
    // Points of the first and the last cell may belong to the blocks beside this one.
    let mut around: Vec<u64> = own.first().into_iter().chain(own.last()).copied().collect();
    let cells_an_axis = 1i64 << level;
    let shift = 3 * (MORTON_BITS - level);
    for &cell in &own {
        let at = MortonCode(cell << shift)
            .cell()
            .map(|axis| i64::from(axis >> (MORTON_BITS - level)));
        for neighbour in 0..27 {
            let offset = [neighbour % 3 - 1, neighbour / 3 % 3 - 1, neighbour / 9 - 1];
            let beside = [0, 1, 2].map(|axis| at[axis] + offset[axis]);
            if beside.iter().any(|axis| !(0..cells_an_axis).contains(axis)) {
                continue;
            }
            let corner = beside.map(|axis| (axis as u32) << (MORTON_BITS - level));
            let prefix = MortonCode::from_cell(corner).prefix(level);
            if own.binary_search(&prefix).is_err() {
                around.push(prefix);
            }
        }
    }
    around.sort_unstable();
    around.dedup();
    around
}

fn measure(cloud: &mut dyn Cloud) -> Result<Bounds, PointsError> {
    let mut bounds = Bounds::EMPTY;
    let mut batch = Vec::new();
    while cloud.next_batch(&mut batch)? {
        batch.iter().for_each(|point| bounds.include(point.position));
        batch.clear();
    }
    cloud.rewind()?;
    Ok(bounds)
}

impl Stage {
    fn start(bounds: &Bounds) -> Self {
        match Quantizer::from_bounds(bounds) {
            Some(quantizer) => Self::Counting(Census::new(quantizer), 0),
            // No points.
            None => Self::Counting(
                Census::new(Quantizer {
                    origin: [0.0; 3],
                    edge: 1.0,
                }),
                0,
            ),
        }
    }
}

/// The next batch of the cloud at `current`, or of those after it; `false` at the end of all.
fn read(clouds: &mut [Box<dyn Cloud>], current: &mut usize, batch: &mut Vec<PointRecord>) -> Result<bool, PointsError> {
    while let Some(cloud) = clouds.get_mut(*current) {
        if cloud.next_batch(batch)? {
            return Ok(true);
        }
        *current += 1;
    }
    Ok(false)
}

impl Outside {
    fn look(&mut self, points: &[PointRecord], bounds: &Bounds) {
        for point in points.iter().filter(|point| !bounds.contains(point.position)) {
            self.count += 1;
            self.first.get_or_insert(point.position);
        }
    }

    fn check(&self) -> Result<(), PointsError> {
        match self.first {
            None => Ok(()),
            Some(first) => Err(PointsError::Request(format!(
                "{} points lie outside the box that their headers declare, the first at {first:?}; give \
                 --recompute-bounds",
                self.count
            ))),
        }
    }
}

impl PointStream for Estimated {
    type Error = PointsError;

    fn bounds(&self) -> Option<Bounds> {
        Some(self.wanted.bounds)
    }

    fn len_hint(&self) -> Option<u64> {
        self.clouds.iter().map(|cloud| cloud.len_hint()).sum()
    }

    /// Bringing the points into order takes many calls that give none.
    fn next_batch(&mut self, batch: &mut Vec<PointRecord>) -> Result<bool, PointsError> {
        let mut points = Vec::new();
        self.stage = match std::mem::replace(&mut self.stage, Stage::Broken) {
            Stage::Counting(mut census, mut current) => {
                if read(&mut self.clouds, &mut current, &mut points)? {
                    self.outside.look(&points, &self.wanted.bounds);
                    census.add(&points);
                    Stage::Counting(census, current)
                } else {
                    self.outside.check()?;
                    self.clouds.iter_mut().try_for_each(|cloud| cloud.rewind())?;
                    Stage::Dealing(Box::new(census.deal(&self.scratch_dir, self.memory_bytes)?), 0)
                }
            }
            Stage::Dealing(mut dealer, mut current) => {
                if read(&mut self.clouds, &mut current, &mut points)? {
                    dealer.add(&points)?;
                    Stage::Dealing(dealer, current)
                } else {
                    Stage::Sorting(dealer, 0)
                }
            }
            Stage::Sorting(mut dealer, bucket) if bucket < dealer.bucket_count() => {
                dealer.sort(bucket)?;
                Stage::Sorting(dealer, bucket + 1)
            }
            Stage::Sorting(dealer, _) => {
                let ordered = dealer.finish();
                let outward = match self.wanted.facing {
                    Some(Facing::Outward) => Some(Outward::find(&ordered, &self.wanted.bounds, self.threads)?),
                    _ => None,
                };
                Stage::Blocks {
                    ordered: Box::new(ordered),
                    outward,
                    next: 0,
                    ready: Vec::new(),
                }
            }
            Stage::Blocks {
                ordered,
                outward,
                mut next,
                mut ready,
            } => {
                if ready.is_empty() {
                    ready = self.blocks(&ordered, outward.as_ref(), &mut next)?;
                }
                let block = ready.pop();
                let more = block.is_some();
                batch.extend(block.into_iter().flatten());
                self.stage = Stage::Blocks {
                    ordered,
                    outward,
                    next,
                    ready,
                };
                return Ok(more);
            }
            Stage::Broken => return Err(PointsError::Request("the input failed before".to_owned())),
        };
        Ok(true)
    }

    fn rewind(&mut self) -> Result<(), PointsError> {
        match &mut self.stage {
            Stage::Blocks { next, ready, .. } => {
                *next = 0;
                ready.clear();
                Ok(())
            }
            stage => {
                *stage = Stage::start(&self.wanted.bounds);
                self.outside = Outside::default();
                self.clouds.iter_mut().try_for_each(|cloud| cloud.rewind())
            }
        }
    }
}
