//! The daemon's side: who loads a page, into which frame, and what becomes of pins whose worker died.
//!
//! Entry points: [`CacheOwner::fetch`], [`CacheOwner::reap`], [`CacheOwner::mount`] and [`CacheOwner::unmount`]. One
//! lock a pool, in this process only; pages are loaded outside it.

use crate::counters::{CacheCounters, JobCounters, SceneCounters};
use crate::error::{CacheError, LoadError, LoadErrorKind};
use crate::flight::Role;
use crate::frame::{FrameId, Tag};
use crate::layout::{KINDS, SegmentLayout};
use crate::pool::{Pool, PoolState};
use crate::segment::Segment;
use pbgi_core::limits::MOUNTS_MAX;
use pbgi_core::{MountId, PageKey, PageKind, SceneInfo};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// How long a fetch waits for a frame to become evictable. By rule 10 one always is, unless a worker scribbled on its
/// ledger; the supervisor finds that one ([`CacheOwner::overrun`]) and kills it well within this time.
const EVICTABLE_WAIT: Duration = Duration::from_secs(10);
/// Unpinning wakes nobody (it is a bit in a worker's ledger), so waiting for it looks again this often.
const EVICTABLE_POLL: Duration = Duration::from_millis(5);

/// Jobs whose counters are kept at a time; a fetch for one more is refused. Far more than a daemon runs at once, so
/// only a server that forgets [`CacheOwner::end_job`], or a worker that makes numbers up, comes here.
pub const JOBS_MAX: usize = 16_384;

/// A worker's seat: a slot, and how often the slot was given to a new worker.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Seat {
    /// Number of the ledger.
    pub slot: u8,
    /// Changes when the slot is reaped, so that a request of the old worker does not pin for the new one.
    pub epoch: u32,
}

/// A page that is resident, and pinned for the worker that asked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fetched {
    /// Where.
    pub frame: FrameId,
    /// Whether it had to be loaded.
    pub origin: Origin,
}

/// Where a fetched page came from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Origin {
    /// Loaded for this request.
    Loaded,
    /// Resident already, or being loaded for another request, of this job.
    Resident,
    /// The same, of another job.
    ResidentOtherJob,
}

/// The owner of the cache: the one writer of frames, tags and page tables (Rule 1). Shared by the threads that serve
/// workers.
#[derive(Debug)]
pub struct CacheOwner {
    segment: Segment,
    pools: [Pool; 2],
    resident_bytes: AtomicU64,
    resident_bytes_peak: AtomicU64,
}

enum Admission {
    Done(Fetched),
    Load { frame: FrameId, page_bytes: usize },
}

impl CacheOwner {
    /// Takes over a new segment. Its layout guarantees an evictable frame (Rule 10).
    pub fn new(segment: Segment) -> Self {
        let pools = KINDS.map(|kind| Pool {
            state: Mutex::new(PoolState::new(kind, segment.layout())),
            changed: Condvar::new(),
        });
        Self {
            segment,
            pools,
            resident_bytes: AtomicU64::new(0),
            resident_bytes_peak: AtomicU64::new(0),
        }
    }

    /// The segment: its name and layout hash go into each worker's welcome.
    pub fn segment(&self) -> &Segment {
        &self.segment
    }

    /// The layout.
    pub fn layout(&self) -> &SegmentLayout {
        self.segment.layout()
    }

    /// The seat of whoever is, or will next be, in a slot. Take it **before** the worker starts: taken later it may
    /// be that of a successor, and requests that the dead worker left behind would pin for it.
    pub fn seat(&self, slot: u8) -> Result<Seat, CacheError> {
        let state = self.lock(PageKind::Node);
        match state.epochs.get(usize::from(slot)) {
            Some(&epoch) => Ok(Seat { slot, epoch }),
            None => Err(CacheError::StaleSeat { slot, epoch: 0 }),
        }
    }

    /// Opens the cache for the pages of a scene. Ids are the caller's; a generation must not return to a slot.
    pub fn mount(&self, mount: MountId, info: &SceneInfo) -> Result<(), CacheError> {
        let mut states = KINDS.map(|kind| self.lock(kind));
        for (state, kind) in states.iter().zip(KINDS) {
            let (page_bytes, frame_bytes) = (info.page_bytes(kind), self.layout().pool(kind).frame_bytes);
            if page_bytes > frame_bytes {
                return Err(CacheError::PageTooLarge {
                    kind,
                    page_bytes,
                    frame_bytes,
                });
            }
            if usize::from(mount.slot) >= MOUNTS_MAX || !state.mount_is_free(self.segment.map(), mount) {
                return Err(CacheError::MountTaken(mount));
            }
        }
        for (state, kind) in states.iter_mut().zip(KINDS) {
            state.mount(mount, info.page_bytes(kind), info.page_count(kind));
        }
        Ok(())
    }

    /// Closes the cache for a scene and drops its pages: at once where nobody pins them, else as soon as the last pin
    /// is gone.
    pub fn unmount(&self, mount: MountId) {
        for kind in KINDS {
            let freed = self.lock(kind).unmount(self.segment.map(), mount);
            self.resident_bytes.fetch_sub(freed, Ordering::Relaxed);
            self.pools[kind as usize].changed.notify_all();
        }
    }

    /// Makes a page resident and pins it for the worker in `seat`, on behalf of job number `job`.
    /// Of the loads that may be in flight, one scene gets half at most.
    ///
    /// `load` is called, outside every lock, if the page has to be read; its buffer has exactly the page's bytes. Of
    /// all who ask for a page at once one loads, and all get its outcome. A seat fetches one page at a time.
    pub fn fetch(
        &self,
        seat: Seat,
        key: PageKey,
        job: u64,
        load: impl FnOnce(&mut [u8]) -> Result<(), LoadError>,
    ) -> Result<Fetched, CacheError> {
        let (frame, page_bytes) = match self.admit(seat, key, job)? {
            Admission::Done(fetched) => return Ok(fetched),
            Admission::Load { frame, page_bytes } => (frame, page_bytes),
        };
        let landing = Landing {
            owner: self,
            seat,
            key,
            job,
            frame,
        };
        // SAFETY: Rule 6: `admit` claimed the frame for this call, and `landing` gives it up after this slice's last
        // use, also when `load` panics.
        let page = unsafe { self.segment.map().frame_mut(key.kind, frame, page_bytes) };
        let outcome = load(page);
        landing.finish(outcome)?;
        Ok(Fetched {
            frame,
            origin: Origin::Loaded,
        })
    }

    /// Frees what a dead worker held, and retires its seat; returns the number of its pins. Call it after `wait`
    /// returned for the process, and before the slot is filled again (Rule 8).
    pub fn reap(&self, slot: u8) -> Result<u32, CacheError> {
        let seat = self.seat(slot)?;
        let map = self.segment.map();
        let mut pins = 0;
        for kind in KINDS {
            let mut state = self.lock(kind);
            state.epochs[usize::from(slot)] = seat.epoch.wrapping_add(1);
            pins += crate::protocol::reap(map.pins(slot, kind));
            crate::protocol::reap(map.touched(slot, kind));
            self.pools[kind as usize].changed.notify_all();
        }
        map.attached(slot).store(0, Ordering::Release);
        Ok(pins)
    }

    /// Pins that a worker holds in a pool.
    pub fn pins(&self, slot: u8, kind: PageKind) -> u32 {
        if u32::from(slot) >= self.layout().workers() {
            return 0;
        }
        self.segment
            .map()
            .pins(slot, kind)
            .iter()
            .map(|word| word.load(Ordering::Relaxed).count_ones())
            .sum()
    }

    /// A worker that holds more pins than it may: it scribbled on its ledger and has to go.
    pub fn overrun(&self) -> Option<Seat> {
        let over = |slot| {
            KINDS
                .iter()
                .any(|&kind| self.pins(slot, kind) > self.layout().pool(kind).local_frames)
        };
        let slot = (0..self.layout().workers() as u8).find(|&slot| over(slot))?;
        self.seat(slot).ok()
    }

    /// The counters, after dropping what an unmounted scene left and nobody pins any more.
    pub fn counters(&self) -> CacheCounters {
        let [node, point] = KINDS.map(|kind| {
            let mut state = self.lock(kind);
            let freed = state.sweep(self.segment.map());
            self.resident_bytes.fetch_sub(freed, Ordering::Relaxed);
            state.counters()
        });
        CacheCounters {
            node,
            point,
            resident_bytes: self.resident_bytes.load(Ordering::Relaxed),
            resident_bytes_peak: self.resident_bytes_peak.load(Ordering::Relaxed),
        }
    }

    /// The counters of a scene, of its node pages and of its point pages; `None` if it is not mounted.
    pub fn scene_counters(&self, mount: MountId) -> Option<[SceneCounters; 2]> {
        let [node, point] = KINDS.map(|kind| self.lock(kind).scene_counters(mount));
        Some([node?, point?])
    }

    /// The counters of a job. A record is kept for each job number until [`CacheOwner::end_job`], for [`JOBS_MAX`] at
    /// most.
    pub fn job_counters(&self, job: u64) -> JobCounters {
        let mut sum = JobCounters::default();
        for kind in KINDS {
            if let Some(record) = self.lock(kind).jobs.get(&job) {
                sum.add(&record.counters);
            }
        }
        sum
    }

    /// The counters of a job that is over; forgets it.
    pub fn end_job(&self, job: u64) -> JobCounters {
        let mut sum = JobCounters::default();
        for kind in KINDS {
            if let Some(record) = self.lock(kind).jobs.remove(&job) {
                sum.add(&record.counters);
            }
        }
        sum
    }

    fn lock(&self, kind: PageKind) -> MutexGuard<'_, PoolState> {
        // Nothing under the lock leaves half a change behind; a panic there is a bug, and ends the daemon.
        self.pools[kind as usize]
            .state
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    /// Finds the page, waits for whoever loads it, or claims a frame to load it into.
    fn admit(&self, seat: Seat, key: PageKey, job: u64) -> Result<Admission, CacheError> {
        let (map, kind, tag) = (self.segment.map(), key.kind, Tag::resident(key));
        let mut exhausted_since = None;
        let mut state = self.lock(kind);
        state.count_fetch(seat, key, job)?;
        loop {
            let page_bytes = state.check(seat, key)?;
            if let Some(frame) = state.find(map, tag) {
                state.pin(map, seat, frame)?;
                let origin = state.count_hit(map, frame, job, true);
                return Ok(Admission::Done(Fetched { frame, origin }));
            }
            state.check_ledger(map, seat)?;
            if state.flights.contains(tag.0)
                && let Role::Follow(flight) = state.flights.join(tag.0, seat)
            {
                drop(state);
                let frame = flight.wait()?;
                let mut state = self.lock(kind);
                // Reaped meanwhile: then nothing was pinned, or is no longer. An unmount meanwhile leaves the pin good.
                state.check_seat(seat)?;
                let origin = state.count_hit(map, frame, job, false);
                return Ok(Admission::Done(Fetched { frame, origin }));
            }
            if state.has_load_for(key.mount) {
                let (claimed, freed) = state.claim(map, tag);
                self.resident_bytes.fetch_sub(freed, Ordering::Relaxed);
                if let Some(frame) = claimed {
                    state.flights.join(tag.0, seat);
                    return Ok(Admission::Load { frame, page_bytes });
                }
                let waited = exhausted_since.get_or_insert_with(Instant::now).elapsed();
                if waited > EVICTABLE_WAIT {
                    return Err(CacheError::Exhausted {
                        kind,
                        waited_ms: waited.as_millis() as u64,
                    });
                }
            }
            let changed = &self.pools[kind as usize].changed;
            state = changed
                .wait_timeout(state, EVICTABLE_POLL)
                .unwrap_or_else(PoisonError::into_inner)
                .0;
        }
    }

    fn add_resident(&self, bytes: u64) {
        let now = self.resident_bytes.fetch_add(bytes, Ordering::Relaxed) + bytes;
        self.resident_bytes_peak.fetch_max(now, Ordering::Relaxed);
    }
}

/// A load on its way: whatever becomes of the loader, the frame is published or freed and the followers wake.
struct Landing<'a> {
    owner: &'a CacheOwner,
    seat: Seat,
    key: PageKey,
    job: u64,
    frame: FrameId,
}

impl Landing<'_> {
    fn finish(self, outcome: Result<(), LoadError>) -> Result<(), CacheError> {
        let result = self.land(outcome);
        std::mem::forget(self);
        result
    }

    fn land(&self, outcome: Result<(), LoadError>) -> Result<(), CacheError> {
        let Self {
            owner,
            seat,
            key,
            job,
            frame,
        } = *self;
        let map = owner.segment.map();
        let mut state = owner.lock(key.kind);
        let outcome = outcome.map_err(CacheError::from).and_then(|()| state.check_mount(key));
        match &outcome {
            Ok(page_bytes) => {
                owner.add_resident(*page_bytes as u64);
                state.settle(map, key, frame, job, seat, *page_bytes);
            }
            Err(error) => state.give_up(map, key, frame, error),
        }
        drop(state);
        owner.pools[key.kind as usize].changed.notify_all();
        outcome?;
        // The page is in either way; the pin is not, if the worker died meanwhile.
        owner.lock(key.kind).check_seat(seat)
    }
}

impl Drop for Landing<'_> {
    fn drop(&mut self) {
        let panicked = LoadError::new(LoadErrorKind::Internal, "the page loader panicked");
        let _ = self.land(Err(panicked));
    }
}
