//! Bounds and tuned constants of a build.

/// Least memory a build accepts. Below it, run buffers get so short that merging takes many passes.
pub const MEMORY_MIN_BYTES: u64 = 64_000_000;

/// Memory that is not for points: code, stacks, the input's own buffers, checksum tables, the allocator's slack.
pub const MEMORY_RESERVE_BYTES: u64 = 16 << 20;

/// Least memory left for points once everything else has its share.
pub const SORT_MIN_BYTES: u64 = 8 << 20;

/// Points between two looks at whether the build goes on.
pub const BATCH_POINTS: usize = 8192;

/// Points of a scene, about a gigabyte, up to which its pages stay in the system's page cache for who shades it next. Those
/// of a larger one would push out more than they save.
pub const CACHED_POINTS_MAX: u64 = 1 << 24;

/// Points of a construction job: 2.6 MB with codes and a usual number of nodes, so that handing over costs nothing and
/// the jobs in flight fit the caches.
pub const JOB_POINTS_MAX: usize = 1 << 14;

/// Points of a job where there is little memory.
pub const JOB_POINTS_MIN: usize = 256;

/// Jobs in flight get this fraction of the memory, 1 / 8, counted for clouds that make the most nodes.
pub const JOB_MEMORY_SHARE: u64 = 8;

/// Threads of one build: more would wait for the one that merges and the one that writes.
pub const THREADS_MAX: usize = 32;

/// Most blocks of a run read at once: 4 MiB, beyond which a disk gets no faster.
pub const BLOCKS_PER_READ_MAX: usize = 16;

/// An input may overstate its number of points by this much before a full disk is reported too early.
pub const LEN_HINT_TRUST: f64 = 0.9;

/// Points written between two looks at the space that is left on the disk: half a gigabyte of scene.
pub const DISK_WATCH_POINTS: u64 = 10_000_000;
