//! [`PointWindow`]: the paper's queue of `leaf_max + 1` points, as a window that slides over batches.

use crate::error::BuildError;
use crate::sort::SortedBatch;
use pbgi_core::{PointRecord, Voxel};

/// Where batches come from; an empty one ends them. The batch given is the one that was emptied last.
pub type BatchSource<'a> = dyn FnMut(SortedBatch) -> Result<SortedBatch, BuildError> + 'a;

/// Shows the next `leaf_max + 1` sorted points and no more.
pub struct PointWindow<'a> {
    source: &'a mut BatchSource<'a>,
    batch: SortedBatch,
    spare: SortedBatch,
    head: usize,
    leaf_max: usize,
    ended: bool,
}

impl<'a> PointWindow<'a> {
    /// Fills the window for the first time.
    ///
    /// # Errors
    /// Those of the source.
    pub fn new(source: &'a mut BatchSource<'a>, leaf_max: u32) -> Result<Self, BuildError> {
        let mut window = Self {
            source,
            batch: SortedBatch::default(),
            spare: SortedBatch::default(),
            head: 0,
            leaf_max: leaf_max as usize,
            ended: false,
        };
        window.refill()?;
        Ok(window)
    }

    /// Whether the next point lies in `voxel`.
    #[inline]
    pub fn front_in(&self, voxel: Voxel) -> bool {
        self.point_in(voxel, 0)
    }

    /// Whether more than `leaf_max` points lie in `voxel`: points are sorted, so one look at the last of the window
    /// tells.
    #[inline]
    pub fn overflows(&self, voxel: Voxel) -> bool {
        self.point_in(voxel, self.leaf_max)
    }

    #[inline]
    fn point_in(&self, voxel: Voxel, ahead: usize) -> bool {
        let code = self.batch.codes.get(self.head + ahead);
        code.is_some_and(|&code| voxel.contains(pbgi_core::MortonCode(code)))
    }

    /// The next points that lie in `voxel`, at most `leaf_max`.
    #[inline]
    pub fn leaf(&self, voxel: Voxel) -> &[PointRecord] {
        let mut count = 0;
        while count < self.leaf_max && self.point_in(voxel, count) {
            count += 1;
        }
        &self.batch.points[self.head..self.head + count]
    }

    /// Moves past `count` points.
    ///
    /// # Errors
    /// Those of the source.
    #[inline]
    pub fn advance(&mut self, count: usize) -> Result<(), BuildError> {
        self.head += count;
        debug_assert!(self.head <= self.batch.codes.len());
        if self.batch.codes.len() - self.head <= self.leaf_max && !self.ended {
            self.refill()?;
        }
        Ok(())
    }

    /// Takes batches until the window is full or the points end.
    #[cold]
    fn refill(&mut self) -> Result<(), BuildError> {
        self.batch.codes.drain(..self.head);
        self.batch.points.drain(..self.head);
        self.head = 0;
        while self.batch.codes.len() <= self.leaf_max && !self.ended {
            self.spare = (self.source)(std::mem::take(&mut self.spare))?;
            self.ended = self.spare.codes.is_empty();
            self.batch.codes.append(&mut self.spare.codes);
            self.batch.points.append(&mut self.spare.points);
        }
        Ok(())
    }
}
