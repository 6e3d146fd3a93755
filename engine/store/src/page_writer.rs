//! [`PageFileWriter`]: streams records into a page file.

use crate::data_file::DataFile;
use crate::error::StoreError;
use crate::file_writer::FileWriter;
use crate::limits::{RECORDS_MAX, WRITE_BUFFER_BYTES};
use crate::page_header::{PageHeader, PageLayout};
use crate::volume::{IoMode, Volume};
use crate::write_behind::WriteBehind;
use pbgi_core::BuildId;
use std::path::Path;
use std::sync::Arc;

/// Writes `[header | pages | checksums]` front to back; the header last, so that an unfinished file never opens.
/// Memory: [`PAGE_WRITER_BYTES`](crate::limits::PAGE_WRITER_BYTES), and four bytes a page.
pub struct PageFileWriter {
    file: Arc<DataFile>,
    // Before what syncs it, so that both know the file to the end.
    writer: FileWriter,
    behind: WriteBehind,
    layout: PageLayout,
    /// Of the pages whose bytes have all been handed over.
    checksums: Vec<u32>,
    /// Of the page that has been handed over in part, and bytes that it lacks.
    open_page: (u32, usize),
    slots: u64,
}

impl PageFileWriter {
    /// Creates the file.
    ///
    /// # Errors
    /// [`StoreError::Exists`], [`StoreError::NoSpace`], [`StoreError::Io`].
    pub fn create(volume: &Arc<dyn Volume>, path: &Path, layout: PageLayout, mode: IoMode) -> Result<Self, StoreError> {
        let file = Arc::new(DataFile::create_new(volume, path, mode)?);
        Ok(Self {
            behind: WriteBehind::new(&file),
            writer: FileWriter::new(&file, layout.page_offset(0), WRITE_BUFFER_BYTES),
            file,
            layout,
            checksums: Vec::new(),
            open_page: (0, layout.page_bytes()),
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
        self.append_zeroes(bytes)?;
        self.slots = slot;
        Ok(())
    }

    fn append_bytes(&mut self, mut bytes: &[u8]) -> Result<(), StoreError> {
        while !bytes.is_empty() {
            bytes = self.writer.buffer().append(bytes);
            self.write_if_full()?;
        }
        Ok(())
    }

    fn append_zeroes(&mut self, mut count: usize) -> Result<(), StoreError> {
        while count > 0 {
            count = self.writer.buffer().append_zeroes(count);
            self.write_if_full()?;
        }
        Ok(())
    }

    fn write_if_full(&mut self) -> Result<(), StoreError> {
        if self.writer.buffer().room() > 0 {
            return Ok(());
        }
        self.sum_buffer();
        let handed = self.writer.hand_over();
        self.or_that_of_a_sync(handed)?;
        self.behind.wrote(WRITE_BUFFER_BYTES as u64)
    }

    /// A file that a sync has abandoned: the sync's own error says more.
    fn or_that_of_a_sync(&mut self, written: Result<(), StoreError>) -> Result<(), StoreError> {
        written.or_else(|error| self.behind.settle().and(Err(error)))
    }

    /// Goes on with the checksums of pages.
    fn sum_buffer(&mut self) {
        let mut rest = self.writer.buffer().bytes();
        while !rest.is_empty() {
            let (checksum, lacks) = self.open_page;
            let (part, tail) = rest.split_at(lacks.min(rest.len()));
            self.open_page = (crc32c::crc32c_append(checksum, part), lacks - part.len());
            if part.len() == lacks {
                self.checksums.push(self.open_page.0);
                self.open_page = (0, self.layout.page_bytes());
            }
            rest = tail;
        }
    }

    /// Writes what is left, the checksums and the header, and makes them durable. Returns the length of the file.
    ///
    /// # Errors
    /// As [`Self::append`].
    pub fn finish(mut self, build_id: BuildId) -> Result<u64, StoreError> {
        let end = self.layout.page_offset(self.layout.page_count(self.slots));
        self.append_zeroes((end - self.writer.end()) as usize)?;
        self.sum_buffer();
        let written = self.writer.finish();
        self.or_that_of_a_sync(written)?;
        self.behind.settle()?;
        let table: &[u8] = bytemuck::cast_slice(&self.checksums);
        if !table.is_empty() {
            self.file.write_at(end, table)?;
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
