//! The glue from cache to shade: a node or point by index becomes a slice of a page, wherever that page is.
//!
//! Looks in the local cache, then in the shared one, then asks the daemon over the miss channel, with whatever else the walk
//! is about to need (`ahead`). Indices come from files and
//! are checked against the scene's counts, so that a forged scene ends in an error and nowhere else.

use crate::ahead;
use crate::shading::FailureKind;
use crate::view::Place;
pub use crate::view::SceneView;
use pbgi_cache::channel::{self, PageOutcome, PageRequest};
use pbgi_cache::{CacheError, LoadErrorKind, LocalCache, Origin};
use pbgi_core::{NodeIndex, NodeRecord, PageKey, PageKind, PointIndex, PointRecord};
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

/// Serves the shading code for one tile.
#[derive(Debug)]
pub struct PageSource<'a> {
    pages: &'a mut Pages,
    scene: &'a mut SceneView,
    job: u64,
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

    /// The place of a record in its page, which is now the cache's last one.
    ///
    /// Walks turn from page to page at every second look: where they go must cost the same wherever they come from.
    #[inline(always)]
    fn slot(
        &mut self,
        kind: PageKind,
        index: u32,
        receivers: u8,
        upcoming: &impl Upcoming,
    ) -> Result<u32, SourceError> {
        self.accesses += u64::from(receivers.count_ones());
        let place = self.scene.place(kind, index);
        let known = place.filter(|place| self.scene.is_touched(place.key, receivers));
        match known {
            Some(place) if self.pages.cache.get(place.key).is_some() => Ok(place.slot),
            _ => self.turn_to(kind, index, receivers, upcoming),
        }
    }

    /// The rare part of [`Self::slot`]: the first look of a receiver at a page, and pages that are not at hand.
    #[inline(never)]
    fn turn_to(
        &mut self,
        kind: PageKind,
        index: u32,
        receivers: u8,
        upcoming: &impl Upcoming,
    ) -> Result<u32, SourceError> {
        let Some(Place { key, slot, .. }) = self.scene.place(kind, index) else {
            let text = format!("{kind} {index} of {}", self.scene.records(kind));
            return Err(self.fail(Fault(FailureKind::Corrupt, text)));
        };
        self.counters.traversal_bytes += self.scene.touch(key, receivers);
        if self.pages.cache.get(key).is_none() {
            self.load(key, upcoming)?;
            self.pages.cache.get(key);
        }
        Ok(slot)
    }

    #[cold]
    fn load(&mut self, missing: PageKey, upcoming: &impl Upcoming) -> Result<(), SourceError> {
        let span = tracing::debug_span!("page load", kind = %missing.kind, page = missing.page.0);
        let _entered = span.enter();
        let start = Instant::now();
        let keys = match self.pages.slow {
            true => ahead::request(&self.pages.cache, self.scene, missing, upcoming),
            false => vec![missing],
        };
        let pages = keys.len();
        let loaded = self.pages.load(keys, self.job);
        let took = start.elapsed();
        self.pages.slow = ahead::waited_for_disk(pages, took);
        self.counters.io_nanos += took.as_nanos() as u64;
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
        let page = self.pages.cache.last(PageKind::Node);
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
        let count = count.min(self.scene.left(PageKind::Point, first.0, slot)) as usize;
        let page = self.pages.cache.last(PageKind::Point);
        let start = slot as usize * BYTES;
        let bytes = page
            .get(start..start + count * BYTES)
            .ok_or_else(|| lost(PageKind::Point))?;
        bytemuck::try_cast_slice(bytes).map_err(|_| lost(PageKind::Point))
    }

    fn begin_pack(&mut self) {
        self.scene.begin_pack();
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
