//! [`Representatives`]: a bounded number of points that stand for all, one for each cell of a lattice that has points.

use super::super::neighbours::Nearest;
use super::super::order::Ordered;
use super::super::{NEIGHBOURS, surface};
use super::{in_parallel, middle};
use crate::error::PointsError;
use glam::Vec3;
use pbgi_core::limits::MORTON_BITS;
use pbgi_core::{Bounds, PointRecord, Quantizer};

/// Most representatives: they and what is computed of them take five megabytes.
const REPRESENTATIVES_MAX: usize = 1 << 15;

/// Records on either side of a representative among which its neighbours are looked for.
const WINDOW_POINTS: u64 = 128;

/// Most of a surface in a cell, faces of the cell: a plane along its diagonal has 1.7, few cells have more sheets.
const CELL_FACES_MAX: f32 = 2.0;

/// The finest cells that are few enough, found as the points pass in order. Each is half as large as that of one bit less.
pub(in super::super) struct Cells {
    /// Low bits of a code that lie within a cell.
    shift: u32,
    cells: Vec<Cell>,
}

struct Cell {
    prefix: u64,
    /// Record of the order.
    first: u64,
}

/// Lengths are in `spacing`, and relative to the middle of the cloud's box.
pub(super) struct Representatives {
    /// Along the Z-curve.
    pub(super) positions: Vec<Vec3>,
    pub(super) codes: Vec<u64>,
    /// Of the plane through the neighbours, to either side.
    pub(super) normals: Vec<Vec3>,
    /// The share of the surface, about 1.
    pub(super) areas: Vec<f32>,
    /// The edge of a square as large as the mean share, world units; 0 where the points have no surface.
    pub(super) spacing: f32,
}

/// Position, normal and area of a representative in world units.
#[derive(Clone, Copy, Default)]
struct Look {
    position: Vec3,
    normal: Vec3,
    area: f32,
}

impl Cells {
    pub(in super::super) fn new() -> Self {
        Self {
            shift: 0,
            cells: Vec::new(),
        }
    }

    /// Takes the points of the order from record `at` on: all of them, one after another.
    pub(in super::super) fn note(&mut self, at: u64, points: &[PointRecord], quantizer: &Quantizer) {
        for (point, record) in points.iter().zip(at..) {
            let prefix = quantizer.code(point.position).0 >> self.shift;
            if self.cells.last().is_some_and(|last| last.prefix == prefix) {
                continue;
            }
            self.cells.push(Cell { prefix, first: record });
            while self.cells.len() > REPRESENTATIVES_MAX {
                self.shift += 1;
                self.cells.iter_mut().for_each(|cell| cell.prefix >>= 1);
                self.cells.dedup_by_key(|cell| cell.prefix);
            }
        }
    }
}

impl Representatives {
    /// Reads the middle point of every cell and those beside it in the order.
    pub(super) fn gather(ordered: &Ordered, bounds: &Bounds, threads: usize) -> Result<Self, PointsError> {
        let Cells { shift, cells } = ordered.cells();
        // A bit halves one axis: three of them quarter a face.
        let face = ordered.quantizer().edge.powi(2) * f64::exp2(f64::from(*shift) / 1.5 - f64::from(2 * MORTON_BITS));
        let area_max = CELL_FACES_MAX * face as f32;
        let failed = std::sync::Mutex::new(None);
        let looks = in_parallel(threads, cells.len(), |number| {
            let end = cells.get(number + 1).map_or(ordered.len(), |next| next.first);
            look(ordered, cells[number].first..end, area_max).unwrap_or_else(|error| {
                *failed.lock().unwrap_or_else(std::sync::PoisonError::into_inner) = Some(error);
                Look::default()
            })
        });
        if let Some(error) = failed.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner) {
            return Err(error);
        }
        let total: f64 = looks.iter().map(|look| f64::from(look.area)).sum();
        let spacing = (total / looks.len().max(1) as f64).sqrt() as f32;
        let unit = if spacing > 0.0 { spacing } else { 1.0 };
        let middle = middle(bounds);
        Ok(Self {
            positions: looks.iter().map(|look| (look.position - middle) / unit).collect(),
            codes: looks
                .iter()
                .map(|look| ordered.quantizer().code(look.position.to_array()).0)
                .collect(),
            normals: looks.iter().map(|look| look.normal).collect(),
            areas: looks.iter().map(|look| look.area / unit / unit).collect(),
            spacing,
        })
    }
}

/// The middle point of a cell. Its neighbours are looked for along the order: they are a few times denser than cells, and
/// most of them lie within.
fn look(ordered: &Ordered, cell: std::ops::Range<u64>, area_max: f32) -> Result<Look, PointsError> {
    let chosen = cell.start + (cell.end - cell.start) / 2;
    let first = chosen.saturating_sub(WINDOW_POINTS);
    let mut points = Vec::new();
    ordered.read(first..(chosen + WINDOW_POINTS + 1).min(ordered.len()), &mut points)?;
    let of = (chosen - first) as usize;
    let position = Vec3::from(points[of].position);
    let mut nearest = Nearest::<NEIGHBOURS>::within(f32::INFINITY);
    for (index, point) in points.iter().enumerate() {
        if index != of {
            nearest.offer(Vec3::from(point.position).distance_squared(position), index as u32);
        }
    }
    let found = nearest.found();
    let around = found
        .iter()
        .map(|&(_, index)| Vec3::from(points[index as usize].position));
    let share = found.last().map_or(0.0, |&(squared, _)| {
        surface::radius_of(squared.sqrt(), found.len()).powi(2) * std::f32::consts::PI
    });
    Ok(Look {
        position,
        normal: surface::least_spread(around.chain([position]), position).unwrap_or(Vec3::Y),
        area: (share * (cell.end - cell.start) as f32).min(area_max),
    })
}
