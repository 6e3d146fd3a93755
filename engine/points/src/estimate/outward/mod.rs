//! [`Outward`]: which side of a plane is out of the body that the points enclose.
//!
//! Some ten thousand points stand for all ([`representatives`]): each has a plane and a share of the surface, and lacks a
//! side. Were all sides right, the winding number, a half on the surface, would say so everywhere ([`winding`]); sides are
//! found that come close to it ([`sides`]). What is left are pieces that are right in themselves: they are turned as wholes
//! ([`pieces`]). Every point then sides with the representatives around it.
//!
//! After Barill et al., "Fast Winding Numbers for Soups and Clouds" (2018), for the field and its tree; Lin et al., "Surface
//! and Normal Reconstruction from Unoriented Points" (2022), for the half; Lin, Shi and Liu, "Fast and Globally Consistent
//! Normal Orientation based on the Winding Number Normal Consistency" (2024), for taking normals from the field's gradient.

mod pieces;
mod representatives;
mod sides;
mod winding;

pub(super) use representatives::Cells;

use super::neighbours::{Nearest, Neighbours};
use super::order::Ordered;
use crate::error::PointsError;
use glam::Vec3;
use pbgi_core::Bounds;
use representatives::Representatives;
use winding::{Field, Tree};

/// Representatives that a point asks: those of its own sheet all around, and of one behind it.
const ASKED: usize = 8;

/// Fewer of them are not worth a thread.
const THREAD_POINTS_MIN: usize = 512;

/// Representatives that know their sides.
pub(super) struct Outward {
    bounds: Bounds,
    positions: Vec<Vec3>,
    /// Out of the body, as long as the share of the surface is large.
    dipoles: Vec<Vec3>,
    /// Distance between representatives.
    spacing: f32,
}

/// [`Outward`] made ready for many questions.
pub(super) struct Sides<'a> {
    outward: &'a Outward,
    neighbours: Neighbours<'a>,
    /// To the place of the last question.
    nearest: Nearest<ASKED>,
}

impl Outward {
    /// Looks at some points of all and finds their sides; the same whatever the number of threads.
    pub(super) fn find(ordered: &Ordered, bounds: &Bounds, threads: usize) -> Result<Self, PointsError> {
        let representatives = Representatives::gather(ordered, bounds, threads)?;
        let normals = if representatives.spacing > 0.0 {
            let tree = Tree::new(
                &representatives.positions,
                &representatives.codes,
                &representatives.areas,
            );
            let normals = sides::find(&representatives, &tree, threads);
            pieces::turn(&representatives, normals, &tree, threads)
        } else {
            // All at one place, or one.
            representatives.normals
        };
        let spacing = representatives.spacing;
        Ok(Self {
            bounds: *bounds,
            positions: representatives
                .positions
                .iter()
                .map(|&position| position * spacing + middle(bounds))
                .collect(),
            dipoles: normals
                .iter()
                .zip(&representatives.areas)
                .map(|(&normal, &area)| normal * area)
                .collect(),
            spacing,
        })
    }

    pub(super) fn sides(&self) -> Sides<'_> {
        Sides {
            outward: self,
            neighbours: Neighbours::new(&self.positions),
            nearest: Nearest::within(f32::INFINITY),
        }
    }
}

impl Sides<'_> {
    /// A vector on the outer side of the plane through a point. Questions about points close to one another are fast.
    pub(super) fn towards(&mut self, position: Vec3) -> Vec3 {
        let Outward {
            bounds,
            positions,
            dipoles,
            spacing,
        } = self.outward;
        self.nearest = self.neighbours.nearest_to(position, &self.nearest);
        let mut field = Field::default();
        for &(_, other) in self.nearest.found() {
            let offset = (positions[other as usize] - position) / *spacing;
            field.add(offset, dipoles[other as usize], 0.0);
        }
        let towards = field.gradient;
        if towards.is_finite() && towards != Vec3::ZERO {
            towards
        } else {
            position - middle(bounds)
        }
    }
}

fn middle(bounds: &Bounds) -> Vec3 {
    (Vec3::from(bounds.min) + Vec3::from(bounds.max)) / 2.0
}

/// One value for each number below `count`, computed by some threads.
fn in_parallel<T: Copy + Default + Send>(threads: usize, count: usize, value: impl Fn(usize) -> T + Sync) -> Vec<T> {
    let mut values = vec![T::default(); count];
    let part = count.div_ceil(threads.max(1)).max(THREAD_POINTS_MIN);
    let fill = |first: usize, values: &mut [T]| {
        for (place, number) in values.iter_mut().zip(first..) {
            *place = value(number);
        }
    };
    if count <= part {
        fill(0, &mut values);
        return values;
    }
    std::thread::scope(|scope| {
        for (number, values) in values.chunks_mut(part).enumerate() {
            let fill = &fill;
            scope.spawn(move || fill(number * part, values));
        }
    });
    values
}
