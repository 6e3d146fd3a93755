//! Which pages stay: this cache against an exact LRU and a plain clock of the same size, on the page trace of real shading.

use crate::costs::MOUNT;
use crate::read_all;
use crate::town::Town;
use pbgi_cache::{CacheOwner, CacheView, LocalCache, PoolLayout, Segment, SegmentLayout};
use pbgi_core::{
    BuildSettings, MountId, NodeIndex, NodeRecord, PageKey, PageKind, PageNo, PointIndex, PointRecord, SceneInfo,
    ShadeSettings,
};
use pbgi_shade::{ArraySource, Receiver, SceneSource, Shaded, Shader, SourceError, Upcoming};
use pbgi_store::Scene;
use std::collections::{BTreeMap, HashMap};

/// Pixels of the picture whose trace is taken.
const SIZE: (u32, u32) = (128, 96);
const TILE: u32 = 32;
const GROUP: u32 = 8;
/// Two workers shade, a third reads the other scene from end to end.
const WORKERS: u8 = 3;
const SCANNER: u8 = 2;
const SCANNED: MountId = MountId { slot: 1, generation: 1 };
/// The scanned scene: this many times the pages of the shaded one.
const SCANNED_PAGES: u32 = 64;

/// A look at a page: who, and where.
type Look = (u8, PageKey);

/// Arrays that note every turn to another page.
struct Recorder {
    arrays: ArraySource,
    per_page: [u32; 2],
    last: [u32; 2],
    looks: Vec<PageKey>,
}

impl Recorder {
    fn note(&mut self, kind: PageKind, index: u32) {
        let page = index / self.per_page[kind as usize];
        if self.last[kind as usize] != page {
            self.last[kind as usize] = page;
            self.looks.push(PageKey {
                mount: MOUNT,
                kind,
                page: PageNo(page),
            });
        }
    }
}

impl SceneSource for Recorder {
    fn node(&mut self, index: NodeIndex, receivers: u8, upcoming: &impl Upcoming) -> Result<&NodeRecord, SourceError> {
        self.note(PageKind::Node, index.0);
        self.arrays.node(index, receivers, upcoming)
    }

    fn points(
        &mut self,
        first: PointIndex,
        count: u32,
        receivers: u8,
        upcoming: &impl Upcoming,
    ) -> Result<&[PointRecord], SourceError> {
        self.note(PageKind::Point, first.0);
        self.note(PageKind::Point, first.0 + count - 1);
        self.arrays.points(first, count, receivers, upcoming)
    }

    fn begin_pack(&mut self) {
        self.last = [u32::MAX; 2];
    }
}

/// The scene as plain arrays.
pub(crate) fn arrays(scene: &Scene) -> ArraySource {
    ArraySource {
        nodes: bytemuck::pod_collect_to_vec(&read_all(scene, PageKind::Node)),
        points: bytemuck::pod_collect_to_vec(&read_all(scene, PageKind::Point)),
    }
}

/// Groups of receivers, tile by tile in the order of handing out.
pub(crate) fn tiles(receivers: &[Receiver], size: (u32, u32)) -> Vec<Vec<Vec<Receiver>>> {
    let mut origins: Vec<(u32, u32)> = (0..size.1 / TILE)
        .flat_map(|row| (0..size.0 / TILE).map(move |column| (column, row)))
        .collect();
    let spread = |value: u32| (0..16).map(|bit| (value >> bit & 1) << (2 * bit)).sum::<u32>();
    origins.sort_by_key(|&(column, row)| spread(column) | spread(row) << 1);
    let group = |x: u32, y: u32| {
        let pixels = (y..y + GROUP).flat_map(|y| (x..x + GROUP).map(move |x| y * size.0 + x));
        pixels.map(|pixel| receivers[pixel as usize]).collect()
    };
    let tile = |(column, row): (u32, u32)| {
        let steps = 0..TILE / GROUP;
        steps
            .clone()
            .flat_map(|y| steps.clone().map(move |x| (x, y)))
            .map(|(x, y)| group(column * TILE + x * GROUP, row * TILE + y * GROUP))
            .collect()
    };
    origins.into_iter().map(tile).collect()
}

/// Shades a picture with two workers that take tiles by turns, and returns their looks as they interleave.
fn record(scene: &Scene) -> Vec<Look> {
    let info = scene.info();
    let mut source = Recorder {
        arrays: arrays(scene),
        per_page: [info.settings.nodes_per_page, info.settings.points_per_page],
        last: [u32::MAX; 2],
        looks: Vec::new(),
    };
    let mut shader = Shader::new(info, ShadeSettings::default(), None).unwrap();
    let receivers = Town::new(info.point_count).receivers(SIZE.0, SIZE.1);
    let mut looks = Vec::new();
    for pair in tiles(&receivers, SIZE).chunks(2) {
        for group in 0..pair[0].len() {
            for (worker, tile) in pair.iter().enumerate() {
                let mut out = vec![Shaded::default(); tile[group].len()];
                shader.shade_group(&tile[group], &mut source, &mut out).unwrap();
                looks.extend(source.looks.drain(..).map(|key| (worker as u8, key)));
            }
        }
    }
    looks
}

/// Sizes of a cache in frames of nodes and points, and the share of them that workers may pin together.
#[derive(Clone, Copy)]
struct Size {
    frames: [u32; 2],
    local_share: f64,
}

impl Size {
    fn of(scene: &SceneInfo, share: f64) -> Self {
        let frames = |kind| ((scene.page_count(kind) as f64 * share) as u32).max(26);
        Self {
            frames: [frames(PageKind::Node), frames(PageKind::Point)],
            local_share: 0.5,
        }
    }
}

/// What became of the looks of the shading workers.
#[derive(Clone, Copy, Debug, Default)]
struct Outcome {
    looks: u64,
    local: u64,
    shared: u64,
    loads: [u64; 2],
}

impl Outcome {
    fn hit_ratio(&self) -> f64 {
        1.0 - self.all_loads() as f64 / self.looks as f64
    }

    fn all_loads(&self) -> u64 {
        self.loads.iter().sum()
    }
}

/// This cache itself, over frames of a few bytes: a page's contents do not matter here.
fn ours(trace: &[Look], size: Size, pages: [u64; 2]) -> Outcome {
    let pool = |kind: PageKind, frame_bytes| {
        let frames = size.frames[kind as usize];
        PoolLayout {
            frame_bytes,
            frames,
            local_frames: (f64::from(frames) * size.local_share / f64::from(WORKERS)) as u32,
        }
    };
    let (node, point) = (size_of::<NodeRecord>(), size_of::<PointRecord>());
    let layout = SegmentLayout::new(
        WORKERS.into(),
        1,
        pool(PageKind::Node, node),
        pool(PageKind::Point, point),
    );
    let segment = Segment::create(&Segment::unique_name().unwrap(), &layout.unwrap()).unwrap();
    let owner = CacheOwner::new(segment);
    for (mount, times) in [(MOUNT, 1), (SCANNED, u64::from(SCANNED_PAGES))] {
        owner
            .mount(mount, &one_record_a_page(pages.map(|pages| pages * times)))
            .unwrap();
    }
    let attach =
        |slot| LocalCache::new(CacheView::attach(owner.segment().name(), owner.layout().hash(), slot).unwrap());
    let mut workers: Vec<LocalCache> = (0..WORKERS).map(attach).collect();
    let mut outcome = Outcome::default();
    for &(slot, key) in trace {
        let worker = &mut workers[usize::from(slot)];
        let shades = slot != SCANNER;
        outcome.looks += u64::from(shades);
        if worker.get(key).is_none() {
            worker.reserve(key.kind, 1);
            let fetched = owner.fetch(owner.seat(slot).unwrap(), key, 1, |_| Ok(())).unwrap();
            worker.adopt(key, fetched.frame).unwrap();
            outcome.loads[key.kind as usize] += u64::from(shades);
        }
    }
    for worker in &workers[..usize::from(SCANNER)] {
        outcome.local += worker.counters().local_hits;
        outcome.shared += worker.counters().shared_hits;
    }
    assert_eq!(
        owner.counters().node.redundant_reads + owner.counters().point.redundant_reads,
        0
    );
    outcome
}

fn one_record_a_page(pages: [u64; 2]) -> SceneInfo {
    SceneInfo {
        build_id: pbgi_core::BuildId(0),
        point_count: pages[1],
        node_count: pages[0],
        node_slots: pages[0],
        root: None,
        bounds: None,
        quantizer: None,
        radius_max: 1.0,
        origin: [0.0; 3],
        settings: BuildSettings {
            nodes_per_page: 1,
            points_per_page: 1,
            ..BuildSettings::default()
        },
    }
}

/// Exact LRU over all looks.
#[derive(Default)]
struct Lru {
    stamps: HashMap<PageKey, u64>,
    order: BTreeMap<u64, PageKey>,
    now: u64,
}

impl Lru {
    fn hit(&mut self, key: PageKey, frames: u32) -> bool {
        self.now += 1;
        let before = self.stamps.insert(key, self.now);
        self.order.insert(self.now, key);
        if let Some(stamp) = before {
            self.order.remove(&stamp);
        } else if self.stamps.len() > frames as usize
            && let Some((_, oldest)) = self.order.pop_first()
        {
            self.stamps.remove(&oldest);
        }
        before.is_some()
    }
}

/// Plain clock over all looks.
#[derive(Default)]
struct Clock {
    frame_of: HashMap<PageKey, usize>,
    frames: Vec<(PageKey, bool)>,
    hand: usize,
}

impl Clock {
    fn hit(&mut self, key: PageKey, frames: u32) -> bool {
        if let Some(&frame) = self.frame_of.get(&key) {
            self.frames[frame].1 = true;
            return true;
        }
        if self.frames.len() < frames as usize {
            self.frame_of.insert(key, self.frames.len());
            self.frames.push((key, true));
            return false;
        }
        while std::mem::take(&mut self.frames[self.hand].1) {
            self.hand = (self.hand + 1) % self.frames.len();
        }
        self.frame_of.remove(&self.frames[self.hand].0);
        self.frame_of.insert(key, self.hand);
        self.frames[self.hand] = (key, true);
        self.hand = (self.hand + 1) % self.frames.len();
        false
    }
}

fn replay(trace: &[Look], size: Size, mut hit: impl FnMut(PageKey, u32) -> bool) -> Outcome {
    let mut outcome = Outcome::default();
    for &(worker, key) in trace {
        let found = hit(key, size.frames[key.kind as usize]);
        if worker != SCANNER {
            outcome.looks += 1;
            outcome.loads[key.kind as usize] += u64::from(!found);
        }
    }
    outcome
}

fn lru(trace: &[Look], size: Size) -> Outcome {
    let mut pools = [Lru::default(), Lru::default()];
    replay(trace, size, |key, frames| pools[key.kind as usize].hit(key, frames))
}

fn clock(trace: &[Look], size: Size) -> Outcome {
    let mut pools = [Clock::default(), Clock::default()];
    replay(trace, size, |key, frames| pools[key.kind as usize].hit(key, frames))
}

/// The trace, with a page of a huge scene read after every few looks.
fn with_scan(trace: &[Look], pages: [u64; 2]) -> Vec<Look> {
    const LOOKS_A_PAGE: usize = 8;
    let mut mixed = Vec::with_capacity(trace.len() + trace.len() / LOOKS_A_PAGE);
    for (scanned, looks) in trace.chunks(LOOKS_A_PAGE).enumerate() {
        mixed.extend_from_slice(looks);
        for kind in [PageKind::Node, PageKind::Point] {
            let page = PageNo((scanned as u64 % (pages[kind as usize] * u64::from(SCANNED_PAGES))) as u32);
            let mount = SCANNED;
            mixed.push((SCANNER, PageKey { mount, kind, page }));
        }
    }
    mixed
}

/// Prints the tables.
pub(crate) fn print(scene: &Scene) {
    let info = scene.info();
    let pages = [PageKind::Node, PageKind::Point].map(|kind| info.page_count(kind));
    let trace = record(scene);
    println!(
        "policy, {} looks of two workers at pages, {} receivers",
        trace.len(),
        SIZE.0 * SIZE.1
    );
    println!(
        "\n| Cache, of the scene | this cache | exact LRU | clock | with the scan: this cache | exact LRU | clock |\n\
         |---|---|---|---|---|---|---|"
    );
    let scanned = with_scan(&trace, pages);
    for share in [0.02, 0.05, 0.1, 0.2, 0.5] {
        let size = Size::of(info, share);
        let hits = |trace: &[Look]| {
            let outcomes = [ours(trace, size, pages), lru(trace, size), clock(trace, size)];
            outcomes
                .map(|outcome| format!("{:.2} %", outcome.hit_ratio() * 100.0))
                .join(" | ")
        };
        println!("| {:.0} % | {} | {} |", share * 100.0, hits(&trace), hits(&scanned));
    }
    println!(
        "\nwith the scan: a third worker reads a scene {SCANNED_PAGES} times as large, a page of each kind every 8 looks\n"
    );
    println!(
        "  share of the frames that workers may pin, in a cache of a tenth: hits in the local and the shared part, loads"
    );
    for local_share in [0.5, 0.25, 0.125, 0.0625] {
        let size = Size {
            local_share,
            ..Size::of(info, 0.1)
        };
        let outcome = ours(&trace, size, pages);
        println!(
            "  {local_share:<6} {:12} {:12} {:10}",
            outcome.local,
            outcome.shared,
            outcome.all_loads()
        );
    }
    println!(
        "  share of the memory for nodes, in a cache of a tenth of the scene's bytes: loads of nodes and points, MiB read"
    );
    let bytes = [PageKind::Node, PageKind::Point].map(|kind| info.page_bytes(kind) as f64);
    for node_share in [0.5, 0.625, 0.75, 0.875] {
        let all = info.out_of_core_bytes() as f64 * 0.1;
        let frames = |share: f64, kind: usize| ((all * share / bytes[kind]) as u32).max(26);
        let size = Size {
            frames: [frames(node_share, 0), frames(1.0 - node_share, 1)],
            local_share: 0.5,
        };
        let outcome = ours(&trace, size, pages);
        let read: f64 = outcome
            .loads
            .iter()
            .zip(bytes)
            .map(|(&loads, bytes)| loads as f64 * bytes)
            .sum();
        println!(
            "  {node_share:<6} {:12} {:12} {:10.1}",
            outcome.loads[0],
            outcome.loads[1],
            read / f64::from(1 << 20)
        );
    }
    println!();
}
