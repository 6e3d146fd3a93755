//! Footprints: the convex cones, seen from the receivers, in which a disc or a cluster hides what is behind it.
//!
//! A footprint is a piece of a plane cut by slabs. The ray `d` meets the plane `n.x = k` at `k d / (n.d)`, so the slab
//! `low <= a.x <= high` is the pair of half-spaces `(k a - low n).d >= 0` and `(high n - k a).d >= 0`: linear in `d`.

use crate::simd::{Floats, Words};
use crate::vector::{Frames, Vector};
use std::ops::Range;

/// Half-spaces of the widest footprint: a section cut by two facets, or the octagon of a disc.
const HALF_SPACES_MAX: usize = 8;
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

/// A convex cone with its apex at the receiver, in the receiver's frame.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Footprint<F: Floats> {
    half_spaces: [HalfSpace<F>; HALF_SPACES_MAX],
    len: usize,
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

impl<F: Floats> Footprint<F> {
    #[inline(always)]
    fn empty(center: Vector<F>, radius: F) -> Self {
        let none = HalfSpace {
            y: F::splat(0.0),
            z: F::splat(0.0),
            upper: F::Words::splat(0),
            lower: F::Words::splat(0),
        };
        Self {
            half_spaces: [none; HALF_SPACES_MAX],
            len: 0,
            center,
            radius,
        }
    }

    #[inline(always)]
    pub(crate) fn half_spaces(&self) -> &[HalfSpace<F>] {
        &self.half_spaces[..self.len]
    }

    #[inline(always)]
    fn add_half_space(&mut self, g: Vector<F>) {
        /// Keeps the division defined; a row is then inside or outside as a whole.
        const TINY: f32 = 1e-20;
        let tiny = F::splat(TINY);
        let x = g.x.abs().less(tiny).select(tiny, g.x);
        let scale = F::splat(-1.0) / x;
        let upper = x.less(F::splat(0.0));
        self.half_spaces[self.len] = HalfSpace {
            y: g.y * scale,
            z: g.z * scale,
            upper,
            lower: !upper,
        };
        self.len += 1;
    }

    /// Everything in the receivers' frames.
    #[inline(always)]
    fn add_slab(&mut self, plane: &Plane<F>, axis: Vector<F>, low: F, high: F) {
        let axis = axis * plane.distance;
        self.add_half_space(plane.normal.mul_add(-low, axis));
        self.add_half_space(plane.normal.mul_add(high, -axis));
    }

    /// A rectangle around `center` in a plane, given by unit axes and half extents; everything in the receivers' frames.
    #[inline(always)]
    pub(crate) fn rectangle(center: Vector<F>, plane: &Plane<F>, sides: [(Vector<F>, F); 2]) -> Self {
        let radius = (sides[0].1 * sides[0].1 + sides[1].1 * sides[1].1).sqrt();
        let mut footprint = Self::empty(center, radius);
        for (axis, half) in sides {
            let middle = axis.dot(center);
            footprint.add_slab(plane, axis, middle - half, middle + half);
        }
        footprint
    }

    /// The octagon with the area of a disc, given by two unit axes of its plane; everything in the receivers' frames.
    #[inline(always)]
    pub(crate) fn disc(center: Vector<F>, plane: &Plane<F>, axes: [Vector<F>; 2], radius: f32) -> Self {
        let half = F::splat(radius * OCTAGON_APOTHEM);
        let diagonal = F::splat(std::f32::consts::FRAC_1_SQRT_2);
        let [u, v] = axes;
        let mut footprint = Self::empty(center, F::splat(radius * OCTAGON_REACH));
        for axis in [u, v, (u + v) * diagonal, (u - v) * diagonal] {
            let middle = axis.dot(center);
            footprint.add_slab(plane, axis, middle - half, middle + half);
        }
        footprint
    }

    /// Where a plane cuts a box, given by its corners relative to the receivers, in the world.
    #[inline(always)]
    pub(crate) fn section(frames: &Frames<F>, low: Vector<F>, high: Vector<F>, plane: &Plane<F>) -> Self {
        let half = F::splat(0.5);
        let center = frames.local_from_world((low + high) * half);
        let radius = (high - low).length_squared().sqrt() * half;
        let mut footprint = Self::empty(center, radius);
        let [x, y, z] = frames.axes();
        footprint.add_slab(plane, x, low.x, high.x);
        footprint.add_slab(plane, y, low.y, high.y);
        footprint.add_slab(plane, z, low.z, high.z);
        footprint
    }

    /// Keeps the part with `normal.x >= distance`; in the receivers' frames.
    #[inline(always)]
    pub(crate) fn cut(&mut self, plane: &Plane<F>, normal: Vector<F>, distance: F) {
        self.add_half_space(plane.normal.mul_add(-distance, normal * plane.distance));
    }

    /// Rows that the footprint may touch in any of these lanes.
    #[inline(always)]
    pub(crate) fn rows(&self, resolution: usize, lanes: u8) -> Range<usize> {
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
    pub(crate) fn rows(&self, resolution: usize, lanes: u8) -> Range<usize> {
        let shown = self.seen & F::Words::from_lanes(lanes);
        if shown.lanes() == 0 {
            return 0..0;
        }
        let first = shown.select(self.low, F::splat(1.0)).min_lane();
        let last = shown.select(self.high, F::splat(-1.0)).max_lane();
        // Rows lie where their middles do; the slack covers rounding.
        let row_of = |sin: f32| (sin + 1.0) * 0.5 * resolution as f32;
        let first = (row_of(first) - 0.501).ceil().max(0.0) as usize;
        let end = (row_of(last) + 0.501).floor().clamp(0.0, resolution as f32) as usize;
        first..end.max(first)
    }
}
