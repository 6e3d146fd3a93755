//! Every constant of the paper and every bound of ours, each with its reason.

/// Bits per axis of a Morton code; also the deepest level of the octree (paper section 3.2: 3 x 21 bits fill a `u64`).
pub const MORTON_BITS: u32 = 21;

/// Most points in a leaf above the deepest level (paper section 4.1).
pub const LEAF_MAX_DEFAULT: u32 = 16;

/// Largest `leaf_max` accepted: the construction keeps `leaf_max + 1` points in memory, a shading call looks at that many.
pub const LEAF_MAX_LIMIT: u32 = 1024;

/// Levels of the octree written together as one chunk (paper section 4.2).
pub const CHUNK_LEVELS_DEFAULT: u32 = 3;

/// Largest `chunk_levels` accepted: a write-out queue holds at most `8^1 + .. + 8^chunk_levels` nodes.
pub const CHUNK_LEVELS_LIMIT: u32 = 5;

/// Nodes in a page of the paper's size (section 5).
pub const PAPER_NODES_PER_PAGE: u32 = 2048;

/// Points in a page of the paper's size: its 512 KiB pages hold 16,384 records of 32 bytes.
pub const PAPER_POINTS_PER_PAGE: u32 = 16_384;

/// Default nodes in a page. Pages this small fault 23 times less than the paper's at equal memory (4 million points, LRU of
/// a tenth of the pages: 3.1 against 71 faults a receiver).
pub const NODES_PER_PAGE_DEFAULT: u32 = 256;

/// Default points in a page: 32 KiB, about the size of a node page.
pub const POINTS_PER_PAGE_DEFAULT: u32 = 1024;

/// Page sizes accepted, in records. A sibling group (8 nodes) never crosses a page, and a frame stays below 16 MiB.
pub const RECORDS_PER_PAGE_RANGE: std::ops::RangeInclusive<u32> = 16..=131_072;

/// Mounted scenes a daemon holds at once.
pub const MOUNTS_MAX: usize = 64;

/// Workers a daemon runs at once; each has one pin ledger in the segment.
pub const WORKERS_MAX: usize = 64;

/// Nodes one shading call may visit before the scene is called hostile.
pub const CUT_NODES_MAX: u32 = 1 << 20;

/// Receivers along one edge of a group: the unit that shares a traversal (8 x 8 pixels).
pub const GROUP_EDGE: u32 = 8;

/// Pixels along one edge of an image tile, a whole number of groups.
pub const TILE_EDGE: u32 = 32;

/// Pixels an image may have.
pub const IMAGE_PIXELS_MAX: u64 = 1 << 26;

/// Default largest solid angle of a cut element, in steradian (RenderMan's `maxsolidangle`).
pub const MAX_SOLID_ANGLE_DEFAULT: f32 = 0.05;

/// Default rows and columns of the raster.
pub const RASTER_RESOLUTION_DEFAULT: u32 = 64;

/// Most bounces of light: at an albedo of 0.8 the sixteenth adds less than three hundredths.
pub const BOUNCES_MAX: u32 = 16;

/// Largest finite value of a half-precision float; harmonics are clamped here when records are packed.
pub const HALF_MAX: f32 = 65_504.0;

/// Memory cap where none is given, unless the machine has less to offer.
pub const MEMORY_DEFAULT_BYTES: u64 = 2 << 30;

/// Share of the page memory given to node pages, the rest goes to points (paper section 5).
pub const NODE_MEMORY_SHARE: f64 = 0.75;
