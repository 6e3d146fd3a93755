//! [`Neighbours`]: the nearest points of a point, found through a hierarchy of boxes over points in Z-order.

use glam::Vec3;

/// Points in a leaf, and boxes under a box.
const FAN: usize = 8;

/// Boxes over runs of consecutive points, and over runs of boxes, up to one.
pub(super) struct Neighbours<'a> {
    positions: &'a [Vec3],
    /// Lowest level first.
    levels: Vec<Vec<Aabb>>,
}

/// The nearest `K` points so far, nearest first.
pub(super) struct Nearest<const K: usize> {
    /// Squared distance, index.
    found: [(f32, u32); K],
    len: usize,
}

#[derive(Clone, Copy)]
struct Aabb {
    low: Vec3,
    high: Vec3,
}

impl Aabb {
    const EMPTY: Self = Self {
        low: Vec3::INFINITY,
        high: Vec3::NEG_INFINITY,
    };

    fn distance_squared(&self, from: Vec3) -> f32 {
        (self.low - from).max(from - self.high).max(Vec3::ZERO).length_squared()
    }
}

impl<'a> Neighbours<'a> {
    /// Over `positions`, at least one, in Z-order.
    pub(super) fn new(positions: &'a [Vec3]) -> Self {
        let leaf = |points: &[Vec3]| {
            points.iter().fold(Aabb::EMPTY, |aabb, &point| Aabb {
                low: aabb.low.min(point),
                high: aabb.high.max(point),
            })
        };
        let mut levels: Vec<Vec<Aabb>> = vec![positions.chunks(FAN).map(leaf).collect()];
        while let Some(below) = levels.last()
            && below.len() > 1
        {
            let above = below.chunks(FAN).map(|boxes| {
                boxes.iter().fold(Aabb::EMPTY, |all, aabb| Aabb {
                    low: all.low.min(aabb.low),
                    high: all.high.max(aabb.high),
                })
            });
            let above = above.collect();
            levels.push(above);
        }
        Self { positions, levels }
    }

    /// The `K` points nearest to point `of`, itself left out; fewer if there are no more. Of points equally far, those
    /// that come first in the search.
    pub(super) fn nearest<const K: usize>(&self, of: usize) -> Nearest<K> {
        let mut nearest = Nearest::within(self.bound::<K>(of));
        self.visit(self.levels.len() - 1, 0, self.positions[of], Some(of), &mut nearest);
        nearest
    }

    /// The `K` points nearest to a place; fewer if there are no more. Those that were nearest to a place nearby shorten the
    /// search.
    pub(super) fn nearest_to<const K: usize>(&self, place: Vec3, nearby: &Nearest<K>) -> Nearest<K> {
        let farthest = nearby.found().iter().fold(0.0, |farthest: f32, &(_, other)| {
            farthest.max(self.positions[other as usize].distance_squared(place))
        });
        let mut nearest = Nearest::within(match nearby.len {
            len if len == K => farthest.next_up(),
            _ => f32::INFINITY,
        });
        self.visit(self.levels.len() - 1, 0, place, None, &mut nearest);
        nearest
    }

    /// A squared distance within which there are `K` others, from the points beside it in the order.
    fn bound<const K: usize>(&self, of: usize) -> f32 {
        let from = self.positions[of];
        let first = of.saturating_sub(K);
        let end = (of + K + 1).min(self.positions.len());
        let mut beside = Nearest::<K>::within(f32::INFINITY);
        for other in (first..end).filter(|&other| other != of) {
            beside.offer(self.positions[other].distance_squared(from), other as u32);
        }
        // Those at this very distance are to be found again.
        beside.limit().next_up()
    }

    fn visit<const K: usize>(
        &self,
        level: usize,
        index: usize,
        from: Vec3,
        except: Option<usize>,
        nearest: &mut Nearest<K>,
    ) {
        let first = index * FAN;
        if level == 0 {
            let end = (first + FAN).min(self.positions.len());
            for other in first..end {
                if Some(other) != except {
                    nearest.offer(self.positions[other].distance_squared(from), other as u32);
                }
            }
            return;
        }
        let below = &self.levels[level - 1];
        let mut order = [(f32::INFINITY, 0usize); FAN];
        let mut count = 0;
        let end = (first + FAN).min(below.len());
        for (child, aabb) in (first..end).zip(&below[first..end]) {
            let distance = aabb.distance_squared(from);
            // Most are too far: only the others are worth sorting.
            if distance < nearest.limit() {
                order[count] = (distance, child);
                count += 1;
            }
        }
        let order = &mut order[..count];
        order.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        for &(distance, child) in order.iter() {
            if distance >= nearest.limit() {
                break;
            }
            self.visit(level - 1, child, from, except, nearest);
        }
    }
}

impl<const K: usize> Nearest<K> {
    /// Of points that are nearer than the root of `squared`.
    pub(super) fn within(squared: f32) -> Self {
        Self {
            found: [(squared, 0); K],
            len: 0,
        }
    }

    fn limit(&self) -> f32 {
        self.found[K - 1].0
    }

    #[inline]
    pub(super) fn offer(&mut self, distance: f32, index: u32) {
        if distance >= self.limit() {
            return;
        }
        let mut slot = self.len.min(K - 1);
        while slot > 0 && self.found[slot - 1].0 > distance {
            self.found[slot] = self.found[slot - 1];
            slot -= 1;
        }
        self.found[slot] = (distance, index);
        self.len = (self.len + 1).min(K);
    }

    /// Squared distance and index, nearest first.
    pub(super) fn found(&self) -> &[(f32, u32)] {
        &self.found[..self.len]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pbgi_core::{Bounds, Quantizer};
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_nearest_are_those_of_a_full_search(points in prop::collection::vec(prop::array::uniform3(0u8..16), 1..200)) {
            let mut positions: Vec<Vec3> = points.iter().map(|p| Vec3::from(p.map(f32::from))).collect();
            let bounds = Bounds { min: [0.0; 3], max: [16.0; 3] };
            let quantizer = Quantizer::from_bounds(&bounds).unwrap();
            positions.sort_by_key(|p| quantizer.code(p.to_array()));
            let neighbours = Neighbours::new(&positions);
            for of in 0..positions.len() {
                let nearest = neighbours.nearest::<5>(of);
                let found: Vec<f32> = nearest.found().iter().map(|(distance, _)| *distance).collect();
                let mut all: Vec<f32> = (0..positions.len())
                    .filter(|&other| other != of)
                    .map(|other| positions[other].distance_squared(positions[of]))
                    .collect();
                all.sort_by(f32::total_cmp);
                all.truncate(5);
                prop_assert_eq!(found, all);
            }
        }
    }
}
