//! Test scenes as plain arrays: surfaces sampled evenly, and an octree built top-down, independent of the real construction.

#![allow(dead_code, unreachable_pub, reason = "each test file uses its part")]

pub mod truth;

use glam::Vec3;
use pbgi_core::point::Sides;
use pbgi_core::{
    Bounds, BuildId, BuildSettings, ClusterAccumulator, MortonCode, NodeIndex, NodeKind, NodeRecord, PointIndex,
    PointRecord, Quantizer, SceneInfo, Voxel,
};
use pbgi_shade::ArraySource;

/// A point of a diffuse surface with the given outgoing radiance on its front.
pub fn point(position: Vec3, normal: Vec3, area: f32, radiance: f32) -> PointRecord {
    let radius = (area / std::f32::consts::PI).sqrt();
    let sides = Sides {
        front: [radiance; 3],
        back: [0.0; 3],
    };
    PointRecord::new(position.to_array(), normal.to_array(), radius, sides).unwrap()
}

/// A parallelogram `corner + s u + t v` in `count` x `count` jittered cells; its front is on the side of `u x v`.
pub fn quad(corner: Vec3, u: Vec3, v: Vec3, count: usize, radiance: f32, points: &mut Vec<PointRecord>) {
    let normal = u.cross(v);
    let area = normal.length() / (count * count) as f32;
    for i in 0..count {
        for j in 0..count {
            let jitter = |seed: usize| {
                let hash = (seed as u32)
                    .wrapping_mul(0x9e37_79b9)
                    .wrapping_add(0x7f4a_7c15)
                    .wrapping_mul(0x85eb_ca6b);
                ((hash >> 8) as f32 / (1 << 24) as f32 - 0.5) * 0.5
            };
            let s = (i as f32 + 0.5 + jitter(2 * (i * count + j))) / count as f32;
            let t = (j as f32 + 0.5 + jitter(2 * (i * count + j) + 1)) / count as f32;
            points.push(point(corner + u * s + v * t, normal.normalize(), area, radiance));
        }
    }
}

/// A sphere in `count` points on a Fibonacci spiral.
pub fn sphere(center: Vec3, radius: f32, count: usize, radiance: f32, points: &mut Vec<PointRecord>) {
    let area = 4.0 * std::f32::consts::PI * radius * radius / count as f32;
    for i in 0..count {
        let z = 1.0 - (2 * i + 1) as f32 / count as f32;
        let (sin, cos) = (i as f32 * 2.399_963_2).sin_cos();
        let r = (1.0 - z * z).sqrt();
        let normal = Vec3::new(r * cos, r * sin, z);
        points.push(point(center + normal * radius, normal, area, radiance));
    }
}

/// A disc in about `count` points on rings.
pub fn disc(center: Vec3, normal: Vec3, radius: f32, count: usize, radiance: f32, points: &mut Vec<PointRecord>) {
    let (u, v) = normal.any_orthonormal_pair();
    let rings = (count as f32 / 3.0).sqrt() as usize;
    let total = 3 * rings * rings;
    let area = std::f32::consts::PI * radius * radius / total as f32;
    for ring in 0..rings {
        let r = (ring as f32 + 0.5) / rings as f32 * radius;
        let on_ring = 6 * ring + 3;
        for i in 0..on_ring {
            let (sin, cos) = ((i as f32 + 0.5 * (ring % 2) as f32) / on_ring as f32 * std::f32::consts::TAU).sin_cos();
            points.push(point(center + (u * cos + v * sin) * r, normal, area, radiance));
        }
    }
}

/// Builds the octree of a cloud.
pub fn build(points: &[PointRecord]) -> (SceneInfo, ArraySource) {
    let mut bounds = Bounds::EMPTY;
    points.iter().for_each(|point| bounds.include(point.position));
    let settings = BuildSettings {
        leaf_max: 16,
        ..BuildSettings::default()
    };
    let mut info = SceneInfo {
        build_id: BuildId(0),
        point_count: points.len() as u64,
        node_count: 0,
        node_slots: 0,
        root: None,
        bounds: None,
        quantizer: None,
        radius_max: points.iter().map(|point| point.radius).fold(0.0, f32::max),
        origin: [0.0; 3],
        settings,
    };
    let Some(quantizer) = Quantizer::from_bounds(&bounds) else {
        return (info, ArraySource::default());
    };
    let mut coded: Vec<_> = points
        .iter()
        .map(|point| (quantizer.code(point.position), *point))
        .collect();
    coded.sort_by_key(|(code, _)| *code);
    let mut builder = Builder {
        quantizer,
        nodes: vec![],
        coded: &coded,
    };
    let (root, _) = builder.node(Voxel::ROOT, 0..coded.len());
    builder.nodes.push(root);
    info.node_count = builder.nodes.len() as u64;
    info.node_slots = info.node_count;
    info.root = Some(NodeIndex(builder.nodes.len() as u32 - 1));
    info.bounds = Some(bounds);
    info.quantizer = Some(quantizer);
    let nodes = builder.nodes;
    (
        info,
        ArraySource {
            nodes,
            points: coded.into_iter().map(|(_, point)| point).collect(),
        },
    )
}

struct Builder<'a> {
    quantizer: Quantizer,
    nodes: Vec<NodeRecord>,
    coded: &'a [(MortonCode, PointRecord)],
}

impl Builder<'_> {
    fn node(&mut self, voxel: Voxel, range: std::ops::Range<usize>) -> (NodeRecord, ClusterAccumulator) {
        let mut sum = ClusterAccumulator::default();
        let kind = if range.len() <= 16 || voxel.level == 21 {
            for (_, point) in &self.coded[range.clone()] {
                sum.add(point, &self.quantizer);
            }
            let (first, count) = (PointIndex(range.start as u32), range.len() as u32);
            if count > 16 {
                NodeKind::Overflow { first, count }
            } else {
                NodeKind::Leaf { first, count }
            }
        } else {
            let (mut start, mut mask, mut children) = (range.start, 0u8, vec![]);
            for octant in 0..8 {
                let child = voxel.child(octant);
                let inside = self.coded[start..range.end]
                    .iter()
                    .take_while(|(code, _)| child.contains(*code))
                    .count();
                if inside > 0 {
                    let (record, child_sum) = self.node(child, start..start + inside);
                    sum.merge(octant, &child_sum);
                    children.push(record);
                    mask |= 1 << octant;
                    start += inside;
                }
            }
            let first = NodeIndex(self.nodes.len() as u32);
            self.nodes.extend(children);
            NodeKind::Inner { first, mask }
        };
        (
            NodeRecord::new(voxel.level, kind, &sum.finalize(voxel, &self.quantizer).attributes),
            sum,
        )
    }
}
