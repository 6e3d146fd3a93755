//! Points in the order of the Z-curve, ties by input index: in memory where they fit, else in runs on scratch that are
//! merged.

pub mod buffer;
pub mod merge;
pub mod sorter;

use crate::limits::BATCH_POINTS;
use pbgi_core::PointRecord;
use pbgi_store::StoreError;

/// Some consecutive sorted points, each with its Morton code.
#[derive(Debug, Default)]
pub struct SortedBatch {
    /// Morton codes, never falling.
    pub codes: Vec<u64>,
    /// The points.
    pub points: Vec<PointRecord>,
}

impl SortedBatch {
    /// Room for a whole batch.
    pub fn with_room() -> Self {
        Self {
            codes: Vec::with_capacity(BATCH_POINTS),
            points: Vec::with_capacity(BATCH_POINTS),
        }
    }

    /// Forgets the points, keeps the room.
    pub fn clear(&mut self) {
        self.codes.clear();
        self.points.clear();
    }

    #[inline]
    pub(crate) fn push(&mut self, code: u64, point: PointRecord) {
        self.codes.push(code);
        self.points.push(point);
    }
}

/// Sorted points, read once from front to back.
pub trait SortedPoints {
    /// Replaces the content of `batch` by the next [`BATCH_POINTS`] points; fewer at the end, then none.
    ///
    /// # Errors
    /// Scratch cannot be read.
    fn next_sorted(&mut self, batch: &mut SortedBatch) -> Result<(), StoreError>;
}
