//! [`Feed`]: sorted points whose codes are seen before they are taken.

use crate::error::BuildError;
use crate::sort::SortedStream;
use pbgi_core::PointRecord;

/// Some consecutive sorted points.
#[derive(Debug, Default)]
pub struct Piece {
    /// Morton codes.
    pub codes: Vec<u64>,
    /// The points that they belong to.
    pub points: Vec<PointRecord>,
}

/// Reads a stream as far ahead as is asked for.
pub struct Feed<'a> {
    stream: &'a mut (dyn SortedStream + Send),
    /// What has been read; the first `taken` points are gone.
    window: Piece,
    taken: usize,
    ended: bool,
}

impl<'a> Feed<'a> {
    /// Feeds everything that `stream` gives.
    pub fn new(stream: &'a mut (dyn SortedStream + Send)) -> Self {
        Self {
            stream,
            window: Piece::default(),
            taken: 0,
            ended: false,
        }
    }

    /// The next codes, at least `count` of them, fewer only at the end.
    ///
    /// # Errors
    /// Scratch cannot be read.
    pub fn codes(&mut self, count: usize) -> Result<&[u64], BuildError> {
        while self.window.codes.len() - self.taken < count && !self.ended {
            let Piece { codes, points } = &mut self.window;
            // What has been taken goes once in a batch.
            codes.drain(..self.taken);
            points.drain(..self.taken);
            self.taken = 0;
            self.ended = !self.stream.next_batch(codes, points)?;
        }
        Ok(&self.window.codes[self.taken..])
    }

    /// Takes the next `count` points, which must have been seen.
    pub fn take(&mut self, count: usize) -> Piece {
        let range = self.taken..self.taken + count;
        self.taken = range.end;
        Piece {
            codes: self.window.codes[range.clone()].to_vec(),
            points: self.window.points[range].to_vec(),
        }
    }
}
