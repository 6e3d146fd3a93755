//! What a look at a page costs, beside a touch of the same bytes in memory, and what a miss costs beside reading the page.

use pbgi_cache::channel::{self, PageReply, PageRequest};
use pbgi_cache::{CacheOwner, CacheView, LocalCache, PoolLayout, Segment, SegmentLayout};
use pbgi_core::{MountId, NodeIndex, PageKey, PageKind, PageNo, PointIndex, SceneInfo};
use pbgi_shade::SceneSource;
use pbgi_store::Scene;
use pbgi_worker::pages::{PageSource, Pages, SceneView};
use std::hint::black_box;
use std::os::unix::net::UnixStream;
use std::time::Instant;

pub(crate) const MOUNT: MountId = MountId { slot: 0, generation: 1 };
/// The best of some rounds counts: others use the machine too.
const ROUNDS: usize = 7;
/// Pages that are hit by turns.
const HOT: u32 = 64;

/// Nanoseconds of one call.
fn nanos(calls: u32, mut call: impl FnMut(u32)) -> f64 {
    let mut round = || {
        let start = Instant::now();
        (0..calls).for_each(&mut call);
        start.elapsed().as_nanos() as f64 / f64::from(calls)
    };
    (0..ROUNDS).map(|_| round()).fold(f64::INFINITY, f64::min)
}

fn key(kind: PageKind, page: u32) -> PageKey {
    PageKey {
        mount: MOUNT,
        kind,
        page: PageNo(page),
    }
}

/// An owner of one scene, for one worker that may hold half of the frames.
pub(crate) fn owner(info: &SceneInfo, node_frames: u32, point_frames: u32) -> CacheOwner {
    let pool = |kind, frames: u32| PoolLayout {
        frame_bytes: info.page_bytes(kind),
        frames,
        local_frames: frames / 2,
    };
    let layout = SegmentLayout::new(
        1,
        1,
        pool(PageKind::Node, node_frames),
        pool(PageKind::Point, point_frames),
    );
    let segment = Segment::create(&Segment::unique_name().unwrap(), &layout.unwrap()).unwrap();
    let owner = CacheOwner::new(segment);
    owner.mount(MOUNT, info).unwrap();
    owner
}

/// Runs `work` as a worker whose misses a thread answers as the daemon does.
pub(crate) fn with_worker<T>(owner: &CacheOwner, scene: &Scene, work: impl FnOnce(Pages) -> T) -> T {
    let view = CacheView::attach(owner.segment().name(), owner.layout().hash(), 0).unwrap();
    with_channel(owner, scene, |channel| work(Pages::new(LocalCache::new(view), channel)))
}

/// Runs `work` with a page channel that a thread serves as the daemon does.
fn with_channel<T>(owner: &CacheOwner, scene: &Scene, work: impl FnOnce(UnixStream) -> T) -> T {
    let (ours, theirs) = UnixStream::pair().unwrap();
    std::thread::scope(|scope| {
        scope.spawn(move || {
            let seat = owner.seat(0).unwrap();
            let answer = |request: &PageRequest| {
                let fetch = |&key: &PageKey| {
                    owner.fetch(seat, key, request.job, |page| {
                        scene.read_page(key.kind, key.page, page).unwrap();
                        Ok(())
                    })
                };
                for key in request.keys.iter().skip(1) {
                    scene.will_need(key.kind, key.page);
                }
                PageReply::new(request.id, request.keys.iter().map(fetch))
            };
            channel::serve(&ours, answer).unwrap();
        });
        work(theirs)
    })
}

/// Prints the table.
pub(crate) fn print(scene: &Scene) {
    println!("costs, best of {ROUNDS} rounds");
    hits(scene);
    misses(scene);
    println!();
}

fn hits(scene: &Scene) {
    let owner = owner(scene.info(), 4 * HOT, 16);
    let bytes = scene.info().page_bytes(PageKind::Node);
    let seat = owner.seat(0).unwrap();
    let mut cache = LocalCache::new(CacheView::attach(owner.segment().name(), owner.layout().hash(), 0).unwrap());
    for page in 0..HOT {
        let key = key(PageKind::Node, page);
        let load = |buffer: &mut [u8]| {
            scene.read_page(key.kind, key.page, buffer).unwrap();
            Ok(())
        };
        let fetched = owner.fetch(seat, key, 1, load).unwrap();
        cache.adopt(key, fetched.frame).unwrap();
    }
    let plain: Vec<Vec<u8>> = (0..HOT).map(|page| vec![page as u8; bytes]).collect();
    let walk = |step: u32| step.wrapping_mul(29) % HOT;
    let touch = nanos(10_000_000, |step| {
        black_box(plain[walk(step) as usize][64]);
    });
    let hit = nanos(10_000_000, |step| {
        black_box(cache.get(key(PageKind::Node, walk(step))).map(|page| page[64]));
    });
    drop(cache);
    let mut view = CacheView::attach(owner.segment().name(), owner.layout().hash(), 0).unwrap();
    let pin = nanos(2_000_000, |step| {
        black_box(view.pin(key(PageKind::Node, walk(step))).map(|page| page[64]));
    });
    println!("  touch of a page in memory           {touch:9.1} ns");
    println!(
        "  local hit                           {hit:9.1} ns   {:+.1} above the touch",
        hit - touch
    );
    println!(
        "  pin, touch and unpin, shared page   {pin:9.1} ns   {:+.1} above the touch",
        pin - touch
    );
}

fn misses(scene: &Scene) {
    for kind in [PageKind::Node, PageKind::Point] {
        let info = scene.info();
        let pages = info.page_count(kind).min(1024) as u32;
        let mut buffer = vec![0; info.page_bytes(kind)];
        let read = nanos(pages, |page| scene.read_page(kind, PageNo(page), &mut buffer).unwrap());
        // Fewer frames than pages, visited in turn: every look is a miss, with an eviction.
        let owner = owner(info, 64, 64);
        let per_page = match kind {
            PageKind::Node => info.settings.nodes_per_page,
            PageKind::Point => info.settings.points_per_page,
        };
        let miss = with_worker(&owner, scene, |mut cache| {
            let mut view = SceneView::new(info, MOUNT);
            let mut source = PageSource::new(&mut cache, &mut view, 1);
            nanos(pages, |page| match kind {
                PageKind::Node => {
                    black_box(source.node(NodeIndex(page * per_page), 1, &()).unwrap());
                }
                PageKind::Point => {
                    black_box(source.points(PointIndex(page * per_page), 1, 1, &()).unwrap());
                }
            })
        });
        let (read, miss) = (read * 1e-3, miss * 1e-3);
        println!(
            "  {kind} page of {:4} KiB: pread and CRC  {read:9.2} us",
            buffer.len() >> 10
        );
        println!(
            "  a miss of it                        {miss:9.2} us   {:+.2} above",
            miss - read
        );
        let together = batches(&owner, scene, kind, pages) * 1e-3;
        println!(
            "  a miss of 16 together, each         {together:9.2} us   {:+.2} above",
            together - read
        );
    }
}

/// Nanoseconds of a page when sixteen are asked for at once.
fn batches(owner: &CacheOwner, scene: &Scene, kind: PageKind, pages: u32) -> f64 {
    let mut cache = LocalCache::new(CacheView::attach(owner.segment().name(), owner.layout().hash(), 0).unwrap());
    with_channel(owner, scene, |theirs| {
        const TOGETHER: u32 = channel::REQUEST_PAGES_MAX as u32;
        let each = nanos(pages / TOGETHER, |batch| {
            let keys: Vec<PageKey> = (0..TOGETHER).map(|page| key(kind, batch * TOGETHER + page)).collect();
            cache.reserve(kind, keys.len());
            let id = u64::from(batch);
            let request = PageRequest::new(id, 1, keys);
            let reply = channel::ask(&theirs, &request).unwrap().unwrap();
            for (&key, outcome) in request.keys.iter().zip(&reply.outcomes) {
                let channel::PageOutcome::Pinned(fetched) = outcome else {
                    panic!("{}", reply.error)
                };
                cache.adopt(key, fetched.frame).unwrap();
            }
        });
        each / f64::from(TOGETHER)
    })
}
