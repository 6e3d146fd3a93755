//! Which pages a walk is about to need: those that hold the children of the nodes it is about to look at. They are asked for
//! together with the next page that is missing, so that a cold walk waits once for several pages.
//!
//! Only while the local cache has room that nobody uses: not every child is looked at, and asking ahead at the expense of
//! other pages tripled the loads of a scene three times the size of the cache (the bench `cache`, `costs`, 2026-11).

use pbgi_cache::LocalCache;
use pbgi_cache::channel::REQUEST_PAGES_MAX;
use pbgi_core::{MountId, NodeIndex, NodeKind, NodeRecord, PageKey, PageKind, PageNo, SceneInfo};

/// Sibling groups that are looked at after a miss. When nothing has been missing for so long, looking ahead is a waste.
const GROUPS_AFTER_MISS: u32 = 1024;

/// Pages wanted soon.
#[derive(Debug, Default)]
pub(crate) struct Ahead {
    /// Newest last.
    wanted: Vec<PageKey>,
    groups_left: u32,
}

/// Where the records of a scene lie.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Paging {
    mount: MountId,
    nodes_per_page: u32,
    points_per_page: u32,
    node_slots: u64,
    point_count: u64,
}

impl Paging {
    pub(crate) fn new(scene: &SceneInfo, mount: MountId) -> Self {
        Self {
            mount,
            nodes_per_page: scene.settings.nodes_per_page,
            points_per_page: scene.settings.points_per_page,
            node_slots: scene.node_slots,
            point_count: scene.point_count,
        }
    }

    /// The page of a record; `None` if a forged scene points behind its end.
    fn page(&self, kind: PageKind, index: u32) -> Option<PageKey> {
        let (records, per_page) = match kind {
            PageKind::Node => (self.node_slots, self.nodes_per_page),
            PageKind::Point => (self.point_count, self.points_per_page),
        };
        (u64::from(index) < records).then(|| PageKey {
            mount: self.mount,
            kind,
            page: PageNo(index / per_page),
        })
    }
}

impl Ahead {
    /// The walk is about to look at the nodes from `first` on, one for each bit of `mask`.
    #[inline]
    pub(crate) fn expect(&mut self, cache: &LocalCache, paging: &Paging, first: NodeIndex, mask: u8) {
        if self.groups_left > 0 {
            self.look(cache, paging, first, mask);
        }
    }

    #[cold]
    fn look(&mut self, cache: &LocalCache, paging: &Paging, first: NodeIndex, mask: u8) {
        self.groups_left -= 1;
        let Some(key) = paging.page(PageKind::Node, first.0) else {
            return;
        };
        let Some(frame) = cache.peek(key) else {
            return self.want(key);
        };
        let slot = (first.0 % paging.nodes_per_page) as usize;
        let records = frame.chunks_exact(size_of::<NodeRecord>()).skip(slot);
        for bytes in records.take(mask.count_ones() as usize) {
            let Ok(node) = bytemuck::try_from_bytes::<NodeRecord>(bytes) else {
                continue;
            };
            let next = match node.kind() {
                NodeKind::Inner { first, .. } => paging.page(PageKind::Node, first.0),
                NodeKind::Leaf { first, .. } => paging.page(PageKind::Point, first.0),
                NodeKind::Overflow { .. } => None,
            };
            if let Some(next) = next.filter(|&next| next != key && cache.peek(next).is_none()) {
                self.want(next);
            }
        }
    }

    fn want(&mut self, key: PageKey) {
        if self.wanted.contains(&key) {
            return;
        }
        if self.wanted.len() == REQUEST_PAGES_MAX - 1 {
            self.wanted.remove(0);
        }
        self.wanted.push(key);
    }

    /// The pages to ask for with `missing`, which comes first. Looks ahead from now on, if there is room for what it finds.
    pub(crate) fn request(&mut self, cache: &LocalCache, missing: PageKey) -> Vec<PageKey> {
        let mut keys = vec![missing];
        for key in self.wanted.drain(..).rev() {
            let asked = keys.iter().filter(|asked| asked.kind == key.kind).count();
            if asked < room(cache, key.kind) && key != missing && cache.peek(key).is_none() {
                keys.push(key);
            }
        }
        let roomy = [PageKind::Node, PageKind::Point].map(|kind| room(cache, kind) > keys.len());
        self.groups_left = if roomy.contains(&true) { GROUPS_AFTER_MISS } else { 0 };
        keys
    }
}

/// Pages of a kind that the local cache takes without letting go of others.
fn room(cache: &LocalCache, kind: PageKind) -> usize {
    cache.capacity(kind) - cache.len(kind)
}
