//! Sort runs: sorted points on scratch, written once, read once, front to back, then deleted. They go past the system's
//! page cache: there are runs because memory is short.
//!
//! A run is a file of plain records. Its length and the checksum of every block stay in memory; a run that may outlive
//! its process has them in a file beside it as well, its seal, written when the run is complete.

use crate::data_file::DataFile;
use crate::error::StoreError;
use crate::limits::{RUN_BLOCK_RECORDS, SEAL_BYTES_MAX};
use crate::scratch::ScratchDir;
use crate::volume::{IoMode, Volume};
use pbgi_core::PointRecord;
use std::ffi::OsStr;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

const PREFIX: &str = "run-";
/// What the name of a seal has behind that of its run.
const SEAL_SUFFIX: &str = ".seal";
/// Start of a seal.
const SEAL_MAGIC: [u8; 8] = *b"\x89PBGIrun";
const DIGITS: usize = 6;
const RECORD_BYTES: u64 = size_of::<PointRecord>() as u64;

/// Whether a file in a scratch folder is a run or its seal.
pub(crate) fn is_run_name(name: &OsStr) -> bool {
    let name = name.as_bytes();
    let name = name.strip_suffix(SEAL_SUFFIX.as_bytes()).unwrap_or(name);
    name.strip_prefix(PREFIX.as_bytes())
        .is_some_and(|digits| digits.len() >= DIGITS && digits.iter().all(u8::is_ascii_digit))
}

/// Number of the run whose seal a file in a scratch folder is.
pub(crate) fn sealed_number(name: &OsStr) -> Option<u64> {
    let name = name.to_str().filter(|name| is_run_name(name.as_ref()))?;
    name.strip_suffix(SEAL_SUFFIX)?.strip_prefix(PREFIX)?.parse().ok()
}

fn run_path(scratch: &Path, number: u64) -> PathBuf {
    scratch.join(format!("{PREFIX}{number:0DIGITS$}"))
}

fn seal_path(run: &Path) -> PathBuf {
    let mut path = run.as_os_str().to_owned();
    path.push(SEAL_SUFFIX);
    path.into()
}

/// A finished run. Dropping it deletes the file.
pub struct Run {
    number: u64,
    file: Arc<DataFile>,
    volume: Arc<dyn Volume>,
    records: u64,
    checksums: Vec<u32>,
    sealed: bool,
}

impl Run {
    /// Creates the file of run `number` in `scratch`, for whoever fills it and [completes](Self::complete) it.
    pub(crate) fn create(scratch: &ScratchDir, number: u64) -> Result<Self, StoreError> {
        let path = run_path(scratch.path(), number);
        let file = DataFile::create_new(scratch.volume(), &path, IoMode::Direct)?;
        Ok(Self {
            number,
            file: Arc::new(file),
            volume: scratch.volume().clone(),
            records: 0,
            checksums: Vec::new(),
            sealed: false,
        })
    }

    /// Takes note of what has been written to the file.
    pub(crate) fn complete(&mut self, bytes: u64, checksums: Vec<u32>) {
        self.records = bytes / RECORD_BYTES;
        self.checksums = checksums;
    }

    pub(crate) fn file(&self) -> &Arc<DataFile> {
        &self.file
    }

    /// That of a block.
    pub(crate) fn checksum(&self, block: usize) -> u32 {
        self.checksums[block]
    }

    /// Opens run `number` of a folder that another process left, and what its writer noted on its seal; `None` if there is
    /// no such run, or no whole one. Blocks are checked when they are read.
    pub(crate) fn reopen(scratch: &ScratchDir, number: u64) -> Option<(Self, Vec<u8>)> {
        let path = run_path(scratch.path(), number);
        let seal = DataFile::open(scratch.volume(), &seal_path(&path)).ok()?;
        let length = seal.byte_len().ok().filter(|length| *length <= SEAL_BYTES_MAX)?;
        let mut bytes = vec![0; length as usize];
        seal.read_at(0, &mut bytes, &|| "seal".to_owned()).ok()?;
        let (records, note, checksums) = decode_seal(&bytes)?;
        let run = Self {
            number,
            file: Arc::new(DataFile::open(scratch.volume(), &path).ok()?),
            volume: scratch.volume().clone(),
            records,
            checksums,
            sealed: true,
        };
        if run.file.byte_len().ok()? == run.bytes() && run.checksums.len() as u64 == run.blocks() {
            Some((run, note))
        } else {
            None
        }
    }

    /// Its file and its seal.
    pub(crate) fn names(&self) -> [PathBuf; 2] {
        [self.file.path().to_owned(), seal_path(self.file.path())]
    }

    fn blocks(&self) -> u64 {
        self.records.div_ceil(RUN_BLOCK_RECORDS as u64)
    }

    /// Writes the seal, with a note for whoever goes on from here.
    pub(crate) fn seal(&mut self, note: &[u8]) -> Result<(), StoreError> {
        let path = seal_path(self.file.path());
        // Before it is written: a torn one is removed as well.
        self.sealed = true;
        let file = DataFile::create_new(&self.volume, &path, IoMode::Buffered)?;
        file.write_at(0, &encode_seal(self.records, note, &self.checksums))
    }

    /// Its number in its folder.
    pub fn number(&self) -> u64 {
        self.number
    }

    /// Points in it.
    pub fn records(&self) -> u64 {
        self.records
    }

    /// Bytes in it.
    pub fn bytes(&self) -> u64 {
        self.records * RECORD_BYTES
    }
}

impl Drop for Run {
    fn drop(&mut self) {
        // What stays behind goes with the scratch folder. The seal goes first: without it, the run is nothing.
        if self.sealed {
            let _ = self.volume.remove_file(&seal_path(self.file.path()));
        }
        let _ = self.volume.remove_file(self.file.path());
    }
}

/// `[magic | records u64 | length of the note u64 | note | checksums u32.. | CRC32C of all before]`
fn encode_seal(records: u64, note: &[u8], checksums: &[u32]) -> Vec<u8> {
    let mut bytes = SEAL_MAGIC.to_vec();
    bytes.extend(records.to_le_bytes());
    bytes.extend((note.len() as u64).to_le_bytes());
    bytes.extend(note);
    bytes.extend_from_slice(bytemuck::cast_slice(checksums));
    bytes.extend(crc32c::crc32c(&bytes).to_le_bytes());
    bytes
}

fn decode_seal(bytes: &[u8]) -> Option<(u64, Vec<u8>, Vec<u32>)> {
    let (content, sum) = bytes.split_last_chunk::<4>()?;
    if crc32c::crc32c(content) != u32::from_le_bytes(*sum) {
        return None;
    }
    let rest = content.strip_prefix(&SEAL_MAGIC)?;
    let (records, rest) = rest.split_first_chunk::<8>()?;
    let (note_length, rest) = rest.split_first_chunk::<8>()?;
    let note_length = usize::try_from(u64::from_le_bytes(*note_length)).ok()?;
    let (note, table) = rest.split_at_checked(note_length)?;
    let checksums = table.as_chunks::<4>().0.iter().map(|sum| u32::from_le_bytes(*sum));
    Some((u64::from_le_bytes(*records), note.to_owned(), checksums.collect()))
}
