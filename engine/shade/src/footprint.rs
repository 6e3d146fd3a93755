//! Footprints: the convex cones, seen from the receivers, in which a disc or a cluster hides what is behind it.
//!
//! A footprint is a piece of a plane cut by slabs. The ray `d` meets the plane `n.x = k` at `k d / (n.d)`, so the slab
//! `low <= a.x <= high` is the pair of half-spaces `(k a - low n).d >= 0` and `(high n - k a).d >= 0`: linear in `d`.

use crate::raster::{INTEGER_MASK, INTEGER_SHIFT};
use crate::simd::{Floats, Words};
use crate::vector::{Frames, Vector};
use std::ops::Range;

/// Half-spaces of a rectangle.
pub(crate) const OF_RECTANGLE: usize = 4;
/// Half-spaces of a section.
pub(crate) const OF_SECTION: usize = 6;
/// Half-spaces of a disc's octagon, and of a section with what may cut it.
pub(crate) const OF_OCTAGON: usize = 8;
/// Apothem of an octagon over the radius of the disc of equal area.
const OCTAGON_APOTHEM: f32 = 0.973_68;
/// Circumradius of that octagon over the disc's radius.
const OCTAGON_REACH: f32 = 1.06;

/// The half-space `x d.x + y d.y + z d.z >= 0` in the receiver's frame, as the bound that it puts on `tan a` in the row with
/// angle `phi` (see [`crate::raster`]): `y sin phi + z cos phi`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct HalfSpace<F: Floats> {
    pub(crate) y: F,
    pub(crate) z: F,
    /// All ones where the bound is an upper one, and where it is a lower one.
    pub(crate) upper: F::Words,
    pub(crate) lower: F::Words,
}

/// A convex cone of `N` half-spaces with its apex at the receiver, in the receiver's frame.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Footprint<F: Floats, const N: usize> {
    pub(crate) half_spaces: [HalfSpace<F>; N],
    /// Sphere around the piece of plane.
    center: Vector<F>,
    radius: F,
}

/// The plane of a footprint, on the far side of the receiver: `normal.x = distance`, `distance > 0`; positions relative to
/// the receiver, in its frame.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Plane<F> {
    pub(crate) normal: Vector<F>,
    pub(crate) distance: F,
}

impl<F: Floats> Plane<F> {
    /// Through `point` (relative to the receiver) with `normal`, both in the world, turned away from the receiver. A receiver
    /// within `touch` of the plane is taken to stand that far in front of it: at the foot of a wall the wall hides half of
    /// the sky.
    #[inline(always)]
    pub(crate) fn through(frames: &Frames<F>, point: Vector<F>, normal: Vector<F>, touch: f32) -> Self {
        let distance = normal.dot(point);
        let touch = F::splat(touch);
        let behind = distance.less(touch);
        let turn = behind.select(F::splat(-1.0), F::splat(1.0));
        Self {
            normal: frames.local_from_world(normal) * turn,
            distance: (distance * turn).max(touch),
        }
    }
}

impl<F: Floats> HalfSpace<F> {
    /// Where `g.d >= 0`; in the receivers' frames.
    #[inline(always)]
    fn new(g: Vector<F>) -> Self {
        /// Keeps the division defined; a row is then inside or outside as a whole.
        const TINY: f32 = 1e-20;
        let tiny = F::splat(TINY);
        let x = g.x.abs().less(tiny).select(tiny, g.x);
        let scale = F::splat(-1.0) / x;
        let upper = x.less(F::splat(0.0));
        Self {
            y: g.y * scale,
            z: g.z * scale,
            upper,
            lower: !upper,
        }
    }

    /// Everywhere.
    #[inline(always)]
    fn none() -> Self {
        let (zero, neither) = (F::splat(0.0), F::Words::splat(u32::MAX));
        Self {
            y: zero,
            z: zero,
            upper: neither,
            lower: neither,
        }
    }
}

impl<F: Floats> Plane<F> {
    /// Where the ray meets the plane with `low <= axis.x <= high`; in the receivers' frames.
    #[inline(always)]
    fn slab(&self, axis: Vector<F>, low: F, high: F) -> [HalfSpace<F>; 2] {
        let axis = axis * self.distance;
        [
            HalfSpace::new(self.normal.mul_add(-low, axis)),
            HalfSpace::new(self.normal.mul_add(high, -axis)),
        ]
    }

    /// The slab around `center` that reaches `half` to both sides.
    #[inline(always)]
    fn strip(&self, axis: Vector<F>, center: Vector<F>, half: F) -> [HalfSpace<F>; 2] {
        let middle = axis.dot(center);
        self.slab(axis, middle - half, middle + half)
    }
}

impl<F: Floats> Footprint<F, OF_RECTANGLE> {
    /// A rectangle around `center` in a plane, given by unit axes and half extents; everything in the receivers' frames.
    #[inline(always)]
    pub(crate) fn rectangle(center: Vector<F>, plane: &Plane<F>, sides: [(Vector<F>, F); 2]) -> Self {
        let [a, b] = [
            plane.strip(sides[0].0, center, sides[0].1),
            plane.strip(sides[1].0, center, sides[1].1),
        ];
        Self {
            half_spaces: [a[0], a[1], b[0], b[1]],
            center,
            radius: (sides[0].1 * sides[0].1 + sides[1].1 * sides[1].1).sqrt(),
        }
    }
}

impl<F: Floats> Footprint<F, OF_OCTAGON> {
    /// The octagon with the area of a disc, given by two unit axes of its plane; everything in the receivers' frames.
    #[inline(always)]
    pub(crate) fn disc(center: Vector<F>, plane: &Plane<F>, axes: [Vector<F>; 2], radius: f32) -> Self {
        let half = F::splat(radius * OCTAGON_APOTHEM);
        let diagonal = F::splat(std::f32::consts::FRAC_1_SQRT_2);
        let [u, v] = axes;
        let (a, b) = (plane.strip(u, center, half), plane.strip(v, center, half));
        let c = plane.strip((u + v) * diagonal, center, half);
        let d = plane.strip((u - v) * diagonal, center, half);
        Self {
            half_spaces: [a[0], a[1], b[0], b[1], c[0], c[1], d[0], d[1]],
            center,
            radius: F::splat(radius * OCTAGON_REACH),
        }
    }
}

impl<F: Floats> Footprint<F, OF_SECTION> {
    /// Where a plane cuts a box, given by its corners relative to the receivers, in the world.
    #[inline(always)]
    pub(crate) fn section(frames: &Frames<F>, low: Vector<F>, high: Vector<F>, plane: &Plane<F>) -> Self {
        let half = F::splat(0.5);
        let [x, y, z] = frames.axes();
        let (x, y, z) = (
            plane.slab(x, low.x, high.x),
            plane.slab(y, low.y, high.y),
            plane.slab(z, low.z, high.z),
        );
        Self {
            half_spaces: [x[0], x[1], y[0], y[1], z[0], z[1]],
            center: frames.local_from_world((low + high) * half),
            radius: (high - low).length_squared().sqrt() * half,
        }
    }

    /// Keeps the parts with `normal.x >= distance`; in the receivers' frames.
    #[inline(always)]
    pub(crate) fn cut(
        &self,
        plane: &Plane<F>,
        cuts: impl ExactSizeIterator<Item = (Vector<F>, F)>,
    ) -> Footprint<F, OF_OCTAGON> {
        debug_assert!(cuts.len() <= OF_OCTAGON - OF_SECTION, "a facet has few neighbours");
        let mut half_spaces = [HalfSpace::none(); OF_OCTAGON];
        half_spaces[..OF_SECTION].copy_from_slice(&self.half_spaces);
        for (half_space, (normal, distance)) in half_spaces[OF_SECTION..].iter_mut().zip(cuts) {
            *half_space = HalfSpace::new(plane.normal.mul_add(-distance, normal * plane.distance));
        }
        Footprint {
            half_spaces,
            center: self.center,
            radius: self.radius,
        }
    }
}

impl<F: Floats, const N: usize> Footprint<F, N> {
    /// Rows that the footprint may touch in any of these lanes.
    #[inline(always)]
    pub(crate) fn rows(&self, resolution: f32, lanes: u8) -> Range<usize> {
        RowSpan::of_spheres(&self.center, self.radius).rows(resolution, lanes)
    }
}

/// Rows that spheres show in, as sines of row angles.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RowSpan<F: Floats> {
    pub(crate) low: F,
    pub(crate) high: F,
    /// Where the sphere is not below the horizon.
    seen: F::Words,
}

impl<F: Floats> RowSpan<F> {
    /// Centres in the receivers' frames.
    #[inline(always)]
    pub(crate) fn of_spheres(center: &Vector<F>, radius: F) -> Self {
        let (one, zero) = (F::splat(1.0), F::splat(0.0));
        let across = (center.y * center.y + center.z * center.z).sqrt();
        let apart = radius.less(across);
        let scale = one / across;
        let (sin, cos) = (center.y * scale, center.z * scale);
        let delta_sin = radius * scale;
        let delta_cos = (one - delta_sin * delta_sin).max(zero).sqrt();
        // Row angles phi - delta and phi + delta; those with a negative cosine are below the horizon.
        let low_above = zero.less(cos * delta_cos + sin * delta_sin);
        let high_above = zero.less(cos * delta_cos - sin * delta_sin);
        Self {
            low: (low_above & apart).select(sin * delta_cos - cos * delta_sin, -one),
            high: (high_above & apart).select(sin * delta_cos + cos * delta_sin, one),
            seen: low_above | high_above | zero.less(cos) | !apart,
        }
    }

    /// The rows of all these lanes together.
    #[inline(always)]
    pub(crate) fn rows(&self, resolution: f32, lanes: u8) -> Range<usize> {
        /// Covers rounding, in rows.
        const SLACK: f32 = 1e-3;
        let shown = self.seen & F::Words::from_lanes(lanes);
        if shown.lanes() == 0 {
            return 0..0;
        }
        let low = shown.select(self.low, F::splat(1.0)).min_lane();
        let high = shown.select(self.high, F::splat(-1.0)).max_lane();
        // Rows lie where their middles do.
        let half = 0.5 * resolution;
        let first = rounded(low.mul_add(half, half - SLACK).max(0.0));
        let end = rounded(high.mul_add(half, half + SLACK).min(resolution));
        first..end.max(first)
    }
}

/// The nearest integer of a number from 0 to [`crate::raster::RESOLUTION_MAX`], much faster than a cast, which has to think of all numbers.
#[inline(always)]
fn rounded(number: f32) -> usize {
    ((number + INTEGER_SHIFT).to_bits() & INTEGER_MASK) as usize
}
