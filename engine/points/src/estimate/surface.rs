//! From a point's neighbours to its normal and radius.

use glam::{DMat3, DVec3, Vec3};

/// The direction in which points spread least: the eigenvector of the smallest eigenvalue of their covariance. `None` where
/// they have no direction: all at one place.
pub(super) fn least_spread(points: impl Iterator<Item = Vec3> + Clone, around: Vec3) -> Option<Vec3> {
    let offsets = points.map(|point| (point - around).as_dvec3());
    let (sum, count) = offsets
        .clone()
        .fold((DVec3::ZERO, 0.0), |(sum, count), offset| (sum + offset, count + 1.0));
    let mean = sum / f64::max(count, 1.0);
    let mut covariance = DMat3::ZERO;
    for offset in offsets {
        let d = offset - mean;
        covariance += DMat3::from_cols(d * d.x, d * d.y, d * d.z);
    }
    let largest = covariance.to_cols_array().into_iter().fold(0.0, f64::max);
    if largest <= 0.0 {
        return None;
    }
    // Scaled, so that no threshold depends on the unit of length.
    let axis = least_eigenvector(covariance * (1.0 / largest));
    axis.try_normalize().map(|axis| axis.as_vec3())
}

/// The eigenvector of the smallest eigenvalue of a symmetric matrix, by Jacobi rotations.
fn least_eigenvector(matrix: DMat3) -> DVec3 {
    /// A 3 x 3 matrix is diagonal to double precision after five or six.
    const SWEEPS: usize = 8;
    const DONE: f64 = 1e-12;
    let mut a = matrix.to_cols_array_2d();
    let mut v = DMat3::IDENTITY.to_cols_array_2d();
    for _ in 0..SWEEPS {
        if a[0][1].abs() + a[0][2].abs() + a[1][2].abs() < DONE {
            break;
        }
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            if a[p][q].abs() <= f64::MIN_POSITIVE {
                continue;
            }
            let theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
            let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
            let c = 1.0 / (t * t + 1.0).sqrt();
            let s = t * c;
            for column in &mut a {
                (column[p], column[q]) = (c * column[p] - s * column[q], s * column[p] + c * column[q]);
            }
            for row in 0..3 {
                (a[p][row], a[q][row]) = (c * a[p][row] - s * a[q][row], s * a[p][row] + c * a[q][row]);
                (v[p][row], v[q][row]) = (c * v[p][row] - s * v[q][row], s * v[p][row] + c * v[q][row]);
            }
        }
    }
    let smallest = (0..3).min_by(|&i, &j| a[i][i].total_cmp(&a[j][j])).unwrap_or(0);
    DVec3::from_array(v[smallest])
}

/// The radius of a disc whose area is the share of one point, where `count` neighbours lie within `distance`: the point
/// itself counts whole, the outermost neighbour half, because it lies on the border.
pub(super) fn radius_of(distance: f32, count: usize) -> f32 {
    distance / (count as f32 + 0.5).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tilted_plane_gives_its_normal() {
        let normal = Vec3::new(1.0, 2.0, -3.0).normalize();
        let (u, v) = normal.any_orthonormal_pair();
        let at = Vec3::new(100.0, -50.0, 7.0);
        let points = (0..16).map(|i| at + u * (i % 4) as f32 + v * (i / 4) as f32 * 0.3);
        let found = least_spread(points, at).unwrap();
        assert!(found.dot(normal).abs() > 1.0 - 1e-6, "{found}");
    }

    #[test]
    fn a_line_has_a_normal_across_and_a_spot_has_none() {
        let along = Vec3::new(1.0, 1.0, 0.0).normalize();
        let line = (0..9).map(|i| along * i as f32);
        assert!(least_spread(line, Vec3::ZERO).unwrap().dot(along).abs() < 1e-6);
        assert_eq!(least_spread([Vec3::ONE; 5].into_iter(), Vec3::ONE), None);
    }

    #[test]
    fn the_discs_of_a_square_grid_have_its_area() {
        // 20 neighbours lie within the root of 5 spacings.
        let radius = radius_of(5f32.sqrt(), 20);
        let area = std::f32::consts::PI * radius * radius;
        assert!((0.7..1.3).contains(&area), "{area}");
    }
}
