//! Going on from the runs of a killed build: which points of the input they hold, and whether this input still begins with
//! those.
//!
//! Every run bears on its seal where in the input its points begin and a hash of them. The input is told anew in any case, so
//! that it is compared as it passes, and whatever decides about its points need not be known beforehand.

use crate::content_hash::UnorderedHash;
use pbgi_core::{PointRecord, Quantizer};
use pbgi_store::Run;
use std::collections::VecDeque;

/// A run of consecutive points of the input.
pub(crate) struct Span {
    pub(crate) run: Run,
    pub(crate) content: Content,
}

/// Consecutive points of the input.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Content {
    /// Where they begin.
    pub(crate) first: u64,
    pub(crate) hash: UnorderedHash,
}

impl Content {
    /// What the seal of a run says.
    pub(crate) fn to_note(self, quantizer: &Quantizer) -> Vec<u8> {
        let mut note = order(quantizer);
        note.extend(self.first.to_le_bytes());
        note.extend(self.hash.0.to_le_bytes());
        note
    }

    /// What a seal said; `None` of a run in another order.
    fn from_note(note: &[u8], quantizer: &Quantizer) -> Option<Self> {
        let rest = note.strip_prefix(&order(quantizer)[..])?;
        let (first, hash) = rest.split_first_chunk::<8>()?;
        Some(Self {
            first: u64::from_le_bytes(*first),
            hash: UnorderedHash(u64::from_le_bytes(hash.try_into().ok()?)),
        })
    }
}

/// What decides the order of a run.
fn order(quantizer: &Quantizer) -> Vec<u8> {
    let [x, y, z] = quantizer.origin;
    [x, y, z, quantizer.edge].map(f64::to_le_bytes).concat()
}

/// The runs that hold the input from its start on without a gap: of two that begin at the same point, the longer one, which was
/// merged from others. What is of no use goes.
pub(crate) fn without_gaps(found: Vec<(Run, Vec<u8>)>, quantizer: &Quantizer) -> Vec<Span> {
    let mut found: Vec<Span> = found
        .into_iter()
        .filter_map(|(run, note)| Content::from_note(&note, quantizer).map(|content| Span { run, content }))
        .collect();
    found.sort_by_key(|span| (span.content.first, std::cmp::Reverse(span.run.records())));
    let mut spans: Vec<Span> = Vec::new();
    let mut end = 0;
    for span in found {
        if span.content.first == end && span.run.records() > 0 {
            end += span.run.records();
            spans.push(span);
        }
    }
    spans
}

/// Points at the start of the input that are in runs, as they are told again.
#[derive(Debug, Default)]
pub(crate) struct Known {
    /// How many are to come, and their hash.
    spans: VecDeque<(u64, UnorderedHash)>,
    /// Those of the first that came.
    came: UnorderedHash,
}

/// The input does not begin with the points that are in runs.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Differs;

impl Known {
    pub(crate) fn new(spans: &[Span]) -> Self {
        Self {
            spans: spans
                .iter()
                .map(|span| (span.run.records(), span.content.hash))
                .collect(),
            came: UnorderedHash::default(),
        }
    }

    /// Takes known points off the next ones of the input.
    pub(crate) fn skip<'a>(&mut self, mut points: &'a [PointRecord]) -> Result<&'a [PointRecord], Differs> {
        while let Some((left, hash)) = self.spans.front_mut()
            && !points.is_empty()
        {
            let (known, rest) = points.split_at(points.len().min(usize::try_from(*left).unwrap_or(usize::MAX)));
            known.iter().for_each(|point| self.came.add(point));
            points = rest;
            *left -= known.len() as u64;
            if *left == 0 {
                if *hash != std::mem::take(&mut self.came) {
                    return Err(Differs);
                }
                self.spans.pop_front();
            }
        }
        Ok(points)
    }

    /// The input has ended.
    pub(crate) fn end(&self) -> Result<(), Differs> {
        if self.spans.is_empty() { Ok(()) } else { Err(Differs) }
    }
}
