//! Points in the order of the Z-curve, ties by input index: in memory where they fit, else in runs on scratch that are
//! merged.

pub mod buffer;
pub mod feed;
pub mod merge;
pub mod radix;
mod resume;
pub mod sorter;

use crate::error::BuildError;
use pbgi_core::PointRecord;

/// Gives sorted points, from front to back.
pub trait SortedStream {
    /// Appends some next points, and their Morton codes; whether there were any.
    ///
    /// # Errors
    /// Scratch cannot be read.
    fn next_batch(&mut self, codes: &mut Vec<u64>, points: &mut Vec<PointRecord>) -> Result<bool, BuildError>;
}
