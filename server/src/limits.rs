//! Every bound of the daemon, with its reason.

use std::time::Duration;

/// Jobs that may wait. One more is refused.
pub const JOBS_QUEUED_MAX: usize = 10_000;
/// Ended jobs remembered; older ones are forgotten first.
pub const JOBS_ENDED_MAX: usize = 1_000;
/// Characters of a job's name.
pub const JOB_ID_CHARS_MAX: usize = 128;
/// Failed jobs whose finished tiles are kept for a retry.
pub const FAILED_JOBS_KEPT_MAX: usize = 16;
/// Ended jobs whose picture is still shown small, 1 MiB each at most.
pub const PREVIEWS_MAX: usize = 8;
/// Times that a job may run when the daemon dies, before it is taken for the reason.
pub const DAEMON_DEATHS_MAX: u32 = 3;
/// Labels of a job.
pub const LABELS_MAX: usize = 16;
/// Characters of a user's name, a label's name and a label.
pub const LABEL_CHARS_MAX: usize = 128;
/// Largest and, negated, smallest priority.
pub const PRIORITY_MAX: i32 = 1_000;
/// Jobs that a job may come after.
pub const AFTER_MAX: usize = 64;
/// Lines of a job's history.
pub const HISTORY_MAX: usize = 48;
/// Bytes of finished tiles that may wait to be stored; beyond, tiles are not stored, and shaded again after a crash.
pub const TILES_UNSTORED_BYTES_MAX: usize = 8 << 20;
/// Memory of the job table's own cache.
pub const TABLE_CACHE_BYTES: usize = 4 << 20;
/// Unused bytes in the job table's file above which it is compacted when the daemon starts.
pub const TABLE_SLACK_BYTES_MAX: u64 = 64 << 20;
/// Input files of a build.
pub const BUILD_INPUTS_MAX: usize = 1_024;
/// Parts of a path below a root.
pub const PATH_PARTS_MAX: usize = 32;
/// Time that a TLS handshake may take.
pub const HANDSHAKE_MAX: Duration = Duration::from_secs(5);
/// Bytes of a path.
pub const PATH_BYTES_MAX: usize = 4_096;
/// Tiles of a picture.
pub const TILES_MAX: u64 = 1 << 17;

/// Bytes of a message from a client: requests are names and numbers.
pub const JOBS_MESSAGE_BYTES_MAX: usize = 1 << 20;
/// Bytes of a message on the queue: a tile and its results are 24 and 28 KiB, an environment map is the largest.
pub const QUEUE_MESSAGE_BYTES_MAX: usize = 4 << 20;
/// Bytes of the headers of a request.
pub const HEADER_BYTES_MAX: u32 = 16 << 10;
/// Streams of a connection.
pub const STREAMS_MAX: u32 = 128;
/// Requests of a connection in flight.
pub const REQUESTS_IN_FLIGHT_MAX: usize = 32;
/// Connections at once, to each socket.
pub const CONNECTIONS_MAX: usize = 256;
/// Descriptors kept for jobs, workers and the daemon itself, whoever connects.
pub const DESCRIPTORS_RESERVED: u64 = 40;
/// Listeners that share the rest.
pub const LISTENERS_MAX: u64 = 5;
/// Streams reset before they were accepted, after which a connection is closed.
pub const PENDING_RESETS_MAX: usize = 20;
/// Time between HTTP/2 pings, and how long an answer may take.
pub const KEEPALIVE_INTERVAL: Duration = Duration::from_secs(20);
/// See [`KEEPALIVE_INTERVAL`].
pub const KEEPALIVE_TIMEOUT: Duration = Duration::from_secs(10);
/// First and longest pause after a failed accept.
pub const ACCEPT_BACKOFF: [Duration; 2] = [Duration::from_secs(1), Duration::from_secs(64)];
/// How long a worker's question for a tile is kept before it is answered with none.
pub const LEASE_WAIT: Duration = Duration::from_secs(5);

/// Columns of the environment map that workers get; larger maps are averaged down. A raster of 64 x 64 cells over a
/// hemicube has cells of 1.4 degrees, a map of this width pixels of 0.7.
pub const ENVIRONMENT_WIDTH_MAX: u32 = 512;

/// Clients that stream receivers at once.
pub const LIVE_SESSIONS_MAX: usize = 64;
/// Tiles of a stream that are neither waiting to be read nor answered: enough for 64 workers at once.
pub const LIVE_TILES_MAX: usize = 64;
/// Bytes of a message of a stream: 170 tiles.
pub const LIVE_MESSAGE_BYTES_MAX: usize = 4 << 20;

/// Scenes of further bounces that are kept, and for how long after their last use.
pub const BOUNCED_SCENES_MAX: usize = 16;
/// See [`BOUNCED_SCENES_MAX`].
pub const BOUNCED_SCENES_KEPT: Duration = Duration::from_secs(24 * 3600);

/// Time between two looks at leases, idle time and memory.
pub const TICK: Duration = Duration::from_millis(200);
/// How long leased tiles may take when the daemon stops.
pub const DRAIN_MAX: Duration = Duration::from_secs(30);
/// How long connections may take to end when the daemon stops.
pub const DISCONNECT_MAX: Duration = Duration::from_secs(2);
/// The same when it was told twice to stop.
pub const DISCONNECT_NOW_MAX: Duration = Duration::from_millis(200);

/// Smallest and longest pause before a worker that died before it was ready is started again.
pub const BACKOFF: [Duration; 2] = [Duration::from_millis(100), Duration::from_secs(5)];
/// Deaths before being ready, within [`PARK_WINDOW`], that park a slot.
pub const PARK_DEATHS: usize = 5;
/// See [`PARK_DEATHS`].
pub const PARK_WINDOW: Duration = Duration::from_secs(10);
/// How long the supervisor sleeps at most while it has children: the fallback for a death that closed no descriptor.
pub const REAP_POLL: Duration = Duration::from_millis(50);
/// How long a worker whose page channel closed may take to end before SIGKILL.
pub const HANGUP_GRACE: Duration = Duration::from_millis(100);
/// How long a process may take to end after SIGTERM before SIGKILL.
pub const TERM_GRACE: Duration = Duration::from_secs(2);
/// Commands the supervisor may be behind.
pub const SUPERVISOR_QUEUE_MAX: usize = 1_024;

/// Loads in flight per worker: its loader thread reads one page after another.
pub const LOADS_PER_WORKER: u32 = 1;
/// Mounts of scenes that no job uses, kept warm.
pub const MOUNTS_IDLE_MAX: usize = 32;

/// Bytes of a progress line of a build child.
pub const PROGRESS_LINE_BYTES_MAX: u64 = 64 << 10;
/// Bytes of a build child's last words that are kept.
pub const STDERR_TAIL_BYTES: usize = 4 << 10;
/// Bytes of the spec that a build child reads.
pub const SPEC_BYTES_MAX: u64 = 16 << 20;

/// Private memory set aside for the daemon itself.
pub const DAEMON_RESERVE_BYTES: u64 = 16 << 20;
/// Private memory set aside for each worker: its code's data, one tile, its raster, an environment map.
pub const WORKER_RESERVE_BYTES: u64 = 8 << 20;
/// Share of the rest that is pages in the segment; what remains is for builds and pictures. At half, the default budget holds
/// a picture of 3840 x 2160.
pub const SEGMENT_SHARE: f64 = 0.5;
/// Memory that a build wants at least, where the budget has it: the least of pbgi-build, with room for its input.
pub const BUILD_BYTES_MIN: u64 = 72 << 20;
/// Bytes that one pixel of a picture takes at its peak, which is when it is written (113 measured at 1920 x 1080).
pub const PICTURE_BYTES_PER_PIXEL: u64 = 116;
/// Bytes of a pixel in a channel that goes from the G-buffer to the picture as it is.
pub const PASSED_BYTES_PER_PIXEL: u64 = 4;
/// Share of a machine's limit that is taken without being asked to, and the most of a container's limit.
pub const LIMIT_SHARE: f64 = 0.8;

/// Bytes of a Unix socket's path, its final zero included.
pub const SOCKET_PATH_BYTES_MAX: usize = 108;
