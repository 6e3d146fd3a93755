//! Cut picking: a depth-first walk of the octree, near octants first, that ends where clusters are small enough, and rasters
//! what it ends on (paper section 5, [Chr08] section 3.3).

use crate::footprint::{Footprint, Plane};
use crate::frame::Frame;
use crate::raster::{Raster, RasterTables};
use crate::shader::{Receiver, ShadeCounters, ShadeError};
use crate::source::{SceneSource, SourceError};
use glam::{Vec2, Vec3};
use half::slice::HalfFloatSliceExt;
use pbgi_core::cluster::separate_sides;
use pbgi_core::limits::{CUT_NODES_MAX, MORTON_BITS};
use pbgi_core::pack::area_normaliser;
use pbgi_core::sh::{SH_TERMS, basis};
use pbgi_core::{NodeIndex, NodeKind, NodeRecord, PointIndex, PointRecord, SceneInfo, ShadeSettings};

/// Zonal factor of the clamped cosine times Y00: the first area term of a cluster over its area.
const AREA_TERM: f32 = 0.886_226_9;
/// A cluster whose normals spread less than this (root mean square sine) and that is thinner than [`FLAT_THICKNESS`] is a
/// piece of a plane.
const FLAT_SPREAD: f32 = 0.25;
/// Standard deviation across the plane over the voxel's edge.
const FLAT_THICKNESS: f32 = 0.06;
/// A flat cluster that covers at least this share of its plane inside the voxel is drawn as the whole section. Sampling
/// noise in small leaves makes the share uncertain by about as much as this is below 1.
const SECTION_FILL: f32 = 0.7;
/// Above this the voxel holds two sheets, of which the receiver sees one.
const TWO_SHEETS_FILL: f32 = 1.6;
/// Share of the accepted solid angle at which clusters without a plane are accepted: their silhouette is a guess.
const ROUND_SHARE: f32 = 0.1;
/// Discs are drawn this much wider than their area says, because round ones of equal area leave gaps on a surface.
const DISC_SCALE: f32 = 1.4;
/// Cosine between normals from which a disc is taken for the receiver's own surface.
const SAME_SURFACE: f32 = 0.7;
/// How far from an arc through both a receiver and an element may stand, as a sine.
const ARC_SLACK: f32 = 0.15;
/// The same where the normals are opposed: a sheet seen from its back, or another surface close by.
const ARC_SLACK_OPPOSED: f32 = 0.03;
/// Distance in voxel edges, and in radii of a disc, within which an element may be the receiver's own surface.
const NEAR_VOXELS: f32 = 2.5;
const NEAR_RADII: f32 = 6.0;
/// Share of covered bits from which it pays to ask whether a voxel is hidden.
const HIDDEN_TEST_SHARE: f32 = 0.1;
/// Octants by distance from the nearest, as differences in bits.
const NEAR_TO_FAR: [u32; 8] = [0, 1, 2, 4, 3, 5, 6, 7];

/// What a walk needs that is the same for all receivers.
pub(crate) struct Walk<'a> {
    pub(crate) info: &'a SceneInfo,
    pub(crate) settings: &'a ShadeSettings,
    pub(crate) tables: &'a RasterTables,
}

/// A voxel to visit; positions relative to the receiver.
#[derive(Clone, Copy)]
pub(crate) struct Visit {
    index: NodeIndex,
    center: Vec3,
    half: f32,
    level: u32,
    /// Path from the root, which names the voxel whatever the layout of the file.
    path: u64,
    /// Upper bound of the radii of its points.
    radius: f32,
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
#[inline(always)]
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
                    for (_, point) in &scratch.discs {
                        painter.draw_disc(point, receiver);
                    }
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

/// A node in plain numbers, seen from one receiver.
struct Cluster {
    /// Relative to the receiver.
    centroid: Vec3,
    distance_squared: f32,
    axis: Vec3,
    /// Covariance, square world units: xx, yy, zz, xy, xz, yz.
    covariance: [f32; 6],
    area: f32,
    fill: f32,
    flat: bool,
    /// Receiver within the voxel's sphere.
    close: bool,
    /// The receiver's own surface passes here.
    own_surface: bool,
    normaliser: f32,
    sh: [[half::f16; 4]; SH_TERMS],
}

impl Cluster {
    #[inline(always)]
    fn new(node: &NodeRecord, visit: &Visit, receiver: &Receiver) -> Self {
        let edge = 2.0 * visit.half;
        let centroid = Vec3::from(node.centroid) - receiver.position;
        let axis = node.axis();
        let mut covariance = [0.0; 6];
        node.covariance.as_slice().convert_to_f32_slice(&mut covariance);
        for value in &mut covariance {
            *value *= edge * edge;
        }
        let normaliser = area_normaliser(edge);
        let across = quadratic_form(&covariance, axis).max(0.0).sqrt();
        let flat = node.spread() < FLAT_SPREAD && across < FLAT_THICKNESS * edge;
        let inside = visit.center.abs().max_element() <= visit.half * 1.01;
        let near = centroid.length_squared() < NEAR_VOXELS * NEAR_VOXELS * edge * edge;
        let own_surface = flat
            && near
            && (continues_surface(receiver.normal, axis, centroid)
                || (inside && is_aligned(receiver.normal, axis) && axis.dot(centroid).abs() < 0.08 * edge));
        Self {
            centroid,
            distance_squared: centroid.length_squared(),
            axis,
            covariance,
            area: node.sh[0][0].to_f32() * normaliser / AREA_TERM,
            fill: node.fill(),
            flat,
            close: visit.center.length_squared() < 3.0 * visit.half * visit.half * 1.2,
            own_surface,
            normaliser,
            sh: node.sh,
        }
    }

    /// Whether the cluster may stand for what is below it.
    #[inline(always)]
    fn small_enough(&self, settings: &ShadeSettings, leaf: bool) -> bool {
        let area = self.area.min(self.normaliser);
        if self.flat {
            let whole = leaf && self.fill >= SECTION_FILL;
            whole || (!self.close && area < settings.max_solid_angle * self.distance_squared)
        } else {
            !self.close && area < ROUND_SHARE * settings.max_solid_angle * self.distance_squared
        }
    }

    /// Power of the terms toward a direction: area, r, g, b over the normaliser.
    #[inline(always)]
    fn evaluate(&self, direction: Vec3) -> ([f32; 4], [f32; 4]) {
        let mut sh = [0.0f32; 4 * SH_TERMS];
        let halves: &[half::f16] = bytemuck::cast_slice(&self.sh);
        halves.convert_to_f32_slice(&mut sh);
        let y = basis(direction);
        // Even and odd bands apart: their sum looks along the direction, their difference against it.
        let (mut even, mut odd) = ([0.0f32; 4], [0.0f32; 4]);
        for (term, y) in y.iter().enumerate() {
            let sum = if (1..4).contains(&term) { &mut odd } else { &mut even };
            for channel in 0..4 {
                sum[channel] += sh[term * 4 + channel] * y;
            }
        }
        (even, odd)
    }
}

#[inline(always)]
fn is_aligned(a: Vec3, b: Vec3) -> bool {
    a.dot(b).abs() > SAME_SURFACE
}

/// Whether an element at `center` with `normal` is the receiver's own surface curving away, which only the flatness of the
/// element lifts above the receiver: the receiver is behind it, and both normals stand on one arc. On a circle the chord
/// makes equal and opposite angles with the normals at its ends.
#[inline(always)]
fn continues_surface(receiver_normal: Vec3, normal: Vec3, center: Vec3) -> bool {
    let facing = normal.dot(receiver_normal);
    let (normal, slack) = if facing < 0.0 {
        (-normal, ARC_SLACK_OPPOSED)
    } else {
        (normal, ARC_SLACK)
    };
    let behind = normal.dot(center);
    facing.abs() > SAME_SURFACE
        && behind >= 0.0
        && (behind + receiver_normal.dot(center)).abs() < slack * center.length()
}

#[inline(always)]
fn quadratic_form(m: &[f32; 6], v: Vec3) -> f32 {
    m[0] * v.x * v.x
        + m[1] * v.y * v.y
        + m[2] * v.z * v.z
        + 2.0 * (m[3] * v.x * v.y + m[4] * v.x * v.z + m[5] * v.y * v.z)
}

#[inline(always)]
fn multiply(m: &[f32; 6], v: Vec3) -> Vec3 {
    Vec3::new(
        m[0] * v.x + m[3] * v.y + m[4] * v.z,
        m[3] * v.x + m[1] * v.y + m[5] * v.z,
        m[4] * v.x + m[5] * v.y + m[2] * v.z,
    )
}

/// Axes and half extents of the rectangle in the plane across `normal` whose uniform covering has this covariance.
#[inline(always)]
fn rectangle_of(covariance: &[f32; 6], normal: Vec3) -> [(Vec3, f32); 2] {
    let (u, v) = normal.any_orthonormal_pair();
    let (cu, cv) = (multiply(covariance, u), multiply(covariance, v));
    let (a, b, c) = (u.dot(cu), u.dot(cv), v.dot(cv));
    let middle = 0.5 * (a + c);
    let reach = (0.25 * (a - c) * (a - c) + b * b).sqrt();
    let (large, small) = (middle + reach, (middle - reach).max(0.0));
    let turn = if (large - c).abs() + b.abs() > 1e-12 * large {
        Vec2::new(large - c, b)
    } else {
        Vec2::X
    };
    let turn = turn.normalize_or(Vec2::X);
    let first = u * turn.x + v * turn.y;
    let second = v * turn.x - u * turn.y;
    // A uniform segment of half length h has variance h^2 / 3.
    [(first, (3.0 * large).sqrt()), (second, (3.0 * small).sqrt())]
}

/// Draws elements into the raster and sums what they add.
struct Painter<'a> {
    walk: &'a Walk<'a>,
    frame: &'a Frame,
    raster: &'a mut Raster,
    seen: Seen,
}

impl Painter<'_> {
    /// Whether nothing of a voxel can be seen: below the horizon, or behind what is drawn already.
    #[inline(always)]
    fn culls(&self, visit: &Visit) -> bool {
        let reach = visit.half * 1.732_051 + visit.radius;
        if self.frame.normal().dot(visit.center) < -reach {
            return true;
        }
        let bits = self.walk.tables.bits();
        if self.raster.covered_count() == bits {
            return true;
        }
        let far = visit.center.length_squared() > 1.1 * reach * reach;
        far && self.raster.covered_count() as f32 > HIDDEN_TEST_SHARE * bits as f32
            && self.raster.hides(
                self.walk.tables,
                &Footprint::around_sphere(self.frame, visit.center, reach),
            )
    }

    #[inline(always)]
    fn draw_cluster(&mut self, cluster: &Cluster, visit: &Visit) {
        if cluster.own_surface {
            return;
        }
        if cluster.flat {
            self.draw_flat(cluster, visit)
        } else {
            self.draw_round(cluster, visit)
        }
    }

    /// A piece of a plane: the section of its voxel if it fills that, else the rectangle of its covariance.
    #[inline(always)]
    fn draw_flat(&mut self, cluster: &Cluster, visit: &Visit) {
        let plane = Plane::through(cluster.centroid, cluster.axis);
        let toward = cluster.axis.dot(cluster.centroid) < 0.0;
        let (footprint, drawn_area) = if cluster.fill >= SECTION_FILL {
            let section = Footprint::voxel_section(self.frame, visit.center, visit.half, plane);
            (section, cluster.area / cluster.fill)
        } else {
            self.rectangle(cluster, plane)
        };
        let distance = cluster.distance_squared.sqrt();
        let count = self.cover(&footprint, 1.0, distance, visit);
        if count > 0 {
            let (even, odd) = cluster.evaluate(cluster.axis);
            let power = |sign: f32| {
                Vec3::new(
                    even[1] + sign * odd[1],
                    even[2] + sign * odd[2],
                    even[3] + sign * odd[3],
                )
            };
            let (front, back) = separate_sides(power(1.0), power(-1.0));
            let power = if toward { front } else { back };
            // One sheet shows all its area; of two the receiver sees the nearer.
            let area = if cluster.fill > TWO_SHEETS_FILL {
                drawn_area
            } else {
                cluster.area
            };
            self.seen.radiance += power * (cluster.normaliser / area) * count as f32;
        }
    }

    #[inline(always)]
    fn rectangle(&self, cluster: &Cluster, plane: Plane) -> (Footprint, f32) {
        let [(u, mut a), (v, mut b)] = rectangle_of(&cluster.covariance, plane.normal);
        // Shrunk where the points cover less than the rectangle; it is never made larger.
        let scale = (cluster.area / (4.0 * a * b).max(1e-30)).min(1.0).sqrt();
        a *= scale;
        b *= scale;
        let local = |v| self.frame.local_from_world(v);
        let sides = [(local(u), a), (local(v), b)];
        let footprint = Footprint::rectangle(local(cluster.centroid), local(plane.normal), plane.distance, sides);
        (footprint, 4.0 * a * b)
    }

    /// A cluster without a plane: the rectangle of its covariance seen from the receiver, as wide as its projected area.
    #[inline(always)]
    fn draw_round(&mut self, cluster: &Cluster, visit: &Visit) {
        let distance = cluster.distance_squared.sqrt();
        if distance < 1e-6 * visit.half {
            return;
        }
        let direction = cluster.centroid / distance;
        let (even, odd) = cluster.evaluate(-direction);
        // Both sides of every disc: twice the even bands.
        let shown = (2.0 * even[0]).max(0.0) * cluster.normaliser;
        let plane = Plane {
            normal: direction,
            distance,
        };
        let [(u, mut a), (v, mut b)] = rectangle_of(&cluster.covariance, direction);
        let whole = (4.0 * a * b).max(1e-30);
        let share = shown / whole;
        let mut density = 1.0;
        if share < OPAQUE_SHARE {
            density = share / OPAQUE_SHARE;
        }
        let scale = (share.clamp(OPAQUE_SHARE, 1.0) * ROUND_SCALE).sqrt();
        a *= scale;
        b *= scale;
        let local = |v| self.frame.local_from_world(v);
        let sides = [(local(u), a), (local(v), b)];
        let footprint = Footprint::rectangle(local(cluster.centroid), local(plane.normal), distance, sides);
        let count = self.cover(&footprint, density, distance, visit);
        if count > 0 {
            let power = Vec3::new(even[1] + odd[1], even[2] + odd[2], even[3] + odd[3]).max(Vec3::ZERO);
            let drawn = (4.0 * a * b * density).min(shown).max(1e-30);
            self.seen.radiance += power * (cluster.normaliser / drawn) * count as f32;
        }
    }

    #[inline(always)]
    fn draw_disc(&mut self, point: &PointRecord, receiver: &Receiver) {
        let center = Vec3::from(point.position) - receiver.position;
        let normal = point.normal();
        let plane = Plane::through(center, normal);
        let distance = center.length();
        if distance < NEAR_RADII * point.radius {
            let touched =
                is_aligned(receiver.normal, normal) && plane.distance < self.walk.settings.bias * point.radius;
            if touched || continues_surface(receiver.normal, normal, center) {
                return;
            }
        }
        let footprint = Footprint::disc(self.frame, center, plane, point.radius * DISC_SCALE);
        let weight = self.weight(distance, point.radius);
        let count = self.raster.cover(self.walk.tables, &footprint, 1.0, weight, 0);
        if count > 0 {
            let sides = point.sides();
            let radiance = if normal.dot(center) < 0.0 {
                sides.front
            } else {
                sides.back
            };
            self.seen.radiance += Vec3::from(radiance) * count as f32;
            self.seen.occlusion += weight * count as f32;
        }
    }

    #[inline(always)]
    fn cover(&mut self, footprint: &Footprint, density: f32, distance: f32, visit: &Visit) -> u32 {
        let weight = self.weight(distance, visit.half);
        let count = self
            .raster
            .cover(self.walk.tables, footprint, density, weight, visit.path);
        self.seen.occlusion += weight * count as f32;
        count
    }

    /// How much a surface at `distance`, reaching `extent` to both sides, counts as an occluder.
    #[inline(always)]
    fn weight(&self, distance: f32, extent: f32) -> f32 {
        let settings = self.walk.settings;
        let within = ((settings.max_dist - distance + extent) / (2.0 * extent)).clamp(0.0, 1.0);
        if settings.falloff > 0.0 {
            within * (-settings.falloff * distance).exp()
        } else {
            within
        }
    }
}

/// Share of its rectangle that a round cluster must show to be drawn opaque; thinner ones are drawn with holes.
const OPAQUE_SHARE: f32 = 0.4;
/// Area by which an opaque round cluster is drawn larger: a rectangle never meets its neighbours exactly, and a closed wall
/// must not leak.
const ROUND_SCALE: f32 = 1.2;
