//! [`InstanceTree`]: which placed geometries a ray may meet. Where there are many they are grouped along the Z-curve: the BVH
//! is over the groups, and a group keeps a coarse box of each of its members, so that an instance costs a few bytes.

use super::{Boxed, build};
use crate::geometry::{Geometry, Instance};
use crate::limits;
use glam::Vec3A;
use obvhs::aabb::Aabb;
use obvhs::cwbvh::CwBvh;
use obvhs::ray::{Ray, RayHit};
use pbgi_core::{Bounds, Quantizer};

/// Cells of a group's box an axis, in which the boxes of its members are given.
const CELLS: f32 = 255.0;

pub(super) struct InstanceTree {
    /// Over the groups' boxes.
    bvh: CwBvh,
    group_len: usize,
    grids: Vec<Grid>,
    /// Group by group.
    members: Vec<Member>,
    bounds: Bounds,
}

/// The box of a group.
#[derive(Clone, Copy)]
struct Grid {
    min: Vec3A,
    cell: Vec3A,
}

/// An instance, and the cells of its group's box that hold it.
#[derive(Clone, Copy)]
struct Member {
    instance: u32,
    min: [u8; 3],
    max: [u8; 3],
}

impl InstanceTree {
    pub(super) fn new(geometries: &[Geometry], instances: &[Instance]) -> Self {
        let group_len = match instances.len() {
            ..limits::GROUPED_INSTANCES_MIN => 1,
            _ => limits::INSTANCE_GROUP,
        };
        let order = along_curve(geometries, instances);
        let mut tree = Self {
            bvh: CwBvh::default(),
            group_len,
            grids: Vec::with_capacity(order.len().div_ceil(group_len)),
            members: Vec::with_capacity(order.len()),
            bounds: Bounds::EMPTY,
        };
        let mut group_boxes = Vec::with_capacity(tree.grids.capacity());
        for group in order.chunks(group_len) {
            let bounds_of = |index: &u32| {
                let instance = &instances[*index as usize];
                instance.bounds(&geometries[instance.geometry()])
            };
            let exact: Vec<Bounds> = group.iter().map(bounds_of).collect();
            exact.iter().for_each(|bounds| tree.bounds.merge(bounds));
            let boxes: Vec<Aabb> = exact.iter().map(roomy).collect();
            let whole = boxes.iter().fold(Aabb::empty(), |whole, other| whole.union(other));
            let grid = Grid {
                min: whole.min,
                cell: (whole.max - whole.min) / CELLS,
            };
            let members = group.iter().zip(&boxes);
            tree.members
                .extend(members.map(|(&instance, aabb)| grid.member(instance, aabb)));
            tree.grids.push(grid);
            group_boxes.push(Boxed(whole));
        }
        drop(order);
        tree.bvh = build(&group_boxes);
        tree
    }

    /// The exact box of all instances, world space.
    pub(super) fn bounds(&self) -> Bounds {
        self.bounds
    }

    /// Visits what a ray may meet, about from near to far. `visit` gets an instance and a distance, and answers with the distance
    /// of something nearer, or infinity.
    pub(super) fn nearest(&self, ray: Ray, mut visit: impl FnMut(usize, f32) -> f32) {
        self.bvh.ray_traverse(ray, &mut RayHit::none(), |ray, slot| {
            let (mut ray, mut nearest) = (*ray, f32::INFINITY);
            for (grid, member) in self.group(slot) {
                if !grid.is_met(member, &ray) {
                    continue;
                }
                let distance = visit(member.instance as usize, ray.tmax);
                if distance < ray.tmax {
                    (ray.tmax, nearest) = (distance, distance);
                }
            }
            nearest
        });
    }

    /// Whether `visit` says so of any instance that a ray may meet.
    pub(super) fn any(&self, ray: Ray, mut visit: impl FnMut(usize) -> bool) -> bool {
        !self.bvh.ray_traverse_miss(ray, |ray, slot| {
            let mut met = self.group(slot).filter(|(grid, member)| grid.is_met(member, ray));
            let blocked = met.any(|(_, member)| visit(member.instance as usize));
            if blocked { 0.0 } else { f32::INFINITY }
        })
    }

    /// The members at a leaf.
    fn group(&self, slot: usize) -> impl Iterator<Item = (&Grid, &Member)> {
        let group = self.bvh.primitive_indices[slot] as usize;
        let start = group * self.group_len;
        let members = &self.members[start..(start + self.group_len).min(self.members.len())];
        members.iter().map(move |member| (&self.grids[group], member))
    }
}

/// Instances in the order of the Z-curve through the middles of their boxes.
fn along_curve(geometries: &[Geometry], instances: &[Instance]) -> Vec<u32> {
    let middle = |instance: &Instance| {
        let middle = instance.middle(&geometries[instance.geometry()]);
        middle.as_vec3().to_array()
    };
    let mut bounds = Bounds::EMPTY;
    instances.iter().for_each(|instance| bounds.include(middle(instance)));
    let mut order: Vec<u32> = (0..instances.len() as u32).collect();
    if let Some(quantizer) = Quantizer::from_bounds(&bounds) {
        order.sort_by_cached_key(|&index| quantizer.code(middle(&instances[index as usize])));
    }
    order
}

/// A ray is moved to local space with roundings of its own: it is let in a little early.
fn roomy(bounds: &Bounds) -> Aabb {
    let (min, max) = (Vec3A::from(bounds.min), Vec3A::from(bounds.max));
    let slack = Vec3A::splat(min.abs().max(max.abs()).max_element() * 1e-5);
    Aabb::new(min - slack, max + slack)
}

impl Grid {
    /// The cells of a box that lies inside, one more on each side where rounding may have lost it.
    fn member(&self, instance: u32, aabb: &Aabb) -> Member {
        let cells = |corner: Vec3A| ((corner - self.min) / self.cell.max(Vec3A::splat(f32::MIN_POSITIVE))).to_array();
        Member {
            instance,
            min: cells(aabb.min).map(|cell| (cell.floor() - 1.0).clamp(0.0, CELLS) as u8),
            max: cells(aabb.max).map(|cell| (cell.ceil() + 1.0).clamp(0.0, CELLS) as u8),
        }
    }

    fn is_met(&self, member: &Member, ray: &Ray) -> bool {
        let corner = |cells: [u8; 3]| self.min + self.cell * Vec3A::from(cells.map(f32::from));
        let aabb = Aabb::new(corner(member.min), corner(member.max));
        // Infinite where it misses.
        aabb.intersect_ray(ray) < ray.tmax
    }
}
