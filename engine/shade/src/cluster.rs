//! A node as receivers see it: whether it may stand for what is below it, and where its surface lies.

use crate::leaf::along_faces;
use crate::simd::{Floats, LANES, Words};
use crate::vector::Vector;
use glam::{Vec2, Vec3};
use half::f16;
use pbgi_core::cluster::separate_sides;
use pbgi_core::coverage::scattered;
use pbgi_core::node::FOLD_TERMS;
use pbgi_core::pack::area_normaliser;
use pbgi_core::sh::{BASIS_FACTORS, SH_TERMS, basis};
use pbgi_core::{HitSides, NodeRecord};

/// Zonal factor of the clamped cosine times Y00: the first area term of a cluster over its area.
const AREA_TERM: f32 = 0.886_226_9;
/// The same of the three linear terms, over the sum of its discs' normals times their areas.
const NORMAL_TERM: f32 = 1.023_326_7;
/// What the second band of `|cos|` makes of it: a constant, and a part by the squared cosine.
const CONSTANT_COSINE: f32 = 3.0 / 16.0;
const SQUARED_COSINE: f32 = 15.0 / 16.0;
/// A cluster whose normals spread less than this (root mean square sine) and that is thinner than [`FLAT_THICKNESS`] is a
/// piece of a plane.
const FLAT_SPREAD: f32 = 0.25;
/// Standard deviation across the plane over the voxel's edge.
const FLAT_THICKNESS: f32 = 0.06;
/// A flat cluster that covers at least this share of its plane inside the voxel is drawn as the whole section. Sampling
/// noise in small leaves makes the share uncertain by about as much as this is below 1.
pub(crate) const SECTION_FILL: f32 = 0.7;
/// A cluster whose normals spread less than this, that is thinner than [`EXACT_THICKNESS`] and covers its section to within
/// [`EXACT_FILL`] has an exact footprint: only its light may be wrong, so it may be the larger the more even that is.
const EXACT_SPREAD: f32 = 0.05;
const EXACT_THICKNESS: f32 = 0.01;
const EXACT_FILL: f32 = 0.08;
/// Variation of light (standard deviation over mean) up to which the accepted solid angle grows ...
const EVEN_VARIATION: f32 = 0.3;
/// ... up to this many times.
const STRETCH_MAX: f32 = 16.0;
/// Share of the accepted solid angle at which clusters without a plane are accepted: their silhouette is a guess.
const ROUND_SHARE: f32 = 0.2;
/// Cosine between normals from which a disc is taken for the receiver's own surface.
pub(crate) const SAME_SURFACE: f32 = 0.7;
/// The same for elements that the receiver nearly touches, facing the same way; shading normals lean, and folds turn within
/// an element.
pub(crate) const SAME_SHEET: f32 = 0.5;
/// How far behind an element's plane a receiver on the same surface may lie, as a share of the element's width.
const SHEET_DEPTH: f32 = 0.15;
/// The same for a receiver inside the element's voxel, to either side.
const INSIDE_DEPTH: f32 = 0.08;
/// How far from an arc through both a receiver and an element may stand, as a sine.
const ARC_SLACK: f32 = 0.15;
/// Distance in voxel edges within which a cluster may be the receiver's own surface.
const NEAR_VOXELS: f32 = 2.5;

/// A cluster is a sheet with other things before it, as ground with trees is, if this share of its area faces one way ...
const SHEET_SHARE: f32 = 0.6;
/// ... and no more than this ...
const SHEET_SHARE_MAX: f32 = 0.85;
/// ... if the others' normals do not lie along its own (mean square sine), as those of another sheet would ...
const OTHERS_SPREAD: f32 = 0.6;
/// ... and if it lies this far behind the centroid, in voxel edges: nearer, it is a relief.
const SHEET_DEPTH_MIN: f32 = 0.06;

/// A uniform segment reaches the square root of three standard deviations.
const UNIFORM_REACH: f32 = 1.732_051;
/// How far a section reaches beyond a uniform covering with the points' variance, which a few points know only roughly ...
const REACH_SCALE: f32 = 1.15;
/// ... and beyond that, in radii.
const REACH_RADII: f32 = 0.5;
/// Overlap of sections with their neighbours, as a share of half a voxel's edge, for a spread of 1.
const SECTION_OVERLAP: f32 = 0.1;

/// A node in plain numbers.
pub(crate) struct Cluster<'a> {
    node: &'a NodeRecord,
    pub(crate) centroid: Vec3,
    pub(crate) axis: Vec3,
    /// Covariance, square world units: xx, yy, zz, xy, xz, yz.
    pub(crate) covariance: [f32; 6],
    pub(crate) area: f32,
    pub(crate) fill: f32,
    /// Edge of the voxel.
    edge: f32,
    /// Root mean square sine between normals and axis.
    spread: f32,
    /// Largest radius of a point, nearly.
    radius: f32,
    /// A piece of a plane.
    pub(crate) flat: bool,
    /// How many times the accepted solid angle it may have.
    stretch: f32,
    pub(crate) normaliser: f32,
}

impl<'a> Cluster<'a> {
    #[inline(always)]
    pub(crate) fn new<F: Floats>(node: &'a NodeRecord, edge: f32) -> Self {
        let [xx, yy, zz, xy, xz, yz] = node.covariance;
        let [covariance @ .., area, _] = F::from_halves([xx, yy, zz, xy, xz, yz, node.sh[0][0], f16::ZERO]).to_array();
        let covariance = covariance.map(|value| value * (edge * edge));
        let normaliser = area_normaliser(edge);
        let axis = node.axis();
        let across = quadratic_form(&covariance, axis).max(0.0).sqrt();
        let (fill, spread) = (node.fill(), node.spread());
        let flat = spread < FLAT_SPREAD && across < FLAT_THICKNESS * edge;
        let exact = spread < EXACT_SPREAD && across < EXACT_THICKNESS * edge && (fill - 1.0).abs() < EXACT_FILL;
        let stretch = if exact {
            (EVEN_VARIATION / node.variation()).clamp(1.0, STRETCH_MAX)
        } else {
            1.0
        };
        Self {
            node,
            centroid: node.centroid.into(),
            axis,
            covariance,
            area: area * normaliser / AREA_TERM,
            fill,
            edge,
            spread,
            radius: node.radius_ratio() * edge,
            flat,
            stretch,
            normaliser,
        }
    }

    /// Whether it is drawn as the section of its voxel by its plane.
    #[inline(always)]
    pub(crate) fn fills_section(&self) -> bool {
        self.flat && self.fill >= SECTION_FILL
    }

    /// How far the section's box reaches from the voxel's centre, and from the centroid: the box is what both contain.
    /// Sections of neighbours on a curved surface lie in different planes, so they are made to overlap; a surface that ends
    /// inside the voxel ends where its points do.
    #[inline(always)]
    pub(crate) fn section_reach(&self) -> (Vec3, Vec3) {
        let variance = Vec3::new(self.covariance[0], self.covariance[1], self.covariance[2]).max(Vec3::ZERO);
        let deviation = Vec3::new(variance.x.sqrt(), variance.y.sqrt(), variance.z.sqrt());
        let of_points = deviation * (UNIFORM_REACH * REACH_SCALE) + Vec3::splat(REACH_RADII * self.radius);
        let half = 0.5 * self.edge;
        let of_voxel = (Vec3::splat(1.0 + SECTION_OVERLAP * self.spread) + along_faces(self.axis)) * half;
        (of_voxel, of_points)
    }

    /// Squared distance beyond which it may stand for what is below it, for all receivers and for those of whose surface it
    /// is certainly no part.
    #[inline(always)]
    pub(crate) fn accepted_from_squared(&self, max_solid_angle: f32) -> (f32, f32) {
        let share = if self.flat { 1.0 } else { ROUND_SHARE };
        let from = self.area.min(self.normaliser) / (share * max_solid_angle);
        (from, from / self.stretch)
    }

    /// The lanes in which a flat cluster is the receiver's own surface; `normal` is the receiver's, `centroid` and `center`
    /// (the voxel's) are relative to it.
    #[inline(always)]
    pub(crate) fn own_surface<F: Floats>(&self, normal: Vector<F>, centroid: Vector<F>, center: Vector<F>) -> u8 {
        let axis = Vector::splat(self.axis);
        let near = centroid
            .length_squared()
            .less(F::splat(NEAR_VOXELS * NEAR_VOXELS * self.edge * self.edge));
        if near.lanes() == 0 {
            return 0;
        }
        let inside = center.max_abs().less(F::splat(0.505 * self.edge));
        let in_plane = axis.dot(centroid).abs().less(F::splat(INSIDE_DEPTH * self.edge));
        let within = inside & in_plane & is_aligned(normal, axis);
        (near & (within | is_own_surface(normal, axis, centroid, self.edge))).lanes()
    }

    /// Squared reach before and behind its centroid along unit directions.
    #[inline(always)]
    pub(crate) fn depth<F: Floats>(&self, direction: Vector<F>) -> F {
        let along = direction.dot(multiply(&self.covariance, direction));
        (along.max(F::splat(0.0)) * F::splat(3.0)).sqrt()
    }

    #[inline(always)]
    fn terms<F: Floats>(&self) -> [f32; 4 * SH_TERMS] {
        let halves: &[f16; 4 * SH_TERMS] = bytemuck::cast_ref(&self.node.sh);
        let mut floats = [0.0; 4 * SH_TERMS];
        let (eights, _) = halves.as_chunks::<LANES>();
        for (floats, eight) in floats.chunks_exact_mut(LANES).zip(eights) {
            floats.copy_from_slice(&F::from_halves(*eight).to_array());
        }
        // The last four are in no eight of their own.
        let last = halves.len() - LANES;
        floats[last..].copy_from_slice(&F::from_halves(std::array::from_fn(|lane| halves[last + lane])).to_array());
        floats
    }

    /// Power of a flat cluster's two sides: radiance times area, the side of the axis first.
    #[inline(always)]
    pub(crate) fn side_powers<F: Floats>(&self) -> [Vec3; 2] {
        let terms = self.terms::<F>();
        let y = basis(self.axis);
        // Even and odd bands apart: their sum looks along the axis, their difference against it.
        let (mut even, mut odd) = (Vec3::ZERO, Vec3::ZERO);
        for (term, y) in y.iter().enumerate() {
            let sum = if (1..4).contains(&term) { &mut odd } else { &mut even };
            *sum += Vec3::new(terms[term * 4 + 1], terms[term * 4 + 2], terms[term * 4 + 3]) * *y;
        }
        let (front, back) = separate_sides(even + odd, even - odd);
        [front * self.normaliser, back * self.normaliser]
    }

    /// Area of a flat cluster's discs that face along its axis, and of those that face against it.
    #[inline(never)]
    pub(crate) fn facing(&self) -> [f32; 2] {
        let (mut even, mut odd) = (0.0, 0.0);
        for (term, y) in basis(self.axis).iter().enumerate() {
            let sum = if (1..4).contains(&term) { &mut odd } else { &mut even };
            *sum += self.node.sh[term][0].to_f32() * y;
        }
        let (front, back) = separate_sides(Vec3::splat(even + odd), Vec3::splat(even - odd));
        [front.x * self.normaliser, back.x * self.normaliser]
    }

    /// What it shows of itself toward unit directions.
    #[inline(always)]
    pub(crate) fn toward<F: Floats>(&self, direction: Vector<F>) -> Shown<'_, F> {
        Shown {
            cluster: self,
            terms: self.terms::<F>(),
            direction,
            basis: basis_of(direction),
        }
    }
}

/// A sheet with other things before it: most of a cluster's area, which faces one way and lies behind the rest.
pub(crate) struct Sheet {
    /// The way it faces.
    pub(crate) axis: Vec3,
    /// Where it lies along the axis, from the cluster's centroid; negative.
    pub(crate) height: f32,
    /// Radiance of the side that faces along the axis.
    pub(crate) radiance: Vec3,
    /// Share of the cluster's area.
    share: f32,
    area: f32,
    /// Radiance times area.
    power: Vec3,
}

impl Sheet {
    /// Where the middle of what is before it lies along the axis, from the cluster's centroid.
    #[inline(always)]
    pub(crate) fn others_height(&self) -> f32 {
        -self.height * self.share / (1.0 - self.share)
    }

    /// Cosines to unit directions, without and with their signs, as blurred as in sums of harmonics.
    #[inline(always)]
    fn cosines<F: Floats>(&self, direction: Vector<F>) -> [F; 2] {
        let cosine = Vector::splat(self.axis).dot(direction);
        let absolute = (cosine * cosine).mul_add(F::splat(SQUARED_COSINE), F::splat(CONSTANT_COSINE));
        [absolute, cosine]
    }
}

/// A cluster without a plane, seen from some directions.
pub(crate) struct Shown<'a, F> {
    cluster: &'a Cluster<'a>,
    terms: [f32; 4 * SH_TERMS],
    direction: Vector<F>,
    basis: [F; SH_TERMS],
}

impl<F: Floats> Shown<'_, F> {
    /// Projected area of the sides of discs that count and that no other disc hides.
    #[inline(always)]
    pub(crate) fn area(&self, sides: HitSides) -> F {
        let [even, odd] = self.bands(0);
        let shown = match sides {
            HitSides::Both => even + even,
            HitSides::Front => even + odd,
            HitSides::Back => even - odd,
        };
        shown.max(F::splat(0.0)) * F::splat(self.cluster.normaliser) * self.visible()
    }

    /// The sheet that most of it is, if the rest lies before that. What is not the sheet faces everywhere, so that sums over all discs
    /// tell the sheet's area (of normals), its power (of normals times radiance), and where it lies (of places by squared cosines).
    #[inline(always)]
    pub(crate) fn sheet(&self) -> Option<Sheet> {
        let cluster = self.cluster;
        let spread_squared = cluster.spread * cluster.spread;
        if cluster.fill < SECTION_FILL || spread_squared > 1.0 - SHEET_SHARE {
            return None;
        }
        let facing = self.normals(0).dot(cluster.axis) * cluster.normaliser;
        let axis = cluster.axis * 1f32.copysign(facing);
        let area = facing.abs();
        let share = area / cluster.area;
        let others = 1.0 - share;
        if !(SHEET_SHARE..SHEET_SHARE_MAX).contains(&share)
            || share * cluster.fill < SECTION_FILL
            || spread_squared < OTHERS_SPREAD * others
        {
            return None;
        }
        let along = Vector::<F>::splat(axis);
        let [fold, ..] = self.fold(along).dot(along).to_array();
        // The others' squared cosines make up for a part of it.
        let height = fold * (others / spread_squared).max(1.0) / share;
        if height > -SHEET_DEPTH_MIN * cluster.edge {
            return None;
        }
        let [red, green, blue] = [self.normals(1), self.normals(2), self.normals(3)];
        let power = Vec3::new(red.dot(axis), green.dot(axis), blue.dot(axis)).max(Vec3::ZERO) * cluster.normaliser;
        Some(Sheet {
            axis,
            height,
            // Where there is more than one layer the others are hidden, and unlit.
            radiance: power / area.min(cluster.area / cluster.fill),
            share,
            area,
            power,
        })
    }

    /// Like [`Self::area`], of all but the sheet.
    #[inline(always)]
    pub(crate) fn area_without(&self, sheet: &Sheet, sides: HitSides) -> F {
        let [absolute, cosine] = sheet.cosines(self.direction);
        let part = match sides {
            HitSides::Both => absolute,
            HitSides::Front => (absolute + cosine) * F::splat(0.5),
            HitSides::Back => (absolute - cosine) * F::splat(0.5),
        };
        self.area(sides) - part * F::splat(sheet.area) * self.visible()
    }

    /// Like [`Self::power`], of all but the sheet.
    #[inline(always)]
    pub(crate) fn power_without(&self, sheet: &Sheet) -> Vector<F> {
        let [absolute, cosine] = sheet.cosines(self.direction);
        let power = self.power() - Vector::splat(sheet.power) * ((absolute + cosine) * F::splat(0.5));
        power.max(Vector::splat(Vec3::ZERO))
    }

    /// Share that the cluster does not hide of itself: along an axis as the node says, between axes by the squares of the cosines.
    #[inline(always)]
    fn visible(&self) -> F {
        let visible = Vector::splat(self.cluster.node.visible());
        let direction = self.direction;
        direction.x * direction.x * visible.x
            + direction.y * direction.y * visible.y
            + direction.z * direction.z * visible.z
    }

    /// From the centroid of all discs to that of what is seen of them. A body hides half of itself; which half, normals do not tell.
    #[inline(always)]
    pub(crate) fn shift(&self) -> Vector<F> {
        let [even, _] = self.bands(0);
        let area = (even + even) * F::splat(self.cluster.normaliser);
        // Of what is never seen there is no middle.
        let least = (1e-3 * self.cluster.area).max(f32::MIN_POSITIVE);
        let scale = F::splat(SQUARED_COSINE * self.cluster.area) / area.max(F::splat(least));
        let visible = self.visible();
        self.fold(self.direction) * (scale * (visible + visible - F::splat(1.0)).max(F::splat(0.0)))
    }

    /// Mean place of its discs from their centroid, weighted by the squared cosines between their normals and unit directions.
    #[inline(always)]
    fn fold(&self, d: Vector<F>) -> Vector<F> {
        let (two, zz) = (F::splat(2.0), d.z * d.z);
        let terms = [
            d.x * d.x - zz,
            d.y * d.y - zz,
            two * d.x * d.y,
            two * d.x * d.z,
            two * d.y * d.z,
        ];
        let [x, y, z] = self.cluster.node.folds();
        let sums = Vector {
            x: along(&terms, &x),
            y: along(&terms, &y),
            z: along(&terms, &z),
        };
        sums * F::splat(self.cluster.edge)
    }

    /// Radiance times projected area.
    #[inline(always)]
    pub(crate) fn power(&self) -> Vector<F> {
        Vector {
            x: self.channel(1),
            y: self.channel(2),
            z: self.channel(3),
        }
    }

    #[inline(always)]
    fn channel(&self, channel: usize) -> F {
        let [even, odd] = self.bands(channel);
        (even + odd).max(F::splat(0.0)) * F::splat(self.cluster.normaliser)
    }

    /// See [`pbgi_core::coverage::scattered`].
    #[inline(always)]
    pub(crate) fn scattered(&self) -> f32 {
        let area = self.terms[0] / AREA_TERM;
        scattered(self.normals(0).length() / area.max(f32::MIN_POSITIVE))
    }

    /// Sum over discs of normal times area, or times power of the front less that of the back; over the normaliser.
    #[inline(always)]
    fn normals(&self, channel: usize) -> Vec3 {
        let [y, z, x] = [4, 8, 12].map(
            #[inline(always)]
            |term| self.terms[term + channel],
        );
        Vec3::new(x, y, z) / NORMAL_TERM
    }

    /// Sums of the even and of the odd bands of a channel.
    #[inline(always)]
    fn bands(&self, channel: usize) -> [F; 2] {
        let with = |index: usize, sum: F| F::splat(self.terms[index * 4 + channel]).mul_add(self.basis[index], sum);
        let zero = F::splat(0.0);
        let even = with(8, with(7, with(6, with(5, with(4, with(0, zero))))));
        let odd = with(3, with(2, with(1, zero)));
        [even, odd]
    }
}

/// The sum of products of two rows.
#[inline(always)]
fn along<F: Floats>(terms: &[F; FOLD_TERMS], factors: &[f32; FOLD_TERMS]) -> F {
    let mut sum = terms[0] * F::splat(factors[0]);
    for (term, factor) in terms[1..].iter().zip(&factors[1..]) {
        sum = term.mul_add(F::splat(*factor), sum);
    }
    sum
}

/// The nine basis functions in unit directions; see [`basis`].
#[inline(always)]
fn basis_of<F: Floats>(d: Vector<F>) -> [F; SH_TERMS] {
    let [constant, linear, product, zonal, square] = BASIS_FACTORS.map(F::splat);
    [
        constant,
        linear * d.y,
        linear * d.z,
        linear * d.x,
        product * d.x * d.y,
        product * d.y * d.z,
        zonal * (F::splat(3.0) * d.z * d.z - F::splat(1.0)),
        product * d.x * d.z,
        square * (d.x * d.x - d.y * d.y),
    ]
}

#[inline(always)]
pub(crate) fn is_aligned<F: Floats>(a: Vector<F>, b: Vector<F>) -> F::Words {
    F::splat(SAME_SURFACE).less(a.dot(b).abs())
}

/// Whether near elements at `center` with `normal`, `size` wide, are the receivers' own surface, which only the flatness of
/// the element lifts above the receiver: the receiver is behind it, and either close to its plane for its size, or both
/// normals stand on one arc. On a circle the chord makes equal and opposite angles with the normals at its ends.
#[inline(always)]
pub(crate) fn is_own_surface<F: Floats>(
    receiver_normal: Vector<F>,
    normal: Vector<F>,
    center: Vector<F>,
    size: f32,
) -> F::Words {
    let facing = normal.dot(receiver_normal);
    // A sheet may be seen from its back.
    let behind = normal.dot(center) * F::splat(1.0).copysign(facing);
    let chord = (behind + receiver_normal.dot(center)).abs();
    let on_arc =
        F::splat(SAME_SURFACE).less(facing.abs()) & chord.less(F::splat(ARC_SLACK) * center.length_squared().sqrt());
    let in_depth = F::splat(SAME_SHEET).less(facing) & behind.less(F::splat(SHEET_DEPTH * size));
    !behind.less(F::splat(0.0)) & (on_arc | in_depth)
}

#[inline(always)]
fn quadratic_form(m: &[f32; 6], v: Vec3) -> f32 {
    m[0] * v.x * v.x
        + m[1] * v.y * v.y
        + m[2] * v.z * v.z
        + 2.0 * (m[3] * v.x * v.y + m[4] * v.x * v.z + m[5] * v.y * v.z)
}

#[inline(always)]
fn multiply<F: Floats>(m: &[f32; 6], v: Vector<F>) -> Vector<F> {
    let [xx, yy, zz, xy, xz, yz] = m.map(F::splat);
    Vector {
        x: xx.mul_add(v.x, xy.mul_add(v.y, xz * v.z)),
        y: xy.mul_add(v.x, yy.mul_add(v.y, yz * v.z)),
        z: xz.mul_add(v.x, yz.mul_add(v.y, zz * v.z)),
    }
}

/// Axes and half extents of the rectangles in the planes across unit `normal`s whose uniform covering has this covariance.
#[inline(always)]
pub(crate) fn rectangle_of<F: Floats>(covariance: &[f32; 6], normal: Vector<F>) -> [(Vector<F>, F); 2] {
    let [u, v] = orthonormal_pair(normal);
    let (cu, cv) = (multiply(covariance, u), multiply(covariance, v));
    let (a, b, c) = (u.dot(cu), u.dot(cv), v.dot(cv));
    let (half, zero) = (F::splat(0.5), F::splat(0.0));
    let middle = half * (a + c);
    let reach = (half * half * (a - c) * (a - c) + b * b).sqrt();
    let (large, small) = (middle + reach, (middle - reach).max(zero));
    // The eigenvector of the larger; any where both are equal.
    let lean = large - c;
    let tilted = (F::splat(1e-12) * large).less(lean.abs() + b.abs());
    let length = (lean * lean + b * b).sqrt();
    let regular = tilted & F::splat(f32::MIN_POSITIVE).less(length);
    let turn_u = regular.select(lean / length, F::splat(Vec2::X.x));
    let turn_v = regular.select(b / length, zero);
    let first = u * turn_u + v * turn_v;
    let second = v * turn_u - u * turn_v;
    // A uniform segment of half length h has variance h^2 / 3.
    let three = F::splat(3.0);
    [(first, (three * large).sqrt()), (second, (three * small).sqrt())]
}

/// Two unit vectors across unit normals and each other (Duff et al. 2017, "Building an Orthonormal Basis, Revisited").
#[inline(always)]
pub(crate) fn orthonormal_pair<F: Floats>(n: Vector<F>) -> [Vector<F>; 2] {
    let one = F::splat(1.0);
    let sign = one.copysign(n.z);
    let a = -one / (sign + n.z);
    let b = n.x * n.y * a;
    [
        Vector {
            x: one + sign * n.x * n.x * a,
            y: sign * b,
            z: -(sign * n.x),
        },
        Vector {
            x: b,
            y: sign + n.y * n.y * a,
            z: -n.y,
        },
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::ScalarFloats;
    use pbgi_core::point::Sides;
    use pbgi_core::{ClusterAccumulator, NodeKind, PointIndex, PointRecord, Quantizer, Voxel};

    /// A layer of discs that together have `area`, in a voxel of edge 1 around the origin.
    fn layer(height: f32, normal: Vec3, area: f32, radiance: f32) -> Vec<PointRecord> {
        const SIDE: i32 = 20;
        let place = |i: i32| (i as f32 + 0.5) / SIDE as f32 - 0.5;
        let radius = (area / (SIDE * SIDE) as f32 / std::f32::consts::PI).sqrt();
        let sides = Sides {
            front: [radiance; 3],
            back: [0.0; 3],
        };
        let point = |i: i32| {
            let position = [place(i % SIDE), place(i / SIDE), height];
            PointRecord::new(position, normal.to_array(), radius, sides).unwrap()
        };
        (0..SIDE * SIDE).map(point).collect()
    }

    fn node(layers: &[Vec<PointRecord>]) -> NodeRecord {
        let quantizer = Quantizer {
            origin: [-0.5; 3],
            edge: 1.0,
        };
        let mut sum = ClusterAccumulator::default();
        for point in layers.iter().flatten() {
            sum.add(point, &quantizer);
        }
        let kind = NodeKind::Leaf {
            first: PointIndex(0),
            count: 1,
        };
        NodeRecord::new(0, kind, &sum.finalize(Voxel::ROOT, &quantizer).attributes)
    }

    fn sheet_of(node: &NodeRecord) -> Option<Sheet> {
        let cluster = Cluster::new::<ScalarFloats>(node, 1.0);
        cluster.toward(Vector::<ScalarFloats>::splat(Vec3::Z)).sheet()
    }

    /// Leaves of all directions, two layers high.
    fn leaves(area: f32) -> [Vec<PointRecord>; 6] {
        [Vec3::X, Vec3::NEG_X, Vec3::Y, Vec3::NEG_Y, Vec3::Z, Vec3::NEG_Z].map(|normal| {
            let mut points = layer(0.0, normal, area / 12.0, 0.5);
            points.extend(layer(0.4, normal, area / 12.0, 0.5));
            points
        })
    }

    #[test]
    fn ground_below_leaves_is_told_from_them() {
        let mut layers = vec![layer(-0.3, Vec3::Z, 1.0, 2.0)];
        layers.extend(leaves(0.4));
        let node = node(&layers);
        let sheet = sheet_of(&node).unwrap();
        // The centroid of 1.0 at -0.3 and 0.4 at 0.2.
        let middle = -0.22 / 1.4;
        assert!(sheet.axis.distance(Vec3::Z) < 1e-3);
        assert!((sheet.area - 1.0).abs() < 0.01, "{}", sheet.area);
        assert!((sheet.height - (-0.3 - middle)).abs() < 0.02, "{}", sheet.height);
        assert!(
            (sheet.others_height() - (0.2 - middle)).abs() < 0.05,
            "{}",
            sheet.others_height()
        );
        assert!(
            (sheet.radiance - Vec3::splat(2.0)).abs().max_element() < 0.02,
            "{}",
            sheet.radiance
        );
        // From the side nothing is seen of the ground, but half of the leaves' area and a quarter of what their fronts send out.
        let cluster = Cluster::new::<ScalarFloats>(&node, 1.0);
        let shown = cluster.toward(Vector::<ScalarFloats>::splat(Vec3::X));
        let [area, ..] = shown.area_without(&sheet, HitSides::Both).to_array();
        let [visible, ..] = shown.visible().to_array();
        assert!(
            (area / visible - 0.2).abs() < 0.02,
            "{area}, of which {visible} is seen"
        );
        let [power, ..] = shown.power_without(&sheet).x.to_array();
        assert!((power - 0.05).abs() < 0.01, "{power}");
    }

    #[test]
    fn walls_are_no_sheet_with_others_before_it() {
        // One behind the other, back to back, and a relief.
        let parallel = [layer(-0.3, Vec3::Z, 1.0, 1.0), layer(0.3, Vec3::Z, 0.3, 1.0)];
        let opposite = [layer(-0.3, Vec3::Z, 1.0, 1.0), layer(0.3, Vec3::NEG_Z, 0.3, 1.0)];
        let mut relief = vec![layer(-0.3, Vec3::Z, 1.0, 1.0)];
        relief.extend([Vec3::X, Vec3::NEG_X].map(|normal| layer(-0.25, normal, 0.2, 1.0)));
        for layers in [&parallel[..], &opposite[..], &relief[..]] {
            assert!(sheet_of(&node(layers)).is_none());
        }
        // Leaves alone.
        assert!(sheet_of(&node(&leaves(1.4))).is_none());
    }
}
