//! Points on their way from where they are made to where they are sorted.

use crate::bounds::Bounds;
use crate::point::PointRecord;

/// A batch that has been read but not decoded: appends its points. Any thread may run it.
pub type Undecoded<E> = Box<dyn FnOnce(&mut Vec<PointRecord>) -> Result<(), E> + Send>;

/// A source of points that need not fit in memory. It can be read more than once, always to the same points in the same
/// order.
pub trait PointStream {
    /// What can go wrong while reading.
    type Error: std::error::Error + Send + Sync + 'static;

    /// A box that holds every point, where known without reading them.
    fn bounds(&self) -> Option<Bounds>;

    /// Number of points, where known without reading them; an estimate is welcome, it only serves progress.
    fn len_hint(&self) -> Option<u64>;

    /// Appends the next batch (some thousands of points) to `batch`; `false` when there was none left.
    ///
    /// # Errors
    /// Unreadable input or an invalid point, named with its index.
    fn next_batch(&mut self, batch: &mut Vec<PointRecord>) -> Result<bool, Self::Error>;

    /// The next batch for a caller that decodes several at once; `None` when there was none left. Sources whose decoding
    /// is dear leave it to the returned function.
    ///
    /// # Errors
    /// As [`Self::next_batch`].
    fn next_undecoded(&mut self) -> Result<Option<Undecoded<Self::Error>>, Self::Error> {
        let mut batch = Vec::new();
        let more = self.next_batch(&mut batch)?;
        Ok((more || !batch.is_empty()).then(|| {
            let decode = move |points: &mut Vec<PointRecord>| {
                points.append(&mut batch);
                Ok(())
            };
            Box::new(decode) as Undecoded<Self::Error>
        }))
    }

    /// Goes back to the first point.
    ///
    /// # Errors
    /// Unreadable input.
    fn rewind(&mut self) -> Result<(), Self::Error>;
}
