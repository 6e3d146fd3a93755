//! The winding number of a surface that is known by dipoles, and what comes with it: [`Field`], summed over a [`Tree`].

use super::in_parallel;
use glam::Vec3;
use std::f32::consts::PI;

/// Points in a leaf.
const LEAF: usize = 8;

/// A node whose radius is below this share of its distance counts as one point: at 0.7 walls a few spacings thick are lost.
const OPENING: f32 = 0.5;

/// Dipoles and charges are blurred over this distance, spacings: less lets single points rule, more mixes thin sheets.
const WIDTH: f32 = 0.8;

/// The winding number on a surface that faces out.
pub(super) const HALF: f32 = 0.5;

/// Bits of a code that a level of the tree has.
const LEVEL_BITS: u32 = 3;

/// An octree over points in Z-order, in depth-first order.
pub(super) struct Tree<'a> {
    positions: &'a [Vec3],
    nodes: Vec<Node>,
}

struct Node {
    centre: Vec3,
    /// Of a ball around the centre that holds its points, squared.
    radius_squared: f32,
    first: u32,
    end: u32,
    /// The node after all that are below this one.
    next: u32,
    leaf: bool,
}

/// What a point or node sends out.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Source {
    /// Normal, as long as the area it stands for.
    pub(super) dipole: Vec3,
    pub(super) charge: f32,
}

/// What sources come to at a place.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Field {
    /// Of the dipoles: 1 inside of a surface whose normals point out, 0 outside, a half on it.
    pub(super) winding: f32,
    /// How the winding number falls: along the normals where they agree with the field.
    pub(super) gradient: Vec3,
    /// Away from the charges: the transpose of `winding`, taken along a normal.
    pub(super) repulsion: Vec3,
    /// Of the charges: the most that `gradient` can be for dipoles as large.
    pub(super) crowding: f32,
}

impl Field {
    /// Adds a source at `offset` from the place, spacings.
    #[inline]
    pub(super) fn add(&mut self, offset: Vec3, dipole: Vec3, charge: f32) {
        let inverse_squared = 1.0 / (offset.length_squared() + WIDTH * WIDTH);
        let falloff = inverse_squared * inverse_squared.sqrt() / (4.0 * PI);
        let along = dipole.dot(offset) * falloff;
        self.winding += along;
        self.gradient += dipole * falloff - offset * (3.0 * along * inverse_squared);
        self.repulsion -= offset * (charge * falloff);
        self.crowding += charge * falloff;
    }
}

impl<'a> Tree<'a> {
    /// Over `positions` whose codes rise; centres are those of the `areas`.
    pub(super) fn new(positions: &'a [Vec3], codes: &[u64], areas: &[f32]) -> Self {
        let mut tree = Self {
            positions,
            nodes: Vec::new(),
        };
        if !positions.is_empty() {
            tree.grow(codes, areas, 0, positions.len());
        }
        tree
    }

    fn grow(&mut self, codes: &[u64], areas: &[f32], first: usize, end: usize) {
        let (sum, area) = (first..end).fold((Vec3::ZERO, 0.0), |(sum, area), point| {
            (sum + self.positions[point] * areas[point], area + areas[point])
        });
        let centre = if area > 0.0 { sum / area } else { self.positions[first] };
        let radius_squared = self.positions[first..end]
            .iter()
            .fold(0.0, |most: f32, position| most.max(position.distance_squared(centre)));
        // The highest level at which the codes differ.
        let differ = codes[first] ^ codes[end - 1];
        let leaf = end - first <= LEAF || differ == 0;
        let at = self.nodes.len();
        self.nodes.push(Node {
            centre,
            radius_squared,
            first: first as u32,
            end: end as u32,
            next: 0,
            leaf,
        });
        if !leaf {
            let shift = differ.ilog2() / LEVEL_BITS * LEVEL_BITS;
            let mut start = first;
            while start < end {
                let prefix = codes[start] >> shift;
                let child = start + codes[start..end].partition_point(|code| code >> shift == prefix);
                self.grow(codes, areas, start, child);
                start = child;
            }
        }
        self.nodes[at].next = self.nodes.len() as u32;
    }

    /// The field of one source a point, at every point.
    pub(super) fn fields(&self, sources: &[Source], threads: usize) -> Vec<Field> {
        let sums = self.sums(sources);
        in_parallel(threads, self.positions.len(), |point| {
            self.field(sources, &sums, self.positions[point])
        })
    }

    fn sums(&self, sources: &[Source]) -> Vec<Source> {
        let mut sums = vec![Source::default(); self.nodes.len()];
        for (at, node) in self.nodes.iter().enumerate().rev() {
            let mut sum = Source::default();
            let mut add = |source: Source| {
                sum.dipole += source.dipole;
                sum.charge += source.charge;
            };
            if node.leaf {
                sources[node.first as usize..node.end as usize]
                    .iter()
                    .copied()
                    .for_each(&mut add);
            } else {
                let mut child = at + 1;
                while child < node.next as usize {
                    add(sums[child]);
                    child = self.nodes[child].next as usize;
                }
            }
            sums[at] = sum;
        }
        sums
    }

    fn field(&self, sources: &[Source], sums: &[Source], place: Vec3) -> Field {
        let mut field = Field::default();
        let mut at = 0;
        while let Some(node) = self.nodes.get(at) {
            let offset = node.centre - place;
            if node.radius_squared < OPENING * OPENING * offset.length_squared() {
                field.add(offset, sums[at].dipole, sums[at].charge);
            } else if node.leaf {
                let points = node.first as usize..node.end as usize;
                for (&position, source) in self.positions[points.clone()].iter().zip(&sources[points]) {
                    field.add(position - place, source.dipole, source.charge);
                }
            } else {
                at += 1;
                continue;
            }
            at = node.next as usize;
        }
        field
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pbgi_core::{Bounds, Quantizer};

    #[test]
    fn a_ball_winds_once_around_what_is_inside() {
        // 4,000 points and one in the middle; a spacing of the ball's surface is the unit.
        let count = 4000;
        let radius = (count as f32 / (4.0 * PI)).sqrt();
        let mut points: Vec<Vec3> = (0..count)
            .map(|i| {
                let (y, turn) = (1.0 - (i as f32 + 0.5) / 2000.0, i as f32 * 2.399_963);
                let across = (1.0 - y * y).sqrt();
                Vec3::new(across * turn.cos(), y, across * turn.sin()) * radius
            })
            .chain([Vec3::ZERO])
            .collect();
        let bounds = Bounds {
            min: [-radius; 3],
            max: [radius; 3],
        };
        let quantizer = Quantizer::from_bounds(&bounds).unwrap();
        points.sort_by_key(|point| quantizer.code(point.to_array()));
        let codes: Vec<u64> = points.iter().map(|point| quantizer.code(point.to_array()).0).collect();
        let sources: Vec<Source> = points
            .iter()
            .map(|point| Source {
                dipole: point.normalize_or_zero(),
                charge: 1.0,
            })
            .collect();
        let tree = Tree::new(&points, &codes, &vec![1.0; points.len()]);
        for (point, field) in points.iter().zip(tree.fields(&sources, 2)) {
            if *point == Vec3::ZERO {
                assert!((field.winding - 1.0).abs() < 0.03, "{field:?}");
            } else {
                assert!((field.winding - 0.5).abs() < 0.05, "{field:?}");
                assert!(field.gradient.normalize().dot(point.normalize()) > 0.99, "{field:?}");
                assert!(field.repulsion.normalize().dot(point.normalize()) > 0.99, "{field:?}");
            }
        }
    }
}
