//! What the owner counts, and the bitmaps of pages it needs for that.

use pbgi_core::MountId;
use std::collections::HashMap;

/// Counters of one pool.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PoolCounters {
    /// Frames of the pool.
    pub frames: u64,
    /// Frames that hold a page.
    pub resident: u64,
    /// Frames that hold a page of a scene no longer mounted, for the pins that are left.
    pub doomed: u64,
    /// Loads in flight.
    pub loading: u64,
    /// Pages asked for.
    pub fetches: u64,
    /// Of these, pages that were resident already.
    pub resident_hits: u64,
    /// Of these, pages that another request was loading already.
    pub joined: u64,
    /// Of the resident and joined, pages that another job loaded.
    pub hits_other_job: u64,
    /// Pages loaded.
    pub loads: u64,
    /// Bytes of the pages loaded.
    pub bytes_loaded: u64,
    /// Loads that failed.
    pub failed_loads: u64,
    /// Pages that were loaded, evicted and loaded again.
    pub reloads: u64,
    /// Loads of a page that was resident or pinned: always 0.
    pub redundant_reads: u64,
    /// Pages evicted to make room.
    pub evictions: u64,
}

/// Counters of the cache.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CacheCounters {
    /// The pool of node pages.
    pub node: PoolCounters,
    /// The pool of point pages.
    pub point: PoolCounters,
    /// Bytes of the pages held now.
    pub resident_bytes: u64,
    /// Most bytes of pages held at a time.
    pub resident_bytes_peak: u64,
}

/// What one scene has of a pool, and what was done for it since it was mounted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SceneCounters {
    /// Pages of its file.
    pub pages: u64,
    /// Of these, pages held now.
    pub resident: u64,
    /// Pages asked for.
    pub fetches: u64,
    /// Pages loaded.
    pub loads: u64,
    /// Of these, pages that had been loaded before and evicted.
    pub reloads: u64,
    /// Loads of a page that was resident or pinned: always 0.
    pub redundant_reads: u64,
    /// Pages evicted to make room.
    pub evictions: u64,
}

/// What one job asked of the owner, both kinds of pages together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct JobCounters {
    /// Pages asked for.
    pub fetches: u64,
    /// Of these, pages that were resident, or being loaded, already.
    pub resident_hits: u64,
    /// Of these, pages that another job loaded.
    pub hits_other_job: u64,
    /// Pages loaded for this job.
    pub loads: u64,
    /// Bytes of the pages loaded for this job.
    pub bytes_loaded: u64,
    /// Pages that were loaded, evicted and loaded again, for whichever job the first time.
    pub reloads: u64,
    /// Different pages loaded for this job.
    pub distinct_pages: u64,
    /// Bytes of these.
    pub distinct_bytes: u64,
    /// Loads of a page that was resident or pinned: always 0.
    pub redundant_reads: u64,
}

impl JobCounters {
    pub(crate) fn add(&mut self, other: &Self) {
        self.fetches += other.fetches;
        self.resident_hits += other.resident_hits;
        self.hits_other_job += other.hits_other_job;
        self.loads += other.loads;
        self.bytes_loaded += other.bytes_loaded;
        self.reloads += other.reloads;
        self.distinct_pages += other.distinct_pages;
        self.distinct_bytes += other.distinct_bytes;
        self.redundant_reads += other.redundant_reads;
    }
}

/// What is remembered of a job, per pool.
#[derive(Debug, Default)]
pub(crate) struct JobRecord {
    pub(crate) counters: JobCounters,
    loaded: HashMap<MountId, Bitmap>,
}

impl JobRecord {
    /// Counts a page of this job as loaded.
    pub(crate) fn loaded(&mut self, mount: MountId, page: u32, bytes: u64) {
        self.counters.loads += 1;
        self.counters.bytes_loaded += bytes;
        if !self.loaded.entry(mount).or_default().set(page) {
            self.counters.distinct_pages += 1;
            self.counters.distinct_bytes += bytes;
        }
    }
}

/// A set of page or frame numbers.
#[derive(Debug, Default)]
pub(crate) struct Bitmap(Vec<u64>);

impl Bitmap {
    /// Puts a page in; says whether it was in before.
    pub(crate) fn set(&mut self, page: u32) -> bool {
        let (word, mask) = (page as usize / 64, 1 << (page % 64));
        if word >= self.0.len() {
            self.0.resize(word + 1, 0);
        }
        let before = self.0[word] & mask != 0;
        self.0[word] |= mask;
        before
    }

    /// The members from `64 * word` on.
    pub(crate) fn word(&self, word: usize) -> u64 {
        self.0.get(word).copied().unwrap_or(0)
    }

    /// Takes a page out.
    pub(crate) fn clear(&mut self, page: u32) {
        if let Some(word) = self.0.get_mut(page as usize / 64) {
            *word &= !(1 << (page % 64));
        }
    }
}
