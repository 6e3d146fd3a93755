//! [`PageFileWriter`]: streams records into a page file.

use crate::data_file::DataFile;
use crate::error::StoreError;
use crate::limits::{RECORDS_MAX, WRITE_BUFFER_BYTES};
use crate::page_header::{PageHeader, PageLayout};
use crate::volume::Volume;
use crate::write_behind::WriteBehind;
use pbgi_core::BuildId;
use std::path::Path;
use std::sync::Arc;

/// Writes `[header | pages | checksums]` front to back; the header last, so that an unfinished file never opens.
/// Memory: one mebibyte or one page, and four bytes a page.
pub struct PageFileWriter {
    file: Arc<DataFile>,
    behind: WriteBehind,
    layout: PageLayout,
    /// Whole pages and the one that is being filled.
    buffer: Vec<u8>,
    buffer_bytes: usize,
    /// Where the buffer goes.
    offset: u64,
    checksums: Vec<u32>,
    slots: u64,
}

impl PageFileWriter {
    /// Creates the file.
    ///
    /// # Errors
    /// [`StoreError::Exists`], [`StoreError::NoSpace`], [`StoreError::Io`].
    pub fn create(volume: &Arc<dyn Volume>, path: &Path, layout: PageLayout) -> Result<Self, StoreError> {
        let page_bytes = layout.page_bytes();
        let buffer_bytes = (WRITE_BUFFER_BYTES / page_bytes).max(1) * page_bytes;
        let file = Arc::new(DataFile::create_new(volume, path)?);
        Ok(Self {
            behind: WriteBehind::new(&file),
            file,
            layout,
            buffer: Vec::with_capacity(buffer_bytes),
            buffer_bytes,
            offset: layout.page_offset(0),
            checksums: Vec::new(),
            slots: 0,
        })
    }

    /// Kind and sizes.
    pub fn layout(&self) -> &PageLayout {
        &self.layout
    }

    /// Slots taken so far, padding included.
    pub fn slots(&self) -> u64 {
        self.slots
    }

    /// Appends records, densely; returns the slot of the first one.
    ///
    /// # Errors
    /// [`StoreError::Limit`] before an index would leave `u32`; [`StoreError::NoSpace`], [`StoreError::Io`],
    /// [`StoreError::Abandoned`].
    pub fn append<T: bytemuck::NoUninit>(&mut self, records: &[T]) -> Result<u64, StoreError> {
        debug_assert_eq!(size_of::<T>(), self.layout.record_bytes as usize);
        let first = self.slots;
        self.slots = self.checked(first, records.len())?;
        self.append_bytes(bytemuck::cast_slice(records))?;
        Ok(first)
    }

    /// Appends records that must share a page, behind zeroed slots where the current page has no room; returns the slot
    /// of the first one.
    ///
    /// # Errors
    /// As [`Self::append`]; [`StoreError::Invalid`] if the group is larger than a page.
    pub fn append_group<T: bytemuck::NoUninit>(&mut self, group: &[T]) -> Result<u64, StoreError> {
        if group.len() > self.layout.records_per_page as usize {
            return Err(StoreError::Invalid(format!(
                "a group of {} records does not fit a page of {}",
                group.len(),
                self.layout.records_per_page
            )));
        }
        let first = self.layout.group_slot(self.slots, group.len());
        self.checked(first, group.len())?;
        self.pad_to(first)?;
        self.append(group)
    }

    fn checked(&self, slots: u64, more: usize) -> Result<u64, StoreError> {
        let count = slots.saturating_add(more as u64);
        if count > RECORDS_MAX {
            return Err(StoreError::Limit {
                what: "records in a file",
                count,
                max: RECORDS_MAX,
            });
        }
        Ok(count)
    }

    fn pad_to(&mut self, slot: u64) -> Result<(), StoreError> {
        let bytes = (slot - self.slots) as usize * self.layout.record_bytes as usize;
        let filled = self.buffer.len() + bytes;
        // Padding ends at the end of a page, so it never passes the end of the buffer.
        self.buffer.resize(filled, 0);
        self.slots = slot;
        self.write_if_full()
    }

    fn append_bytes(&mut self, mut bytes: &[u8]) -> Result<(), StoreError> {
        while !bytes.is_empty() {
            let room = self.buffer_bytes - self.buffer.len();
            let (head, tail) = bytes.split_at(room.min(bytes.len()));
            self.buffer.extend_from_slice(head);
            bytes = tail;
            self.write_if_full()?;
        }
        Ok(())
    }

    fn write_if_full(&mut self) -> Result<(), StoreError> {
        if self.buffer.len() == self.buffer_bytes {
            self.write_pages()
        } else {
            Ok(())
        }
    }

    /// Writes the buffer, which holds whole pages.
    fn write_pages(&mut self) -> Result<(), StoreError> {
        let pages = self.buffer.chunks_exact(self.layout.page_bytes());
        self.checksums.extend(pages.map(crc32c::crc32c));
        self.file
            .write_at(self.offset, &self.buffer)
            // A file that a sync has abandoned: the sync's own error says more.
            .or_else(|error| self.behind.settle().and(Err(error)))?;
        self.behind.wrote(self.buffer.len() as u64)?;
        self.offset += self.buffer.len() as u64;
        self.buffer.clear();
        Ok(())
    }

    /// Writes what is left, the checksums and the header, and makes them durable. Returns the length of the file.
    ///
    /// # Errors
    /// As [`Self::append`].
    pub fn finish(mut self, build_id: BuildId) -> Result<u64, StoreError> {
        let whole = self.buffer.len().next_multiple_of(self.layout.page_bytes());
        self.buffer.resize(whole, 0);
        if !self.buffer.is_empty() {
            self.write_pages()?;
        }
        self.behind.settle()?;
        let table: &[u8] = bytemuck::cast_slice(&self.checksums);
        if !table.is_empty() {
            self.file.write_at(self.offset, table)?;
        }
        let header = PageHeader {
            layout: self.layout,
            record_count: self.slots,
            build_id,
            table_checksum: crc32c::crc32c(table),
        };
        self.file.write_at(0, &header.encode())?;
        self.file.sync()?;
        Ok(self.layout.file_bytes(self.slots))
    }
}
