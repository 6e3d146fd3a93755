//! Rays in, the surface that they meet out: pictures of a scene that has no meshes.
//!
//! Rays of one origin walk together, near octants first, down to nodes that are smaller than a pixel, and past what all of
//! them have met already. What they end on is a heap of discs, each larger than its share of the surface, so that neighbours
//! overlap. A ray meets the nearest disc that it passes close to the middle of; position, normal and radiance are blended
//! over the discs around it at that depth (Zwicker et al. 2001, "Surface Splatting").

use crate::cut::{Visit, check, children, read_points};
use crate::shader::{ShadeCounters, ShadeError};
use crate::source::{SceneSource, Upcoming, Wanted};
use bytemuck::{Pod, Zeroable};
use glam::{DVec3, Vec3};
use pbgi_core::limits::CUT_NODES_MAX;
use pbgi_core::sh::basis;
use pbgi_core::{NodeIndex, NodeKind, NodeRecord, PointRecord, SceneInfo};
use std::ops::ControlFlow;

/// Rays that walk together.
const PACKET_RAYS: usize = 64;
/// Radius of a disc's kernel over its own: discs of equal shares of a surface are 1.8 radii apart, and random ones leave
/// gaps twice as wide.
const KERNEL_RADII: f32 = 2.2;
/// A kernel is never narrower than this many pixels, so that no disc falls between two rays.
const KERNEL_PIXELS: f32 = 0.9;
/// A ray meets a disc within this share of its kernel; beyond, the disc is only blended in.
const CORE_SHARE: f32 = 0.75;
/// Depth over which discs belong to one surface, in kernels.
const DEPTH_KERNELS: f32 = 0.8;
/// A node is drawn whole from where it is this many pixels wide.
const NODE_PIXELS: f32 = 1.0;
/// Discs seen at a smaller cosine are edge-on: they cover nothing.
const EDGE_ON: f32 = 0.04;
/// Weight of the blend from which a ray that met no disc is covered all the same.
const COVERING_WEIGHT: f32 = 0.4;

/// A ray, world space.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub struct Ray {
    /// Where it starts.
    pub origin: Vec3,
    /// Where it goes, of any length; one without a direction meets nothing.
    pub direction: Vec3,
}

/// What a ray meets; zeros where it meets nothing.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub struct Hit {
    /// Place on the surface, world space.
    pub position: [f32; 3],
    /// Unit normal on the side of the ray.
    pub normal: [f32; 3],
    /// Radiance that the points send back along the ray, W/(m2 sr).
    pub radiance: [f32; 3],
    /// 1 on a surface, less at its rim, 0 beside it.
    pub coverage: f32,
}

/// Traces groups of rays through one scene. One per thread.
pub struct Tracer {
    info: SceneInfo,
    pixel_angle: f32,
    stack: Vec<Visit>,
    points: Vec<PointRecord>,
    discs: Vec<Disc>,
    counters: ShadeCounters,
}

/// A piece of surface, relative to the origin of the rays.
#[derive(Clone, Copy, Debug)]
struct Disc {
    center: Vec3,
    normal: Vec3,
    kernel: f32,
    /// Of the side of the normal, and of the other one.
    radiance: [Vec3; 2],
}

/// Rays of one origin.
struct Packet<'a> {
    origin: Vec3,
    directions: &'a [Vec3],
    axis: Vec3,
    /// Of the cone around all of them.
    cosine: f32,
    sine: f32,
    pixel_angle: f32,
    /// Depth at which a ray has met a disc, and the kernel of that.
    front: [(f32, f32); PACKET_RAYS],
}

impl Tracer {
    /// For a scene, and neighbouring rays `pixel_angle` radians apart.
    pub fn new(info: &SceneInfo, pixel_angle: f32) -> Self {
        Self {
            info: info.clone(),
            pixel_angle,
            stack: Vec::new(),
            points: Vec::new(),
            discs: Vec::new(),
            counters: ShadeCounters::default(),
        }
    }

    /// Traces a group of neighbouring rays. The results depend on the scene and on the group alone.
    ///
    /// # Errors
    /// A page that cannot be had, a scene that contradicts itself, or slices of different lengths.
    pub fn trace_group<S: SceneSource>(
        &mut self,
        rays: &[Ray],
        source: &mut S,
        hits: &mut [Hit],
    ) -> Result<(), ShadeError> {
        if rays.len() != hits.len() {
            let (receivers, results) = (rays.len(), hits.len());
            return Err(ShadeError::Lengths { receivers, results });
        }
        hits.fill(Hit::default());
        let mut start = 0;
        for run in rays.chunk_by(|a, b| a.origin == b.origin) {
            for packet in run.chunks(PACKET_RAYS) {
                self.trace_packet(packet, source, &mut hits[start..start + packet.len()])?;
                start += packet.len();
            }
        }
        Ok(())
    }

    /// Work done since the start; receivers are rays.
    pub fn counters(&self) -> ShadeCounters {
        self.counters
    }

    fn trace_packet<S: SceneSource>(
        &mut self,
        rays: &[Ray],
        source: &mut S,
        hits: &mut [Hit],
    ) -> Result<(), ShadeError> {
        let directions: Vec<Vec3> = rays.iter().map(|ray| ray.direction.normalize_or_zero()).collect();
        let Some(mut packet) = Packet::new(rays, &directions, self.pixel_angle) else {
            return Ok(());
        };
        self.counters.receivers += rays.len() as u64;
        self.discs.clear();
        self.walk(&mut packet, source)?;
        for (hit, (direction, front)) in hits.iter_mut().zip(directions.iter().zip(&packet.front)) {
            *hit = blend(&self.discs, packet.origin, *direction, *front, self.pixel_angle);
        }
        Ok(())
    }

    /// Collects the discs that the rays may meet.
    fn walk<S: SceneSource>(&mut self, packet: &mut Packet<'_>, source: &mut S) -> Result<(), ShadeError> {
        let (Some(root), Some(quantizer)) = (self.info.root, self.info.quantizer) else {
            return Ok(());
        };
        let middle = DVec3::from(quantizer.origin) + DVec3::splat(quantizer.edge / 2.0);
        let middle = (middle - packet.origin.as_dvec3()).as_vec3();
        source.begin_pack();
        self.stack.clear();
        self.stack.push(Visit {
            index: root,
            offset: Vec3::ZERO,
            half: (quantizer.edge / 2.0) as f32,
            level: 0,
            path: 0,
            radius: self.info.radius_max,
            lanes: 1,
        });
        let mut visited = 0;
        while let Some(visit) = self.stack.pop() {
            let center = middle + visit.offset;
            if !packet.may_see(&visit, center) {
                continue;
            }
            visited += 1;
            if visited > CUT_NODES_MAX {
                return Err(ShadeError::Budget { nodes: CUT_NODES_MAX });
            }
            self.counters.nodes_visited += 1;
            let pending = Pending {
                packet,
                middle,
                stack: &self.stack,
            };
            let node = source.node(visit.index, 1, &pending)?;
            check(node, &visit, self.info.settings.leaf_max)?;
            let small = packet.is_small(&visit, center);
            match node.kind() {
                NodeKind::Inner { first, mask } if !small => {
                    let radius = visit.radius.min(node.radius_ratio() * 2.0 * visit.half);
                    let side = |axis: f32, bit: u32| u32::from(axis < 0.0) << bit;
                    let near = side(center.x, 0) | side(center.y, 1) | side(center.z, 2);
                    self.stack.extend(children(&visit, radius, first, mask, near, 1));
                }
                NodeKind::Leaf { first, count } if !small => {
                    read_points(source, first, count, 1, &pending, &mut self.points)?;
                    for point in &self.points {
                        let disc = Disc::of_point(point, packet.origin);
                        if packet.take(&disc) {
                            self.discs.push(disc);
                        }
                    }
                }
                _ => {
                    let disc = Disc::of_node(node, visit.half, packet.origin);
                    if packet.take(&disc) {
                        self.discs.push(disc);
                    }
                }
            }
        }
        self.counters.cut_elements += self.discs.len() as u64;
        Ok(())
    }
}

/// What a packet has before it.
struct Pending<'a> {
    packet: &'a Packet<'a>,
    /// The root's centre relative to the origin.
    middle: Vec3,
    stack: &'a [Visit],
}

impl Upcoming for Pending<'_> {
    fn tell<'a>(
        &self,
        peek: impl Fn(NodeIndex) -> Option<&'a NodeRecord>,
        mut want: impl FnMut(Wanted) -> ControlFlow<()>,
    ) -> ControlFlow<()> {
        for visit in self.stack.iter().rev() {
            let center = self.middle + visit.offset;
            if !self.packet.may_see(visit, center) {
                continue;
            }
            let wanted = match peek(visit.index) {
                None => Some(Wanted::Node(visit.index)),
                Some(node) if !self.packet.is_small(visit, center) => Wanted::below(node),
                Some(_) => None,
            };
            wanted.map_or(ControlFlow::Continue(()), &mut want)?;
        }
        ControlFlow::Continue(())
    }
}

impl<'a> Packet<'a> {
    /// `None` if there is nothing to trace.
    fn new(rays: &[Ray], directions: &'a [Vec3], pixel_angle: f32) -> Option<Self> {
        let origin = rays.first()?.origin;
        let axis = directions.iter().sum::<Vec3>().try_normalize()?;
        if !origin.is_finite() {
            return None;
        }
        let real = directions.iter().filter(|direction| **direction != Vec3::ZERO);
        let cosine = real.map(|direction| direction.dot(axis)).fold(1.0, f32::min);
        // Beyond a right angle a cone is no bound; half a space is.
        let cosine = cosine.max(0.0);
        Some(Self {
            origin,
            directions,
            axis,
            cosine,
            sine: (1.0 - cosine * cosine).max(0.0).sqrt(),
            pixel_angle,
            front: [(f32::INFINITY, 0.0); PACKET_RAYS],
        })
    }

    /// Whether a ray may meet something of a voxel around `center`, relative to the origin.
    fn may_see(&self, visit: &Visit, center: Vec3) -> bool {
        let distance = center.length();
        let pixel = self.pixel_angle * distance;
        let reach = visit.half * 3f32.sqrt() + KERNEL_RADII * visit.radius + KERNEL_PIXELS * pixel;
        self.may_meet(center, distance, reach)
    }

    /// Whether a voxel is drawn whole.
    fn is_small(&self, visit: &Visit, center: Vec3) -> bool {
        let distance = center.length();
        2.0 * visit.half <= NODE_PIXELS * self.pixel_angle * distance && distance > 2.0 * visit.half
    }

    /// Whether a ball may touch a ray before that has met a disc.
    fn may_meet(&self, center: Vec3, distance: f32, reach: f32) -> bool {
        if distance <= reach {
            return true;
        }
        let along = center.dot(self.axis);
        let across = (center - self.axis * along).length();
        let fronts = &self.front[..self.directions.len()];
        let behind = |(depth, kernel): &(f32, f32)| distance - reach > depth + DEPTH_KERNELS * kernel;
        across * self.cosine - along * self.sine <= reach && along > -reach && !fronts.iter().all(behind)
    }

    /// Lets the rays meet a disc; whether any of them touches it.
    fn take(&mut self, disc: &Disc) -> bool {
        let distance = disc.center.length();
        if !self.may_meet(
            disc.center,
            distance,
            disc.kernel + KERNEL_PIXELS * self.pixel_angle * distance,
        ) {
            return false;
        }
        let mut touched = false;
        for (direction, front) in self.directions.iter().zip(&mut self.front) {
            if let Some(Touch { depth, kernel, share }) = disc.touch(*direction, self.pixel_angle) {
                touched = true;
                if share < CORE_SHARE * CORE_SHARE && depth < front.0 {
                    *front = (depth, kernel);
                }
            }
        }
        touched
    }
}

/// Where a ray passes a disc.
struct Touch {
    depth: f32,
    /// Radius of the kernel that it passes through.
    kernel: f32,
    /// Squared distance from the middle over the squared radius, below 1.
    share: f32,
}

impl Disc {
    fn of_point(point: &PointRecord, origin: Vec3) -> Self {
        let sides = point.sides();
        Self {
            center: Vec3::from(point.position) - origin,
            normal: point.normal(),
            kernel: KERNEL_RADII * point.radius,
            radiance: [sides.front.into(), sides.back.into()],
        }
    }

    fn of_node(node: &NodeRecord, half: f32, origin: Vec3) -> Self {
        let center = Vec3::from(node.centroid) - origin;
        // Seen from here, whichever side that is.
        let radiance = radiance_toward(node, -center.normalize_or(Vec3::Y));
        Self {
            center,
            normal: node.axis(),
            kernel: KERNEL_RADII * half,
            radiance: [radiance; 2],
        }
    }

    fn touch(&self, direction: Vec3, pixel_angle: f32) -> Option<Touch> {
        let along = self.center.dot(direction);
        // From the vector: the difference of two squares would lose it far away.
        let across = (self.center - direction * along).length_squared();
        let pixels = KERNEL_PIXELS * pixel_angle * along;
        let kernel = self.kernel.max(pixels);
        if along <= 0.0 || across >= kernel * kernel {
            return None;
        }
        let (mut depth, mut squared) = (along, across);
        if self.kernel > pixels {
            let facing = self.normal.dot(direction);
            if facing.abs() < EDGE_ON {
                return None;
            }
            depth = self.center.dot(self.normal) / facing;
            squared = (direction * depth - self.center).length_squared();
        }
        let share = squared / (kernel * kernel);
        (share < 1.0 && depth > 0.0).then_some(Touch { depth, kernel, share })
    }
}

/// Radiance of a node toward a unit direction.
fn radiance_toward(node: &NodeRecord, direction: Vec3) -> Vec3 {
    let y = basis(direction);
    let (mut area, mut power) = (0.0, Vec3::ZERO);
    for (term, (values, y)) in node.sh.iter().zip(y).enumerate() {
        let [front, red, green, blue] = values.map(half::f16::to_f32);
        // Both sides have an area: twice the even bands.
        if !(1..4).contains(&term) {
            area += 2.0 * front * y;
        }
        power += Vec3::new(red, green, blue) * y;
    }
    if area > 0.0 {
        (power / area).max(Vec3::ZERO)
    } else {
        Vec3::ZERO
    }
}

/// The surface around the depth at which a ray met a disc; around the nearest touch if it met none.
fn blend(discs: &[Disc], origin: Vec3, direction: Vec3, front: (f32, f32), pixel_angle: f32) -> Hit {
    if direction == Vec3::ZERO {
        return Hit::default();
    }
    let touches = || {
        discs
            .iter()
            .filter_map(|disc| Some((disc, disc.touch(direction, pixel_angle)?)))
    };
    let met = front.0.is_finite();
    let (depth, kernel) = if met {
        front
    } else {
        let nearest = touches().map(|(_, touch)| (touch.depth, touch.kernel));
        nearest.fold((f32::INFINITY, 0.0), |a, b| if b.0 < a.0 { b } else { a })
    };
    let (mut weight, mut along, mut normal, mut radiance) = (0.0, 0.0, Vec3::ZERO, Vec3::ZERO);
    for (disc, touch) in touches() {
        if (touch.depth - depth).abs() > DEPTH_KERNELS * kernel {
            continue;
        }
        let w = (1.0 - touch.share) * (1.0 - touch.share);
        let away = disc.normal.dot(direction) > 0.0;
        weight += w;
        along += w * touch.depth;
        normal += disc.normal * if away { -w } else { w };
        radiance += disc.radiance[usize::from(away)] * w;
    }
    let Some(normal) = normal.try_normalize().filter(|_| weight > 0.0) else {
        return Hit::default();
    };
    Hit {
        position: (origin + direction * (along / weight)).to_array(),
        normal: normal.to_array(),
        radiance: (radiance / weight).to_array(),
        coverage: if met { 1.0 } else { (weight / COVERING_WEIGHT).min(1.0) },
    }
}
