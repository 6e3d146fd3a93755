//! The paper's experiments: Table 1 for procedural scenes, the ablation over chunk levels, the sweep over page sizes, and a
//! view that touches a tenth of a scene against loading it whole.
//!
//! `cargo bench -p pbgi-tests --bench tables -- [--points 4000000] [--receivers 4096] [--memory 2G] [--kind city] [--table-only] [--dir DIR]`
//!
//! Receivers are points of the scene, in groups of 64 neighbours along the Z-curve, spread over all of it; one thread shades
//! them through an LRU of pages.

#![allow(clippy::unwrap_used, reason = "a benchmark asserts")]

use glam::Vec3;
use lru::LruCache;
use pbgi_build::{BuildReport, BuildRequest, build};
use pbgi_core::{
    BuildSettings, NodeIndex, NodeRecord, PageKind, PageNo, PointIndex, PointRecord, SceneInfo, ShadeSettings,
};
use pbgi_points::{InputOptions, Kind, PlyForm, ProceduralScene, open_input, write_point_ply};
use pbgi_shade::{Receiver, SceneSource, ShadeCounters, Shaded, Shader, SourceError, Upcoming};
use pbgi_store::{Overwrite, Scene};
use pbgi_tests::forget;
use std::collections::HashSet;
use std::num::NonZeroUsize;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

const KINDS: [Kind; 4] = [Kind::Tree, Kind::Tighten, Kind::City, Kind::Forest];
const GROUP: usize = 64;

/// The paper's Table 1, columns Tree, Tighten, City and Forest.
const PAPER: [(&str, [&str; 4]); 12] = [
    ("points, millions", ["2.73", "22.71", "128.10", "927.07"]),
    ("nodes, millions", ["0.65", "5.24", "27.45", "203.73"]),
    ("shading calls", ["1.24 M", "1.61 M", "3.21 M", "18.81 M"]),
    ("sort, s", ["0.82", "7.70", "198.95", "1618.25"]),
    ("build, s", ["0.92", "7.79", "59.81", "603.97"]),
    ("total build, s", ["1.73", "15.49", "258.75", "2222.12"]),
    ("shading, s", ["116", "173", "383", "1459"]),
    ("shading I/O, %", ["0.01", "0.03", "1.93", "7.00"]),
    ("out-of-core data, MB", ["158", "1292", "7051", "51607"]),
    ("cache hits, %", ["99.99", "99.99", "99.97", "99.97"]),
    ("average cut", ["1055", "1230", "1378", "857"]),
    ("nodes traversed", ["1797", "2122", "2559", "1906"]),
];

/// Pages of one file, the last used ones of them.
struct Pool<T> {
    pages: LruCache<u32, Vec<T>>,
    kind: PageKind,
    per_page: u32,
    last: Option<u32>,
    distinct: HashSet<u32>,
    requests: u64,
    loads: u64,
}

impl<T: bytemuck::Pod> Pool<T> {
    fn new(kind: PageKind, info: &SceneInfo, share: f64) -> Self {
        let per_page = match kind {
            PageKind::Node => info.settings.nodes_per_page,
            PageKind::Point => info.settings.points_per_page,
        };
        let pages = (info.page_count(kind) as f64 * share).ceil() as usize;
        Self {
            pages: LruCache::new(NonZeroUsize::new(pages.max(2)).unwrap()),
            kind,
            per_page,
            last: None,
            distinct: HashSet::new(),
            requests: 0,
            loads: 0,
        }
    }

    fn page(&mut self, scene: &Scene, index: u32, waited: &mut Duration) -> (&[T], usize) {
        let page = index / self.per_page;
        self.requests += 1;
        if !self.pages.contains(&page) {
            let started = Instant::now();
            let mut records = vec![T::zeroed(); self.per_page as usize];
            let bytes = bytemuck::cast_slice_mut(&mut records);
            scene.read_page(self.kind, PageNo(page), bytes).unwrap();
            self.pages.push(page, records);
            self.distinct.insert(page);
            self.loads += 1;
            *waited += started.elapsed();
        }
        if self.last != Some(page) {
            self.pages.promote(&page);
            self.last = Some(page);
        }
        (self.pages.peek(&page).unwrap(), (index % self.per_page) as usize)
    }
}

/// A scene through a cache that holds a share of its pages.
struct Paged {
    scene: Scene,
    nodes: Pool<NodeRecord>,
    points: Pool<PointRecord>,
    waited: Duration,
}

impl Paged {
    fn open(path: &Path, share: f64) -> Self {
        let scene = Scene::open(path).unwrap();
        Self {
            nodes: Pool::new(PageKind::Node, scene.info(), share),
            points: Pool::new(PageKind::Point, scene.info(), share),
            scene,
            waited: Duration::ZERO,
        }
    }

    fn loads(&self) -> u64 {
        self.nodes.loads + self.points.loads
    }

    fn hit_ratio(&self) -> f64 {
        1.0 - self.loads() as f64 / (self.nodes.requests + self.points.requests) as f64
    }

    fn distinct_bytes(&self) -> f64 {
        let info = self.scene.info();
        (self.nodes.distinct.len() * info.page_bytes(PageKind::Node)
            + self.points.distinct.len() * info.page_bytes(PageKind::Point)) as f64
    }

    fn loaded_bytes(&self) -> f64 {
        let info = self.scene.info();
        (self.nodes.loads as usize * info.page_bytes(PageKind::Node)
            + self.points.loads as usize * info.page_bytes(PageKind::Point)) as f64
    }
}

impl SceneSource for Paged {
    fn node(&mut self, index: NodeIndex, _: u8, _: &impl Upcoming) -> Result<&NodeRecord, SourceError> {
        let (page, slot) = self.nodes.page(&self.scene, index.0, &mut self.waited);
        Ok(&page[slot])
    }

    fn points(
        &mut self,
        first: PointIndex,
        count: u32,
        _: u8,
        _: &impl Upcoming,
    ) -> Result<&[PointRecord], SourceError> {
        let (page, slot) = self.points.page(&self.scene, first.0, &mut self.waited);
        Ok(&page[slot..(slot + count as usize).min(page.len())])
    }
}

struct Options {
    points: u64,
    receivers: usize,
    memory: u64,
    kinds: Vec<Kind>,
    table_only: bool,
    dir: PathBuf,
}

fn options() -> Options {
    let mut options = Options {
        points: 4_000_000,
        receivers: 4096,
        memory: 2 << 30,
        kinds: KINDS.to_vec(),
        table_only: false,
        dir: std::env::temp_dir(),
    };
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        let mut value = || arguments.next().unwrap();
        match argument.as_str() {
            "--points" => options.points = value().parse().unwrap(),
            "--receivers" => options.receivers = value().parse().unwrap(),
            "--memory" => options.memory = value().trim_end_matches('G').parse::<u64>().unwrap() << 30,
            "--kind" => options.kinds = vec![value().parse().unwrap()],
            "--table-only" => options.table_only = true,
            "--dir" => options.dir = value().into(),
            // Said by cargo.
            "--bench" => {}
            other => panic!("unknown option {other}"),
        }
    }
    options
}

struct Bench {
    options: Options,
    dir: tempfile::TempDir,
}

impl Bench {
    fn input(&self, kind: Kind) -> PathBuf {
        let path = self.dir.path().join(format!("{kind:?}.ply"));
        let mut scene = ProceduralScene::new(kind, self.options.points, 1).unwrap();
        write_point_ply(&path, PlyForm::Records, &mut scene, &mut |_| ControlFlow::Continue(())).unwrap();
        path
    }

    fn build(&self, input: &Path, settings: BuildSettings) -> (PathBuf, BuildReport, f64) {
        let request = BuildRequest {
            output: self.dir.path().join("scene.pbgi"),
            overwrite: Overwrite::Replace,
            scratch_dir: self.dir.path().to_owned(),
            memory_bytes: self.options.memory,
            settings,
            input_key: None,
        };
        let mut stream = open_input(&[input.to_owned()], &InputOptions::default()).unwrap();
        let started = Instant::now();
        let report = build(&mut stream, &request, &mut |_| ControlFlow::Continue(())).unwrap();
        (request.output, report, started.elapsed().as_secs_f64())
    }

    /// Groups of neighbours spread over the first `share` of the Z-curve.
    fn receivers(&self, scene: &Path, share: f64) -> Vec<Receiver> {
        let mut source = Paged::open(scene, 0.01);
        let count = source.scene.info().point_count as f64 * share;
        let groups = self.options.receivers.div_ceil(GROUP);
        let mut receivers = Vec::new();
        for group in 0..groups {
            let first = (count / groups as f64 * group as f64) as u32;
            for index in first..first + GROUP as u32 {
                let point = source.points(PointIndex(index), 1, 1, &()).unwrap()[0];
                receivers.push(Receiver {
                    position: Vec3::from(point.position),
                    normal: point.normal(),
                });
            }
        }
        receivers
    }

    fn shade(&self, source: &mut Paged, receivers: &[Receiver]) -> (f64, ShadeCounters) {
        let mut shader = Shader::new(source.scene.info(), ShadeSettings::default(), None).unwrap();
        let mut results = vec![Shaded::default(); GROUP];
        let started = Instant::now();
        for group in receivers.chunks(GROUP) {
            shader.shade_group(group, source, &mut results[..group.len()]).unwrap();
        }
        (started.elapsed().as_secs_f64(), shader.counters())
    }

    /// Every chunk level or page size in a cache of a tenth of the scene.
    fn sweep(&self, input: &Path, name: &str, variants: &[(String, BuildSettings)]) {
        println!(
            "\n{name:<24} {:>9} {:>10} {:>12} {:>14} {:>12} {:>9}",
            "build, s", "shading, s", "page faults", "MB loaded", "queues, KB", "hits, %"
        );
        for (label, settings) in variants {
            let (scene, report, seconds) = self.build(input, *settings);
            let receivers = self.receivers(&scene, 1.0);
            let mut source = Paged::open(&scene, 0.1);
            let (shading, _) = self.shade(&mut source, &receivers);
            println!(
                "{label:<24} {seconds:>9.2} {shading:>10.2} {:>12} {:>14.1} {:>12} {:>9.3}",
                source.loads(),
                source.loaded_bytes() / 1e6,
                report.queue_peak_bytes >> 10,
                100.0 * source.hit_ratio()
            );
        }
    }

    fn table(&self, columns: &[Vec<String>]) {
        let kinds = &self.options.kinds;
        print!("\n{:<22}", "Table 1");
        kinds
            .iter()
            .for_each(|kind| print!(" {:>12} {:>9}", format!("{kind:?}"), "(paper)"));
        println!();
        for (row, (name, paper)) in PAPER.iter().enumerate() {
            print!("{name:<22}");
            for (kind, column) in kinds.iter().zip(columns) {
                let place = KINDS.iter().position(|known| known == kind).unwrap();
                print!(" {:>12} {:>9}", column[row], paper[place]);
            }
            println!();
        }
    }

    fn column(&self, input: &Path) -> Vec<String> {
        let (scene, report, seconds) = self.build(input, BuildSettings::default());
        let receivers = self.receivers(&scene, 1.0);
        let mut source = Paged::open(&scene, 0.3);
        let (shading, counters) = self.shade(&mut source, &receivers);
        let each = |value: u64| format!("{:.0}", value as f64 / counters.receivers as f64);
        let info = &report.info;
        vec![
            format!("{:.2}", info.point_count as f64 / 1e6),
            format!("{:.2}", info.node_count as f64 / 1e6),
            counters.receivers.to_string(),
            format!("{:.2}", report.sort_seconds),
            format!("{:.2}", report.build_seconds),
            format!("{seconds:.2}"),
            format!("{shading:.2}"),
            format!("{:.2}", 100.0 * source.waited.as_secs_f64() / shading),
            format!("{:.0}", info.out_of_core_bytes() as f64 / 1e6),
            format!("{:.3}", 100.0 * source.hit_ratio()),
            each(counters.cut_elements),
            each(counters.nodes_visited),
        ]
    }

    /// A view into a tenth of the scene, with the disk cold: paged, and with everything loaded first.
    fn tenth(&self, scene: &Path) {
        let receivers = self.receivers(scene, 0.1);
        let cold = || {
            ["nodes.pages", "points.pages"]
                .iter()
                .for_each(|name| forget(&scene.join(name)))
        };
        cold();
        let mut source = Paged::open(scene, 1.0);
        let (paged, _) = self.shade(&mut source, &receivers);
        let touched = source.distinct_bytes() / source.scene.info().out_of_core_bytes() as f64;
        cold();
        let mut source = Paged::open(scene, 1.0);
        let started = Instant::now();
        let info = source.scene.info().clone();
        for page in 0..info.page_count(PageKind::Node) {
            let index = page as u32 * info.settings.nodes_per_page;
            source.nodes.page(&source.scene, index, &mut source.waited);
        }
        for page in 0..info.page_count(PageKind::Point) {
            let index = page as u32 * info.settings.points_per_page;
            source.points.page(&source.scene, index, &mut source.waited);
        }
        let loading = started.elapsed().as_secs_f64();
        let (shading, _) = self.shade(&mut source, &receivers);
        println!(
            "\na view of a tenth, disk cold: paged {paged:.2} s ({:.1} % of the scene touched), loaded whole {:.2} s \
             ({loading:.2} s of it loading)",
            100.0 * touched,
            loading + shading
        );
    }
}

fn main() {
    let options = options();
    let dir = tempfile::tempdir_in(&options.dir).unwrap();
    let bench = Bench { options, dir };
    let mut columns = Vec::new();
    let mut last = None;
    for &kind in &bench.options.kinds {
        let input = bench.input(kind);
        columns.push(bench.column(&input));
        if let Some(before) = last.replace(input) {
            std::fs::remove_file(before).unwrap();
        }
    }
    bench.table(&columns);
    if bench.options.table_only {
        return;
    }
    let input = last.unwrap();
    let default = BuildSettings::default();
    bench.tenth(&bench.build(&input, default).0);
    let chunks: Vec<_> = (0..=4)
        .map(|chunk_levels| {
            let settings = BuildSettings {
                chunk_levels,
                ..default
            };
            (format!("{chunk_levels} chunk levels"), settings)
        })
        .collect();
    let name = format!("{:?}, a tenth cached", bench.options.kinds.last().unwrap());
    bench.sweep(&input, &name, &chunks);
    let pages: Vec<_> = [
        (64, 256),
        (128, 512),
        (256, 1024),
        (512, 2048),
        (1024, 4096),
        (2048, 16_384),
    ]
    .into_iter()
    .map(|(nodes_per_page, points_per_page)| {
        let settings = BuildSettings {
            nodes_per_page,
            points_per_page,
            ..default
        };
        (format!("{nodes_per_page} nodes, {points_per_page} points"), settings)
    })
    .collect();
    bench.sweep(&input, "records in a page", &pages);
}
