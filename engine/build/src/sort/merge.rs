//! [`Merge`]: many sorted runs read as one, through a tree of losers (Knuth, volume 3, section 5.4.1).

use crate::error::BuildError;
use crate::limits::BATCH_POINTS;
use crate::sort::SortedStream;
use pbgi_core::{PointRecord, Quantizer};
use pbgi_store::{Run, RunReader, StoreError};

/// Behind every code of 63 bits: the key of a run that has ended.
const ENDED: u64 = u64::MAX;

/// Merges runs. Runs must be given in the order of their input: of equal codes, that of the earlier run comes first.
pub struct Merge {
    /// Their files stay until the merge goes: should this process die, the next one needs them.
    runs: RunReader,
    /// For each run, which point of its part in memory is next.
    next: Vec<usize>,
    /// Code of the next point of each run, apart from the runs so that comparing touches little memory.
    codes: Vec<u64>,
    /// `losers[i]`, i >= 1: the run that lost the comparison at inner node i; its children are nodes 2 i and 2 i + 1,
    /// node `runs + r` is the leaf of run r.
    losers: Vec<usize>,
    winner: usize,
    quantizer: Quantizer,
}

impl Merge {
    /// Starts reading all runs, `blocks_per_read` blocks of each at a time.
    ///
    /// # Errors
    /// Scratch cannot be read.
    pub fn new(runs: Vec<Run>, blocks_per_read: usize, quantizer: Quantizer) -> Result<Self, StoreError> {
        let mut merge = Self {
            next: vec![0; runs.len()],
            codes: vec![ENDED; runs.len()],
            losers: vec![0; runs.len()],
            winner: 0,
            runs: RunReader::new(runs, blocks_per_read)?,
            quantizer,
        };
        for run in 0..merge.codes.len() {
            merge.load_code(run)?;
        }
        merge.play_all();
        Ok(merge)
    }

    /// The next point and its code; `None` at the end.
    #[inline]
    fn next_point(&mut self) -> Result<Option<(u64, PointRecord)>, StoreError> {
        let run = self.winner;
        let code = self.codes.get(run).copied().unwrap_or(ENDED);
        if code == ENDED {
            return Ok(None);
        }
        let point = self.runs.records(run)[self.next[run]];
        self.next[run] += 1;
        self.load_code(run)?;
        self.replay(run);
        Ok(Some((code, point)))
    }

    #[inline]
    fn load_code(&mut self, run: usize) -> Result<(), StoreError> {
        if self.next[run] == self.runs.records(run).len() {
            self.next[run] = 0;
            self.runs.advance(run)?;
        }
        let front = self.runs.records(run).get(self.next[run]);
        self.codes[run] = front.map_or(ENDED, |point| self.quantizer.code(point.position).0);
        Ok(())
    }

    #[inline]
    fn before(&self, a: usize, b: usize) -> bool {
        (self.codes[a], a) < (self.codes[b], b)
    }

    /// Plays every match, from the leaves up.
    fn play_all(&mut self) {
        let count = self.codes.len();
        let mut winners = vec![0; 2 * count];
        for run in 0..count {
            winners[count + run] = run;
        }
        for node in (1..count).rev() {
            let (a, b) = (winners[2 * node], winners[2 * node + 1]);
            (winners[node], self.losers[node]) = if self.before(a, b) { (a, b) } else { (b, a) };
        }
        self.winner = winners.get(1).copied().unwrap_or(0);
    }

    /// Plays again the matches between the leaf of `run` and the root.
    #[inline]
    fn replay(&mut self, run: usize) {
        let mut winner = run;
        let mut node = (self.codes.len() + run) / 2;
        while node > 0 {
            let loser = self.losers[node];
            if self.before(loser, winner) {
                self.losers[node] = winner;
                winner = loser;
            }
            node /= 2;
        }
        self.winner = winner;
    }
}

impl SortedStream for Merge {
    fn next_batch(&mut self, codes: &mut Vec<u64>, points: &mut Vec<PointRecord>) -> Result<bool, BuildError> {
        let before = codes.len();
        while codes.len() - before < BATCH_POINTS
            && let Some((code, point)) = self.next_point()?
        {
            codes.push(code);
            points.push(point);
        }
        Ok(codes.len() > before)
    }
}
