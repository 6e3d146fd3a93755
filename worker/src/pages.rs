//! The glue from cache to shade: a node or point by index becomes a slice of a page, wherever that page is.
//!
//! Looks in the local cache, then in the shared one, then asks the daemon over the miss channel, with whatever else the walk
//! is about to need (`ahead`). Indices come from files and
//! are checked against the scene's counts, so that a forged scene ends in an error and nowhere else.

use crate::ahead::{self, Paging};
use crate::shading::FailureKind;
use pbgi_cache::channel::{self, PageOutcome, PageRequest};
use pbgi_cache::{CacheError, LoadErrorKind, LocalCache, Origin};
use pbgi_core::{MountId, NodeIndex, NodeRecord, PageKey, PageKind, PageNo, PointIndex, PointRecord, SceneInfo};
use pbgi_proto::v1::TileCounters;
use pbgi_shade::{SceneSource, SourceError, Upcoming};
use std::os::unix::net::UnixStream;
use std::time::Instant;

/// The worker's cache and its way to the daemon.
#[derive(Debug)]
pub struct Pages {
    cache: LocalCache,
    channel: UnixStream,
    requests: u64,
    /// Whether the last request waited for a disk.
    slow: bool,
}

impl Pages {
    /// A cache that asks over `channel` for what it lacks.
    pub fn new(cache: LocalCache, channel: UnixStream) -> Self {
        Self {
            cache,
            channel,
            requests: 0,
            slow: false,
        }
    }

    /// Has the daemon load pages, and adopts them. The first is the one that is missing; the others are needed soon.
    fn load(&mut self, keys: Vec<PageKey>, job: u64) -> Result<Vec<Origin>, Fault> {
        // Before asking: the daemon pins the pages in this worker's name.
        for kind in [PageKind::Node, PageKind::Point] {
            match keys.iter().filter(|key| key.kind == kind).count() {
                0 => {}
                count => self.cache.reserve(kind, count),
            }
        }
        self.requests += 1;
        let id = self.requests;
        let request = PageRequest::new(id, job, keys);
        let reply = channel::ask(&self.channel, &request)?
            .ok_or_else(|| Fault(FailureKind::Io, "the daemon closed the page channel".to_owned()))?;
        if reply.id != id || reply.outcomes.len() != request.keys.len() {
            let text = format!("reply {} with {} pages to request {id}", reply.id, reply.outcomes.len());
            return Err(Fault(FailureKind::Internal, text));
        }
        // The missing page last, so that it is the most recently used. One that was only asked for ahead may fail.
        let mut origins = Vec::with_capacity(request.keys.len());
        for (&key, outcome) in request.keys.iter().zip(&reply.outcomes).rev() {
            if let PageOutcome::Pinned(fetched) = outcome {
                self.cache.adopt(key, fetched.frame)?;
                origins.push(fetched.origin);
            }
        }
        match reply.outcomes.first() {
            Some(PageOutcome::Failed(kind)) => Err(Fault(failure_kind(*kind), reply.error)),
            _ => Ok(origins),
        }
    }
}

/// What a worker knows of one mounted scene.
#[derive(Debug)]
pub struct SceneView {
    mount: MountId,
    paging: Paging,
    nodes: FileView,
    points: FileView,
    /// Number of the pack of receivers that is being shaded.
    pack: u32,
}

/// One of the scene's files.
#[derive(Debug)]
struct FileView {
    kind: PageKind,
    records: u64,
    records_per_page: u32,
    page_bytes: u64,
    /// By page, who touched it last: the pack, and its receivers in the low bits.
    stamps: Vec<u32>,
}

impl SceneView {
    /// Prepares for a scene.
    pub fn new(scene: &SceneInfo, mount: MountId) -> Self {
        let file = |kind, records, records_per_page| FileView {
            kind,
            records,
            records_per_page,
            page_bytes: scene.page_bytes(kind) as u64,
            stamps: vec![0; scene.page_count(kind) as usize],
        };
        Self {
            mount,
            paging: Paging::new(scene, mount),
            nodes: file(PageKind::Node, scene.node_slots, scene.settings.nodes_per_page),
            points: file(PageKind::Point, scene.point_count, scene.settings.points_per_page),
            pack: 0,
        }
    }

    fn begin_pack(&mut self) {
        if self.pack == PACK_MAX {
            self.nodes.stamps.fill(0);
            self.points.stamps.fill(0);
            self.pack = 0;
        }
        self.pack += 1;
    }
}

/// Bits of a stamp that name receivers.
const RECEIVER_BITS: u32 = 8;
/// Packs that can be told apart by stamps.
const PACK_MAX: u32 = u32::MAX >> RECEIVER_BITS;

impl FileView {
    /// Notes that receivers of a pack touch a page; says how many of them do for the first time.
    fn touch(&mut self, page: u32, pack: u32, receivers: u8) -> Option<u32> {
        let stamp = self.stamps.get_mut(page as usize)?;
        let before = if *stamp >> RECEIVER_BITS == pack {
            *stamp as u8
        } else {
            0
        };
        *stamp = pack << RECEIVER_BITS | u32::from(before | receivers);
        Some((receivers & !before).count_ones())
    }
}

/// Where the last access to a file went: the next one is likely to go there too.
#[derive(Clone, Copy, Debug, Default)]
struct Place {
    /// Index of the page's first record.
    first: u32,
    /// Records of the file in this page. Without any there was no access yet.
    count: u32,
    /// Receivers of the pack that are known to touch it.
    receivers: u8,
}

/// Serves the shading code for one tile.
#[derive(Debug)]
pub struct PageSource<'a> {
    pages: &'a mut Pages,
    scene: &'a mut SceneView,
    job: u64,
    places: [Place; 2],
    counters: TileCounters,
    accesses: u64,
    fault: Option<Fault>,
}

impl<'a> PageSource<'a> {
    /// Serves `scene` out of `pages`, in the name of `job`.
    pub fn new(pages: &'a mut Pages, scene: &'a mut SceneView, job: u64) -> Self {
        pages.cache.set_job(job);
        pages.cache.take_counters();
        Self {
            pages,
            scene,
            job,
            places: [Place::default(); 2],
            counters: TileCounters::default(),
            accesses: 0,
            fault: None,
        }
    }

    /// What happened since this source was made.
    pub fn counters(&self) -> TileCounters {
        let found = self.pages.cache.counters();
        let shared_hits = self.counters.shared_hits + found.shared_hits;
        let mut counters = self.counters;
        counters.shared_hits = shared_hits;
        counters.shared_hits_other_job += found.shared_hits_other_job;
        // Pages that came ahead were not looked for.
        counters.local_hits = self.accesses.saturating_sub(shared_hits + counters.cache_misses);
        counters
    }

    /// Why the last call failed, more exactly than its error says.
    pub fn take_fault(&mut self) -> Option<(FailureKind, String)> {
        self.fault.take().map(|Fault(kind, text)| (kind, text))
    }

    /// Where in its page a record is; the page is pinned, and the cache's last one of its kind.
    #[inline(always)]
    fn slot(
        &mut self,
        kind: PageKind,
        index: u32,
        receivers: u8,
        upcoming: &impl Upcoming,
    ) -> Result<u32, SourceError> {
        self.accesses += u64::from(receivers.count_ones());
        let place = &self.places[kind as usize];
        let slot = index.wrapping_sub(place.first);
        if slot < place.count && receivers & !place.receivers == 0 {
            Ok(slot)
        } else {
            self.turn_to(kind, index, receivers, upcoming)
        }
    }

    #[inline(never)]
    fn turn_to(
        &mut self,
        kind: PageKind,
        index: u32,
        receivers: u8,
        upcoming: &impl Upcoming,
    ) -> Result<u32, SourceError> {
        let pack = self.scene.pack;
        let mount = self.scene.mount;
        let file = match kind {
            PageKind::Node => &mut self.scene.nodes,
            PageKind::Point => &mut self.scene.points,
        };
        let page = index / file.records_per_page;
        let key = PageKey {
            mount,
            kind,
            page: PageNo(page),
        };
        let in_file = u64::from(index) < file.records;
        let touched = in_file.then(|| file.touch(page, pack, receivers)).flatten();
        let Some(newly) = touched else {
            let text = format!("{} {index} of {}", file.kind, file.records);
            return Err(self.fail(Fault(FailureKind::Corrupt, text)));
        };
        self.counters.traversal_bytes += u64::from(newly) * file.page_bytes;
        let first = page * file.records_per_page;
        let count = (file.records - u64::from(first)).min(u64::from(file.records_per_page)) as u32;
        if self.pages.cache.get(key).is_none() {
            self.load(key, upcoming)?;
            self.pages.cache.get(key);
        }
        let before = self.places[kind as usize];
        let same = before.count != 0 && before.first == first;
        self.places[kind as usize] = Place {
            first,
            count,
            receivers: if same { before.receivers | receivers } else { receivers },
        };
        Ok(index - first)
    }

    #[cold]
    fn load(&mut self, missing: PageKey, upcoming: &impl Upcoming) -> Result<(), SourceError> {
        let span = tracing::debug_span!("page load", kind = %missing.kind, page = missing.page.0);
        let _entered = span.enter();
        let start = Instant::now();
        let keys = match self.pages.slow {
            true => ahead::request(&self.pages.cache, &self.scene.paging, missing, upcoming),
            false => vec![missing],
        };
        let pages = keys.len();
        let loaded = self.pages.load(keys, self.job);
        let took = start.elapsed();
        self.pages.slow = ahead::waited_for_disk(pages, took);
        self.counters.io_nanos += took.as_nanos() as u64;
        // Other pages may have gone to make room.
        self.places = [Place::default(); 2];
        for origin in loaded.map_err(|fault| self.fail(fault))? {
            match origin {
                Origin::Loaded => self.counters.cache_misses += 1,
                Origin::Resident => self.counters.shared_hits += 1,
                Origin::ResidentOtherJob => {
                    self.counters.shared_hits += 1;
                    self.counters.shared_hits_other_job += 1;
                }
            }
        }
        Ok(())
    }

    /// Remembers a fault in full, and tells the shading code what it can hold.
    #[cold]
    fn fail(&mut self, fault: Fault) -> SourceError {
        let Fault(kind, text) = &fault;
        let error = match kind {
            FailureKind::Corrupt => SourceError::Corrupt(text.clone()),
            _ => SourceError::Io(text.clone()),
        };
        self.fault = Some(fault);
        error
    }
}

impl SceneSource for PageSource<'_> {
    #[inline(always)]
    fn node(&mut self, index: NodeIndex, receivers: u8, upcoming: &impl Upcoming) -> Result<&NodeRecord, SourceError> {
        const BYTES: usize = size_of::<NodeRecord>();
        let slot = self.slot(PageKind::Node, index.0, receivers, upcoming)?;
        let page = self.pages.cache.again(PageKind::Node);
        let start = slot as usize * BYTES;
        let bytes = page.get(start..start + BYTES).ok_or_else(|| lost(PageKind::Node))?;
        bytemuck::try_from_bytes(bytes).map_err(|_| lost(PageKind::Node))
    }

    #[inline]
    fn points(
        &mut self,
        first: PointIndex,
        count: u32,
        receivers: u8,
        upcoming: &impl Upcoming,
    ) -> Result<&[PointRecord], SourceError> {
        const BYTES: usize = size_of::<PointRecord>();
        if count == 0 {
            return Err(self.fail(Fault(FailureKind::Corrupt, format!("no points from {} on", first.0))));
        }
        let slot = self.slot(PageKind::Point, first.0, receivers, upcoming)?;
        let count = count.min(self.places[PageKind::Point as usize].count - slot) as usize;
        let page = self.pages.cache.again(PageKind::Point);
        let start = slot as usize * BYTES;
        let bytes = page
            .get(start..start + count * BYTES)
            .ok_or_else(|| lost(PageKind::Point))?;
        bytemuck::try_cast_slice(bytes).map_err(|_| lost(PageKind::Point))
    }

    fn begin_pack(&mut self) {
        self.scene.begin_pack();
        // The stamps are looked at when the page changes: have the next access look.
        self.places = [Place::default(); 2];
    }
}

/// A frame that is not there or not as large as its layout says: a defect, not an input.
#[cold]
fn lost(kind: PageKind) -> SourceError {
    SourceError::Io(format!("a {kind} page left the cache while it was used"))
}

/// Kind and text of what went wrong.
#[derive(Clone, Debug)]
struct Fault(FailureKind, String);

impl From<CacheError> for Fault {
    fn from(error: CacheError) -> Self {
        let kind = match error {
            CacheError::Channel { .. } => FailureKind::Io,
            _ => FailureKind::Internal,
        };
        Self(kind, error.to_string())
    }
}

fn failure_kind(kind: LoadErrorKind) -> FailureKind {
    match kind {
        LoadErrorKind::Corrupt => FailureKind::Corrupt,
        LoadErrorKind::Io => FailureKind::Io,
        LoadErrorKind::Refused | LoadErrorKind::Internal => FailureKind::Internal,
    }
}
