//! Points on their way from where they are made to where they are sorted.

use crate::bounds::Bounds;
use crate::point::PointRecord;

/// A source of points that need not fit in memory. It can be read more than once, always to the same points in the same
/// order.
pub trait PointStream {
    /// What can go wrong while reading.
    type Error: std::error::Error + Send + Sync + 'static;

    /// A box that holds every point, where known without reading them.
    fn bounds(&self) -> Option<Bounds>;

    /// Number of points, where known without reading them; an estimate is welcome, it only serves progress.
    fn len_hint(&self) -> Option<u64>;

    /// What was subtracted from the coordinates of the files, in their own axes, to make positions.
    fn origin(&self) -> [f64; 3] {
        [0.0; 3]
    }

    /// Appends the next batch (some thousands of points) to `batch`; `false` when there was none left.
    ///
    /// # Errors
    /// Unreadable input or an invalid point, named with its index.
    fn next_batch(&mut self, batch: &mut Vec<PointRecord>) -> Result<bool, Self::Error>;

    /// Goes back to the first point.
    ///
    /// # Errors
    /// Unreadable input.
    fn rewind(&mut self) -> Result<(), Self::Error>;
}
