//! Cut picking: a depth-first walk of the octree, near octants first, that ends where clusters are small enough, and rasters
//! what it ends on (paper section 5; Christensen 2008, section 3.3).

use crate::cluster::Cluster;
use crate::frame::Frame;
use crate::painter::Painter;
use crate::raster::{Raster, RasterTables};
use crate::shader::{Receiver, ShadeCounters, ShadeError};
use crate::simd::Simd;
use crate::source::{SceneSource, SourceError};
use glam::Vec3;
use pbgi_core::limits::{CUT_NODES_MAX, MORTON_BITS};
use pbgi_core::{NodeIndex, NodeKind, NodeRecord, PointIndex, PointRecord, SceneInfo, ShadeSettings};

/// Octants by distance from the nearest, as differences in bits.
const NEAR_TO_FAR: [u32; 8] = [0, 1, 2, 4, 3, 5, 6, 7];

/// What a walk needs that is the same for all receivers.
pub(crate) struct Walk<'a> {
    pub(crate) info: &'a SceneInfo,
    pub(crate) settings: &'a ShadeSettings,
    pub(crate) tables: &'a RasterTables,
    pub(crate) simd: Simd,
}

/// A voxel to visit; positions relative to the receiver.
#[derive(Clone, Copy)]
pub(crate) struct Visit {
    pub(crate) index: NodeIndex,
    pub(crate) center: Vec3,
    pub(crate) half: f32,
    pub(crate) level: u32,
    /// Path from the root, which names the voxel whatever the layout of the file.
    pub(crate) path: u64,
    /// Upper bound of the radii of its points.
    pub(crate) radius: f32,
}

/// Memory that walks use again and again.
#[derive(Default)]
pub(crate) struct Scratch {
    stack: Vec<Visit>,
    discs: Vec<(f32, PointRecord)>,
}

/// What one receiver sees: sums over bits.
#[derive(Clone, Copy, Default)]
pub(crate) struct Seen {
    /// Radiance, bit by bit.
    pub(crate) radiance: Vec3,
    /// Occlusion weight, bit by bit.
    pub(crate) occlusion: f32,
}

/// Walks the octree for one receiver and fills its raster.
pub(crate) fn gather<S: SceneSource>(
    walk: &Walk<'_>,
    receiver: &Receiver,
    frame: &Frame,
    source: &mut S,
    raster: &mut Raster,
    scratch: &mut Scratch,
    counters: &mut ShadeCounters,
) -> Result<Seen, ShadeError> {
    let (Some(root), Some(quantizer)) = (walk.info.root, walk.info.quantizer) else {
        return Ok(Seen::default());
    };
    let half = quantizer.edge / 2.0;
    let center = [0, 1, 2].map(|axis| (quantizer.origin[axis] + half - f64::from(receiver.position[axis])) as f32);
    let mut painter = Painter {
        walk,
        frame,
        raster,
        seen: Seen::default(),
    };
    scratch.stack.clear();
    let radius = walk.info.radius_max;
    scratch.stack.push(Visit {
        index: root,
        center: center.into(),
        half: half as f32,
        level: 0,
        path: 0,
        radius,
    });
    let mut visited = 0u32;
    while let Some(visit) = scratch.stack.pop() {
        if painter.culls(&visit) {
            continue;
        }
        visited += 1;
        if visited > CUT_NODES_MAX {
            return Err(ShadeError::Budget { nodes: CUT_NODES_MAX });
        }
        let node = *source.node(visit.index)?;
        check(&node, &visit, walk.info.settings.leaf_max)?;
        let cluster = Cluster::new(&node, &visit, receiver);
        match node.kind() {
            NodeKind::Overflow { .. } => {
                painter.draw_cluster(&cluster, &visit);
                counters.cut_elements += 1;
            }
            NodeKind::Inner { first, mask } => {
                if cluster.small_enough(walk.settings, false) {
                    painter.draw_cluster(&cluster, &visit);
                    counters.cut_elements += 1;
                } else {
                    push_children(&mut scratch.stack, &visit, &node, first, mask);
                }
            }
            NodeKind::Leaf { first, count } => {
                if cluster.small_enough(walk.settings, true) {
                    painter.draw_cluster(&cluster, &visit);
                    counters.cut_elements += 1;
                } else {
                    read_discs(source, first, count, receiver, &mut scratch.discs)?;
                    counters.cut_elements += u64::from(count);
                    painter.draw_leaf(&scratch.discs, &visit, receiver);
                }
            }
        }
    }
    counters.nodes_visited += u64::from(visited);
    Ok(painter.seen)
}

/// What a page says must fit where it was found: pages are checksummed, but a file may be forged.
#[inline(always)]
fn check(node: &NodeRecord, visit: &Visit, leaf_max: u32) -> Result<(), SourceError> {
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

#[inline(always)]
fn push_children(stack: &mut Vec<Visit>, visit: &Visit, node: &NodeRecord, first: NodeIndex, mask: u8) {
    let radius = visit.radius.min(node.radius_ratio() * 2.0 * visit.half);
    let near =
        u32::from(visit.center.x < 0.0) | u32::from(visit.center.y < 0.0) << 1 | u32::from(visit.center.z < 0.0) << 2;
    let half = visit.half * 0.5;
    for step in NEAR_TO_FAR.iter().rev() {
        let octant = near ^ step;
        if mask >> octant & 1 == 0 {
            continue;
        }
        let rank = (u32::from(mask) & ((1 << octant) - 1)).count_ones();
        let side = |bit: u32| if octant >> bit & 1 == 1 { half } else { -half };
        stack.push(Visit {
            index: NodeIndex(first.0.wrapping_add(rank)),
            center: visit.center + Vec3::new(side(0), side(1), side(2)),
            half,
            level: visit.level + 1,
            path: visit.path << 3 | u64::from(octant),
            radius,
        });
    }
}

/// Reads a leaf's points, nearest first.
#[inline(always)]
fn read_discs<S: SceneSource>(
    source: &mut S,
    first: PointIndex,
    count: u32,
    receiver: &Receiver,
    discs: &mut Vec<(f32, PointRecord)>,
) -> Result<(), SourceError> {
    discs.clear();
    let mut read = 0;
    while read < count {
        let first = PointIndex(first.0.wrapping_add(read));
        let points = source.points(first, count - read)?;
        read += points.len() as u32;
        discs.extend(points.iter().map(|point| {
            let distance = Vec3::from(point.position).distance_squared(receiver.position);
            (distance, *point)
        }));
    }
    discs.sort_by(|a, b| a.0.total_cmp(&b.0));
    Ok(())
}
