//! How much a cluster covers, seen along the axes. It is less than the sum of its discs, as some hide others.
//!
//! The parts of one surface lie beside each other; the front of a house hides its back; leaves hide each other by chance,
//! and stand in clumps, so that a crown covers less than chance alone has it (Nilson 1971, "A theoretical analysis of the
//! frequency of gaps in plant stands"). No sum over points tells these apart, so coverage is made from the leaves up: two
//! children that lie behind each other cover what their kind says, and columns of two lie beside each other.

use crate::point::PointRecord;
use glam::{DVec3, Vec3};

/// Length of the mean normal from which the discs of a cluster are one sheet, and up to which they face everywhere; along an axis, how
/// much of what is shown faces one way.
const SHEET_NORMAL: f32 = 0.6;
const SCATTERED_NORMAL: f32 = 0.2;

/// Share of a voxel's face that is nothing.
const NOTHING: f64 = 1e-6;

/// What a voxel's discs cover, added point by point in leaves and child by child above.
#[derive(Clone, Debug, Default)]
pub(crate) struct Coverage {
    /// Sum of areas.
    pub(crate) area: f64,
    /// Sum of area times normal.
    pub(crate) normal: DVec3,
    /// Sum of area times the normal's part along each axis: what is seen along it, hidden discs too.
    shown: DVec3,
    /// Sum of the squares of what discs show along each axis.
    shown_squares: DVec3,
    children: [Option<Child>; 8],
    /// Shares of the voxel's faces, once they are known.
    covered: DVec3,
}

#[derive(Clone, Copy, Debug)]
struct Child {
    covered: DVec3,
    normal: DVec3,
    scattered: DVec3,
}

impl Coverage {
    /// Adds a disc of this area, square world units.
    pub(crate) fn add(&mut self, point: &PointRecord, area: f64) {
        let normal = point.normal().as_dvec3();
        self.area += area;
        let seen = normal * area;
        self.normal += seen;
        self.shown += seen.abs();
        self.shown_squares += seen * seen;
    }

    /// Adds what the child in `octant` covers, which is known.
    pub(crate) fn merge(&mut self, octant: u32, child: &Self) {
        self.area += child.area;
        self.normal += child.normal;
        self.shown += child.shown;
        self.shown_squares += child.shown_squares;
        self.children[octant as usize] = Some(Child {
            covered: child.covered,
            normal: child.normal,
            scattered: child.scattered(),
        });
    }

    /// Finds what is covered of the faces of a voxel with this edge, world units, and returns the share of what the discs show
    /// along x, y and z that no other disc hides. `covariance` is that of the covered surface over the square of the edge.
    pub(crate) fn finish(&mut self, covariance: &[f32; 6], edge: f64) -> Vec3 {
        let shown = self.shown / (edge * edge);
        self.covered = if self.children.iter().any(Option::is_some) {
            DVec3::from_array(std::array::from_fn(|axis| self.covered_by_children(axis)))
        } else {
            // Scattered discs cover a share of the rectangle that they lie in, others what they show.
            let rectangle = rectangles(covariance);
            let by_chance = DVec3::from_array(std::array::from_fn(|axis| {
                rectangle[axis] * covered_by_chance(shown[axis] / rectangle[axis])
            }));
            shown + (by_chance - shown) * self.scattered()
        };
        let share = |axis: usize| {
            if shown[axis] > NOTHING {
                (self.covered[axis] / shown[axis]).min(1.0) as f32
            } else {
                1.0
            }
        };
        Vec3::new(share(0), share(1), share(2))
    }

    /// The mean of the four columns of two children along an axis.
    fn covered_by_children(&self, axis: usize) -> f64 {
        let far = 1 << axis;
        let near_ones = (0..8).filter(|octant| octant & far == 0);
        let columns = near_ones.map(|near| match (self.children[near], self.children[near | far]) {
            (Some(a), Some(b)) => a.covered_with(&b, axis),
            (Some(one), None) | (None, Some(one)) => one.covered[axis],
            (None, None) => 0.0,
        });
        columns.sum::<f64>() / 4.0
    }

    /// How much of what is seen along each axis are discs that face both ways. Ground with trees is a sheet from above and a crowd from
    /// its side.
    fn scattered(&self) -> DVec3 {
        DVec3::from_array(std::array::from_fn(|axis| {
            scattered_pairs(self.normal[axis].powi(2), self.shown[axis], self.shown_squares[axis])
        }))
    }
}

/// See [`scattered`]; from the square of a sum over discs of area times normal, the sum of areas and that of their squares, all of them
/// as they are or as seen along an axis. It looks at all pairs of discs, so that a few are not taken for a sheet because their normals
/// do not cancel out.
pub fn scattered_pairs(normal_squared: f64, area: f64, area_squares: f64) -> f64 {
    let pairs = area * area - area_squares;
    if pairs <= NOTHING * area * area {
        return 0.0;
    }
    let mean_square = (normal_squared - area_squares) / pairs;
    scattered(mean_square.max(0.0).sqrt() as f32).into()
}

/// How much of a cluster is discs that face everywhere, as leaves do: 1, or a sheet, folded perhaps: 0. `normal` is the length of
/// the mean normal.
#[inline]
pub fn scattered(normal: f32) -> f32 {
    ((SHEET_NORMAL - normal) / (SHEET_NORMAL - SCATTERED_NORMAL)).clamp(0.0, 1.0)
}

impl Child {
    /// What two children cover of the face that they share, seen along an axis.
    fn covered_with(&self, other: &Self, axis: usize) -> f64 {
        let (a, b) = (self.covered[axis], other.covered[axis]);
        let larger = a.max(b);
        let surfaces = if self.normal.dot(other.normal) < 0.0 {
            // The two sides of a body.
            larger
        } else {
            (a + b).min(larger.max(1.0))
        };
        let by_chance = a + b * (1.0 - a.min(1.0));
        surfaces + self.scattered[axis].min(other.scattered[axis]) * (by_chance - surfaces)
    }
}

/// For each axis, the area across it of the rectangle whose uniform covering has these variances.
fn rectangles(covariance: &[f32; 6]) -> DVec3 {
    const FLAT: f64 = 1e-12;
    let [xx, yy, zz, xy, xz, yz] = covariance.map(f64::from);
    let area = |a: f64, b: f64, mixed: f64| 12.0 * (a * b - mixed * mixed).max(FLAT).sqrt();
    DVec3::new(area(yy, zz, yz), area(xx, zz, xz), area(xx, yy, xy))
}

/// `1 - exp(-share)` to within 0.001, the same on every machine.
fn covered_by_chance(share: f64) -> f64 {
    let part = share / 8.0;
    let growth = 1.0 + part * (1.0 + part * (0.5 + part / 6.0));
    let squared = growth * growth;
    let fourth = squared * squared;
    1.0 - 1.0 / (fourth * fourth)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::point::Sides;

    const EDGE: f64 = 2.0;

    fn covered(points: &[([f32; 3], f32)], covariance: &[f32; 6]) -> (Coverage, Vec3) {
        let mut coverage = Coverage::default();
        for (normal, area) in points {
            let radius = (area / std::f32::consts::PI).sqrt();
            let point = PointRecord::new([0.0; 3], *normal, radius, Sides::default()).unwrap();
            coverage.add(&point, f64::from(*area));
        }
        let visible = coverage.finish(covariance, EDGE);
        (coverage, visible)
    }

    /// As a uniformly filled voxel has it.
    const FILLED: [f32; 6] = [1.0 / 12.0, 1.0 / 12.0, 1.0 / 12.0, 0.0, 0.0, 0.0];

    #[test]
    fn chance_is_as_exact_as_it_says() {
        for step in 0..2000 {
            let share = f64::from(step) * 0.01;
            assert!(
                (covered_by_chance(share) - (1.0 - (-share).exp())).abs() < 1e-3,
                "{share}"
            );
        }
        assert_eq!(covered_by_chance(f64::INFINITY), 1.0);
    }

    #[test]
    fn a_sheet_shows_all_of_itself_and_leaves_hide_each_other() {
        let (wall, visible) = covered(&[([1.0, 0.0, 0.0], 1.0); 4], &FILLED);
        assert!((wall.covered.x - 1.0).abs() < 1e-6 && wall.covered.y < 1e-6);
        assert_eq!(visible, Vec3::ONE);
        // As much area in every direction: along each axis a third of it, twice the face, is shown.
        let leaves: Vec<_> = (0..600)
            .map(|i| {
                let mut normal = [0.0; 3];
                normal[i % 3] = if i / 3 % 2 == 0 { 1.0 } else { -1.0 };
                (normal, 0.04)
            })
            .collect();
        let (crown, visible) = covered(&leaves, &FILLED);
        let expected = 1.0 - f64::exp(-2.0);
        assert!((crown.covered.x - expected).abs() < 2e-3, "{:?}", crown.covered);
        assert!((f64::from(visible.y) - expected / 2.0).abs() < 3e-3, "{visible}");
    }

    #[test]
    fn one_disc_is_no_crowd_and_ground_with_leaves_is_one_from_its_side() {
        let scattered = |points: &[([f32; 3], f32)]| covered(points, &FILLED).0.scattered();
        let side = 3f32.sqrt().recip();
        assert_eq!(scattered(&[([side; 3], 1.0)]), DVec3::ZERO);
        let four = [[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]];
        let leaves = four.map(|normal| (normal.map(|part| part * side), 0.1));
        assert_eq!(scattered(&leaves), DVec3::ONE);
        let mut forest = vec![([0.0, 0.0, 1.0], 1.0); 4];
        forest.extend(leaves);
        assert_eq!(scattered(&forest), DVec3::new(1.0, 1.0, 0.0));
    }

    #[test]
    fn children_behind_each_other_cover_what_their_kind_says() {
        let parent = |near: &Coverage, far: &Coverage| {
            let mut coverage = Coverage::default();
            coverage.merge(0, near);
            coverage.merge(1, far);
            coverage.finish(&FILLED, 2.0 * EDGE);
            // Of one column of four.
            4.0 * coverage.covered.x
        };
        let half_wall = |normal: f32| covered(&[([normal, 0.0, 0.0], 1.0); 2], &FILLED).0;
        let (front, back) = (half_wall(-1.0), half_wall(1.0));
        assert!((parent(&front, &back) - 0.5).abs() < 1e-6, "the two sides of a body");
        assert!((parent(&front, &front) - 1.0).abs() < 1e-6, "a surface that goes on");
        let leaves: Vec<_> = (0..6)
            .map(|i| {
                let mut normal = [0.0; 3];
                normal[i % 3] = if i < 3 { 1.0 } else { -1.0 };
                (normal, 1.0)
            })
            .collect();
        let crown = covered(&leaves, &FILLED).0;
        let share = crown.covered.x;
        let expected = 1.0 - (1.0 - share) * (1.0 - share);
        assert!((parent(&crown, &crown) - expected).abs() < 1e-6, "leaves");
        // Two of eight children: a clump, which covers less than the same leaves everywhere would.
        assert!(parent(&crown, &crown) / 4.0 < 0.9 * covered_by_chance(0.25 * 2.0 * 0.5));
    }
}
