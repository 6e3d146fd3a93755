//! Points in the order of the Z-curve, ties by input index: in memory where they fit, else in runs on scratch that are
//! merged.

pub mod buffer;
pub mod merge;
mod resume;
pub mod sorter;

use crate::error::BuildError;
use crate::sort::buffer::Stretch;
use pbgi_core::PointRecord;

/// Sorted points, read once from front to back: codes are seen before their points are taken.
pub trait Feed {
    /// The next codes, at least `count` of them, fewer only at the end.
    ///
    /// # Errors
    /// Scratch cannot be read.
    fn codes(&mut self, count: usize) -> Result<&[u64], BuildError>;

    /// Takes the next `count` points, which must have been seen.
    fn take(&mut self, count: usize) -> Piece;
}

/// Some consecutive sorted points.
pub enum Piece {
    /// Where they are in memory; fetching them is the dear part, and is done by whoever needs them.
    Stretch(Stretch),
    /// Morton codes, and the points that they belong to.
    Points(Vec<u64>, Vec<PointRecord>),
}

impl Piece {
    /// Replaces the content of `codes` and `points` by these.
    pub fn read(self, codes: &mut Vec<u64>, points: &mut Vec<PointRecord>) {
        match self {
            Self::Stretch(stretch) => stretch.read(codes, points),
            Self::Points(its_codes, its_points) => (*codes, *points) = (its_codes, its_points),
        }
    }
}
