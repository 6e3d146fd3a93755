//! Bounds and tuned constants of files on disk.

use pbgi_core::PointRecord;
use std::time::Duration;

/// Records in one file: every index fits a `u32`, and so does the index behind the last record.
pub const RECORDS_MAX: u64 = u32::MAX as u64;

/// Bytes in front of the first page: one sector of any disk, so that pages stay aligned.
pub const HEADER_BYTES: usize = 4096;

/// Bytes of a checksum in the table behind the last page.
pub const CHECKSUM_BYTES: u64 = 4;

/// What direct transfers are counted in: at least the sector of any disk, and the block of most file systems.
pub const SECTOR_BYTES: usize = 4096;

/// Bytes a page file gathers before it writes, whole sectors.
pub const WRITE_BUFFER_BYTES: usize = 1 << 20;

/// Buffers of a file that is written: one that is filled, one on its way to the disk, and one between them, so that
/// neither waits.
pub const FILE_BUFFERS: usize = 3;

/// Memory of a page file that is written, checksums aside.
pub const PAGE_WRITER_BYTES: usize = FILE_BUFFERS * WRITE_BUFFER_BYTES;

/// Bytes written to a page file after which it is synced in the background: long enough that a disk works at its full
/// rate, short enough that little is left at the end.
pub const SYNC_BEHIND_BYTES: u64 = 32 << 20;

/// Records in a block of a run: 256 KiB, large enough to read at the speed of the disk, small enough that 64 MB merge
/// 60 runs at once, each with two.
pub const RUN_BLOCK_RECORDS: usize = 8192;

/// Bytes of such a block.
pub const RUN_BLOCK_BYTES: usize = RUN_BLOCK_RECORDS * size_of::<PointRecord>();

/// Memory of a run that is written.
pub const RUN_WRITER_BYTES: usize = FILE_BUFFERS * RUN_BLOCK_BYTES;

/// Longest seal of a run read: of a run as long as indices allow.
pub const SEAL_BYTES_MAX: u64 = 4 << 20;

/// How long the runs of a killed build are kept for the next try.
pub const RUNS_KEPT: Duration = Duration::from_secs(24 * 3600);

/// Longest manifest read: a real one has about 1 KiB.
pub const MANIFEST_BYTES_MAX: u64 = 64 << 10;

/// How often a read that failed with EIO, EINTR or ESTALE is tried.
pub const READ_ATTEMPTS: u32 = 3;

/// Pause before the second try of a read; the third waits ten times as long.
pub const READ_BACKOFF: Duration = Duration::from_millis(1);

/// How often an operation that lost a race with another process is tried.
pub const RACE_ATTEMPTS: u32 = 16;

/// Permissions of files: the group may read.
pub const FILE_MODE: u32 = 0o640;

/// Permissions of a scene's folder.
pub const SCENE_MODE: u32 = 0o750;

/// Permissions of scratch folders.
pub const SCRATCH_MODE: u32 = 0o700;
