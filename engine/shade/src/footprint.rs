//! Footprints: the convex cones, seen from the receiver, in which a disc or a cluster hides what is behind it.
//!
//! A footprint is a piece of a plane cut by slabs. The ray `d` meets the plane `n.x = k` at `k d / (n.d)`, so the slab
//! `low <= a.x <= high` is the pair of half-spaces `(k a - low n).d >= 0` and `(high n - k a).d >= 0`: linear in `d`.

use crate::frame::Frame;
use crate::raster::LANES;
use glam::Vec3;

/// Half-spaces of the widest footprint: a section cut by two facets, or the octagon of a disc.
const HALF_SPACES_MAX: usize = 8;
/// Apothem of an octagon over the radius of the disc of equal area.
const OCTAGON_APOTHEM: f32 = 0.973_68;
/// Cosine between a plane's normal and an axis from which the plane counts as running along the faces across that axis.
const ALONG_FACE: f32 = 0.9;
/// How far such a plane may lie outside the voxel, as a share of its half edge.
const FACE_SLACK: f32 = 0.05;

/// The half-space `x d.x + y d.y + z d.z >= 0` in the receiver's frame.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct HalfSpace {
    pub(crate) inverse_x: f32,
    pub(crate) y: f32,
    pub(crate) z: f32,
}

/// A convex cone with its apex at the receiver, in the receiver's frame.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Footprint {
    half_spaces: [HalfSpace; HALF_SPACES_MAX],
    len: usize,
    /// Sphere around the piece of plane.
    center: Vec3,
    radius: f32,
}

/// The plane of a footprint, on the far side of the receiver: `normal.x = distance`, `distance > 0`; world directions,
/// positions relative to the receiver.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Plane {
    pub(crate) normal: Vec3,
    pub(crate) distance: f32,
}

/// The box in which a plane is drawn: a voxel, less the part that its points do not reach; relative to the receiver.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SectionBox {
    low: Vec3,
    high: Vec3,
}

impl SectionBox {
    /// A voxel, larger by the share `slack` of its half edge. A plane along a face must not fall out of it by rounding.
    #[inline(always)]
    pub(crate) fn voxel(center: Vec3, half: f32, normal: Vec3, slack: f32) -> Self {
        let along = normal.abs().cmpgt(Vec3::splat(ALONG_FACE));
        let reach = Vec3::splat(half * (1.0 + slack)) + Vec3::select(along, Vec3::splat(half * FACE_SLACK), Vec3::ZERO);
        Self {
            low: center - reach,
            high: center + reach,
        }
    }

    /// The part between two corners.
    #[inline(always)]
    pub(crate) fn within(self, low: Vec3, high: Vec3) -> Self {
        Self {
            low: self.low.max(low),
            high: self.high.min(high),
        }
    }
}

impl Plane {
    /// Through `point` (relative to the receiver) with `normal`, turned away from the receiver. A receiver within `touch`
    /// of the plane is taken to stand that far in front of it: at the foot of a wall the wall hides half of the sky.
    #[inline(always)]
    pub(crate) fn through(point: Vec3, normal: Vec3, touch: f32) -> Self {
        let distance = normal.dot(point);
        if distance < touch {
            Self {
                normal: -normal,
                distance: (-distance).max(touch),
            }
        } else {
            Self { normal, distance }
        }
    }
}

impl Footprint {
    #[inline(always)]
    fn empty(center: Vec3, radius: f32) -> Self {
        Self {
            half_spaces: [HalfSpace::default(); HALF_SPACES_MAX],
            len: 0,
            center,
            radius,
        }
    }

    #[inline(always)]
    pub(crate) fn half_spaces(&self) -> &[HalfSpace] {
        &self.half_spaces[..self.len]
    }

    #[inline(always)]
    fn add_half_space(&mut self, g: Vec3) {
        /// Keeps the division defined; a row is then inside or outside as a whole.
        const TINY: f32 = 1e-20;
        let x = if g.x.abs() < TINY { TINY } else { g.x };
        self.half_spaces[self.len] = HalfSpace {
            inverse_x: 1.0 / x,
            y: g.y,
            z: g.z,
        };
        self.len += 1;
    }

    /// All vectors in the receiver's frame.
    #[inline(always)]
    fn add_slab(&mut self, normal: Vec3, distance: f32, axis: Vec3, low: f32, high: f32) {
        self.add_half_space(axis * distance - normal * low);
        self.add_half_space(normal * high - axis * distance);
    }

    /// A rectangle around `center` in the plane with `normal` at `distance`, given by unit axes and half extents; everything
    /// in the receiver's frame.
    #[inline(always)]
    pub(crate) fn rectangle(center: Vec3, normal: Vec3, distance: f32, sides: [(Vec3, f32); 2]) -> Self {
        let mut footprint = Self::empty(center, (sides[0].1 * sides[0].1 + sides[1].1 * sides[1].1).sqrt());
        for (axis, half) in sides {
            let middle = axis.dot(center);
            footprint.add_slab(normal, distance, axis, middle - half, middle + half);
        }
        footprint
    }

    /// The octagon with the area of a disc; `center` relative to the receiver, world directions.
    #[inline(always)]
    pub(crate) fn disc(frame: &Frame, center: Vec3, plane: Plane, radius: f32) -> Self {
        let (u, v) = plane.normal.any_orthonormal_pair();
        let (u, v) = (frame.local_from_world(u), frame.local_from_world(v));
        let normal = frame.local_from_world(plane.normal);
        let center = frame.local_from_world(center);
        let half = radius * OCTAGON_APOTHEM;
        let mut footprint = Self::empty(center, radius * 1.06);
        let (p, q) = (
            (u + v) * std::f32::consts::FRAC_1_SQRT_2,
            (u - v) * std::f32::consts::FRAC_1_SQRT_2,
        );
        for axis in [u, v, p, q] {
            let middle = axis.dot(center);
            footprint.add_slab(normal, plane.distance, axis, middle - half, middle + half);
        }
        footprint
    }

    /// Where a plane cuts a box.
    #[inline(always)]
    pub(crate) fn section(frame: &Frame, bounds: SectionBox, plane: Plane) -> Self {
        let SectionBox { low, high } = bounds;
        let normal = frame.local_from_world(plane.normal);
        let mut footprint = Self::empty(frame.local_from_world((low + high) * 0.5), (high - low).length() * 0.5);
        for (axis, low, high) in [
            (Vec3::X, low.x, high.x),
            (Vec3::Y, low.y, high.y),
            (Vec3::Z, low.z, high.z),
        ] {
            footprint.add_slab(normal, plane.distance, frame.local_from_world(axis), low, high);
        }
        footprint
    }

    /// Keeps the part of a section with `cut.x >= distance`; world directions, relative to the receiver.
    #[inline(always)]
    pub(crate) fn cut(&mut self, frame: &Frame, plane: Plane, cut: Vec3, distance: f32) {
        let (normal, cut) = (frame.local_from_world(plane.normal), frame.local_from_world(cut));
        self.add_half_space(cut * plane.distance - normal * distance);
    }

    /// Blocks of rows that the footprint may touch.
    #[inline(always)]
    pub(crate) fn rows(&self, resolution: usize) -> std::ops::Range<usize> {
        row_blocks(self.center, self.radius, resolution)
    }
}

/// Blocks of rows that a sphere may touch; its centre in the receiver's frame.
#[inline(always)]
pub(crate) fn row_blocks(center: Vec3, radius: f32, resolution: usize) -> std::ops::Range<usize> {
    let blocks = resolution / LANES;
    let across = (center.y * center.y + center.z * center.z).sqrt();
    if across <= radius {
        return 0..blocks;
    }
    let (sin, cos) = (center.y / across, center.z / across);
    let delta_sin = radius / across;
    let delta_cos = (1.0 - delta_sin * delta_sin).sqrt();
    // Row angles phi - delta and phi + delta; those with a negative cosine are below the horizon.
    let low_above = cos * delta_cos + sin * delta_sin > 0.0;
    let high_above = cos * delta_cos - sin * delta_sin > 0.0;
    if !low_above && !high_above && cos <= 0.0 {
        return 0..0;
    }
    let low = if low_above {
        sin * delta_cos - cos * delta_sin
    } else {
        -1.0
    };
    let high = if high_above {
        sin * delta_cos + cos * delta_sin
    } else {
        1.0
    };
    let block_of = |sin: f32| (sin + 1.0) * 0.5 * blocks as f32;
    // The rows' middles lie half a row inside; the slack covers rounding.
    let first = (block_of(low) - 1e-3).max(0.0) as usize;
    let end = (block_of(high) + 1e-3).ceil().clamp(0.0, blocks as f32) as usize;
    first..end.max(first)
}
