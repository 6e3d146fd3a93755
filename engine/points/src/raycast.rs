//! Light by casting rays at the mesh itself: the truth that point-based gathering is held against.

use crate::geometry::area_vector;
use crate::scene::MeshScene;
use crate::trace::Ray;
use glam::Vec3;
use std::f32::consts::PI;

/// What a receiver gets from the surfaces of a mesh, estimated with rays.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RayCast {
    /// Cosine-weighted share of the hemisphere that surfaces cover, 0 to 1.
    pub occlusion: f32,
    /// Irradiance from what those surfaces reflect of the punctual lights and emit, W/m2.
    pub irradiance: [f32; 3],
}

impl MeshScene {
    /// Casts `side` x `side` rays, cosine-weighted and stratified, from a receiver with unit `normal`, and follows each until light
    /// along it was reflected `bounces` times. Every call with the same arguments gives the same answer; `seed` chooses the rays.
    pub fn raycast(&self, position: Vec3, normal: Vec3, side: u32, seed: u64, bounces: u32) -> RayCast {
        let (mut hits, mut sum) = (0u32, Vec3::ZERO);
        self.for_each_ray(position, normal, side, seed, |ray, random| {
            if let Some(radiance) = self.radiance_along(ray, bounces, random) {
                hits += 1;
                sum += radiance;
            }
        });
        let rays = (side * side).max(1) as f32;
        RayCast {
            occlusion: hits as f32 / rays,
            irradiance: (sum * (PI / rays)).to_array(),
        }
    }

    /// The occlusion of [`Self::raycast`] alone, for which any hit will do.
    pub fn raycast_occlusion(&self, position: Vec3, normal: Vec3, side: u32, seed: u64) -> f32 {
        let mut hits = 0u32;
        self.for_each_ray(position, normal, side, seed, |ray, _| {
            hits += u32::from(self.occluded(ray, f32::INFINITY));
        });
        hits as f32 / (side * side).max(1) as f32
    }

    fn for_each_ray(
        &self,
        position: Vec3,
        normal: Vec3,
        side: u32,
        seed: u64,
        mut cast: impl FnMut(&Ray, &mut Random),
    ) {
        let origin = position + normal * self.ray_offset(position);
        let mut random = Random(seed);
        for cell in 0..side * side {
            let share = ((cell / side) as f32 + random.unit()) / side as f32;
            let turn = ((cell % side) as f32 + random.unit()) / side as f32;
            let direction = around(normal, share, turn);
            cast(&Ray { origin, direction }, &mut random);
        }
    }

    /// Radiance that comes back along a ray from the nearest surface, if there is one.
    fn radiance_along(&self, ray: &Ray, bounces: u32, random: &mut Random) -> Option<Vec3> {
        let (surface, distance) = self.closest(ray)?;
        let instance = &self.instances[surface.instance as usize];
        let geometry = &self.geometries[instance.geometry()];
        let corners = instance.corners(geometry, surface.triangle as usize);
        let winding = area_vector(&corners).normalize_or_zero().as_vec3();
        let front = if instance.mirrors() { -winding } else { winding };
        let from_front = front.dot(ray.direction) < 0.0;
        let side = if from_front { front } else { -front };
        let look = self.appearance(instance.geometry(), surface.triangle as usize, surface.barycentric);
        let place = ray.origin + ray.direction * distance;
        let irradiance = self.direct_one_side(place, side, side);
        // Nobody sees the back of a surface that is not double-sided.
        let seen = from_front || look.double_sided;
        let emission = if seen { look.emission } else { Vec3::ZERO };
        let mut radiance = look.albedo * irradiance / PI + emission;
        if bounces > 1 && seen {
            let next = Ray {
                origin: place + side * self.ray_offset(place),
                direction: around(side, random.unit(), random.unit()),
            };
            radiance += look.albedo * self.radiance_along(&next, bounces - 1, random).unwrap_or_default();
        }
        Some(radiance)
    }
}

/// A direction around `normal`, cosine-weighted where both numbers (0 to 1) are evenly spread.
fn around(normal: Vec3, share: f32, turn: f32) -> Vec3 {
    let (u, v) = normal.any_orthonormal_pair();
    let (sin, cos) = (2.0 * PI * turn).sin_cos();
    (u * cos + v * sin) * share.sqrt() + normal * (1.0 - share).max(0.0).sqrt()
}

/// Numbers that look random (SplitMix64).
struct Random(u64);

impl Random {
    fn unit(&mut self) -> f32 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ z >> 31) >> 40) as f32 / (1u64 << 24) as f32
    }
}
