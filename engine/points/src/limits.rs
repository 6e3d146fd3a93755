//! Bounds and defaults of this crate, each with its reason.

/// Points sampled from a mesh when neither a count nor a spacing is given: a room at 2 million points has 2 to 3 cm discs,
/// and the whole render takes a minute or two on two cores.
pub const POINTS_DEFAULT: u64 = 2_000_000;

/// Most points asked of a mesh: positions on the Morton lattice stop being distinct long before.
pub const POINTS_MAX: u64 = 1 << 40;

/// Points in one batch of a stream: large enough to share between threads, small enough to stay in the caches.
pub const BATCH_POINTS: usize = 16_384;

/// Points lit by one thread at a time.
pub const LIGHT_CHUNK_POINTS: usize = 1024;

/// Threads that light points or trace primary rays, unless the caller says otherwise.
pub const THREADS_DEFAULT: usize = 2;

/// Memory for what an input keeps, unless the caller says otherwise.
pub const INPUT_MEMORY_DEFAULT: u64 = 2 << 30;

/// Least memory that brings a cloud into order: two blocks at work, and the counts of coarse cells; or the points that stand for
/// all while their sides are found, five megabytes.
pub const ESTIMATE_MEMORY_MIN: u64 = 8_000_000;

/// Most channels of an EXR file: passes, light groups and Cryptomatte ranks of a film's frame are 100 to 300. Only those that
/// are read take memory.
pub const EXR_CHANNELS_MAX: usize = 1024;

/// Most parts of an EXR file whose headers are looked at.
pub const EXR_PARTS_MAX: usize = 64;

/// Edge of the tiles of EXR files that we write, pixels: the tiles of the work queue.
pub const EXR_TILE_EDGE: usize = pbgi_core::limits::TILE_EDGE as usize;

/// Most bytes of a scene file: hundreds of thousands of placed meshes.
pub const SCENE_FILE_BYTES_MAX: u64 = 64 << 20;

/// Most bytes of a PLY header.
pub const PLY_HEADER_BYTES_MAX: u64 = 1 << 16;

/// Most properties of one PLY element.
pub const PLY_PROPERTIES_MAX: usize = 256;

/// Longest line of an ASCII PLY file.
pub const PLY_LINE_BYTES_MAX: usize = 1 << 16;

/// Most elements in a list property that is skipped.
pub const PLY_LIST_MAX: u64 = 1 << 20;

/// Most channels of a PTC file.
pub const PTC_CHANNELS_MAX: i32 = 256;

/// Longest line that names a channel of a PTC file.
pub const PTC_LINE_BYTES_MAX: u64 = 1 << 10;

/// Most bytes of a mesh file or one of its buffers.
pub const MESH_FILE_BYTES_MAX: u64 = 8 << 30;

/// Deepest node hierarchy of a mesh file: a cycle would have no end.
pub const NODE_DEPTH_MAX: usize = 256;

/// Memory of a triangle at its peak, while charts and BVHs are made, vertices not counted (240 measured on 0.9 million).
pub const TRIANGLE_BYTES: usize = 300;

/// Memory of a placed mesh at its peak, while the BVH over all of them is made.
pub const INSTANCE_BYTES: usize = 128;

/// Memory of a node of a glTF file or a prim of a USD stage while it is read (480 measured on 110,000).
pub const NODE_BYTES: usize = 500;

/// Placed meshes from which on they are grouped for the BVH: alone each would take 300 bytes while it is made, but rays find
/// them faster.
pub const GROUPED_INSTANCES_MIN: usize = 1 << 16;

/// Placed meshes of a group.
pub const INSTANCE_GROUP: usize = 8;

/// Placed triangles of a mesh up to which it is copied rather than placed.
pub const COPIED_TRIANGLES_MAX: usize = 100_000;

/// Most patches of a procedural scene that are written as triangles: two gigabytes.
pub const GLB_PATCHES_MAX: u64 = 1 << 24;

/// Most placed meshes in a scene.
pub const INSTANCES_MAX: usize = 1 << 22;

/// Most triangles of one mesh: 32-bit indices.
pub const TRIANGLES_MAX: usize = 1 << 30;

/// Most pixels along one edge of a texture.
pub const TEXTURE_EDGE_MAX: u32 = 1 << 15;

/// Most bytes that decoding one texture may take.
pub const TEXTURE_BYTES_MAX: u64 = 1 << 30;

/// Most bytes of the pixels that are read from an EXR file, all channels together.
pub const EXR_BYTES_MAX: u64 = 4 << 30;

/// Most bytes of one tile or block of scanlines of an EXR file, decoded.
pub const EXR_BLOCK_BYTES_MAX: u64 = 1 << 30;

/// Most prims of a USD stage that are looked at, those of shared prototypes once: references that double on each level would have
/// no end.
pub const USD_PRIMS_MAX: usize = 1 << 20;

/// Deepest nesting of brackets in a USD text file, and of prims of a stage: each level takes stack.
pub const USD_DEPTH_MAX: usize = 256;

/// Longest time that one prim or one file of a USD stage may take, seconds: composition can be made endless.
pub const USD_STALL_SECS: u64 = 300;

/// Shortest file that leaves the system's memory as it is read for the last time.
pub const DROP_BEHIND_MIN: u64 = 1 << 29;
/// How much of it leaves at once.
pub const DROP_BEHIND_BYTES: u64 = 8 << 20;
