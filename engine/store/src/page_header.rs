//! The first 4096 bytes of a page file: what its pages are, and checksums of itself and of the table of checksums.

use crate::error::StoreError;
use crate::limits::{CHECKSUM_BYTES, HEADER_BYTES, RECORDS_MAX};
use pbgi_core::limits::RECORDS_PER_PAGE_RANGE;
use pbgi_core::{BuildId, BuildSettings, NodeRecord, PageKind, PointRecord};
use std::path::Path;

/// As PNG's: a byte that is no ASCII, and line ends that a transfer in text mode would change.
const MAGIC: [u8; 8] = [0x89, b'P', b'B', b'G', b'\r', b'\n', 0x1a, b'\n'];

/// Version of the format; readers accept no other.
pub const VERSION: u32 = 4;

const CHECKSUM_AT: usize = HEADER_BYTES - 4;

/// Kind and size of the records and pages of one file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PageLayout {
    /// What the records are.
    pub kind: PageKind,
    /// Bytes of a record.
    pub record_bytes: u32,
    /// Records in a page.
    pub records_per_page: u32,
}

impl PageLayout {
    /// The layout that `settings` ask for.
    pub fn new(kind: PageKind, settings: &BuildSettings) -> Self {
        let (record_bytes, records_per_page) = match kind {
            PageKind::Node => (size_of::<NodeRecord>(), settings.nodes_per_page),
            PageKind::Point => (size_of::<PointRecord>(), settings.points_per_page),
        };
        Self {
            kind,
            record_bytes: record_bytes as u32,
            records_per_page,
        }
    }

    /// Bytes of one page.
    pub fn page_bytes(&self) -> usize {
        self.record_bytes as usize * self.records_per_page as usize
    }

    /// Pages that hold this many records.
    pub fn page_count(&self, record_count: u64) -> u64 {
        record_count.div_ceil(u64::from(self.records_per_page))
    }

    /// Where a page starts in its file.
    pub fn page_offset(&self, page: u64) -> u64 {
        HEADER_BYTES as u64 + page * self.page_bytes() as u64
    }

    /// Length of the whole file: header, pages, checksums.
    pub fn file_bytes(&self, record_count: u64) -> u64 {
        let pages = self.page_count(record_count);
        self.page_offset(pages) + pages * CHECKSUM_BYTES
    }

    /// Slot where a group of `count` records goes if the file holds `slots` so far: the next one, or the first of the
    /// next page where the group would straddle two.
    pub fn group_slot(&self, slots: u64, count: usize) -> u64 {
        let per_page = u64::from(self.records_per_page);
        let in_page = slots % per_page;
        if in_page + count as u64 > per_page {
            slots + per_page - in_page
        } else {
            slots
        }
    }
}

/// The header's fields, decoded and checked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PageHeader {
    /// Kind and sizes.
    pub layout: PageLayout,
    /// Records, padding slots included.
    pub record_count: u64,
    /// The build that wrote the file.
    pub build_id: BuildId,
    /// CRC32C of the table of checksums.
    pub table_checksum: u32,
}

impl PageHeader {
    /// The bytes on disk.
    pub fn encode(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(HEADER_BYTES);
        bytes.extend(MAGIC);
        bytes.extend(VERSION.to_le_bytes());
        bytes.extend(kind_code(self.layout.kind).to_le_bytes());
        bytes.extend(self.layout.record_bytes.to_le_bytes());
        bytes.extend(self.layout.records_per_page.to_le_bytes());
        bytes.extend(self.record_count.to_le_bytes());
        bytes.extend(self.layout.page_count(self.record_count).to_le_bytes());
        bytes.extend(self.build_id.0.to_le_bytes());
        bytes.extend(self.table_checksum.to_le_bytes());
        bytes.resize(CHECKSUM_AT, 0);
        bytes.extend(crc32c::crc32c(&bytes).to_le_bytes());
        bytes
    }

    /// Reads and checks a header; `path` is for errors, `kind` and `record_bytes` are what the caller can use.
    ///
    /// # Errors
    /// [`StoreError::Mismatch`] for another format, version or record; [`StoreError::Corrupt`] for damage.
    pub fn decode(bytes: &[u8; HEADER_BYTES], kind: PageKind, path: &Path) -> Result<Self, StoreError> {
        let mut fields = Fields(bytes);
        let magic = fields.take::<8>();
        if magic != MAGIC {
            let (expected, actual) = (hex(&MAGIC), hex(&magic));
            return Err(StoreError::mismatch(path, "file type", expected, actual));
        }
        let version = fields.u32();
        if version != VERSION {
            return Err(StoreError::mismatch(path, "format version", VERSION, version));
        }
        let mut stored = Fields(&bytes[CHECKSUM_AT..]);
        check_sum(path, "header", &bytes[..CHECKSUM_AT], stored.u32())?;
        let (kind_read, record_bytes, records_per_page) = (fields.u32(), fields.u32(), fields.u32());
        if kind_read != kind_code(kind) {
            return Err(StoreError::mismatch(path, "record kind", kind_code(kind), kind_read));
        }
        if !RECORDS_PER_PAGE_RANGE.contains(&records_per_page) {
            let expected = format!("{RECORDS_PER_PAGE_RANGE:?} records");
            return Err(StoreError::mismatch(path, "page size", expected, records_per_page));
        }
        let layout = PageLayout {
            kind,
            record_bytes,
            records_per_page,
        };
        let expected_bytes = match kind {
            PageKind::Node => size_of::<NodeRecord>(),
            PageKind::Point => size_of::<PointRecord>(),
        };
        if record_bytes as usize != expected_bytes {
            return Err(StoreError::mismatch(path, "record size", expected_bytes, record_bytes));
        }
        let (record_count, page_count) = (fields.u64(), fields.u64());
        if record_count > RECORDS_MAX || layout.page_count(record_count) != page_count {
            let expected = format!("{} pages for {record_count} records", layout.page_count(record_count));
            return Err(StoreError::corrupt(path, "header", expected, page_count));
        }
        Ok(Self {
            layout,
            record_count,
            build_id: BuildId(u128::from_le_bytes(fields.take())),
            table_checksum: fields.u32(),
        })
    }
}

/// Compares a checksum with the bytes it stands for.
pub(crate) fn check_sum(path: &Path, place: &str, bytes: &[u8], expected: u32) -> Result<(), StoreError> {
    let actual = crc32c::crc32c(bytes);
    if actual == expected {
        return Ok(());
    }
    let sum = |value: u32| format!("checksum {value:08x}");
    Err(StoreError::corrupt(path, place, sum(expected), sum(actual)))
}

fn kind_code(kind: PageKind) -> u32 {
    match kind {
        PageKind::Node => 1,
        PageKind::Point => 2,
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Takes little-endian fields from the front.
struct Fields<'a>(&'a [u8]);

impl Fields<'_> {
    fn take<const N: usize>(&mut self) -> [u8; N] {
        let mut out = [0; N];
        let (head, tail) = self.0.split_at(N);
        out.copy_from_slice(head);
        self.0 = tail;
        out
    }

    fn u32(&mut self) -> u32 {
        u32::from_le_bytes(self.take())
    }

    fn u64(&mut self) -> u64 {
        u64::from_le_bytes(self.take())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header() -> PageHeader {
        PageHeader {
            layout: PageLayout::new(PageKind::Node, &BuildSettings::default()),
            record_count: 1000,
            build_id: BuildId(0x0123_4567_89ab_cdef_0011_2233_4455_6677),
            table_checksum: 7,
        }
    }

    fn encoded(header: &PageHeader) -> [u8; HEADER_BYTES] {
        header.encode().try_into().unwrap()
    }

    /// Puts `bytes` at `offset` and mends the checksum, as a writer of another version would.
    fn patched(offset: usize, patch: &[u8]) -> [u8; HEADER_BYTES] {
        let mut bytes = encoded(&header());
        bytes[offset..offset + patch.len()].copy_from_slice(patch);
        let sum = crc32c::crc32c(&bytes[..CHECKSUM_AT]).to_le_bytes();
        bytes[CHECKSUM_AT..].copy_from_slice(&sum);
        bytes
    }

    #[test]
    fn a_header_survives_the_disk() {
        let decoded = PageHeader::decode(&encoded(&header()), PageKind::Node, Path::new("x")).unwrap();
        assert_eq!(decoded, header());
    }

    #[test]
    fn every_flipped_bit_of_a_header_is_refused() {
        for bit in 0..HEADER_BYTES * 8 {
            let mut bytes = encoded(&header());
            bytes[bit / 8] ^= 1 << (bit % 8);
            assert!(
                PageHeader::decode(&bytes, PageKind::Node, Path::new("x")).is_err(),
                "bit {bit}"
            );
        }
    }

    #[test]
    fn a_foreign_version_layout_or_kind_is_refused_naming_both_values() {
        let cases: [(usize, &[u8], &str, &str); 6] = [
            (0, &[0x42], "895042470d0a1a0a", "425042470d0a1a0a"),
            (8, &[5], "needs 4", "has 5"),
            // A big-endian writer.
            (8, &[0, 0, 0, 1], "needs 4", "has 16777216"),
            (12, &[2], "needs 1", "has 2"),
            (16, &[120], "needs 128", "has 120"),
            (20, &[3, 0], "16..=131072", "has 3"),
        ];
        for (offset, patch, expected, actual) in cases {
            let error = PageHeader::decode(&patched(offset, patch), PageKind::Node, Path::new("x")).unwrap_err();
            assert!(matches!(error, StoreError::Mismatch { .. }), "{error}");
            let text = error.to_string();
            assert!(text.contains(expected) && text.contains(actual), "{text}");
        }
    }

    #[test]
    fn groups_never_straddle_a_page() {
        let layout = header().layout;
        assert_eq!(layout.group_slot(0, 8), 0);
        assert_eq!(layout.group_slot(248, 8), 248);
        assert_eq!(layout.group_slot(249, 8), 256);
        assert_eq!(layout.group_slot(255, 1), 255);
        assert_eq!(layout.group_slot(256, 1), 256);
    }
}
