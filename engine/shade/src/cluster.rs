//! A node as a receiver sees it: whether it may stand for what is below it, and where its surface lies.

use crate::cut::Visit;
use crate::footprint::SectionBox;
use crate::shader::Receiver;
use glam::{Vec2, Vec3};
use half::slice::HalfFloatSliceExt;
use pbgi_core::pack::area_normaliser;
use pbgi_core::sh::{SH_TERMS, basis};
use pbgi_core::{NodeRecord, ShadeSettings};

/// Zonal factor of the clamped cosine times Y00: the first area term of a cluster over its area.
const AREA_TERM: f32 = 0.886_226_9;
/// A cluster whose normals spread less than this (root mean square sine) and that is thinner than [`FLAT_THICKNESS`] is a
/// piece of a plane.
const FLAT_SPREAD: f32 = 0.25;
/// Standard deviation across the plane over the voxel's edge.
const FLAT_THICKNESS: f32 = 0.06;
/// A flat cluster that covers at least this share of its plane inside the voxel is drawn as the whole section. Sampling
/// noise in small leaves makes the share uncertain by about as much as this is below 1.
pub(crate) const SECTION_FILL: f32 = 0.7;
/// Share of the accepted solid angle at which clusters without a plane are accepted: their silhouette is a guess.
const ROUND_SHARE: f32 = 0.2;
/// Cosine between normals from which a disc is taken for the receiver's own surface.
const SAME_SURFACE: f32 = 0.7;
/// The same for elements that the receiver nearly touches, facing the same way; shading normals lean, and folds turn within
/// an element.
const SAME_SHEET: f32 = 0.5;
/// How far behind an element's plane a receiver on the same surface may lie, as a share of the element's width.
const SHEET_DEPTH: f32 = 0.15;
/// The same for a receiver inside the element's voxel, to either side.
const INSIDE_DEPTH: f32 = 0.08;
/// How far from an arc through both a receiver and an element may stand, as a sine.
const ARC_SLACK: f32 = 0.15;
/// Distance in voxel edges, and in radii of a disc, within which an element may be the receiver's own surface.
const NEAR_VOXELS: f32 = 2.5;

/// How far a section reaches beyond a uniform covering with the points' variance, which a few points know only roughly ...
const REACH_SCALE: f32 = 1.15;
/// ... and beyond that, in radii.
const REACH_RADII: f32 = 0.5;
/// Overlap of sections with their neighbours, as a share of half a voxel's edge, for a spread of 1.
const SECTION_OVERLAP: f32 = 0.1;

/// A node in plain numbers, seen from one receiver.
pub(crate) struct Cluster {
    /// Relative to the receiver.
    pub(crate) centroid: Vec3,
    pub(crate) distance_squared: f32,
    pub(crate) axis: Vec3,
    /// Covariance, square world units: xx, yy, zz, xy, xz, yz.
    pub(crate) covariance: [f32; 6],
    pub(crate) area: f32,
    pub(crate) fill: f32,
    /// How far it reaches before and behind its centroid, as the receiver sees it.
    pub(crate) depth: f32,
    /// Root mean square sine between normals and axis.
    spread: f32,
    /// Largest radius of a point, nearly.
    radius: f32,
    pub(crate) flat: bool,
    /// Receiver within the voxel's sphere.
    pub(crate) close: bool,
    /// The receiver's own surface passes here.
    pub(crate) own_surface: bool,
    pub(crate) normaliser: f32,
    sh: [[half::f16; 4]; SH_TERMS],
}

impl Cluster {
    #[inline(always)]
    pub(crate) fn new(node: &NodeRecord, visit: &Visit, receiver: &Receiver) -> Self {
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
            && (is_own_surface(receiver.normal, axis, centroid, edge)
                || (inside && is_aligned(receiver.normal, axis) && axis.dot(centroid).abs() < INSIDE_DEPTH * edge));
        let along = quadratic_form(&covariance, centroid.normalize_or_zero()).max(0.0);
        Self {
            centroid,
            // A uniform segment reaches the square root of three standard deviations.
            depth: (3.0 * along).sqrt(),
            distance_squared: centroid.length_squared(),
            axis,
            covariance,
            area: node.sh[0][0].to_f32() * normaliser / AREA_TERM,
            fill: node.fill(),
            spread: node.spread(),
            radius: node.radius_ratio() * edge,
            flat,
            close: visit.center.length_squared() < 3.0 * visit.half * visit.half * 1.2,
            own_surface,
            normaliser,
            sh: node.sh,
        }
    }

    /// The part of the voxel that a flat cluster's surface reaches. Sections of neighbours on a curved surface lie in
    /// different planes, so they are made to overlap; a surface that ends inside the voxel ends where its points do.
    #[inline(always)]
    pub(crate) fn section_box(&self, visit: &Visit) -> SectionBox {
        let variance = Vec3::new(self.covariance[0], self.covariance[1], self.covariance[2]).max(Vec3::ZERO);
        // A uniform segment reaches the square root of three standard deviations.
        let spread = Vec3::new(variance.x.sqrt(), variance.y.sqrt(), variance.z.sqrt()) * 1.732_051;
        let reach = spread * REACH_SCALE + Vec3::splat(REACH_RADII * self.radius);
        let slack = SECTION_OVERLAP * self.spread;
        SectionBox::voxel(visit.center, visit.half, self.axis, slack)
            .within(self.centroid - reach, self.centroid + reach)
    }

    /// Whether the cluster may stand for what is below it.
    #[inline(always)]
    pub(crate) fn small_enough(&self, settings: &ShadeSettings, leaf: bool) -> bool {
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
    pub(crate) fn evaluate(&self, direction: Vec3) -> ([f32; 4], [f32; 4]) {
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
pub(crate) fn is_aligned(a: Vec3, b: Vec3) -> bool {
    a.dot(b).abs() > SAME_SURFACE
}

/// Whether a near element at `center` with `normal`, `size` wide, is the receiver's own surface, which only the flatness of
/// the element lifts above the receiver: the receiver is behind it, and either close to its plane for its size, or both
/// normals stand on one arc. On a circle the chord makes equal and opposite angles with the normals at its ends.
#[inline(always)]
pub(crate) fn is_own_surface(receiver_normal: Vec3, normal: Vec3, center: Vec3, size: f32) -> bool {
    let facing = normal.dot(receiver_normal);
    // A sheet may be seen from its back.
    let normal = if facing < 0.0 { -normal } else { normal };
    let behind = normal.dot(center);
    let on_arc =
        facing.abs() > SAME_SURFACE && (behind + receiver_normal.dot(center)).abs() < ARC_SLACK * center.length();
    let in_depth = facing > SAME_SHEET && behind < SHEET_DEPTH * size;
    behind >= 0.0 && (on_arc || in_depth)
}

#[inline(always)]
pub(crate) fn quadratic_form(m: &[f32; 6], v: Vec3) -> f32 {
    m[0] * v.x * v.x
        + m[1] * v.y * v.y
        + m[2] * v.z * v.z
        + 2.0 * (m[3] * v.x * v.y + m[4] * v.x * v.z + m[5] * v.y * v.z)
}

#[inline(always)]
pub(crate) fn multiply(m: &[f32; 6], v: Vec3) -> Vec3 {
    Vec3::new(
        m[0] * v.x + m[3] * v.y + m[4] * v.z,
        m[3] * v.x + m[1] * v.y + m[5] * v.z,
        m[4] * v.x + m[5] * v.y + m[2] * v.z,
    )
}

/// Axes and half extents of the rectangle in the plane across `normal` whose uniform covering has this covariance.
#[inline(always)]
pub(crate) fn rectangle_of(covariance: &[f32; 6], normal: Vec3) -> [(Vec3, f32); 2] {
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
