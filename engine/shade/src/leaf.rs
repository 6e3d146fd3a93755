//! Leaves that are opened: their points as discs, or, where they lie on two or three planes (an edge or a corner of a
//! surface), as those planes' pieces of the voxel, each cut by the others, so that walls meet in a line instead of a fringe
//! of discs. Nothing here depends on a receiver.

use crate::cluster::SECTION_FILL;
use glam::{DVec3, Vec3};
use pbgi_core::coverage::scattered_pairs;
use pbgi_core::section::{HalfSpace, section_area, voxel_half_spaces, voxel_section_area};
use pbgi_core::{NodeIndex, PointRecord};

/// Planes a leaf is taken apart into; with more it is no edge or corner.
const FACETS_MAX: usize = 3;
/// Planes that cut a facet.
const CUTS_MAX: usize = FACETS_MAX - 1;
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
/// Share of its section that a facet's points must cover to be drawn as the section. A leaf holds few points, so the share is
/// uncertain by a third.
const FACET_FILL: f32 = 0.35;
/// Discs of a surface are drawn this much wider than their area says, because round ones of equal area leave gaps.
const DISC_SCALE: f32 = 1.4;
/// Membership is kept in one word.
const POINTS_MAX: usize = 64;

/// Leaves that are kept taken apart.
const KEPT: usize = 128;

/// A voxel of the world.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Cube {
    pub(crate) center: Vec3,
    pub(crate) half: f32,
}

/// What an opened leaf is drawn as.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Part {
    Disc(Disc),
    Facet(Facet),
}

/// One point; world space.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Disc {
    pub(crate) center: Vec3,
    pub(crate) normal: Vec3,
    pub(crate) radius: f32,
    /// Radius that it is drawn with.
    pub(crate) drawn_radius: f32,
    /// Radiance of the front and of the back.
    pub(crate) radiance: [Vec3; 2],
}

/// The points of a leaf on one plane; world space.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Facet {
    pub(crate) normal: Vec3,
    pub(crate) centroid: Vec3,
    /// Largest radius of its points.
    pub(crate) radius: f32,
    /// Radiance of the side the normal points to, and of the other.
    pub(crate) radiance: [Vec3; 2],
    /// Area of the points that face as the normal does, and of those that face the other way.
    pub(crate) facing: [f32; 2],
    /// The part of the voxel that its points reach.
    pub(crate) low: Vec3,
    pub(crate) high: Vec3,
    cuts: [Cut; CUTS_MAX],
    cut_count: usize,
}

/// A plane that a facet ends at: the facet lies where `normal.(x - point) >= 0`.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Cut {
    pub(crate) normal: Vec3,
    pub(crate) point: Vec3,
}

impl Part {
    /// Where it lies.
    #[inline(always)]
    pub(crate) fn center(&self) -> Vec3 {
        match self {
            Self::Disc(disc) => disc.center,
            Self::Facet(facet) => facet.centroid,
        }
    }
}

impl Facet {
    #[inline(always)]
    pub(crate) fn cuts(&self) -> &[Cut] {
        &self.cuts[..self.cut_count]
    }
}

impl Disc {
    fn new(point: &PointRecord, scale: f32) -> Self {
        let sides = point.sides();
        Self {
            center: point.position.into(),
            normal: point.normal(),
            radius: point.radius,
            drawn_radius: point.radius * scale,
            radiance: [sides.front.into(), sides.back.into()],
        }
    }
}

/// Sums over the points of a plane; positions relative to the voxel's centre.
#[derive(Clone, Copy, Debug)]
struct Plane {
    normal: Vec3,
    centroid: Vec3,
    area: f32,
    radius: f32,
    low: Vec3,
    high: Vec3,
    power: [Vec3; 2],
    facing: [f32; 2],
    members: u64,
}

/// The leaves that were taken apart lately, by what names them: neighbouring receivers open the same ones.
pub(crate) struct Leaves {
    slots: Vec<(Option<LeafName>, Vec<Part>)>,
}

/// Where a leaf lies in its file, and the path to its voxel, which only a forged file has twice.
type LeafName = (NodeIndex, u64);

impl Default for Leaves {
    fn default() -> Self {
        Self {
            slots: vec![(None, Vec::new()); KEPT],
        }
    }
}

impl Leaves {
    /// The parts of a leaf with these points.
    pub(crate) fn parts(&mut self, name: LeafName, points: &[PointRecord], voxel: Cube) -> &[Part] {
        // Neighbours in the file get neighbouring slots.
        let (kept, parts) = &mut self.slots[name.0.0 as usize % KEPT];
        if *kept != Some(name) {
            take_apart(points, voxel, parts);
            *kept = Some(name);
        }
        parts
    }
}

/// Takes a leaf apart.
fn take_apart(points: &[PointRecord], voxel: Cube, parts: &mut Vec<Part>) {
    parts.clear();
    let scale = disc_scale(points);
    let discs = |members: u64| {
        let inside = move |(index, _): &(usize, &PointRecord)| members >> (index % POINTS_MAX) & 1 == 1;
        let members = points.iter().enumerate().filter(inside);
        members.map(|(_, point)| Part::Disc(Disc::new(point, scale)))
    };
    let Some((planes, len)) = planes(points, voxel.center) else {
        parts.extend(discs(u64::MAX));
        return;
    };
    let planes = &planes[..len];
    for plane in planes {
        let (cuts, cut_count) = plane.cuts(planes, points, voxel.center);
        // Without a neighbour to end at, a section would reach over the edge of its surface.
        let needed = if cut_count == 0 { SECTION_FILL } else { FACET_FILL };
        if plane.fill(voxel.half, &cuts[..cut_count]) < needed {
            parts.extend(discs(plane.members));
            continue;
        }
        let reach = Vec3::splat(POINT_REACH * plane.radius);
        let bound = Vec3::splat(voxel.half) + along_faces(plane.normal) * voxel.half;
        parts.push(Part::Facet(Facet {
            normal: plane.normal,
            centroid: voxel.center + plane.centroid,
            radius: plane.radius,
            radiance: plane.power.map(|power| power / plane.area),
            facing: plane.facing,
            low: voxel.center + (plane.low - reach).max(-bound),
            high: voxel.center + (plane.high + reach).min(bound),
            cuts: cuts.map(|cut| Cut {
                normal: cut.normal,
                point: voxel.center + cut.point,
            }),
            cut_count,
        }));
    }
}

/// How much wider than they are the discs of a leaf are drawn: those of a surface would leave gaps, leaves of a tree lie apart.
fn disc_scale(points: &[PointRecord]) -> f32 {
    let (mut normal, mut area, mut squares) = (DVec3::ZERO, 0.0, 0.0);
    for point in points {
        let its_area = f64::from(point.area());
        normal += point.normal().as_dvec3() * its_area;
        area += its_area;
        squares += its_area * its_area;
    }
    DISC_SCALE + (1.0 - DISC_SCALE) * scattered_pairs(normal.length_squared(), area, squares) as f32
}

/// How far a section's box reaches out of its voxel, as shares of half its edge: a plane along a face must not fall out of it
/// by rounding.
#[inline(always)]
pub(crate) fn along_faces(normal: Vec3) -> Vec3 {
    /// Cosine between a plane's normal and an axis from which the plane counts as running along the faces across it.
    const ALONG_FACE: f32 = 0.9;
    const FACE_SLACK: f32 = 0.05;
    Vec3::select(
        normal.abs().cmpgt(Vec3::splat(ALONG_FACE)),
        Vec3::splat(FACE_SLACK),
        Vec3::ZERO,
    )
}

/// The planes that points lie on. `None` if there are more than a few.
fn planes(points: &[PointRecord], origin: Vec3) -> Option<([Plane; FACETS_MAX], usize)> {
    if points.len() > POINTS_MAX {
        return None;
    }
    let empty = Plane {
        normal: Vec3::ZERO,
        centroid: Vec3::ZERO,
        area: 0.0,
        radius: 0.0,
        low: Vec3::INFINITY,
        high: Vec3::NEG_INFINITY,
        power: [Vec3::ZERO; 2],
        facing: [0.0; 2],
        members: 0,
    };
    let (mut planes, mut len) = ([empty; FACETS_MAX], 0);
    for (index, point) in points.iter().enumerate() {
        let normal = point.normal();
        let position = Vec3::from(point.position) - origin;
        let fits = |plane: &Plane| {
            let (axis, middle) = (plane.normal.normalize(), plane.centroid / plane.area);
            axis.dot(normal).abs() > SAME_PLANE && axis.dot(position - middle).abs() < PLANE_REACH * point.radius
        };
        let found = match planes[..len].iter().position(fits) {
            Some(found) => found,
            None if len == FACETS_MAX => return None,
            None => {
                len += 1;
                len - 1
            }
        };
        planes[found].add(point, normal, position, index);
    }
    for plane in &mut planes[..len] {
        plane.normal = plane.normal.normalize();
        plane.centroid /= plane.area;
    }
    Some((planes, len))
}

impl Plane {
    /// Sums of normal and centroid are weighted by area until all points are in.
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
        self.facing[usize::from(flipped)] += area;
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

    /// The other planes where all points of this one lie on one side.
    fn cuts(&self, others: &[Self], points: &[PointRecord], origin: Vec3) -> ([Cut; CUTS_MAX], usize) {
        let (mut cuts, mut len) = ([Cut::default(); CUTS_MAX], 0);
        for other in others {
            if other.members == self.members || other.normal.dot(self.normal).abs() > PARALLEL {
                continue;
            }
            let side = other.normal.dot(self.centroid - other.centroid).signum();
            let cut = Cut {
                normal: other.normal * side,
                point: other.centroid,
            };
            let inside = |(index, point): (usize, &PointRecord)| {
                let depth = cut.normal.dot(Vec3::from(point.position) - origin - cut.point);
                self.members >> index & 1 == 0 || depth > -BEYOND * point.radius
            };
            if points.iter().enumerate().all(inside) {
                cuts[len] = cut;
                len += 1;
            }
        }
        (cuts, len)
    }

    /// Area of its points over the area of its section.
    fn fill(&self, half: f32, cuts: &[Cut]) -> f32 {
        let (through, normal) = (self.centroid.as_dvec3(), self.normal.as_dvec3());
        let half = f64::from(half);
        let area = if cuts.is_empty() {
            voxel_section_area(through, normal, DVec3::ZERO, half)
        } else {
            let mut clips = [HalfSpace {
                normal: DVec3::ZERO,
                offset: 0.0,
            }; 6 + CUTS_MAX];
            clips[..6].copy_from_slice(&voxel_half_spaces(DVec3::ZERO, half, normal));
            for (clip, cut) in clips[6..].iter_mut().zip(cuts) {
                *clip = HalfSpace {
                    normal: cut.normal.as_dvec3(),
                    offset: -f64::from(cut.normal.dot(cut.point)),
                };
            }
            section_area(through, normal, 4.0 * half, &clips[..6 + cuts.len()])
        };
        self.area / (area as f32).max(f32::MIN_POSITIVE)
    }
}
