//! Clouds, builds of them, and the audit that every scene of these tests passes.

use bytemuck::Zeroable;
use pbgi_build::{BuildError, BuildHost, BuildReport, BuildRequest, build_on};
use pbgi_core::point::Sides;
use pbgi_core::{
    Bounds, BuildSettings, ClusterAccumulator, NodeIndex, NodeKind, NodeRecord, PageKind, PageNo, PointRecord,
    PointStream, Quantizer, Voxel,
};
use pbgi_store::{Overwrite, Scene, StoreError, Volume};
use rand::rngs::StdRng;
use rand::seq::SliceRandom;
use rand::{Rng, SeedableRng};
use std::collections::HashSet;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// An input that breaks off.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Broken(pub(crate) usize);

impl std::fmt::Display for Broken {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "the input breaks off at point {}", self.0)
    }
}

impl std::error::Error for Broken {}

/// Points from memory.
#[derive(Clone)]
pub(crate) struct Cloud {
    pub(crate) points: Arc<Vec<PointRecord>>,
    pub(crate) bounds: Option<Bounds>,
    pub(crate) breaks_at: Option<usize>,
    next: usize,
}

impl Cloud {
    pub(crate) fn new(points: Vec<PointRecord>) -> Self {
        Self {
            points: Arc::new(points),
            bounds: None,
            breaks_at: None,
            next: 0,
        }
    }

    /// The same points with their tight bounds declared.
    pub(crate) fn bounded(mut self) -> Self {
        let mut bounds = Bounds::EMPTY;
        self.points.iter().for_each(|point| bounds.include(point.position));
        self.bounds = Some(bounds);
        self
    }
}

impl PointStream for Cloud {
    type Error = Broken;

    fn bounds(&self) -> Option<Bounds> {
        self.bounds
    }

    fn len_hint(&self) -> Option<u64> {
        Some(self.points.len() as u64)
    }

    fn next_batch(&mut self, batch: &mut Vec<PointRecord>) -> Result<bool, Broken> {
        if let Some(at) = self.breaks_at.filter(|&at| at <= self.next) {
            return Err(Broken(at));
        }
        let end = (self.next + 1000).min(self.points.len());
        batch.extend_from_slice(&self.points[self.next..end]);
        let more = self.next < end;
        self.next = end;
        Ok(more)
    }

    fn rewind(&mut self) -> Result<(), Broken> {
        self.next = 0;
        Ok(())
    }
}

pub(crate) fn point(position: [f32; 3]) -> PointRecord {
    let [x, y, z] = position;
    let normal = [x.sin() + 0.1, y.cos(), z.sin() - 0.2];
    let sides = Sides {
        front: [0.5 + 0.1 * x.sin(), 0.25, 1.0],
        back: [0.0, 0.125, 0.5],
    };
    PointRecord::new(position, normal, 0.01, sides).unwrap()
}

/// Points on a wavy sheet: dense and sparse places, no two alike.
pub(crate) fn sheet(count: usize) -> Vec<PointRecord> {
    let mut random = StdRng::seed_from_u64(count as u64);
    let mut spread = || random.random_range(-1.0f32..1.0);
    let position = |u: f32, v: f32| [10.0 * u * u.abs(), (5.0 * u).sin() + (7.0 * v).cos(), 10.0 * v];
    (0..count).map(|_| point(position(spread(), spread()))).collect()
}

pub(crate) fn shuffled(mut points: Vec<PointRecord>, seed: u64) -> Vec<PointRecord> {
    points.shuffle(&mut StdRng::seed_from_u64(seed));
    points
}

/// A folder with places for scratch and output.
pub(crate) struct Place {
    _dir: Option<tempfile::TempDir>,
    pub(crate) volume: Arc<dyn Volume>,
    root: PathBuf,
}

impl Place {
    pub(crate) fn on_disk() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let root = dir.path().to_owned();
        Self {
            _dir: Some(dir),
            ..Self::on(BuildHost::default().volume, &root)
        }
    }

    pub(crate) fn on(volume: Arc<dyn Volume>, root: &Path) -> Self {
        for name in ["out", "scratch"] {
            volume.create_dir(&root.join(name), 0o700).unwrap();
        }
        Self {
            volume,
            ..Self::at(root)
        }
    }

    /// One that another process made.
    pub(crate) fn at(root: &Path) -> Self {
        Self {
            _dir: None,
            volume: BuildHost::default().volume,
            root: root.to_owned(),
        }
    }

    pub(crate) fn root(&self) -> &Path {
        &self.root
    }

    pub(crate) fn output(&self) -> PathBuf {
        self.root.join("out/scene.pbgi")
    }

    pub(crate) fn scratch(&self) -> PathBuf {
        self.root.join("scratch")
    }

    pub(crate) fn host(&self) -> BuildHost {
        BuildHost {
            volume: self.volume.clone(),
            ..BuildHost::default()
        }
    }

    pub(crate) fn request(&self, settings: BuildSettings) -> BuildRequest {
        BuildRequest {
            output: self.output(),
            overwrite: Overwrite::Replace,
            scratch_dir: self.scratch(),
            memory_bytes: 256_000_000,
            settings,
            input_key: None,
        }
    }

    pub(crate) fn open(&self) -> Result<Scene, StoreError> {
        Scene::open_on(&self.volume, &self.output())
    }

    /// Everything in the two folders, the scene aside.
    pub(crate) fn leftovers(&self, volume: &dyn Volume) -> Vec<PathBuf> {
        let mut left = Vec::new();
        for dir in [self.root.join("out"), self.scratch()] {
            let entries = volume.list(&dir).unwrap();
            left.extend(entries.into_iter().map(|entry| dir.join(entry.name)));
        }
        left.retain(|path| *path != self.output());
        left
    }
}

/// Settings small enough that small clouds have many pages and chunks.
pub(crate) fn small_pages() -> BuildSettings {
    BuildSettings {
        nodes_per_page: 16,
        points_per_page: 32,
        ..BuildSettings::default()
    }
}

/// Builds, audits, and checks that nothing else is left.
pub(crate) fn build_and_audit(cloud: &Cloud, settings: BuildSettings) -> (Tree, BuildReport) {
    let place = Place::on_disk();
    let report = build_cloud(cloud, &place, &place.host(), settings).unwrap();
    let scene = place.open().unwrap();
    assert_eq!(scene.info(), &report.info);
    assert!(place.leftovers(place.volume.as_ref()).is_empty());
    (Tree::audit(&scene, &cloud.points), report)
}

pub(crate) fn build_cloud(
    cloud: &Cloud,
    place: &Place,
    host: &BuildHost,
    settings: BuildSettings,
) -> Result<BuildReport, BuildError<Broken>> {
    build_on(&mut cloud.clone(), &place.request(settings), host, &mut |_| {
        ControlFlow::Continue(())
    })
}

/// A scene read back and checked.
pub(crate) struct Tree {
    nodes: Vec<NodeRecord>,
    points: Vec<PointRecord>,
    quantizer: Quantizer,
    settings: BuildSettings,
    /// Slots of nodes that were reached.
    seen: HashSet<u32>,
    /// The point that must come next.
    next_point: u64,
    /// Nodes by level.
    pub(crate) levels: [u64; 22],
    /// Points in overflow leaves.
    pub(crate) overflow_points: u64,
}

impl Tree {
    /// Checks that every input point lies in exactly one leaf, that every node is where and what it must be, and that
    /// clusters are the sums of what is below them.
    pub(crate) fn audit(scene: &Scene, input: &[PointRecord]) -> Self {
        let info = scene.info();
        let mut points: Vec<PointRecord> = read_all(scene, PageKind::Point);
        points.truncate(info.point_count as usize);
        let nodes: Vec<NodeRecord> = read_all(scene, PageKind::Node);
        let mut tree = Self {
            nodes,
            points,
            quantizer: info.quantizer.unwrap_or(Quantizer {
                origin: [0.0; 3],
                edge: 1.0,
            }),
            settings: info.settings,
            seen: HashSet::new(),
            next_point: 0,
            levels: [0; 22],
            overflow_points: 0,
        };
        if let Some(root) = info.root {
            assert_eq!(u64::from(root.0) + 1, info.node_slots, "the root is last");
            tree.check(root, Voxel::ROOT);
        }
        assert_eq!(tree.next_point, info.point_count);
        assert_eq!(tree.seen.len() as u64, info.node_count);
        let shape = scene.shape().unwrap();
        let counted = shape.levels.iter().map(|level| level.inner + level.leaves);
        let levels = tree.levels[..shape.levels.len()].iter().copied();
        assert!(counted.eq(levels) && tree.levels[shape.levels.len()..].iter().all(|&nodes| nodes == 0));
        assert_eq!(
            shape.levels.iter().map(|level| level.points).sum::<u64>(),
            info.point_count
        );
        let overflow_leaves =
            shape.levels.iter().map(|level| level.leaves).sum::<u64>() - shape.occupancy.iter().sum::<u64>();
        assert_eq!(overflow_leaves > 0, tree.overflow_points > 0);
        let padding = (0..info.node_slots as u32).filter(|slot| !tree.seen.contains(slot));
        let zero = NodeRecord::zeroed();
        padding.for_each(|slot| assert!(tree.nodes[slot as usize] == zero, "padding slot {slot} is not zero"));
        let bytes = |points: &[PointRecord]| {
            let mut all: Vec<[u8; 32]> = points.iter().map(|point| bytemuck::cast(*point)).collect();
            all.sort_unstable();
            all
        };
        assert!(bytes(&tree.points) == bytes(input), "the points are those of the input");
        let code = |point: &PointRecord| tree.quantizer.code(point.position);
        assert!(tree.points.is_sorted_by_key(code));
        tree
    }

    fn check(&mut self, index: NodeIndex, voxel: Voxel) -> ClusterAccumulator {
        assert!(self.seen.insert(index.0), "node {index:?} has two parents");
        let node = self.nodes[index.0 as usize];
        assert_eq!(node.level(), voxel.level);
        self.levels[voxel.level as usize] += 1;
        let numbers = node.centroid.into_iter().chain(node.covariance.map(f32::from));
        let mut numbers = numbers.chain(node.sh.into_iter().flatten().map(f32::from));
        assert!(
            numbers.all(f32::is_finite) && node.axis().is_finite(),
            "{voxel:?} has numbers that are none: {node:?}"
        );
        let mut sum = match node.kind() {
            NodeKind::Inner { first, mask } => self.check_children(first, mask, voxel),
            NodeKind::Leaf { first, count } => {
                assert!(count <= self.settings.leaf_max);
                self.sum_points(first.0, count, voxel)
            }
            NodeKind::Overflow { first, count } => {
                assert!(count > self.settings.leaf_max && voxel.level == 21);
                self.overflow_points += u64::from(count);
                self.sum_points(first.0, count, voxel)
            }
        };
        let attributes = sum.finalize(voxel, &self.quantizer).attributes;
        let expected = NodeRecord::new(voxel.level, node.kind(), &attributes);
        assert_eq!(
            bytemuck::bytes_of(&node),
            bytemuck::bytes_of(&expected),
            "cluster of {voxel:?}"
        );
        sum
    }

    fn check_children(&mut self, first: NodeIndex, mask: u8, voxel: Voxel) -> ClusterAccumulator {
        let per_page = self.settings.nodes_per_page;
        let count = mask.count_ones();
        assert!(count > 0);
        assert_eq!(
            first.0 / per_page,
            (first.0 + count - 1) / per_page,
            "siblings straddle a page"
        );
        let mut sum = ClusterAccumulator::default();
        let octants = (0..8).filter(|octant| mask >> octant & 1 == 1);
        for (offset, octant) in (0..).zip(octants) {
            sum.merge(octant, &self.check(NodeIndex(first.0 + offset), voxel.child(octant)));
        }
        assert!(
            sum.point_count() > u64::from(self.settings.leaf_max),
            "{voxel:?} need not be divided"
        );
        sum
    }

    fn sum_points(&mut self, first: u32, count: u32, voxel: Voxel) -> ClusterAccumulator {
        assert!(count > 0);
        assert_eq!(u64::from(first), self.next_point, "leaves take the points in order");
        self.next_point += u64::from(count);
        let mut sum = ClusterAccumulator::default();
        for point in &self.points[first as usize..][..count as usize] {
            assert!(voxel.contains(self.quantizer.code(point.position)));
            sum.add(point, &self.quantizer);
        }
        sum
    }

    pub(crate) fn node_count(&self) -> usize {
        self.seen.len()
    }
}

fn read_all<T: bytemuck::Pod>(scene: &Scene, kind: PageKind) -> Vec<T> {
    let mut all = Vec::new();
    for page in 0..scene.info().page_count(kind) {
        let mut records = vec![T::zeroed(); scene.info().page_bytes(kind) / size_of::<T>()];
        let bytes = bytemuck::cast_slice_mut(&mut records);
        scene.read_page(kind, PageNo(page as u32), bytes).unwrap();
        all.append(&mut records);
    }
    all
}
