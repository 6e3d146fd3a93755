//! The glue between cache and shade against a real segment and a daemon's end of the miss channel: the right record for every
//! index, an error for every index that is none, and counters that add up.
#![allow(clippy::unwrap_used, reason = "tests assert")]

use pbgi_cache::channel::{self, PageReply, PageRequest};
use pbgi_cache::{CacheOwner, CacheView, LoadError, LoadErrorKind, LocalCache, PoolLayout, Segment, SegmentLayout};
use pbgi_core::{
    BuildId, BuildSettings, MountId, NodeIndex, NodeKind, NodeRecord, PageKey, PageKind, PointIndex, SceneInfo,
};
use pbgi_shade::{SceneSource, SourceError, Upcoming, Wanted};
use pbgi_worker::FailureKind;
use pbgi_worker::pages::{PageSource, Pages, SceneView};
use std::ops::ControlFlow;
use std::os::unix::net::UnixStream;
use std::thread::JoinHandle;
use std::time::Duration;

const MOUNT: MountId = MountId { slot: 1, generation: 9 };
const RECORDS_PER_PAGE: u32 = 16;
const NODE_BYTES: usize = 128;
const POINT_BYTES: usize = 32;
/// Pages of each file but the last are full.
const NODES: u64 = 16 * 20 - 3;
const POINTS: u64 = 16 * 40 - 5;
const BAD_PAGE: u32 = 7;

fn scene() -> SceneInfo {
    SceneInfo {
        build_id: BuildId(1),
        point_count: POINTS,
        node_count: NODES,
        node_slots: NODES,
        root: Some(NodeIndex(0)),
        bounds: None,
        quantizer: None,
        radius_max: 1.0,
        origin: [0.0; 3],
        settings: BuildSettings {
            nodes_per_page: RECORDS_PER_PAGE,
            points_per_page: RECORDS_PER_PAGE,
            ..BuildSettings::default()
        },
    }
}

/// Every record begins with its own index as a float; one page is damaged.
fn fill(page: &mut [u8], key: PageKey) -> Result<(), LoadError> {
    if key.kind == PageKind::Point && key.page.0 == BAD_PAGE {
        return Err(LoadError::new(LoadErrorKind::Corrupt, "page checksum mismatch"));
    }
    let record_bytes = match key.kind {
        PageKind::Node => NODE_BYTES,
        PageKind::Point => POINT_BYTES,
    };
    // As slow as a disk, so that the worker asks ahead.
    std::thread::sleep(Duration::from_micros(300));
    page.fill(0);
    for (slot, record) in page.chunks_exact_mut(record_bytes).enumerate() {
        let index = (key.page.0 * RECORDS_PER_PAGE) as f32 + slot as f32;
        record[..4].copy_from_slice(&index.to_le_bytes());
        if key.kind == PageKind::Node {
            // The children of the n-th node of a page are on the n-th page after the first.
            let node: &mut NodeRecord = bytemuck::from_bytes_mut(record);
            node.set_first_child(NodeIndex((slot as u32 + 1) * RECORDS_PER_PAGE));
        }
    }
    Ok(())
}

/// A worker's pages, and the daemon's thread that serves them until they are dropped.
fn daemon(local_frames: u32) -> (Pages, JoinHandle<CacheOwner>) {
    let pool = |bytes: usize| PoolLayout {
        frame_bytes: bytes * RECORDS_PER_PAGE as usize,
        frames: 2 * local_frames + 4,
        local_frames,
    };
    let layout = SegmentLayout::new(1, 1, pool(NODE_BYTES), pool(POINT_BYTES)).unwrap();
    let owner = CacheOwner::new(Segment::create(&Segment::unique_name().unwrap(), &layout).unwrap());
    owner.mount(MOUNT, &scene()).unwrap();
    let view = CacheView::attach(owner.segment().name(), owner.layout().hash(), 0).unwrap();
    let (ours, theirs) = UnixStream::pair().unwrap();
    let thread = std::thread::spawn(move || {
        let seat = owner.seat(0).unwrap();
        let answer = |request: &PageRequest| {
            let fetch = |&key: &PageKey| owner.fetch(seat, key, request.job, |page| fill(page, key));
            PageReply::new(request.id, request.keys.iter().map(fetch))
        };
        channel::serve(&ours, answer).unwrap();
        owner
    });
    (Pages::new(LocalCache::new(view), theirs), thread)
}

#[test]
fn every_index_gives_its_record_whatever_the_order() {
    let (mut pages, thread) = daemon(4);
    let mut view = SceneView::new(&scene(), MOUNT);
    let mut source = PageSource::new(&mut pages, &mut view, 1);
    source.begin_pack();
    for step in 0..4000u64 {
        let node = (step * 37 % NODES) as u32;
        assert_eq!(source.node(NodeIndex(node), 1, &()).unwrap().centroid[0], node as f32);
        let point = (step * 53 % POINTS) as u32;
        if point / RECORDS_PER_PAGE != BAD_PAGE {
            let points = source.points(PointIndex(point), 100, 1, &()).unwrap();
            assert_eq!(points[0].position[0], point as f32);
            // Cut at the end of the page, and of the file.
            let rest = (RECORDS_PER_PAGE - point % RECORDS_PER_PAGE).min(POINTS as u32 - point);
            assert_eq!(points.len(), rest as usize);
        }
    }
    drop(pages);
    let owner = thread.join().unwrap();
    assert_eq!(owner.pins(0, PageKind::Node) + owner.pins(0, PageKind::Point), 0);
    assert_eq!(owner.counters().node.redundant_reads, 0);
}

#[test]
fn an_index_out_of_range_is_corruption_not_a_panic() {
    let (mut pages, thread) = daemon(4);
    let mut view = SceneView::new(&scene(), MOUNT);
    let mut source = PageSource::new(&mut pages, &mut view, 1);
    source.begin_pack();
    for index in [NODES as u32, NODES as u32 + 2, 1 << 20, u32::MAX] {
        assert!(
            matches!(source.node(NodeIndex(index), 1, &()), Err(SourceError::Corrupt(_))),
            "{index}"
        );
        assert_eq!(source.take_fault().unwrap().0, FailureKind::Corrupt);
    }
    for index in [POINTS as u32, u32::MAX] {
        assert!(
            matches!(
                source.points(PointIndex(index), 1, 1, &()),
                Err(SourceError::Corrupt(_))
            ),
            "{index}"
        );
    }
    assert!(source.points(PointIndex(0), 0, 1, &()).is_err());
    drop(pages);
    thread.join().unwrap();
}

#[test]
fn a_damaged_page_fails_with_the_daemons_words() {
    let (mut pages, thread) = daemon(4);
    let mut view = SceneView::new(&scene(), MOUNT);
    let mut source = PageSource::new(&mut pages, &mut view, 1);
    source.begin_pack();
    let bad = PointIndex(BAD_PAGE * RECORDS_PER_PAGE);
    let error = source.points(bad, 1, 1, &()).unwrap_err();
    assert!(matches!(error, SourceError::Corrupt(_)), "{error}");
    let (kind, text) = source.take_fault().unwrap();
    assert_eq!(kind, FailureKind::Corrupt);
    assert!(text.contains("checksum"), "{text}");
    // The next page is unaffected.
    assert!(source.points(PointIndex(0), 1, 1, &()).is_ok());
    drop(pages);
    thread.join().unwrap();
}

#[test]
fn counters_add_up_and_a_receiver_pays_for_a_page_once() {
    let (mut pages, thread) = daemon(8);
    let mut view = SceneView::new(&scene(), MOUNT);
    let page_bytes = (NODE_BYTES * RECORDS_PER_PAGE as usize) as u64;
    {
        let mut source = PageSource::new(&mut pages, &mut view, 1);
        source.begin_pack();
        for index in [0, 1, 20, 2] {
            source.node(NodeIndex(index), 1, &()).unwrap();
        }
        let counters = source.counters();
        assert_eq!(
            (counters.cache_misses, counters.local_hits, counters.shared_hits),
            (2, 2, 0)
        );
        assert_eq!(counters.traversal_bytes, 2 * page_bytes);
        assert!(counters.io_nanos > 0);
        source.begin_pack();
        source.node(NodeIndex(3), 1, &()).unwrap();
        assert_eq!(source.counters().traversal_bytes, 3 * page_bytes);
    }
    let mut source = PageSource::new(&mut pages, &mut view, 2);
    source.begin_pack();
    source.node(NodeIndex(4), 1, &()).unwrap();
    let counters = source.counters();
    assert_eq!(
        (counters.cache_misses, counters.local_hits),
        (0, 1),
        "a tile counts its own"
    );
    drop(pages);
    thread.join().unwrap();
}

/// A walk that will open the nodes of the first page, in their order.
struct FirstPage;

impl Upcoming for FirstPage {
    fn tell<'a>(
        &self,
        peek: impl Fn(NodeIndex) -> Option<&'a NodeRecord>,
        mut want: impl FnMut(Wanted) -> ControlFlow<()>,
    ) -> ControlFlow<()> {
        for index in (0..RECORDS_PER_PAGE).map(NodeIndex) {
            let child = peek(index).map(|node| match node.kind() {
                NodeKind::Inner { first, .. } => first,
                _ => panic!("all nodes have children"),
            });
            want(Wanted::Node(child.unwrap_or(index)))?;
        }
        ControlFlow::Continue(())
    }
}

#[test]
fn pages_needed_soon_come_with_the_missing_one_as_far_as_there_is_room() {
    // An eighth of a full cache may go for them.
    for (local_frames, ahead, when_full) in [(32, 15, None), (16, 14, Some(1)), (4, 2, Some(0))] {
        let (mut pages, thread) = daemon(local_frames);
        let mut view = SceneView::new(&scene(), MOUNT);
        let mut source = PageSource::new(&mut pages, &mut view, 1);
        source.begin_pack();
        source.node(NodeIndex(0), 1, &()).unwrap();
        assert_eq!(source.counters().cache_misses, 1);
        // Their children are on the pages 1 to 16.
        source.node(NodeIndex(18 * RECORDS_PER_PAGE), 1, &FirstPage).unwrap();
        assert_eq!(source.counters().cache_misses, 2 + ahead, "{local_frames} frames");
        // The first page is still held; so are those needed soonest.
        for page in (1..=ahead as u32).chain([18, 0]) {
            source.node(NodeIndex(page * RECORDS_PER_PAGE), 1, &()).unwrap();
        }
        let counters = source.counters();
        assert_eq!((counters.cache_misses, counters.shared_hits), (2 + ahead, 0));
        if let Some(when_full) = when_full {
            source.node(NodeIndex(19 * RECORDS_PER_PAGE), 1, &FirstPage).unwrap();
            let after = source.counters();
            let came = after.cache_misses + after.shared_hits - counters.cache_misses;
            assert_eq!(came, 1 + when_full, "{local_frames} frames, all in use");
        }
        drop(pages);
        assert_eq!(thread.join().unwrap().counters().node.redundant_reads, 0);
    }
}
