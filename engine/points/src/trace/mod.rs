//! Rays against the scene: a compressed wide BVH over the triangles of each geometry, and one over the placed geometries.
//! Masked texels are no surface.

mod instances;

use crate::geometry::{Barycentric, Geometry, Instance};
use crate::scene::{MeshScene, SurfaceId};
use glam::{DAffine3, Vec3, Vec3A};
use instances::InstanceTree;
use obvhs::aabb::Aabb;
use obvhs::cwbvh::CwBvh;
use obvhs::cwbvh::builder::build_cwbvh;
use obvhs::ray::RayHit;
use obvhs::{Boundable, BvhBuildParams};
use pbgi_core::Bounds;
use std::time::Duration;

/// Where to look from, and along which unit vector.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Ray {
    pub(crate) origin: Vec3,
    pub(crate) direction: Vec3,
}

/// The BVHs of a scene.
pub(crate) struct Tracer {
    geometries: Vec<TriangleBvh>,
    instances: InstanceTree,
}

struct TriangleBvh {
    bvh: CwBvh,
    /// In the order of the BVH's leaves.
    triangles: Vec<Triangle>,
}

/// First corner and the edges to the two others.
#[derive(Clone, Copy)]
struct Triangle {
    corner: [f32; 3],
    edge1: [f32; 3],
    edge2: [f32; 3],
}

struct Boxed(Aabb);

impl Boundable for Boxed {
    fn aabb(&self) -> Aabb {
        self.0
    }
}

impl Tracer {
    pub(crate) fn new(geometries: &[Geometry], instances: &[Instance]) -> Self {
        Self {
            geometries: geometries.iter().map(TriangleBvh::new).collect(),
            instances: InstanceTree::new(geometries, instances),
        }
    }

    /// The exact box of all triangles, world space.
    pub(crate) fn bounds(&self) -> Bounds {
        self.instances.bounds()
    }
}

fn build(boxes: &[Boxed]) -> CwBvh {
    if boxes.is_empty() {
        return CwBvh::default();
    }
    build_cwbvh(boxes, BvhBuildParams::medium_build(), &mut Duration::default())
}

impl TriangleBvh {
    fn new(geometry: &Geometry) -> Self {
        let boxed = |triangle: usize| {
            let [a, b, c] = geometry.corners(triangle).map(Vec3A::from);
            Boxed(Aabb::new(a.min(b).min(c), a.max(b).max(c)))
        };
        let boxes: Vec<Boxed> = (0..geometry.triangles.len()).map(boxed).collect();
        let bvh = build(&boxes);
        let triangles = bvh.primitive_indices.iter().map(|&index| {
            let [a, b, c] = geometry.corners(index as usize);
            Triangle {
                corner: a.to_array(),
                edge1: (b - a).to_array(),
                edge2: (c - a).to_array(),
            }
        });
        Self {
            triangles: triangles.collect(),
            bvh,
        }
    }

    /// Nearest hit below `limit` that `accept`s: leaf slot, weights, distance.
    fn closest(
        &self,
        ray: &Ray,
        limit: f32,
        mut accept: impl FnMut(usize, Barycentric) -> bool,
    ) -> Option<(usize, Barycentric, f32)> {
        let mut best = None;
        let mut hit = RayHit::none();
        self.bvh.ray_traverse(bvh_ray(ray, limit), &mut hit, |bvh_ray, slot| {
            let Some((t, barycentric)) = self.triangles[slot].intersect(ray) else {
                return f32::INFINITY;
            };
            if t >= bvh_ray.tmax || !accept(slot, barycentric) {
                return f32::INFINITY;
            }
            best = Some((slot, barycentric, t));
            t
        });
        best
    }

    fn occluded(&self, ray: &Ray, limit: f32, mut accept: impl FnMut(usize, Barycentric) -> bool) -> bool {
        !self.bvh.ray_traverse_miss(bvh_ray(ray, limit), |_, slot| {
            match self.triangles[slot].intersect(ray) {
                Some((t, barycentric)) if t < limit && accept(slot, barycentric) => t,
                _ => f32::INFINITY,
            }
        })
    }
}

fn bvh_ray(ray: &Ray, limit: f32) -> obvhs::ray::Ray {
    // A component of -0 has the library take a box's sides the wrong way round, and miss it.
    let direction = ray.direction + Vec3::ZERO;
    obvhs::ray::Ray::new(ray.origin.into(), direction.into(), 0.0, limit)
}

impl Triangle {
    /// Möller and Trumbore, both sides; edges belong to both neighbours so that no ray slips between them.
    fn intersect(&self, ray: &Ray) -> Option<(f32, Barycentric)> {
        const RIM: f32 = 1e-6;
        let (corner, edge1, edge2) = (Vec3::from(self.corner), Vec3::from(self.edge1), Vec3::from(self.edge2));
        let p = ray.direction.cross(edge2);
        let determinant = edge1.dot(p);
        if determinant == 0.0 {
            return None;
        }
        let inverse = 1.0 / determinant;
        let offset = ray.origin - corner;
        let v = offset.dot(p) * inverse;
        let q = offset.cross(edge1);
        let w = ray.direction.dot(q) * inverse;
        let t = edge2.dot(q) * inverse;
        (v >= -RIM && w >= -RIM && v + w <= 1.0 + RIM && t > 0.0).then_some((t, [v, w]))
    }
}

impl Instance {
    /// The ray in local space, its direction again of unit length, and the length of a world unit there.
    fn to_local(self, ray: &Ray) -> (Ray, f32) {
        let world_from_local = self.world_from_local();
        if world_from_local == DAffine3::IDENTITY {
            return (*ray, 1.0);
        }
        let transform = world_from_local.inverse();
        let direction = transform.transform_vector3(ray.direction.as_dvec3());
        let length = direction.length();
        let local = Ray {
            origin: transform.transform_point3(ray.origin.as_dvec3()).as_vec3(),
            direction: (direction / length).as_vec3(),
        };
        (local, length as f32)
    }
}

impl MeshScene {
    /// The nearest surface along a ray, and its distance.
    pub(crate) fn closest(&self, ray: &Ray) -> Option<(SurfaceId, f32)> {
        let tracer = self.tracer();
        let mut best: Option<(SurfaceId, f32)> = None;
        let mut visit = |index: usize, limit: f32| {
            let placed = &self.instances[index];
            let (local, scale) = placed.to_local(ray);
            let geometry = &tracer.geometries[placed.geometry()];
            let triangle = |slot: usize| geometry.bvh.primitive_indices[slot];
            let found = geometry.closest(&local, limit * scale, |slot, barycentric| {
                self.is_opaque(placed.geometry(), triangle(slot) as usize, barycentric)
            });
            let Some((slot, barycentric, t)) = found else {
                return f32::INFINITY;
            };
            let surface = SurfaceId {
                instance: index as u32,
                triangle: triangle(slot),
                barycentric,
            };
            best = Some((surface, t / scale));
            t / scale
        };
        if self.instances.len() == 1 {
            visit(0, f32::INFINITY);
        } else {
            tracer.instances.nearest(bvh_ray(ray, f32::INFINITY), visit);
        }
        best
    }

    /// Whether any surface lies along a ray before `limit`.
    pub(crate) fn occluded(&self, ray: &Ray, limit: f32) -> bool {
        let tracer = self.tracer();
        let visit = |index: usize| {
            let placed = &self.instances[index];
            let (local, scale) = placed.to_local(ray);
            let geometry = &tracer.geometries[placed.geometry()];
            geometry.occluded(&local, limit * scale, |slot, barycentric| {
                let triangle = geometry.bvh.primitive_indices[slot] as usize;
                self.is_opaque(placed.geometry(), triangle, barycentric)
            })
        };
        if self.instances.len() == 1 {
            return visit(0);
        }
        tracer.instances.any(bvh_ray(ray, limit), visit)
    }
}
