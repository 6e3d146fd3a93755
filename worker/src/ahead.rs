//! Which pages a walk is about to need: it says where it will probably go, and what is not at hand of that is asked for together
//! with the page that is missing, so that a cold walk waits once for several pages.
//!
//! Only while pages come slowly, from a disk: one that the operating system holds comes sooner than the walk has told its way.

use crate::view::{Place, SceneView};
use pbgi_cache::LocalCache;
use pbgi_cache::channel::REQUEST_PAGES_MAX;
use pbgi_core::{NodeIndex, NodeRecord, PageKey, PageKind};
use pbgi_shade::{Upcoming, Wanted};
use std::ops::ControlFlow;
use std::time::Duration;

/// A request takes this share of the local cache at most, where that has no free room: a walk is not always right.
const SHARE: usize = 8;

/// What a request costs, and each of its pages, when the operating system holds them; a request that takes longer waited for
/// a disk.
const QUICK: (Duration, Duration) = (Duration::from_micros(60), Duration::from_micros(20));

/// Whether a request for this many pages waited for a disk.
pub(crate) fn waited_for_disk(pages: usize, took: Duration) -> bool {
    took > QUICK.0 + QUICK.1 * pages as u32
}

/// The pages to ask for when `missing` is: that first, then those wanted soon, soonest first.
pub(crate) fn request(
    cache: &LocalCache,
    scene: &SceneView,
    missing: PageKey,
    upcoming: &impl Upcoming,
) -> Vec<PageKey> {
    let mut keys = Vec::with_capacity(REQUEST_PAGES_MAX);
    keys.push(missing);
    let peek = |index: NodeIndex| {
        let place = scene.place(PageKind::Node, index.0)?;
        let start = place.slot as usize * size_of::<NodeRecord>();
        let bytes = cache.peek(place.key)?.get(start..start + size_of::<NodeRecord>())?;
        bytemuck::try_from_bytes(bytes).ok()
    };
    let want = |wanted| {
        let place = match wanted {
            Wanted::Node(index) => scene.place(PageKind::Node, index.0),
            Wanted::Points(index) => scene.place(PageKind::Point, index.0),
        };
        if let Some(Place { key, .. }) = place {
            let asked = keys.iter().filter(|asked| asked.kind == key.kind).count();
            if asked < room(cache, key.kind) && !keys.contains(&key) && cache.peek(key).is_none() {
                keys.push(key);
            }
        }
        match keys.len() {
            REQUEST_PAGES_MAX => ControlFlow::Break(()),
            _ => ControlFlow::Continue(()),
        }
    };
    // Broken off or not: the request is what it is.
    let _ = upcoming.tell(peek, want);
    keys
}

/// Pages of a kind that one request may bring.
fn room(cache: &LocalCache, kind: PageKind) -> usize {
    let capacity = cache.capacity(kind);
    (capacity - cache.len(kind)).max(capacity / SHARE)
}
