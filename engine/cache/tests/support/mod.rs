//! Scenes whose pages say what they are, and workers over them.
#![allow(dead_code, reason = "each test binary uses a part")]

use pbgi_cache::{CacheOwner, CacheView, LoadError, LocalCache, PoolLayout, Segment, SegmentLayout};
use pbgi_core::{BuildId, BuildSettings, MountId, PageKey, PageKind, PageNo, SceneInfo};

pub(crate) const PAGE_BYTES: usize = 4096;
pub(crate) const PAGES: u32 = 4096;
pub(crate) const MOUNT: MountId = MountId { slot: 3, generation: 1 };
pub(crate) const OTHER_MOUNT: MountId = MountId { slot: 4, generation: 1 };

pub(crate) fn node(page: u32) -> PageKey {
    PageKey {
        mount: MOUNT,
        kind: PageKind::Node,
        page: PageNo(page),
    }
}

pub(crate) fn point(page: u32) -> PageKey {
    PageKey {
        kind: PageKind::Point,
        ..node(page)
    }
}

pub(crate) fn scene(pages: u32) -> SceneInfo {
    let settings = BuildSettings {
        nodes_per_page: 32,
        points_per_page: 128,
        ..BuildSettings::default()
    };
    let info = SceneInfo {
        build_id: BuildId(1),
        point_count: u64::from(pages) * 128,
        node_count: u64::from(pages) * 32,
        node_slots: u64::from(pages) * 32,
        root: None,
        bounds: None,
        quantizer: None,
        radius_max: 1.0,
        origin: [0.0; 3],
        settings,
    };
    assert_eq!(
        (info.page_bytes(PageKind::Node), info.page_bytes(PageKind::Point)),
        (PAGE_BYTES, PAGE_BYTES)
    );
    info
}

pub(crate) fn layout(workers: u32, frames: u32, local_frames: u32, loads: u32) -> SegmentLayout {
    let pool = PoolLayout {
        frame_bytes: PAGE_BYTES,
        frames,
        local_frames,
    };
    SegmentLayout::new(workers, loads, pool, pool).unwrap()
}

pub(crate) fn owner(workers: u32, frames: u32, local_frames: u32, loads: u32) -> CacheOwner {
    let layout = layout(workers, frames, local_frames, loads);
    let owner = CacheOwner::new(Segment::create(&Segment::unique_name().unwrap(), &layout).unwrap());
    owner.mount(MOUNT, &scene(PAGES)).unwrap();
    owner
}

pub(crate) fn view(owner: &CacheOwner, slot: u8) -> CacheView {
    CacheView::attach(owner.segment().name(), owner.layout().hash(), slot).unwrap()
}

pub(crate) fn worker(owner: &CacheOwner, slot: u8) -> LocalCache {
    LocalCache::new(view(owner, slot))
}

/// Each word of a page follows from its key and its place.
fn word(key: PageKey, index: usize) -> u64 {
    let id = u64::from(key.mount.slot) << 48 | u64::from(key.mount.generation) << 32 | u64::from(key.page.0);
    (id ^ (key.kind as u64) << 60)
        .wrapping_mul(0x9e37_79b9_7f4a_7c15)
        .wrapping_add(index as u64)
}

pub(crate) fn fill(page: &mut [u8], key: PageKey) -> Result<(), LoadError> {
    assert_eq!(page.len(), PAGE_BYTES);
    for (index, bytes) in page.chunks_exact_mut(8).enumerate() {
        bytes.copy_from_slice(&word(key, index).to_le_bytes());
    }
    Ok(())
}

pub(crate) fn matches(page: &[u8], key: PageKey) -> bool {
    let mut words = page[..PAGE_BYTES].chunks_exact(8).enumerate();
    words.all(|(index, bytes)| bytes == word(key, index).to_le_bytes())
}

#[track_caller]
pub(crate) fn check(page: &[u8], key: PageKey) {
    assert!(matches(page, key), "a wrong page for {key:?}");
}

/// Makes a page resident, pinned for a slot.
pub(crate) fn load(owner: &CacheOwner, slot: u8, key: PageKey, job: u64) {
    owner
        .fetch(owner.seat(slot).unwrap(), key, job, |page| fill(page, key))
        .unwrap();
}

/// What a worker does on a miss, without the channel.
pub(crate) fn fetch_into(owner: &CacheOwner, worker: &mut LocalCache, key: PageKey, job: u64) {
    worker.reserve(key.kind, 1);
    let seat = owner.seat(worker.view().slot()).unwrap();
    let fetched = owner.fetch(seat, key, job, |page| fill(page, key)).unwrap();
    worker.adopt(key, fetched.frame).unwrap();
}
