//! Edges and corners: a leaf whose points lie on two or three planes is drawn as those planes' pieces of its voxel, each cut
//! by the others, so that walls meet in a line instead of a fringe of discs.

use crate::cut::Visit;
use crate::footprint::SectionBox;
use glam::{DVec3, Vec3};
use pbgi_core::PointRecord;
use pbgi_core::section::{HalfSpace, section_area, voxel_half_spaces};

/// Planes a leaf is taken apart into; with more it is no edge or corner.
pub(crate) const FACETS_MAX: usize = 3;
/// Points of one plane have normals closer than this (cosine) ...
const SAME_PLANE: f32 = 0.97;
/// ... and lie nearer to the plane than this share of their radius.
const PLANE_REACH: f32 = 0.3;
/// Planes closer than this (cosine) do not cut each other where they can be told apart.
const PARALLEL: f32 = 0.9;
/// How far points may lie beyond a plane that still cuts their facet, as a share of their radius.
const BEYOND: f32 = 0.5;
/// How far a facet reaches beyond its points' centres, in radii: a little over the distance between points.
const POINT_REACH: f32 = 2.0;
/// Membership is kept in one word.
const POINTS_MAX: usize = 64;

/// The points of a leaf on one plane; positions relative to the receiver.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Facet {
    pub(crate) normal: Vec3,
    pub(crate) centroid: Vec3,
    pub(crate) area: f32,
    pub(crate) radius: f32,
    /// Box around the points' centres.
    low: Vec3,
    high: Vec3,
    /// Radiance times area of the side the normal points to, and of the other.
    pub(crate) power: [Vec3; 2],
    /// Which points of the leaf lie on it.
    pub(crate) members: u64,
}

/// The planes that cut a facet: normal (inward) and distance, `normal.x >= distance`, relative to the receiver.
pub(crate) type Cuts = ([(Vec3, f32); FACETS_MAX], usize);

/// Takes a leaf apart. `None` if its points do not lie on a few planes.
#[inline(always)]
pub(crate) fn facets(points: &[(f32, PointRecord)], receiver: Vec3) -> Option<([Facet; FACETS_MAX], usize)> {
    if points.len() > POINTS_MAX {
        return None;
    }
    let empty = Facet {
        normal: Vec3::ZERO,
        centroid: Vec3::ZERO,
        area: 0.0,
        radius: 0.0,
        low: Vec3::INFINITY,
        high: Vec3::NEG_INFINITY,
        power: [Vec3::ZERO; 2],
        members: 0,
    };
    let (mut facets, mut len) = ([empty; FACETS_MAX], 0);
    for (index, (_, point)) in points.iter().enumerate() {
        let normal = point.normal();
        let position = Vec3::from(point.position) - receiver;
        let fits = |facet: &Facet| {
            let (axis, middle) = (facet.normal.normalize(), facet.centroid / facet.area);
            axis.dot(normal).abs() > SAME_PLANE && axis.dot(position - middle).abs() < PLANE_REACH * point.radius
        };
        let found = match facets[..len].iter().position(fits) {
            Some(found) => found,
            None if len == FACETS_MAX => return None,
            None => {
                len += 1;
                len - 1
            }
        };
        facets[found].add(point, normal, position, index);
    }
    for facet in &mut facets[..len] {
        facet.normal = facet.normal.normalize();
        facet.centroid /= facet.area;
    }
    facets[..len].sort_by(|a, b| a.centroid.length_squared().total_cmp(&b.centroid.length_squared()));
    Some((facets, len))
}

impl Facet {
    /// Sums of normal and centroid are weighted by area until all points are in.
    #[inline(always)]
    fn add(&mut self, point: &PointRecord, normal: Vec3, position: Vec3, index: usize) {
        let area = point.area();
        let sides = point.sides();
        let (front, back) = (Vec3::from(sides.front) * area, Vec3::from(sides.back) * area);
        let flipped = self.normal.dot(normal) < 0.0;
        let (normal, front, back) = if flipped {
            (-normal, back, front)
        } else {
            (normal, front, back)
        };
        self.normal += normal * area;
        self.centroid += position * area;
        self.area += area;
        self.radius = self.radius.max(point.radius);
        self.low = self.low.min(position);
        self.high = self.high.max(position);
        self.power[0] += front;
        self.power[1] += back;
        self.members |= 1 << index;
    }

    /// The part of the voxel that its points reach.
    #[inline(always)]
    pub(crate) fn section_box(&self, visit: &Visit) -> SectionBox {
        let reach = Vec3::splat(POINT_REACH * self.radius);
        SectionBox::voxel(visit.center, visit.half, self.normal, 0.0).within(self.low - reach, self.high + reach)
    }

    /// The other facets' planes where all points of this one lie on one side.
    #[inline(always)]
    pub(crate) fn cuts(&self, others: &[Facet], points: &[(f32, PointRecord)], receiver: Vec3) -> Cuts {
        let (mut cuts, mut len) = ([(Vec3::ZERO, 0.0); FACETS_MAX], 0);
        for other in others {
            if other.members == self.members || other.normal.dot(self.normal).abs() > PARALLEL {
                continue;
            }
            let side = (other.normal.dot(self.centroid - other.centroid)).signum();
            let plane = (other.normal * side, side * other.normal.dot(other.centroid));
            let inside = |(index, (_, point)): (usize, &(f32, PointRecord))| {
                let depth = plane.0.dot(Vec3::from(point.position) - receiver) - plane.1;
                self.members >> index & 1 == 0 || depth > -BEYOND * point.radius
            };
            if points.iter().enumerate().all(inside) {
                cuts[len] = plane;
                len += 1;
            }
        }
        (cuts, len)
    }

    /// Area of its points over the area of its section.
    #[inline(always)]
    pub(crate) fn fill(&self, center: Vec3, half: f32, cuts: &[(Vec3, f32)]) -> f32 {
        let normal = self.normal.as_dvec3();
        let mut clips = [HalfSpace {
            normal: DVec3::ZERO,
            offset: 0.0,
        }; 6 + FACETS_MAX];
        clips[..6].copy_from_slice(&voxel_half_spaces(center.as_dvec3(), f64::from(half), normal));
        for (clip, (normal, distance)) in clips[6..].iter_mut().zip(cuts) {
            *clip = HalfSpace {
                normal: normal.as_dvec3(),
                offset: -f64::from(*distance),
            };
        }
        let area = section_area(
            self.centroid.as_dvec3(),
            normal,
            4.0 * f64::from(half),
            &clips[..6 + cuts.len()],
        );
        self.area / (area as f32).max(f32::MIN_POSITIVE)
    }
}
