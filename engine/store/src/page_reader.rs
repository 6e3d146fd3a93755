//! [`PageFile`]: an open page file whose header, table and length have been checked.

use crate::data_file::DataFile;
use crate::error::StoreError;
use crate::limits::{CHECKSUM_BYTES, HEADER_BYTES};
use crate::page_header::{PageHeader, check_sum};
use crate::volume::Volume;
use pbgi_core::{PageKind, PageNo};
use std::path::Path;
use std::sync::Arc;

/// A page file, open for positional reads from any thread. Keeps the checksums in memory, four bytes a page.
pub struct PageFile {
    file: DataFile,
    header: PageHeader,
    checksums: Vec<u32>,
}

impl PageFile {
    /// Opens a file and checks everything but its pages.
    ///
    /// # Errors
    /// [`StoreError::Mismatch`] for another format or kind, [`StoreError::Corrupt`] for damage or a wrong length,
    /// [`StoreError::Io`].
    pub fn open(volume: &Arc<dyn Volume>, path: &Path, kind: PageKind) -> Result<Self, StoreError> {
        let file = DataFile::open(volume, path)?;
        let mut bytes = [0; HEADER_BYTES];
        file.read_at(0, &mut bytes, &|| "header".to_owned())?;
        let header = PageHeader::decode(&bytes, kind, path)?;
        let (expected, actual) = (header.layout.file_bytes(header.record_count), file.byte_len()?);
        if expected != actual {
            let bytes = |count: u64| format!("{count} bytes");
            return Err(StoreError::corrupt(path, "file length", bytes(expected), bytes(actual)));
        }
        // The length of the file bounds this allocation.
        let pages = header.layout.page_count(header.record_count);
        let mut checksums = vec![0u32; (expected / CHECKSUM_BYTES).min(pages) as usize];
        let table: &mut [u8] = bytemuck::cast_slice_mut(&mut checksums);
        file.read_at(header.layout.page_offset(pages), table, &|| {
            "table of checksums".to_owned()
        })?;
        check_sum(path, "table of checksums", table, header.table_checksum)?;
        Ok(Self {
            file,
            header,
            checksums,
        })
    }

    /// The file's name when it was opened.
    pub fn path(&self) -> &Path {
        self.file.path()
    }

    /// What the header says.
    pub fn header(&self) -> &PageHeader {
        &self.header
    }

    /// Pages.
    pub fn page_count(&self) -> u64 {
        self.checksums.len() as u64
    }

    /// Has the operating system begin to read a page that will be read soon; returns at once.
    pub fn will_need(&self, page: PageNo) {
        let layout = &self.header.layout;
        if u64::from(page.0) < self.page_count() {
            let offset = layout.page_offset(u64::from(page.0));
            self.file.will_need(offset, layout.page_bytes() as u64);
        }
    }

    /// Reads a page and checks its sum; `out` is exactly one page long.
    ///
    /// # Errors
    /// [`StoreError::PageRange`], [`StoreError::Invalid`] for a buffer of another length, [`StoreError::Corrupt`],
    /// [`StoreError::Io`]. The content of `out` is then unspecified.
    pub fn read_page(&self, page: PageNo, out: &mut [u8]) -> Result<(), StoreError> {
        let layout = &self.header.layout;
        let Some(&expected) = self.checksums.get(page.0 as usize) else {
            return Err(StoreError::PageRange {
                kind: layout.kind,
                page: page.0,
                count: self.page_count(),
                path: self.path().to_owned(),
            });
        };
        if out.len() != layout.page_bytes() {
            return Err(StoreError::Invalid(format!(
                "a {} page has {} bytes, the buffer {}",
                layout.kind,
                layout.page_bytes(),
                out.len()
            )));
        }
        let place = || format!("{} page {}", layout.kind, page.0);
        self.file.read_at(layout.page_offset(u64::from(page.0)), out, &place)?;
        let actual = crc32c::crc32c(out);
        if actual == expected {
            Ok(())
        } else {
            check_sum(self.path(), &place(), out, expected)
        }
    }
}
