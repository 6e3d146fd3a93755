//! One pool as its owner sees it, behind one lock: what is resident where, what is being loaded, what is free.

use crate::counters::{Bitmap, JobRecord, PoolCounters, SceneCounters};
use crate::error::CacheError;
use crate::flight::Flights;
use crate::frame::{FrameId, Tag, TagState};
use crate::layout::SegmentLayout;
use crate::ledger::{Ledgers, word_and_mask};
use crate::map::SegmentMap;
use crate::owner::{JOBS_MAX, Origin, Seat};
use crate::page_table;
use crate::protocol::{FullFence, load_tag, owner_pin, publish, try_claim};
use crate::quota::{Holding, Room, room};
use crate::victim::{Among, Clock};
use pbgi_core::limits::MOUNTS_MAX;
use pbgi_core::{MountId, PageKey, PageKind};
use std::collections::HashMap;
use std::sync::atomic::Ordering;
use std::sync::{Condvar, Mutex};

/// A pool's lock, and the signal that a load ended or pins went.
#[derive(Debug)]
pub(crate) struct Pool {
    pub(crate) state: Mutex<PoolState>,
    pub(crate) changed: Condvar,
}

/// What the lock protects; claims run under it, so one at a time (Rules 1 and 7).
#[derive(Debug)]
pub(crate) struct PoolState {
    kind: PageKind,
    workers: u8,
    frames: u32,
    local_frames: u32,
    loads_max: usize,
    pub(crate) epochs: Vec<u32>,
    pub(crate) flights: Flights<Result<FrameId, CacheError>, Seat>,
    pub(crate) jobs: HashMap<u64, JobRecord>,
    mounts: Vec<Option<Mount>>,
    free: Vec<FrameId>,
    doomed: Vec<FrameId>,
    /// Bytes of the page in each frame.
    page_bytes: Vec<u32>,
    clock: Clock,
    counters: PoolCounters,
}

/// A scene's pages of this kind.
#[derive(Debug)]
struct Mount {
    generation: u16,
    page_bytes: usize,
    pages: u64,
    /// Pages loaded at least once.
    known: Bitmap,
    /// Pages resident now: kept apart from tags and table, to notice a second read that these would not.
    resident: Bitmap,
    /// Frames that hold its pages.
    frames: Bitmap,
    /// The pool's loads when it last asked for a page.
    asked_at: u64,
    counters: SceneCounters,
}

impl PoolState {
    pub(crate) fn new(kind: PageKind, layout: &SegmentLayout) -> Self {
        let pool = layout.pool(kind);
        Self {
            kind,
            workers: layout.workers() as u8,
            frames: pool.frames,
            local_frames: pool.local_frames,
            loads_max: layout.loads_in_flight_max() as usize,
            epochs: vec![0; layout.workers() as usize],
            flights: Flights::default(),
            jobs: HashMap::new(),
            mounts: (0..MOUNTS_MAX).map(|_| None).collect(),
            free: (0..pool.frames).rev().map(FrameId).collect(),
            doomed: Vec::new(),
            page_bytes: vec![0; pool.frames as usize],
            clock: Clock::default(),
            counters: PoolCounters::default(),
        }
    }

    // Checks

    pub(crate) fn check_seat(&self, seat: Seat) -> Result<(), CacheError> {
        match self.epochs.get(usize::from(seat.slot)) {
            Some(&epoch) if epoch == seat.epoch => Ok(()),
            _ => Err(CacheError::StaleSeat {
                slot: seat.slot,
                epoch: seat.epoch,
            }),
        }
    }

    /// The bytes of the page, if the scene is mounted and has it.
    pub(crate) fn check_mount(&self, key: PageKey) -> Result<usize, CacheError> {
        let mount = self.mounts.get(usize::from(key.mount.slot)).and_then(Option::as_ref);
        let mount = mount.filter(|mount| mount.generation == key.mount.generation);
        let mount = mount.ok_or(CacheError::NotMounted(key.mount))?;
        if u64::from(key.page.0) >= mount.pages {
            return Err(CacheError::PageOutOfRange {
                kind: self.kind,
                page: key.page.0,
                pages: mount.pages,
            });
        }
        Ok(mount.page_bytes)
    }

    pub(crate) fn check(&self, seat: Seat, key: PageKey) -> Result<usize, CacheError> {
        self.check_seat(seat)?;
        self.check_mount(key)
    }

    /// Rule 10: a worker's pins never exceed its share.
    pub(crate) fn check_ledger(&self, map: &SegmentMap, seat: Seat) -> Result<(), CacheError> {
        let pins = map
            .pins(seat.slot, self.kind)
            .iter()
            .map(|word| word.load(Ordering::Relaxed).count_ones())
            .sum();
        if pins < self.local_frames {
            return Ok(());
        }
        Err(CacheError::LedgerFull {
            slot: seat.slot,
            kind: self.kind,
            pins,
            limit: self.local_frames,
        })
    }

    // Finding and pinning

    /// The frame of a resident page. Under the lock nothing is being evicted, so this never misses one.
    pub(crate) fn find(&self, map: &SegmentMap, tag: Tag) -> Option<FrameId> {
        let headers = map.frame_headers(self.kind);
        page_table::find(map.table(self.kind), tag.hash32(), |frame| {
            load_tag(&headers[frame.0 as usize].tag) == tag
        })
    }

    /// Pins a resident page for a worker (Rule 7).
    pub(crate) fn pin(&self, map: &SegmentMap, seat: Seat, frame: FrameId) -> Result<(), CacheError> {
        let (word, mask) = word_and_mask(frame);
        if map.pins(seat.slot, self.kind)[word].load(Ordering::Relaxed) & mask == 0 {
            self.check_ledger(map, seat)?;
            pin(map, self.kind, seat.slot, frame);
        }
        Ok(())
    }

    // Loading

    /// Claims a frame to load the page of `tag` into; also the bytes that its old page, and others swept on the way,
    /// gave back.
    pub(crate) fn claim(&mut self, map: &SegmentMap, tag: Tag) -> (Option<FrameId>, u64) {
        let mut freed = 0;
        if self.free.is_empty() {
            freed += self.sweep(map);
        }
        let loading = tag.with_state(TagState::Loading);
        if let Some(frame) = self.free.pop() {
            publish(&map.frame_header(self.kind, frame).tag, loading);
            return (Some(frame), freed);
        }
        let (kind, headers) = (self.kind, map.frame_headers(self.kind));
        let ledgers = Ledgers {
            map,
            kind,
            workers: self.workers,
        };
        let mut old = Tag::EMPTY;
        let mut claim = |frame: FrameId| {
            let header = &headers[frame.0 as usize];
            old = load_tag(&header.tag);
            let (word, mask) = word_and_mask(frame);
            old.state() == TagState::Resident
                && try_claim::<FullFence>(&header.tag, old, loading, ledgers.pins(word), mask)
        };
        // Rule 12: where the quota points first; where everything is pinned there, anywhere.
        let among = match self.room(tag.mount().slot) {
            Room::Of(slot) => self.mounts[usize::from(slot)].as_ref(),
            Room::Anywhere => None,
        };
        let (clock, frames) = (&mut self.clock, self.frames);
        let victim = among
            .and_then(|mount| {
                let usage = Among {
                    usage: &ledgers,
                    frames: &mount.frames,
                };
                clock.victim(frames, &usage, &mut claim)
            })
            .or_else(|| clock.victim(frames, &ledgers, &mut claim));
        if let Some(frame) = victim {
            freed += self.forget(map, old, frame);
            self.counters.evictions += 1;
            if let Some(Some(mount)) = self.mounts.get_mut(usize::from(old.mount().slot)) {
                mount.counters.evictions += 1;
            }
        }
        (victim, freed)
    }

    /// Whose frame a load for the scene in `slot` takes.
    fn room(&self, slot: u8) -> Room {
        let now = self.counters.loads;
        let holdings: Vec<Holding> = (0..)
            .zip(&self.mounts)
            .filter_map(|(slot, mount)| {
                let mount = mount.as_ref()?;
                Some(Holding {
                    slot,
                    frames: mount.counters.resident as u32,
                    at_work: now - mount.asked_at < u64::from(self.frames),
                })
            })
            .collect();
        room(self.frames, slot, &holdings)
    }

    /// Publishes a loaded page, with the pins of everyone who waited for it.
    pub(crate) fn settle(
        &mut self,
        map: &SegmentMap,
        key: PageKey,
        frame: FrameId,
        job: u64,
        seat: Seat,
        page_bytes: usize,
    ) {
        let (kind, tag) = (self.kind, Tag::resident(key));
        let header = map.frame_header(kind, frame);
        header.job.store(job, Ordering::Relaxed);
        if self.check_seat(seat).is_ok() {
            pin(map, kind, seat.slot, frame);
        }
        // Rule 6: the bytes and the pins come before the tag, the tag before the table.
        publish(&header.tag, tag);
        page_table::insert(map.table(kind), tag.hash32(), frame);
        self.page_bytes[frame.0 as usize] = page_bytes as u32;
        if let Some(Some(mount)) = self.mounts.get_mut(usize::from(key.mount.slot)) {
            mount.frames.set(frame.0);
        }
        let epochs = &self.epochs;
        self.flights.land(tag.0, Ok(frame), |seat| {
            if epochs.get(usize::from(seat.slot)) == Some(&seat.epoch) {
                pin(map, kind, seat.slot, frame);
            }
        });
        self.count_load(key, job, page_bytes as u64);
    }

    /// Frees the frame of a load that failed, and tells everyone who waited for it.
    pub(crate) fn give_up(&mut self, map: &SegmentMap, key: PageKey, frame: FrameId, error: &CacheError) {
        publish(&map.frame_header(self.kind, frame).tag, Tag::EMPTY);
        self.free.push(frame);
        self.counters.failed_loads += 1;
        self.flights.land(Tag::resident(key).0, Err(error.clone()), drop);
    }

    /// Takes a page out of the books; its frame is claimed already. Returns its bytes.
    fn forget(&mut self, map: &SegmentMap, tag: Tag, frame: FrameId) -> u64 {
        page_table::remove(map.table(self.kind), tag.hash32(), frame);
        if let Some(Some(mount)) = self.mounts.get_mut(usize::from(tag.mount().slot))
            && mount.generation == tag.mount().generation
        {
            mount.resident.clear(tag.page().0);
            mount.frames.clear(frame.0);
            mount.counters.resident -= 1;
        }
        self.counters.resident -= 1;
        u64::from(self.page_bytes[frame.0 as usize])
    }

    // Mounts

    /// Loads in flight for a scene.
    fn loads_of(&self, mount: MountId) -> usize {
        self.flights.count(|key| Tag(key).mount() == mount)
    }

    /// Whether another load may start: one scene on slow storage takes half of the loads at most, so that the others
    /// keep flowing.
    pub(crate) fn has_load_for(&self, mount: MountId) -> bool {
        self.flights.len() < self.loads_max && self.loads_of(mount) < self.loads_max.div_ceil(2)
    }

    /// Whether the slot is empty and no page of an earlier scene of the same generation is left.
    pub(crate) fn mount_is_free(&self, map: &SegmentMap, mount: MountId) -> bool {
        let of_mount = |&frame: &FrameId| load_tag(&map.frame_header(self.kind, frame).tag).mount() == mount;
        let free = matches!(self.mounts.get(usize::from(mount.slot)), Some(None));
        free && !self.doomed.iter().any(of_mount) && self.loads_of(mount) == 0
    }

    pub(crate) fn mount(&mut self, mount: MountId, page_bytes: usize, pages: u64) {
        self.mounts[usize::from(mount.slot)] = Some(Mount {
            generation: mount.generation,
            page_bytes,
            pages,
            known: Bitmap::default(),
            resident: Bitmap::default(),
            frames: Bitmap::default(),
            asked_at: self.counters.loads,
            counters: SceneCounters {
                pages,
                ..SceneCounters::default()
            },
        });
    }

    /// Drops the pages of a scene; those that are pinned become doomed. Returns the bytes freed.
    pub(crate) fn unmount(&mut self, map: &SegmentMap, mount: MountId) -> u64 {
        match self.mounts.get_mut(usize::from(mount.slot)) {
            Some(seat @ Some(_)) if seat.as_ref().is_some_and(|seat| seat.generation == mount.generation) => {
                *seat = None
            }
            _ => return 0,
        }
        for frame in (0..self.frames).map(FrameId) {
            let header = map.frame_header(self.kind, frame);
            let tag = load_tag(&header.tag);
            if tag.state() == TagState::Resident && tag.mount() == mount {
                self.forget(map, tag, frame);
                publish(&header.tag, tag.with_state(TagState::Doomed));
                self.doomed.push(frame);
            }
        }
        self.sweep(map)
    }

    /// Frees doomed frames that nobody pins any more; returns their bytes.
    pub(crate) fn sweep(&mut self, map: &SegmentMap) -> u64 {
        let ledgers = Ledgers {
            map,
            kind: self.kind,
            workers: self.workers,
        };
        let mut freed = 0;
        self.doomed.retain(|&frame| {
            let tag = &map.frame_header(self.kind, frame).tag;
            let (word, mask) = word_and_mask(frame);
            let claimed = try_claim::<FullFence>(tag, load_tag(tag), Tag::EMPTY, ledgers.pins(word), mask);
            if claimed {
                freed += u64::from(self.page_bytes[frame.0 as usize]);
                self.free.push(frame);
            }
            !claimed
        });
        freed
    }

    // Counting

    pub(crate) fn counters(&self) -> PoolCounters {
        let (frames, doomed, loading) = (
            u64::from(self.frames),
            self.doomed.len() as u64,
            self.flights.len() as u64,
        );
        PoolCounters {
            frames,
            doomed,
            loading,
            ..self.counters
        }
    }

    /// The counters of a mounted scene.
    pub(crate) fn scene_counters(&self, id: MountId) -> Option<SceneCounters> {
        let mount = self.mounts.get(usize::from(id.slot))?.as_ref()?;
        (mount.generation == id.generation).then_some(mount.counters)
    }

    pub(crate) fn count_fetch(&mut self, seat: Seat, key: PageKey, job: u64) -> Result<(), CacheError> {
        self.check(seat, key)?;
        if self.jobs.len() >= JOBS_MAX && !self.jobs.contains_key(&job) {
            return Err(CacheError::TooManyJobs { limit: JOBS_MAX });
        }
        self.counters.fetches += 1;
        let loads = self.counters.loads;
        if let Some(Some(mount)) = self.mounts.get_mut(usize::from(key.mount.slot)) {
            mount.asked_at = loads;
            mount.counters.fetches += 1;
        }
        self.jobs.entry(job).or_default().counters.fetches += 1;
        Ok(())
    }

    pub(crate) fn count_hit(&mut self, map: &SegmentMap, frame: FrameId, job: u64, resident: bool) -> Origin {
        if resident {
            self.counters.resident_hits += 1;
        } else {
            self.counters.joined += 1;
        }
        let own = map.frame_header(self.kind, frame).job.load(Ordering::Relaxed) == job;
        self.counters.hits_other_job += u64::from(!own);
        let record = &mut self.jobs.entry(job).or_default().counters;
        record.resident_hits += 1;
        record.hits_other_job += u64::from(!own);
        if own {
            Origin::Resident
        } else {
            Origin::ResidentOtherJob
        }
    }

    fn count_load(&mut self, key: PageKey, job: u64, bytes: u64) {
        self.counters.loads += 1;
        self.counters.bytes_loaded += bytes;
        self.counters.resident += 1;
        let Some(Some(mount)) = self.mounts.get_mut(usize::from(key.mount.slot)) else {
            return;
        };
        let page = key.page.0;
        let redundant = u64::from(mount.resident.set(page));
        let reload = u64::from(mount.known.set(page));
        mount.counters.resident += 1;
        mount.counters.loads += 1;
        mount.counters.reloads += reload;
        mount.counters.redundant_reads += redundant;
        self.counters.redundant_reads += redundant;
        self.counters.reloads += reload;
        let record = self.jobs.entry(job).or_default();
        record.counters.redundant_reads += redundant;
        record.counters.reloads += reload;
        record.loaded(key.mount, page, bytes);
    }
}

/// Sets a worker's pin for it, and its touched bit (Rules 7 and 11).
fn pin(map: &SegmentMap, kind: PageKind, slot: u8, frame: FrameId) {
    let (word, mask) = word_and_mask(frame);
    owner_pin(&map.pins(slot, kind)[word], mask);
    map.touched(slot, kind)[word].fetch_or(mask, Ordering::Relaxed);
}
