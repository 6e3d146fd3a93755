//! A worker's own cache: an exact LRU of pins on frames of the shared cache, never copies.
//!
//! A repeated hit costs a few nanoseconds and writes nothing shared: a small direct-mapped table answers it. Such
//! hits only leave a time stamp there; before anything is evicted the stamps are replayed, oldest first, into the LRU
//! order, which is therefore exact.

use crate::attach::CacheView;
use crate::error::CacheError;
use crate::frame::{FrameId, Tag};
use crate::layout::{KINDS, PoolLayout};
use lru::LruCache;
use pbgi_core::{MountId, PageKey, PageKind};
use std::hash::{BuildHasherDefault, Hasher};
use std::num::NonZeroUsize;

/// Entries of the front table, per pool: 16 KiB, which stay in the processor's nearest caches.
const FRONT: usize = 512;

/// A worker's local cache over its [`CacheView`].
#[derive(Debug)]
pub struct LocalCache {
    view: CacheView,
    pools: [LocalPool; 2],
    job: u64,
    counters: LocalCounters,
}

/// Where pages were found. A page that was found nowhere is a miss, and is then adopted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LocalCounters {
    /// In the local cache.
    pub local_hits: u64,
    /// In the shared cache, without asking the owner.
    pub shared_hits: u64,
    /// Of the shared hits, those on pages that another job loaded.
    pub shared_hits_other_job: u64,
    /// Nowhere: the owner has to be asked.
    pub misses: u64,
    /// Pins given up to make room.
    pub evictions: u64,
}

impl LocalCache {
    /// An empty cache. Its capacities are the layout's `local_frames`.
    pub fn new(view: CacheView) -> Self {
        let pools = KINDS.map(|kind| LocalPool::new(view.layout().pool(kind)));
        Self {
            view,
            pools,
            job: 0,
            counters: LocalCounters::default(),
        }
    }

    /// Sets the number of the job that lookups are made for; it tells own pages from other jobs' in the counters.
    pub fn set_job(&mut self, job: u64) {
        self.job = job;
    }

    /// The page, if it is in the local or in the shared cache; then it is pinned, and most recently used.
    ///
    /// The slice is a whole frame, aligned to 4,096 bytes: cut it to the scene's page size before casting it to
    /// records.
    #[inline]
    pub fn get(&mut self, key: PageKey) -> Option<&[u8]> {
        let tag = Tag::resident(key);
        let pool = &mut self.pools[key.kind as usize];
        let entry = &mut pool.front[front_index(tag)];
        if entry.tag == tag {
            pool.now += 1;
            entry.stamp = pool.now;
            pool.last = entry.held;
            self.counters.local_hits += 1;
        } else {
            self.find(key)?;
        }
        Some(self.last(key.kind))
    }

    /// The page of a kind that [`Self::get`] gave last, or nothing if it is no longer held; it is not counted as a use.
    #[inline(always)]
    pub fn last(&self, kind: PageKind) -> &[u8] {
        let pool = &self.pools[kind as usize];
        // SAFETY: Rule 4: the frame is in the local cache, so its pin is held, or `release` would have forgotten it here;
        // pins are given up only by methods that borrow `self` exclusively, which the result's lifetime forbids.
        unsafe { pool.bytes(pool.last) }
    }

    /// The page, if it is in the local cache; it is not counted as a use.
    pub fn peek(&self, key: PageKey) -> Option<&[u8]> {
        let tag = Tag::resident(key);
        let pool = &self.pools[key.kind as usize];
        let entry = &pool.front[front_index(tag)];
        let held = if entry.tag == tag {
            entry.held
        } else {
            *pool.lru.peek(&tag)?
        };
        // SAFETY: Rule 4, as in `last`.
        Some(unsafe { pool.bytes(held) })
    }

    /// Makes room for `count` pages of a kind (at most the capacity, so a request has no more either): **before** the
    /// owner is asked for them, since it pins them in this worker's name and refuses to exceed the capacity (Rule
    /// 10).
    pub fn reserve(&mut self, kind: PageKind, count: usize) {
        let pool = &mut self.pools[kind as usize];
        let capacity = pool.lru.cap().get();
        let keep = capacity - count.min(capacity);
        if pool.lru.len() > keep {
            pool.replay();
        }
        while self.pools[kind as usize].lru.len() > keep
            && let Some((tag, held)) = self.pools[kind as usize].lru.pop_lru()
        {
            self.release(kind, tag, held);
        }
    }

    /// Gives up the pins on scenes that `keep` does not want: the owner frees an unmounted scene only as they go.
    pub fn retain(&mut self, keep: impl Fn(MountId) -> bool) {
        for kind in KINDS {
            let pool = &mut self.pools[kind as usize];
            pool.replay();
            let gone: Vec<Tag> = pool
                .lru
                .iter()
                .map(|(&tag, _)| tag)
                .filter(|tag| !keep(tag.mount()))
                .collect();
            for tag in gone {
                if let Some(held) = self.pools[kind as usize].lru.pop(&tag) {
                    self.release(kind, tag, held);
                }
            }
        }
    }

    /// Unpins a frame that the LRU has let go of.
    fn release(&mut self, kind: PageKind, tag: Tag, held: Held) {
        let pool = &mut self.pools[kind as usize];
        let entry = &mut pool.front[front_index(tag)];
        if entry.tag == tag {
            *entry = FrontEntry::EMPTY;
        }
        if pool.last.frame == held.frame {
            pool.last = Held::NONE;
        }
        self.view.unpin(kind, held.frame);
        self.counters.evictions += 1;
    }

    /// Takes over a page that the owner pinned in this worker's name. Fails if the owner did no such thing.
    pub fn adopt(&mut self, key: PageKey, frame: FrameId) -> Result<(), CacheError> {
        let tag = Tag::resident(key);
        if self.pools[key.kind as usize].lru.contains(&tag) {
            return Ok(()); // Asked for although held, or twice: one page, one frame, one bit.
        }
        if !self.view.holds(key, frame) {
            return Err(CacheError::Malformed {
                message: "page reply",
                what: format!("frame {} does not hold {} page {}", frame.0, key.kind, key.page.0),
            });
        }
        self.insert(key.kind, tag, frame);
        Ok(())
    }

    /// Gives up every pin.
    pub fn clear(&mut self) {
        for kind in KINDS {
            self.reserve(kind, usize::MAX);
        }
    }

    /// Pages held.
    pub fn len(&self, kind: PageKind) -> usize {
        self.pools[kind as usize].lru.len()
    }

    /// Whether no page is held.
    pub fn is_empty(&self) -> bool {
        self.pools.iter().all(|pool| pool.lru.is_empty())
    }

    /// Pages that may be held.
    pub fn capacity(&self, kind: PageKind) -> usize {
        self.pools[kind as usize].lru.cap().get()
    }

    /// The counters since the cache was made or they were last taken.
    pub fn counters(&self) -> LocalCounters {
        self.counters
    }

    /// Takes the counters and starts them anew.
    pub fn take_counters(&mut self) -> LocalCounters {
        std::mem::take(&mut self.counters)
    }

    /// The view underneath.
    pub fn view(&self) -> &CacheView {
        &self.view
    }

    /// Looks where the front table does not: in the LRU, then in the shared cache. What is found is the last page.
    #[inline(never)]
    fn find(&mut self, key: PageKey) -> Option<()> {
        let tag = Tag::resident(key);
        let pool = &mut self.pools[key.kind as usize];
        if let Some(&held) = pool.lru.peek(&tag) {
            self.counters.local_hits += 1;
            pool.put_in_front(tag, held);
            pool.last = held;
            return Some(());
        }
        // Rule 10: room first, so that not even for a moment more is pinned than may be. A miss needs the room as well.
        self.reserve(key.kind, 1);
        let Some(frame) = self.view.find_and_pin(key) else {
            self.counters.misses += 1;
            return None;
        };
        self.counters.shared_hits += 1;
        self.counters.shared_hits_other_job += u64::from(self.view.job(key.kind, frame) != self.job);
        self.pools[key.kind as usize].last = self.insert(key.kind, tag, frame);
        Some(())
    }

    /// Takes a pinned frame into the LRU.
    fn insert(&mut self, kind: PageKind, tag: Tag, frame: FrameId) -> Held {
        self.reserve(kind, 1);
        // SAFETY: Rule 4: the frame is pinned. Its address outlives the slice, and is followed under the same rule.
        let start = unsafe { self.view.frame(kind, frame) }.as_ptr();
        let held = Held { frame, start };
        let pool = &mut self.pools[kind as usize];
        pool.replay();
        pool.lru.push(tag, held);
        pool.put_in_front(tag, held);
        held
    }
}

impl Drop for LocalCache {
    fn drop(&mut self) {
        self.clear();
    }
}

#[derive(Debug)]
struct LocalPool {
    lru: LruCache<Tag, Held, BuildHasherDefault<TagHasher>>,
    front: Box<[FrontEntry; FRONT]>,
    /// Stamps of entries that lost their place in the front table, not yet replayed.
    displaced: Vec<(u64, Tag)>,
    now: u64,
    replayed: u64,
    /// What was given out last, while it is held.
    last: Held,
    frame_bytes: usize,
}

/// A frame that this worker pins, and where it is, so that a hit computes nothing.
#[derive(Clone, Copy, Debug)]
struct Held {
    frame: FrameId,
    start: *const u8,
}

// SAFETY: numbers. The address is followed only under Rule 4, on whatever thread.
unsafe impl Send for Held {}

impl Held {
    const NONE: Self = Self {
        frame: FrameId(u32::MAX),
        start: std::ptr::null(),
    };
}

#[derive(Clone, Copy, Debug)]
struct FrontEntry {
    tag: Tag,
    stamp: u64,
    held: Held,
}

impl FrontEntry {
    const EMPTY: Self = Self {
        tag: Tag::EMPTY,
        stamp: 0,
        held: Held::NONE,
    };
}

impl LocalPool {
    fn new(layout: &PoolLayout) -> Self {
        let capacity = NonZeroUsize::new(layout.local_frames as usize).unwrap_or(NonZeroUsize::MIN);
        Self {
            lru: LruCache::with_hasher(capacity, BuildHasherDefault::default()),
            front: Box::new([FrontEntry::EMPTY; FRONT]),
            displaced: Vec::with_capacity(FRONT),
            now: 0,
            replayed: 0,
            last: Held::NONE,
            frame_bytes: layout.frame_bytes,
        }
    }

    /// The bytes of a frame; none of [`Held::NONE`].
    ///
    /// # Safety
    ///
    /// The frame is pinned (Rule 4) as long as the result lives.
    #[inline(always)]
    unsafe fn bytes(&self, held: Held) -> &[u8] {
        if held.start.is_null() {
            return &[];
        }
        // SAFETY: Rules 4 and 9: the view gave the address out for a frame of this pool, which is `frame_bytes` long.
        unsafe { std::slice::from_raw_parts(held.start, self.frame_bytes) }
    }

    fn put_in_front(&mut self, tag: Tag, held: Held) {
        let index = front_index(tag);
        let old = self.front[index];
        if old.stamp > self.replayed {
            if self.displaced.len() == FRONT {
                self.replay();
            } else {
                self.displaced.push((old.stamp, old.tag));
            }
        }
        self.now += 1;
        self.front[index] = FrontEntry {
            tag,
            stamp: self.now,
            held,
        };
    }

    /// Brings the LRU order up to date: promotes what was hit in the front table, in the order of the last hits.
    fn replay(&mut self) {
        if self.replayed == self.now {
            return;
        }
        let recent = self
            .front
            .iter()
            .filter(|entry| entry.stamp > self.replayed)
            .map(|entry| (entry.stamp, entry.tag));
        self.displaced.extend(recent);
        self.displaced.sort_unstable_by_key(|&(stamp, _)| stamp);
        for (_, tag) in self.displaced.drain(..) {
            self.lru.promote(&tag);
        }
        self.replayed = self.now;
    }
}

/// Neighbouring pages get neighbouring entries.
#[inline(always)]
fn front_index(tag: Tag) -> usize {
    tag.page().0 as usize % FRONT
}

/// Tags mix themselves.
#[derive(Default)]
struct TagHasher(u64);

impl Hasher for TagHasher {
    fn finish(&self) -> u64 {
        self.0
    }

    fn write(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            self.0 = self.0.rotate_left(8) ^ u64::from(byte);
        }
    }

    fn write_u64(&mut self, word: u64) {
        self.0 = u64::from(Tag(word).hash32()) << 32 | u64::from(Tag(word).hash32());
    }
}
