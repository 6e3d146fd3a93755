//! Cut picking: a depth-first walk of the octree, near octants first, that ends where clusters are small enough, and rasters
//! what it ends on (paper section 5; Christensen 2008, section 3.3).
//!
//! Eight receivers walk together. Each decides for itself at every node, and receivers that would visit children in another
//! order part, so that what a receiver gets does not depend on its company.

use crate::cluster::Cluster;
use crate::frame::Frame;
use crate::leaf::{Cube, Leaves, Part};
use crate::painter::Painter;
use crate::raster::{Raster, RasterTables, Window};
use crate::shader::{Receiver, ShadeCounters, ShadeError};
use crate::simd::{Floats, LANES, ScalarFloats, Words};
use crate::source::{SceneSource, SourceError, Upcoming, Wanted};
use crate::vector::{Frames, Vector};
use glam::{DVec3, Vec3};
use pbgi_core::limits::{CUT_NODES_MAX, MORTON_BITS};
use pbgi_core::{NodeIndex, NodeKind, NodeRecord, PointIndex, PointRecord, SceneInfo, ShadeSettings};
use std::ops::ControlFlow;

/// Octants by distance from the nearest, as differences in bits.
const NEAR_TO_FAR: [u32; 8] = [0, 1, 2, 4, 3, 5, 6, 7];

/// Cosine to the receiver's normal below which clusters grow no larger.
const COSINE_MIN: f32 = 0.25;

/// What a walk needs that is the same for all receivers.
pub(crate) struct Walk<'a> {
    pub(crate) info: &'a SceneInfo,
    pub(crate) settings: &'a ShadeSettings,
    pub(crate) tables: &'a RasterTables,
}

/// Eight receivers, world space. Lanes without a receiver repeat another.
pub(crate) struct Pack<F> {
    position: Vector<F>,
    pub(crate) frames: Frames<F>,
    /// Lanes with a receiver, one bit each.
    lanes: u8,
    /// The root's centre relative to the receivers.
    root: Vector<F>,
    /// One receiver, for guesses at what all of them will do.
    leader: Leader,
}

/// One receiver of a pack.
#[derive(Clone, Copy)]
struct Leader {
    position: Vec3,
    normal: Vec3,
    /// The root's centre relative to it.
    root: Vec3,
}

/// A voxel to visit.
#[derive(Clone, Copy)]
pub(crate) struct Visit {
    pub(crate) index: NodeIndex,
    /// Centre relative to the root's.
    pub(crate) offset: Vec3,
    pub(crate) half: f32,
    pub(crate) level: u32,
    /// Path from the root, which names the voxel whatever the layout of the file.
    pub(crate) path: u64,
    /// Upper bound of the radii of its points.
    pub(crate) radius: f32,
    /// Receivers that visit it, one bit each.
    pub(crate) lanes: u8,
}

impl Visit {
    /// How far its points' discs reach from its centre.
    #[inline(always)]
    pub(crate) fn reach(&self) -> f32 {
        self.half * 1.732_051 + self.radius
    }

    /// Distance from its centre up to which it is always opened: receivers that may be inside.
    #[inline(always)]
    fn apart(&self) -> f32 {
        1.9 * self.half
    }
}

/// A voxel to visit as receivers see it: what can be told when its parent is opened, for eight children at a time faster than one
/// by one.
pub(crate) struct Sight<F: Floats, const WORDS: usize> {
    pub(crate) visit: Visit,
    /// How far away its centre is.
    distance: F,
    /// The most that light from it can count for, as a cosine; low ones still are discs to be told apart from each other.
    cosine: F,
    /// Where it shows.
    pub(crate) window: Window<F, WORDS>,
    /// Lanes far enough from it for the window to mean something.
    pub(crate) far: u8,
}

impl<F: Floats, const WORDS: usize> Sight<F, WORDS> {
    /// `None` for a voxel that is lower than every bit.
    #[inline(always)]
    fn new(walk: &Walk<'_>, pack: &Pack<F>, visit: Visit) -> Option<Self> {
        let center = pack.root + Vector::splat(visit.offset);
        let distance = center.length_squared().sqrt();
        let reach = visit.reach();
        let local = pack.frames.local_from_world(center);
        let height = local.z + F::splat(reach);
        let nearest = distance - F::splat(reach);
        let below = height.less(nearest * F::splat(walk.tables.lowest));
        let lanes = visit.lanes & !below.lanes();
        if lanes == 0 {
            return None;
        }
        Some(Self {
            visit: Visit { lanes, ..visit },
            distance,
            cosine: (height / distance).clamp(COSINE_MIN, 1.0),
            window: Window::of_spheres(walk.tables, &local, reach, lanes),
            far: F::splat(1.05 * reach).less(distance).lanes(),
        })
    }
}

/// Memory that walks use again and again.
#[derive(Default)]
pub(crate) struct Scratch {
    points: Vec<PointRecord>,
    leaves: Leaves,
    order: Vec<(f32, u32)>,
}

/// What eight receivers see: sums over bits.
pub(crate) struct Seen<F> {
    pub(crate) radiance: Vector<F>,
    pub(crate) occlusion: F,
}

impl<F: Floats> Pack<F> {
    /// Up to eight receivers with unit normals.
    #[inline(always)]
    pub(crate) fn new(info: &SceneInfo, receivers: &[Receiver], frames: &[Frame; LANES]) -> Self {
        let receiver = |lane: usize| receivers[lane.min(receivers.len() - 1)];
        let middle = info.quantizer.map_or(DVec3::ZERO, |quantizer| {
            DVec3::from(quantizer.origin) + DVec3::splat(quantizer.edge / 2.0)
        });
        let root = |lane: usize| (middle - receiver(lane).position.as_dvec3()).as_vec3();
        Self {
            position: Vector::from_array(std::array::from_fn(|lane| receiver(lane).position)),
            frames: Frames::new(frames),
            lanes: (u8::MAX as u32 >> (LANES - receivers.len().min(LANES))) as u8,
            root: Vector::from_array(std::array::from_fn(root)),
            leader: Leader {
                position: receiver(0).position,
                normal: receiver(0).normal,
                root: root(0),
            },
        }
    }

    /// A place of the world, relative to the receivers.
    #[inline(always)]
    pub(crate) fn relative(&self, place: Vec3) -> Vector<F> {
        Vector::splat(place) - self.position
    }
}

/// What a gather has before it.
struct Pending<'a, F: Floats, const WORDS: usize> {
    walk: &'a Walk<'a>,
    leader: Leader,
    stack: &'a [Sight<F, WORDS>],
}

impl<F: Floats, const WORDS: usize> Upcoming for Pending<'_, F, WORDS> {
    fn tell<'a>(
        &self,
        peek: impl Fn(NodeIndex) -> Option<&'a NodeRecord>,
        mut want: impl FnMut(Wanted) -> ControlFlow<()>,
    ) -> ControlFlow<()> {
        for Sight { visit, .. } in self.stack.iter().rev() {
            let center = self.leader.root + visit.offset;
            let height = self.leader.normal.dot(center) + visit.reach();
            if height < 0.0 {
                continue;
            }
            let Some(node) = peek(visit.index) else {
                want(Wanted::Node(visit.index))?;
                continue;
            };
            let cluster = Cluster::new::<ScalarFloats>(node, 2.0 * visit.half);
            let (from, _) = cluster.accepted_from_squared(self.walk.settings.max_solid_angle);
            let cosine = (height / center.length()).clamp(COSINE_MIN, 1.0);
            let distance = (cluster.centroid - self.leader.position).length_squared();
            let whole = matches!(node.kind(), NodeKind::Leaf { .. }) && cluster.fills_section();
            if !whole && (distance <= from * cosine || center.length() <= visit.apart()) {
                Wanted::below(node).map_or(ControlFlow::Continue(()), &mut want)?;
            }
        }
        ControlFlow::Continue(())
    }
}

/// Walks the octree for a pack of receivers and fills their rasters.
#[inline(always)]
pub(crate) fn gather<F: Floats, S: SceneSource, const WORDS: usize>(
    walk: &Walk<'_>,
    pack: &Pack<F>,
    source: &mut S,
    raster: &mut Raster<F, WORDS>,
    stack: &mut Vec<Sight<F, WORDS>>,
    scratch: &mut Scratch,
    counters: &mut ShadeCounters,
) -> Result<Seen<F>, ShadeError> {
    let mut painter = Painter::new(walk, pack, raster);
    let Scratch { points, leaves, order } = scratch;
    stack.clear();
    if let (Some(root), Some(quantizer)) = (walk.info.root, walk.info.quantizer) {
        let root = Visit {
            index: root,
            offset: Vec3::ZERO,
            half: (quantizer.edge / 2.0) as f32,
            level: 0,
            path: 0,
            radius: walk.info.radius_max,
            lanes: pack.lanes,
        };
        stack.extend(Sight::new(walk, pack, root));
    }
    let middle = walk.info.quantizer.map_or(DVec3::ZERO, |quantizer| {
        DVec3::from(quantizer.origin) + DVec3::splat(quantizer.edge / 2.0)
    });
    let mut visited = F::Words::splat(0);
    while let Some(sight) = stack.pop() {
        let lanes = painter.seen_by(&sight);
        if lanes == 0 {
            continue;
        }
        let visit = sight.visit;
        let center = pack.root + Vector::splat(visit.offset);
        visited = visited.wrapping_sub(F::Words::from_lanes(lanes));
        if visited.greater_signed(F::Words::splat(CUT_NODES_MAX)).lanes() != 0 {
            return Err(ShadeError::Budget { nodes: CUT_NODES_MAX });
        }
        let lane_count = u64::from(lanes.count_ones());
        counters.nodes_visited += lane_count;
        let pending = Pending {
            walk,
            leader: pack.leader,
            stack,
        };
        let node = source.node(visit.index, lanes, &pending)?;
        check(node, &visit, walk.info.settings.leaf_max)?;
        let radius = visit.radius.min(node.radius_ratio() * 2.0 * visit.half);
        let cluster = Cluster::new::<F>(node, 2.0 * visit.half);
        let centroid = pack.relative(cluster.centroid);
        let kind = node.kind();
        let whole = match kind {
            NodeKind::Overflow { .. } => true,
            NodeKind::Leaf { .. } => cluster.fills_section(),
            NodeKind::Inner { .. } => false,
        };
        let accepted = if whole {
            lanes
        } else {
            let apart = F::splat(visit.apart()).less(sight.distance);
            let (from, from_stretched) = cluster.accepted_from_squared(walk.settings.max_solid_angle);
            // Squared, and the larger the less its light counts.
            let distance = centroid.length_squared() / sight.cosine;
            let accepted = lanes & (apart & F::splat(from).less(distance)).lanes();
            let stretched = lanes & !accepted & (apart & F::splat(from_stretched).less(distance)).lanes();
            if stretched == 0 {
                accepted
            } else {
                accepted | stretched & !cluster.own_surface(pack.frames.z, centroid, center)
            }
        };
        if accepted != 0 {
            counters.cut_elements += u64::from(accepted.count_ones());
            painter.draw_cluster(&cluster, &visit, center, centroid, accepted);
        }
        let mut opened = lanes & !accepted;
        if opened == 0 {
            continue;
        }
        let mut parts: &[Part] = &[];
        if let NodeKind::Leaf { first, count } = kind {
            counters.cut_elements += u64::from(count) * u64::from(opened.count_ones());
            read_points(source, first, count, opened, &pending, points)?;
            let voxel = Cube {
                center: (middle + visit.offset.as_dvec3()).as_vec3(),
                half: visit.half,
            };
            parts = leaves.parts((visit.index, visit.path), points, voxel);
        }
        // The octant of the voxel that is nearest to a receiver.
        let zero = F::splat(0.0);
        let negative = [
            center.x.less(zero).lanes(),
            center.y.less(zero).lanes(),
            center.z.less(zero).lanes(),
        ];
        while opened != 0 {
            let lane = opened.trailing_zeros();
            let mut together = opened;
            let mut near = 0;
            for (axis, negative) in negative.into_iter().enumerate() {
                let side = negative >> lane & 1;
                near |= u32::from(side) << axis;
                together &= if side == 1 { negative } else { !negative };
            }
            opened &= !together;
            match kind {
                NodeKind::Inner { first, mask } => {
                    for child in children(&visit, radius, first, mask, near, together) {
                        stack.extend(Sight::new(walk, pack, child));
                    }
                }
                _ => painter.draw_parts(parts, order, &visit, near, together),
            }
        }
    }
    Ok(Seen {
        radiance: painter.radiance,
        occlusion: painter.occlusion,
    })
}

/// What a page says must fit where it was found: pages are checksummed, but a file may be forged.
#[inline(always)]
pub(crate) fn check(node: &NodeRecord, visit: &Visit, leaf_max: u32) -> Result<(), SourceError> {
    let fits = match node.kind() {
        NodeKind::Inner { mask, .. } => mask != 0 && visit.level < MORTON_BITS,
        NodeKind::Leaf { count, .. } => count != 0 && count <= leaf_max,
        NodeKind::Overflow { count, .. } => count != 0,
    };
    if fits && node.level() == visit.level {
        Ok(())
    } else {
        Err(SourceError::Corrupt(format!(
            "node {} does not fit level {} of the octree",
            visit.index.0, visit.level
        )))
    }
}

/// The children for receivers to whom octant `near` is the nearest, that one last. No point of theirs is larger than `radius`.
#[inline(always)]
pub(crate) fn children(
    visit: &Visit,
    radius: f32,
    first: NodeIndex,
    mask: u8,
    near: u32,
    lanes: u8,
) -> impl Iterator<Item = Visit> {
    let half = visit.half * 0.5;
    let octants = NEAR_TO_FAR.iter().rev().map(move |step| near ^ step);
    octants
        .filter(move |octant| mask >> octant & 1 == 1)
        .map(move |octant| {
            let rank = (u32::from(mask) & ((1 << octant) - 1)).count_ones();
            let side = |bit: u32| if octant >> bit & 1 == 1 { half } else { -half };
            Visit {
                index: NodeIndex(first.0.wrapping_add(rank)),
                offset: visit.offset + Vec3::new(side(0), side(1), side(2)),
                half,
                level: visit.level + 1,
                path: visit.path << 3 | u64::from(octant),
                radius,
                lanes,
            }
        })
}

/// Reads a leaf's points.
#[inline(always)]
pub(crate) fn read_points<S: SceneSource>(
    source: &mut S,
    first: PointIndex,
    count: u32,
    lanes: u8,
    upcoming: &impl Upcoming,
    points: &mut Vec<PointRecord>,
) -> Result<(), SourceError> {
    points.clear();
    while (points.len() as u32) < count {
        let read = points.len() as u32;
        let first = PointIndex(first.0.wrapping_add(read));
        points.extend_from_slice(source.points(first, count - read, lanes, upcoming)?);
    }
    Ok(())
}
