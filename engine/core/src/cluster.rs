//! From points to clusters: the sums that make a node, added point by point in leaves and child by child above.

use crate::coverage::Coverage;
use crate::limits::HALF_MAX;
use crate::morton::Quantizer;
use crate::node::{FOLD_TERMS, NodeAttributes};
use crate::pack::pack_harmonics;
use crate::point::PointRecord;
use crate::section::voxel_section_area;
use crate::sh::{SH_TERMS, band, project_cosine};
use crate::voxel::Voxel;
use glam::{DMat3, DVec3, Vec3};

/// Sums over the points of a voxel. All but what is covered is additive, so a parent is the sum of its children; sums stay in f64 until
/// [`Self::finalize`] packs them, and packed values are never summed again.
#[derive(Clone, Debug)]
pub struct ClusterAccumulator {
    /// Harmonics of (projected front area, power r, g, b).
    sh: [[f64; 4]; SH_TERMS],
    /// Sum of area times position.
    first_moment: DVec3,
    /// Sum of area times position outer position, with the disc's own extent: xx, yy, zz, xy, xz, yz.
    second_moment: [f64; 6],
    /// Sum of area times xx, yy, xy, xz, yz of normal outer normal times position.
    fold_moments: [DVec3; FOLD_TERMS],
    /// Sum of area times normal outer normal: xx, yy, zz, xy, xz, yz.
    normal_moment: [f64; 6],
    /// Light of the front and of the back.
    light: [LightSums; 2],
    /// Areas and normals are among its sums.
    coverage: Coverage,
    radius_max: f32,
    point_count: u64,
}

/// Sums over the radiance of one side.
#[derive(Clone, Copy, Debug, Default)]
struct LightSums {
    /// Area times radiance.
    first: DVec3,
    /// Area times the sum of the squares of the channels.
    second: f64,
}

/// A node's attributes, ready to be packed, and what packing lost.
#[derive(Clone, Copy, Debug)]
pub struct FinalizedCluster {
    /// The attributes.
    pub attributes: NodeAttributes,
    /// Harmonics that left the range of a half-precision float.
    pub clamped: u32,
}

impl Default for ClusterAccumulator {
    fn default() -> Self {
        Self {
            sh: [[0.0; 4]; SH_TERMS],
            first_moment: DVec3::ZERO,
            second_moment: [0.0; 6],
            fold_moments: [DVec3::ZERO; FOLD_TERMS],
            normal_moment: [0.0; 6],
            light: [LightSums::default(); 2],
            coverage: Coverage::default(),
            radius_max: 0.0,
            point_count: 0,
        }
    }
}

impl ClusterAccumulator {
    /// Points summed so far.
    pub fn point_count(&self) -> u64 {
        self.point_count
    }

    /// Adds one point. Moments are taken about the lattice's origin, which keeps them exact far from the world's.
    pub fn add(&mut self, point: &PointRecord, quantizer: &Quantizer) {
        let normal = point.normal();
        let radius = f64::from(point.radius);
        // Not `point.area()`: the square of a radius that a single holds may be one that it does not.
        let area = std::f64::consts::PI * radius * radius;
        let sides = point.sides();
        let [front, back] = [sides.front, sides.back].map(|side| DVec3::from_array(side.map(f64::from)));
        // The back's cosine is the front's mirrored: terms of even bands stay, those of odd ones change their sign. Area is
        // seen from the front only.
        let power = |radiance: DVec3| [area, area * radiance.x, area * radiance.y, area * radiance.z];
        let bands = [power(front + back), power(front - back), power(front + back)];
        for (index, (sums, term)) in self.sh.iter_mut().zip(project_cosine(normal)).enumerate() {
            for (sum, power) in sums.iter_mut().zip(bands[band(index)]) {
                *sum += f64::from(term) * power;
            }
        }
        let position = DVec3::from_array(point.position.map(f64::from)) - DVec3::from_array(quantizer.origin);
        let normal = normal.as_dvec3();
        let spread = radius * radius / 4.0;
        self.coverage.add(point, area);
        self.first_moment += position * area;
        let outer_position = outer(position);
        let outer_normal = outer(normal);
        for (moment, product) in self.fold_moments.iter_mut().zip(fold_terms(&outer_normal)) {
            *moment += position * (area * product);
        }
        for i in 0..6 {
            let identity = if i < 3 { 1.0 } else { 0.0 };
            self.second_moment[i] += area * (outer_position[i] + spread * (identity - outer_normal[i]));
            self.normal_moment[i] += area * outer_normal[i];
        }
        for (sums, radiance) in self.light.iter_mut().zip([front, back]) {
            sums.first += radiance * area;
            sums.second += area * radiance.length_squared();
        }
        self.radius_max = self.radius_max.max(point.radius);
        self.point_count += 1;
    }

    /// Adds the sums of the child in `octant`, once [`Self::finalize`] has seen it. Call in octant order: the result then depends
    /// on the points alone.
    pub fn merge(&mut self, octant: u32, child: &Self) {
        self.coverage.merge(octant, &child.coverage);
        for (term, other) in self.sh.iter_mut().zip(&child.sh) {
            for (value, add) in term.iter_mut().zip(other) {
                *value += add;
            }
        }
        self.first_moment += child.first_moment;
        for (moment, other) in self.fold_moments.iter_mut().zip(&child.fold_moments) {
            *moment += other;
        }
        for i in 0..6 {
            self.second_moment[i] += child.second_moment[i];
            self.normal_moment[i] += child.normal_moment[i];
        }
        for (sums, other) in self.light.iter_mut().zip(&child.light) {
            sums.first += other.first;
            sums.second += other.second;
        }
        self.radius_max = self.radius_max.max(child.radius_max);
        self.point_count += child.point_count;
    }

    /// Turns the sums into the attributes of `voxel`'s node.
    ///
    /// # Panics
    /// If no point was added: a voxel without points has no node.
    pub fn finalize(&mut self, voxel: Voxel, quantizer: &Quantizer) -> FinalizedCluster {
        assert!(self.point_count > 0, "a cluster has at least one point");
        let edge = voxel.edge(quantizer);
        let mean = self.first_moment / self.coverage.area;
        let mean_outer = outer(mean);
        let mut covariance = [0.0f32; 6];
        for i in 0..6 {
            let variance = self.second_moment[i] / self.coverage.area - mean_outer[i];
            let variance = if i < 3 { variance.max(0.0) } else { variance };
            // Discs may be far wider than their voxel.
            let limit = f64::from(HALF_MAX);
            covariance[i] = (variance / (edge * edge)).clamp(-limit, limit) as f32;
        }
        let axis = self.axis();
        let aligned = quadratic_form(&self.normal_moment, axis) / self.coverage.area;
        let origin = DVec3::from_array(quantizer.origin);
        let center = DVec3::from_array(voxel.min_corner(quantizer)) - origin + edge / 2.0;
        let section = voxel_section_area(mean, axis, center, edge / 2.0);
        let (sh, clamped) = pack_harmonics(&self.sh, edge);
        let attributes = NodeAttributes {
            centroid: (mean + origin).as_vec3(),
            axis: axis.as_vec3(),
            radius_ratio: self.radius_max / edge as f32,
            spread: (1.0 - aligned).max(0.0).sqrt() as f32,
            fill: if section > 0.0 {
                (self.coverage.area / section) as f32
            } else {
                0.0
            },
            covariance,
            variation: self.variation(),
            folds: self.folds(mean, edge),
            visible: self.coverage.finish(&covariance, edge),
            sh,
        };
        FinalizedCluster { attributes, clamped }
    }

    /// See [`NodeAttributes::folds`].
    fn folds(&self, mean: DVec3, edge: f64) -> [[f32; FOLD_TERMS]; 3] {
        let products = fold_terms(&self.normal_moment);
        let scale = 1.0 / (self.coverage.area * edge);
        let fold = |term: usize| (self.fold_moments[term] - mean * products[term]) * scale;
        let folds: [DVec3; FOLD_TERMS] = std::array::from_fn(fold);
        std::array::from_fn(|axis| folds.map(|fold| fold[axis] as f32))
    }

    /// See [`NodeAttributes::variation`].
    fn variation(&self) -> f32 {
        let [front, back] = self.light.map(|sums| {
            let mean = sums.first / self.coverage.area;
            let variance = sums.second / self.coverage.area - mean.length_squared();
            (mean.length(), variance.max(0.0).sqrt())
        });
        let (brightest, deviation) = (front.0.max(back.0), front.1.max(back.1));
        if deviation > 0.0 {
            (deviation / brightest) as f32
        } else {
            0.0
        }
    }

    /// Principal axis of the normals, on the side that most area faces: the dominant eigenvector of their second moment.
    fn axis(&self) -> DVec3 {
        // The sixteenth power: a flat cluster has converged to machine precision; a round one has no axis to converge to.
        const SQUARINGS: usize = 4;
        const RANK_ONE: f64 = 1e-12;
        let [xx, yy, zz, xy, xz, yz] = self.normal_moment;
        let mut power = DMat3::from_cols(DVec3::new(xx, xy, xz), DVec3::new(xy, yy, yz), DVec3::new(xz, yz, zz));
        for _ in 0..SQUARINGS {
            // The trace of a second moment is not zero, and stays above a third of its square when that is taken.
            power *= 1.0 / (power.x_axis.x + power.y_axis.y + power.z_axis.z);
            // The squares of all entries are those of the eigenvalues, whose sum is one: of a flat cluster there is but one.
            let [x, y, z] = [power.x_axis, power.y_axis, power.z_axis].map(DVec3::length_squared);
            if x + y + z > 1.0 - RANK_ONE {
                break;
            }
            power *= power;
        }
        // The columns of a matrix of rank one are multiples of the axis; the longest is the most exact.
        let columns = [power.x_axis, power.y_axis, power.z_axis];
        let longest = columns
            .into_iter()
            .max_by(|a, b| a.length_squared().total_cmp(&b.length_squared()));
        let axis = longest.and_then(DVec3::try_normalize).unwrap_or(DVec3::Z);
        if axis.dot(self.coverage.normal) < 0.0 {
            -axis
        } else {
            axis
        }
    }
}

/// Upper triangle of `v v^T`: xx, yy, zz, xy, xz, yz.
fn outer(v: DVec3) -> [f64; 6] {
    [v.x * v.x, v.y * v.y, v.z * v.z, v.x * v.y, v.x * v.z, v.y * v.z]
}

/// Of a symmetric matrix as xx, yy, zz, xy, xz, yz whose trace is known.
fn fold_terms(m: &[f64; 6]) -> [f64; FOLD_TERMS] {
    [m[0], m[1], m[3], m[4], m[5]]
}

/// `v^T M v` for a symmetric matrix as xx, yy, zz, xy, xz, yz.
fn quadratic_form(m: &[f64; 6], v: DVec3) -> f64 {
    let o = outer(v);
    m[0] * o[0] + m[1] * o[1] + m[2] * o[2] + 2.0 * (m[3] * o[3] + m[4] * o[4] + m[5] * o[5])
}

/// Front-side radiance of a flat cluster and of its back, from harmonics evaluated at the axis and opposite to it.
///
/// A disc facing the axis shows `cosine_lobe(1)` of itself there and `cosine_lobe(-1)` from behind, so the two powers are a
/// two-by-two system. Inputs and outputs are power (radiance times area); exact when every normal is plus or minus the axis.
#[inline]
pub fn separate_sides(toward_axis: Vec3, against_axis: Vec3) -> (Vec3, Vec3) {
    const SAME: f32 = 1.0625;
    const OPPOSITE: f32 = 0.0625;
    const SCALE: f32 = 1.0 / (SAME * SAME - OPPOSITE * OPPOSITE);
    let front = (toward_axis * SAME - against_axis * OPPOSITE) * SCALE;
    let back = (against_axis * SAME - toward_axis * OPPOSITE) * SCALE;
    (front.max(Vec3::ZERO), back.max(Vec3::ZERO))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bounds::Bounds;
    use crate::pack::area_normaliser;
    use crate::point::Sides;
    use crate::sh::basis;

    fn quantizer() -> Quantizer {
        Quantizer::from_bounds(&Bounds {
            min: [-1.0; 3],
            max: [1.0; 3],
        })
        .unwrap()
    }

    /// A square of side 2 through the middle of the root voxel, facing z, in 20 x 20 points.
    fn wall(front: [f32; 3], back: [f32; 3]) -> Vec<PointRecord> {
        let spacing = 2.0 / 20.0;
        let radius = spacing / std::f32::consts::PI.sqrt();
        let center = |i: i32| (i as f32 + 0.5) * spacing - 1.0;
        (0..400)
            .map(|i| {
                let position = [center(i % 20), center(i / 20), 0.0];
                PointRecord::new(position, [0.0, 0.0, 1.0], radius, Sides { front, back }).unwrap()
            })
            .collect()
    }

    fn summed(points: &[PointRecord]) -> ClusterAccumulator {
        let mut sum = ClusterAccumulator::default();
        for point in points {
            sum.add(point, &quantizer());
        }
        sum
    }

    #[test]
    fn a_wall_is_flat_full_and_as_wide_as_its_voxel() {
        let node = summed(&wall([1.0; 3], [0.0; 3]))
            .finalize(Voxel::ROOT, &quantizer())
            .attributes;
        assert!(node.centroid.length() < 1e-6);
        assert!(node.axis.distance(Vec3::Z) < 1e-6);
        assert!(node.spread < 1e-3, "{}", node.spread);
        assert!((node.fill - 1.0).abs() < 1e-3, "{}", node.fill);
        // A uniform square of unit edge has variance 1/12 along both sides.
        assert!((node.covariance[0] - 1.0 / 12.0).abs() < 1e-3);
        assert!((node.covariance[1] - 1.0 / 12.0).abs() < 1e-3);
        assert!(node.covariance[2].abs() < 1e-6);
        assert!(node.variation < 1e-3, "{}", node.variation);
    }

    #[test]
    fn the_sides_of_a_wall_are_told_apart() {
        let node = summed(&wall([3.0, 2.0, 1.0], [0.0, 0.5, 1.0]))
            .finalize(Voxel::ROOT, &quantizer())
            .attributes;
        let power = |d: Vec3| -> Vec3 {
            let y = basis(d);
            (0..SH_TERMS)
                .map(|i| Vec3::new(node.sh[i][1].to_f32(), node.sh[i][2].to_f32(), node.sh[i][3].to_f32()) * y[i])
                .sum()
        };
        let area = 4.0 / area_normaliser(2.0);
        let (front, back) = separate_sides(power(Vec3::Z), power(-Vec3::Z));
        assert!(
            (front / area).distance(Vec3::new(3.0, 2.0, 1.0)) < 0.01,
            "{}",
            front / area
        );
        assert!(
            (back / area).distance(Vec3::new(0.0, 0.5, 1.0)) < 0.01,
            "{}",
            back / area
        );
    }

    #[test]
    fn variation_is_that_of_the_brighter_side() {
        let mut points = wall([1.0; 3], [0.0; 3]);
        points.extend(wall([3.0; 3], [0.0; 3]));
        let variation =
            |points: &[PointRecord]| summed(points).finalize(Voxel::ROOT, &quantizer()).attributes.variation;
        assert!((variation(&points) - 0.5).abs() < 1e-3, "{}", variation(&points));
        points.iter_mut().for_each(|point| {
            *point = PointRecord::new(point.position, [0.0, 0.0, -1.0], point.radius, point.sides()).unwrap()
        });
        assert!((variation(&points) - 0.5).abs() < 1e-3, "{}", variation(&points));
        assert_eq!(variation(&wall([0.0; 3], [0.0; 3])), 0.0);
        // Colours of one brightness are not even.
        let mut points = wall([1.0, 0.0, 0.0], [0.0; 3]);
        points.extend(wall([0.0, 1.0, 0.0], [0.0; 3]));
        assert!((variation(&points) - 1.0).abs() < 1e-3, "{}", variation(&points));
    }

    #[test]
    fn two_walls_that_meet_are_seen_off_their_centroid() {
        // One faces z and ends at x = -1, the other faces x and stands there.
        let mut points = wall([1.0; 3], [0.0; 3]);
        points.extend(wall([1.0; 3], [0.0; 3]).iter().map(|point| {
            let [x, y, _] = point.position;
            PointRecord::new([-1.0, y, x], [1.0, 0.0, 0.0], point.radius, point.sides()).unwrap()
        }));
        let node = summed(&points).finalize(Voxel::ROOT, &quantizer()).attributes;
        assert!(node.centroid.distance(Vec3::new(-0.5, 0.0, 0.0)) < 1e-6);
        // What faces x, half of all, is a quarter of the edge to the left of the centroid.
        let [x, y, z] = node.folds;
        assert!((x[0] + 0.125).abs() < 1e-6 && x[1].abs() < 1e-6, "{x:?}");
        assert!(y.iter().chain(&z).all(|fold| fold.abs() < 1e-6), "{y:?} {z:?}");
    }

    #[test]
    fn a_parent_is_the_sum_of_its_children() {
        let points = wall([1.0, 0.5, 0.25], [0.1; 3]);
        let whole = summed(&points).finalize(Voxel::ROOT, &quantizer()).attributes;
        let mut merged = summed(&points[..150]);
        merged.merge(7, &summed(&points[150..]));
        let merged = merged.finalize(Voxel::ROOT, &quantizer()).attributes;
        assert!(merged.centroid.distance(whole.centroid) < 1e-6);
        assert_eq!(merged.sh, whole.sh);
    }

    #[test]
    fn a_round_cluster_has_spread() {
        let points: Vec<_> = (0..1000)
            .map(|i| {
                let z = 1.0 - (2 * i + 1) as f32 / 1000.0;
                let phi = i as f32 * 2.399_963_2;
                let n = [(1.0 - z * z).sqrt() * phi.cos(), (1.0 - z * z).sqrt() * phi.sin(), z];
                PointRecord::new(n, n, 0.05, Sides::default()).unwrap()
            })
            .collect();
        let node = summed(&points).finalize(Voxel::ROOT, &quantizer()).attributes;
        assert!((node.spread - (2.0f32 / 3.0).sqrt()).abs() < 0.02, "{}", node.spread);
    }
}
