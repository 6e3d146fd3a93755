//! [`SectorBuffer`]: memory that lies as direct transfers ask for it ([`IoMode::Direct`]).
//!
//! [`IoMode::Direct`]: crate::volume::IoMode::Direct

use crate::limits::SECTOR_BYTES;
use bytemuck::{Pod, Zeroable};

#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C, align(4096))]
struct Sector([u8; SECTOR_BYTES]);

/// Bytes that start on a sector.
#[derive(Default)]
pub(crate) struct SectorBuffer {
    sectors: Vec<Sector>,
    /// How many of the bytes count.
    len: usize,
}

impl SectorBuffer {
    pub(crate) fn with_capacity(bytes: usize) -> Self {
        Self {
            sectors: vec![Sector::zeroed(); bytes.div_ceil(SECTOR_BYTES)],
            len: 0,
        }
    }

    #[inline]
    pub(crate) fn bytes(&self) -> &[u8] {
        &bytemuck::cast_slice(&self.sectors)[..self.len]
    }

    /// The content as records of another type; the length must be a multiple of theirs.
    #[inline]
    pub(crate) fn records<T: Pod>(&self) -> &[T] {
        bytemuck::cast_slice(self.bytes())
    }

    /// Takes `len` bytes to be written over.
    pub(crate) fn resize(&mut self, len: usize) -> &mut [u8] {
        let sectors = len.div_ceil(SECTOR_BYTES);
        if sectors > self.sectors.len() {
            self.sectors.resize(sectors, Sector::zeroed());
        }
        self.len = len;
        &mut bytemuck::cast_slice_mut(&mut self.sectors)[..len]
    }

    /// Bytes that [`Self::append`] still takes.
    pub(crate) fn room(&self) -> usize {
        self.sectors.len() * SECTOR_BYTES - self.len
    }

    /// Appends as many of `bytes` as there is room for; returns the others.
    pub(crate) fn append<'a>(&mut self, bytes: &'a [u8]) -> &'a [u8] {
        let (head, tail) = bytes.split_at(self.room().min(bytes.len()));
        let start = self.len;
        self.resize(start + head.len())[start..].copy_from_slice(head);
        tail
    }

    /// As [`Self::append`], with this many zeroes; returns how many are left.
    pub(crate) fn append_zeroes(&mut self, count: usize) -> usize {
        let some = self.room().min(count);
        let start = self.len;
        self.resize(start + some)[start..].fill(0);
        count - some
    }

    pub(crate) fn clear(&mut self) {
        self.len = 0;
    }
}
