//! Which of its sides each representative faces: first what brings the winding number closest to a half, then what the
//! field around it says.

use super::representatives::Representatives;
use super::winding::{Field, HALF, Source, Tree};
use glam::Vec3;

/// Steps of the solver; it stops before where it is close enough, or no longer nearer because the tree is not exact.
const SOLVER_STEPS: usize = 12;

/// A squared error of the solver, of that at the start, that is small enough to tell sides.
const SOLVER_DONE: f64 = 1e-2;

/// How much the solver minds long normals: without, noise on thin sheets makes them grow.
const SHORTNESS: f64 = 0.05;

/// Rounds in which the sides follow the field; 40 were no better on any cloud tried.
const ROUNDS: usize = 16;

/// How soon a representative is sure of its side, of the most that its surroundings can say.
const SURENESS: f32 = 3.0;

/// Normals to the sides that agree best.
pub(super) fn find(representatives: &Representatives, tree: &Tree<'_>, threads: usize) -> Vec<Vec3> {
    let system = System {
        representatives,
        tree,
        threads,
    };
    let mut sides = system.solve();
    system.follow(&mut sides);
    representatives
        .normals
        .iter()
        .zip(&sides)
        .map(|(&normal, &side)| if side < 0.0 { -normal } else { normal })
        .collect()
}

/// Sides are numbers between -1 and 1: how sure a representative is of the side to which its normal points, or of the other.
struct System<'a> {
    representatives: &'a Representatives,
    tree: &'a Tree<'a>,
    threads: usize,
}

impl System<'_> {
    fn fields(&self, source: impl Fn(usize) -> Source) -> Vec<Field> {
        let sources: Vec<Source> = (0..self.representatives.areas.len()).map(source).collect();
        self.tree.fields(&sources, self.threads)
    }

    fn dipole(&self, point: usize, side: f32) -> Vec3 {
        self.representatives.normals[point] * (side * self.representatives.areas[point])
    }

    /// Winding numbers of sides.
    fn winding(&self, sides: &[f32]) -> Vec<f32> {
        let fields = self.fields(|point| Source {
            dipole: self.dipole(point, sides[point]),
            charge: 0.0,
        });
        fields.iter().map(|field| field.winding).collect()
    }

    /// The transpose of [`Self::winding`]: how sides change the sum of the winding numbers by their weights.
    fn transposed(&self, weights: &[f32]) -> Vec<f32> {
        let fields = self.fields(|point| Source {
            dipole: Vec3::ZERO,
            charge: weights[point] * self.representatives.areas[point],
        });
        let normals = self.representatives.normals.iter();
        normals
            .zip(&fields)
            .map(|(normal, field)| field.repulsion.dot(*normal))
            .collect()
    }

    fn dot(&self, a: &[f32], b: &[f32]) -> f64 {
        let areas = self.representatives.areas.iter();
        areas
            .zip(a.iter().zip(b))
            .map(|(&area, (&a, &b))| f64::from(area * a * b))
            .sum()
    }

    /// Least squares by conjugate gradients, the surface as its measure; scaled to 1 in the mean.
    fn solve(&self) -> Vec<f32> {
        let count = self.representatives.areas.len();
        let mut sides = vec![0.0; count];
        let mut residual = self.transposed(&vec![HALF; count]);
        let mut direction = residual.clone();
        let mut error = self.dot(&residual, &residual);
        let enough = error * SOLVER_DONE;
        for _ in 0..SOLVER_STEPS {
            if error <= enough {
                break;
            }
            let winding = self.winding(&direction);
            let curvature = self.dot(&winding, &winding) + SHORTNESS * self.dot(&direction, &direction);
            let step = (error / curvature) as f32;
            let change = self.transposed(&winding);
            for point in 0..count {
                sides[point] += step * direction[point];
                residual[point] -= step * (change[point] + SHORTNESS as f32 * direction[point]);
            }
            let before = std::mem::replace(&mut error, self.dot(&residual, &residual));
            if error > before {
                break;
            }
            for point in 0..count {
                direction[point] = residual[point] + (error / before) as f32 * direction[point];
            }
        }
        let mean = sides.iter().map(|side| side.abs()).sum::<f32>() / count as f32;
        if mean > 0.0 {
            sides.iter_mut().for_each(|side| *side = (*side / mean).tanh());
        }
        sides
    }

    /// Lets every side follow the gradient of the field, and what the winding number still lacks.
    fn follow(&self, sides: &mut [f32]) {
        let areas = &self.representatives.areas;
        let most: Vec<f32> = self
            .fields(|point| Source {
                dipole: Vec3::ZERO,
                charge: areas[point],
            })
            .iter()
            .map(|field| field.crowding)
            .collect();
        let mut lacking = vec![0.0; areas.len()];
        for _ in 0..ROUNDS {
            let fields = self.fields(|point| Source {
                dipole: self.dipole(point, sides[point]),
                charge: lacking[point] * areas[point],
            });
            for (point, field) in fields.iter().enumerate() {
                let says = field.gradient / most[point].max(f32::MIN_POSITIVE) + field.repulsion;
                sides[point] = (SURENESS * says.dot(self.representatives.normals[point])).tanh();
                lacking[point] = HALF - field.winding;
            }
        }
    }
}
