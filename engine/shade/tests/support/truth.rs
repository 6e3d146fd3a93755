//! Scenes of analytic shapes, sampled into points and ray-cast for their exact occlusion and indirect light.

#![allow(dead_code, unreachable_pub, reason = "each test file uses its part")]

use super::{quad, sphere};
use glam::Vec3;
use pbgi_core::PointRecord;
use pbgi_core::point::Sides;
use pbgi_shade::Receiver;
use std::f32::consts::PI;

/// A shape of the scene; all reflect half of the light.
#[derive(Clone, Copy)]
pub enum Shape {
    Sphere {
        center: Vec3,
        radius: f32,
    },
    /// Axis-aligned.
    Block {
        low: Vec3,
        high: Vec3,
    },
    /// The square around the origin in the plane y = 0.
    Ground {
        half: f32,
    },
    /// A square with two sides; half of its edges, across each other.
    Leaf {
        center: Vec3,
        u: Vec3,
        v: Vec3,
    },
}

pub struct Truth {
    pub shapes: Vec<Shape>,
    /// Direction to the sun, unit, and its irradiance.
    pub sun: (Vec3, f32),
    pub shadows: bool,
}

const ALBEDO: f32 = 0.5;

impl Truth {
    /// 64 spheres over a ground, half of them touching it; the sun casts no shadows (scene S64).
    pub fn spheres() -> Self {
        let mut shapes = vec![Shape::Ground { half: 10.0 }];
        for i in 0..64 {
            let (x, z) = ((i % 8) as f32, (i / 8) as f32);
            let radius = 0.6 + 0.4 * ((i * 7 % 11) as f32 / 11.0);
            let lift = if i % 2 == 0 { 0.0 } else { 0.5 + 0.1 * (i % 5) as f32 };
            let center = Vec3::new((x - 3.5) * 2.4, radius + lift, (z - 3.5) * 2.4);
            shapes.push(Shape::Sphere { center, radius });
        }
        Self {
            shapes,
            sun: (Vec3::new(0.3, 0.8, 0.5).normalize(), 1.0),
            shadows: false,
        }
    }

    /// 100 blocks of different heights along streets, under a hard sun.
    pub fn city() -> Self {
        let mut shapes = vec![Shape::Ground { half: 10.0 }];
        for i in 0..100 {
            let (x, z) = ((i % 10) as f32 - 4.5, (i / 10) as f32 - 4.5);
            let height = 0.6 + 2.4 * ((i * 37 % 23) as f32 / 23.0);
            let width = 0.55 + 0.2 * ((i * 5 % 7) as f32 / 7.0);
            let middle = Vec3::new(x * 2.0, 0.0, z * 2.0);
            let low = middle - Vec3::new(width, 0.0, width);
            shapes.push(Shape::Block {
                low,
                high: middle + Vec3::new(width, height, width),
            });
        }
        Self {
            shapes,
            sun: (Vec3::new(0.5, 0.7, 0.35).normalize(), 3.0),
            shadows: true,
        }
    }

    /// Four crowns of 200 leaves each over a ground: they hide a third of what is behind them.
    pub fn crowns() -> Self {
        let mut state = 7u64;
        let mut random = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f32 / (1u64 << 23) as f32 - 1.0
        };
        let mut in_ball = || {
            std::iter::repeat_with(|| Vec3::new(random(), random(), random()))
                .find(|place| place.length_squared() < 1.0)
                .unwrap_or_default()
        };
        let mut shapes = vec![Shape::Ground { half: 3.0 }];
        for crown in 0..4 {
            let middle = Vec3::new((crown % 2) as f32 * 3.0 - 1.5, 2.5, (crown / 2) as f32 * 3.0 - 1.5);
            for _ in 0..200 {
                let (u, v) = in_ball().normalize_or(Vec3::Y).any_orthonormal_pair();
                let center = middle + in_ball();
                let (u, v) = (u * 0.06, v * 0.06);
                shapes.push(Shape::Leaf { center, u, v });
            }
        }
        Self {
            shapes,
            sun: (Vec3::new(0.5, 0.7, 0.35).normalize(), 3.0),
            shadows: true,
        }
    }

    /// Nearest hit: distance and outward normal.
    pub fn hit(&self, origin: Vec3, direction: Vec3) -> Option<(f32, Vec3)> {
        let mut best: Option<(f32, Vec3)> = None;
        for shape in &self.shapes {
            if let Some((t, normal)) = intersect(shape, origin, direction)
                && best.is_none_or(|(nearest, _)| t < nearest)
            {
                best = Some((t, normal));
            }
        }
        best
    }

    /// Radiance that leaves a surface point.
    pub fn radiance(&self, position: Vec3, normal: Vec3) -> f32 {
        let (toward, irradiance) = self.sun;
        let cosine = normal.dot(toward).max(0.0);
        let lit = cosine > 0.0 && (!self.shadows || self.hit(position + normal * 1e-3, toward).is_none());
        if lit { ALBEDO / PI * irradiance * cosine } else { 0.0 }
    }

    /// Occlusion and irradiance over pi at a receiver, from `side` x `side` stratified rays.
    pub fn reference(&self, receiver: &Receiver, side: usize, random: &mut impl FnMut() -> f32) -> (f32, f32) {
        let (u, v) = receiver.normal.any_orthonormal_pair();
        let (mut occlusion, mut light) = (0.0, 0.0);
        for i in 0..side * side {
            let a = ((i % side) as f32 + random()) / side as f32;
            let b = ((i / side) as f32 + random()) / side as f32;
            let (sin, cos) = (a * 2.0 * PI).sin_cos();
            let r = b.sqrt();
            let direction = u * (r * cos) + v * (r * sin) + receiver.normal * (1.0 - b).max(0.0).sqrt();
            let origin = receiver.position + receiver.normal * 1e-3;
            if let Some((t, normal)) = self.hit(origin, direction) {
                occlusion += 1.0;
                light += self.radiance(origin + direction * t, normal);
            }
        }
        let rays = (side * side) as f32;
        (occlusion / rays, light / rays)
    }

    /// About `count` evenly spread points.
    pub fn points(&self, count: usize) -> Vec<PointRecord> {
        let total: f32 = self.shapes.iter().map(area).sum();
        let spacing = (total / count as f32).sqrt();
        let mut points = vec![];
        for shape in &self.shapes {
            match *shape {
                Shape::Sphere { center, radius } => {
                    sphere(
                        center,
                        radius,
                        (area(shape) / spacing / spacing) as usize,
                        0.0,
                        &mut points,
                    );
                }
                Shape::Ground { half } => {
                    let corner = Vec3::new(-half, 0.0, -half);
                    let side = (2.0 * half / spacing) as usize;
                    quad(
                        corner,
                        Vec3::Z * 2.0 * half,
                        Vec3::X * 2.0 * half,
                        side,
                        0.0,
                        &mut points,
                    );
                }
                Shape::Leaf { center, u, v } => {
                    rectangle(center - u - v, 2.0 * u, 2.0 * v, spacing, &mut points);
                }
                Shape::Block { low, high } => {
                    let d = high - low;
                    let (x, y, z) = (Vec3::X * d.x, Vec3::Y * d.y, Vec3::Z * d.z);
                    for (corner, u, v) in [
                        (low + y, z, x),
                        (low, y, x),
                        (low + z, x, y),
                        (low, z, y),
                        (low + x, y, z),
                    ] {
                        rectangle(corner, u, v, spacing, &mut points);
                    }
                }
            }
        }
        for point in &mut points {
            let radiance = |normal: Vec3| [self.radiance(point.position.into(), normal); 3];
            // The backs of all others are inside of something, or below the ground.
            let leaf = self.shapes.iter().any(|shape| matches!(shape, Shape::Leaf { .. }));
            let sides = Sides {
                front: radiance(point.normal()),
                back: if leaf { radiance(-point.normal()) } else { [0.0; 3] },
            };
            *point = PointRecord::new(point.position, point.normal().to_array(), point.radius, sides).unwrap();
        }
        points
    }

    /// Receivers on all surfaces that can be seen: `count` of the points, moved onto the exact surface.
    pub fn receivers(&self, count: usize) -> Vec<Receiver> {
        let points = self.points(count * 40);
        let step = points.len() / count;
        let chosen = points.iter().step_by(step.max(1)).take(count);
        let lifted = chosen.map(|point| Receiver {
            position: point.position.into(),
            normal: point.normal(),
        });
        lifted
            .filter(|receiver| !self.buried(receiver.position + receiver.normal * 1e-3))
            .collect()
    }

    fn buried(&self, position: Vec3) -> bool {
        self.shapes.iter().any(|shape| match *shape {
            Shape::Sphere { center, radius } => position.distance(center) < radius,
            Shape::Block { low, high } => position.cmpgt(low).all() && position.cmplt(high).all(),
            Shape::Ground { .. } => position.y < 0.0,
            Shape::Leaf { .. } => false,
        })
    }
}

/// A rectangle in jittered cells of about `spacing` both ways.
fn rectangle(corner: Vec3, u: Vec3, v: Vec3, spacing: f32, points: &mut Vec<PointRecord>) {
    let (long, short) = (u.length().max(v.length()), u.length().min(v.length()));
    let parts = (long / short).round().max(1.0) as usize;
    let (u_parts, v_parts) = if u.length() > v.length() {
        (parts, 1)
    } else {
        (1, parts)
    };
    for i in 0..u_parts {
        for j in 0..v_parts {
            let (u, v) = (u / u_parts as f32, v / v_parts as f32);
            let side = ((u.length() * v.length()).sqrt() / spacing).round().max(1.0) as usize;
            quad(corner + u * i as f32 + v * j as f32, u, v, side, 0.0, points);
        }
    }
}

fn area(shape: &Shape) -> f32 {
    match *shape {
        Shape::Sphere { radius, .. } => 4.0 * PI * radius * radius,
        Shape::Ground { half } => 4.0 * half * half,
        Shape::Leaf { u, v, .. } => 4.0 * u.length() * v.length(),
        Shape::Block { low, high } => {
            let d = high - low;
            d.x * d.z + 2.0 * d.y * (d.x + d.z)
        }
    }
}

fn intersect(shape: &Shape, origin: Vec3, direction: Vec3) -> Option<(f32, Vec3)> {
    match *shape {
        Shape::Ground { half } => {
            let t = -origin.y / direction.y;
            let p = origin + direction * t;
            (t > 1e-4 && p.x.abs() <= half && p.z.abs() <= half).then_some((t, Vec3::Y))
        }
        Shape::Leaf { center, u, v } => {
            let normal = u.cross(v).normalize();
            let normal = normal * -normal.dot(direction).signum();
            let t = normal.dot(center - origin) / normal.dot(direction);
            let offset = origin + direction * t - center;
            let inside = |edge: Vec3| offset.dot(edge).abs() <= edge.length_squared();
            (t > 1e-4 && inside(u) && inside(v)).then_some((t, normal))
        }
        Shape::Sphere { center, radius } => {
            let m = origin - center;
            let b = m.dot(direction);
            let discriminant = b * b - (m.length_squared() - radius * radius);
            let t = -b - discriminant.max(0.0).sqrt();
            (discriminant >= 0.0 && t > 1e-4).then(|| (t, (m + direction * t) / radius))
        }
        Shape::Block { low, high } => {
            let inverse = direction.recip();
            let (a, b) = ((low - origin) * inverse, (high - origin) * inverse);
            let (near, far) = (a.min(b), a.max(b));
            let (t, exit) = (near.max_element(), far.min_element());
            if t > exit || t < 1e-4 {
                return None;
            }
            let axis = if t == near.x {
                Vec3::X
            } else if t == near.y {
                Vec3::Y
            } else {
                Vec3::Z
            };
            Some((t, -axis * direction.dot(axis).signum()))
        }
    }
}
