//! Bounds and tuned constants of a build.

/// Least memory a build accepts. Below it, run buffers get so short that merging takes many passes.
pub const MEMORY_MIN_BYTES: u64 = 64_000_000;

/// Memory that is not for points: code, stacks, the input's own buffers, checksum tables, the allocator's slack.
pub const MEMORY_RESERVE_BYTES: u64 = 16 << 20;

/// Least memory left for points once everything else has its share.
pub const SORT_MIN_BYTES: u64 = 8 << 20;

/// Points handed from one stage to the next at once: 320 KiB with their codes, which stays in a core's own cache.
pub const BATCH_POINTS: usize = 8192;

/// Batches on their way between the sorting and the constructing thread.
pub const BATCHES_IN_FLIGHT: usize = 4;

/// Most blocks of a run read at once: 4 MiB, beyond which a disk gets no faster.
pub const BLOCKS_PER_READ_MAX: usize = 16;

/// An input may overstate its number of points by this much before a full disk is reported too early.
pub const LEN_HINT_TRUST: f64 = 0.9;
