//! Real spherical harmonics of three bands: the directional memory of a cluster (Christensen 2008, section 3.2).
//!
//! A disc of area `a` with normal `n` shows the projected area `a max(0, n.d)` to direction `d`. Its projection onto the
//! nine terms is closed-form: `a A_l Y_lm(n)` with the zonal factors of the clamped cosine, pi, 2 pi / 3 and pi / 4.

use glam::Vec3;
use std::f32::consts::PI;

/// Terms of three bands.
pub const SH_TERMS: usize = 9;

/// Band of a term.
#[inline]
pub const fn band(term: usize) -> usize {
    match term {
        0 => 0,
        1..4 => 1,
        _ => 2,
    }
}

/// Zonal factor of the clamped cosine for each term.
pub const COSINE_FACTORS: [f32; SH_TERMS] = {
    let (l0, l1, l2) = (PI, 2.0 * PI / 3.0, PI / 4.0);
    [l0, l1, l1, l1, l2, l2, l2, l2, l2]
};

/// Constants of the basis functions: of Y00, of the linear ones, of the products of two coordinates, of Y20 and of Y22.
pub const BASIS_FACTORS: [f32; 5] = [0.282_094_8, 0.488_602_5, 1.092_548_4, 0.315_391_57, 0.546_274_2];

/// The nine basis functions in direction `d` (unit): Y00, Y1-1, Y10, Y11, Y2-2, Y2-1, Y20, Y21, Y22.
#[inline]
pub fn basis(d: Vec3) -> [f32; SH_TERMS] {
    let [constant, linear, product, zonal, square] = BASIS_FACTORS;
    [
        constant,
        linear * d.y,
        linear * d.z,
        linear * d.x,
        product * d.x * d.y,
        product * d.y * d.z,
        zonal * (3.0 * d.z * d.z - 1.0),
        product * d.x * d.z,
        square * (d.x * d.x - d.y * d.y),
    ]
}

/// The clamped cosine around `normal`, projected: one disc of unit area.
#[inline]
pub fn project_cosine(normal: Vec3) -> [f32; SH_TERMS] {
    let mut terms = basis(normal);
    for (term, factor) in terms.iter_mut().zip(COSINE_FACTORS) {
        *term *= factor;
    }
    terms
}

/// What the terms of band 0 to 2 make of a clamped cosine at cosine `x`: 1.0625 at 1, 0.09375 at 0, 0.0625 at -1.
#[inline]
pub fn cosine_lobe(x: f32) -> f32 {
    0.25 + 0.5 * x + 0.156_25 * (3.0 * x * x - 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn directions() -> impl Iterator<Item = Vec3> {
        // A Fibonacci sphere: evenly spread directions.
        (0..2000).map(|i| {
            let z = 1.0 - (2 * i + 1) as f32 / 2000.0;
            let phi = i as f32 * 2.399_963_2;
            let r = (1.0 - z * z).sqrt();
            Vec3::new(r * phi.cos(), r * phi.sin(), z)
        })
    }

    #[test]
    fn the_basis_is_orthonormal() {
        for i in 0..SH_TERMS {
            for j in 0..SH_TERMS {
                let sum: f32 = directions().map(|d| basis(d)[i] * basis(d)[j]).sum();
                let integral = sum * 4.0 * PI / 2000.0;
                let expected = if i == j { 1.0 } else { 0.0 };
                assert!((integral - expected).abs() < 2e-3, "<{i},{j}> = {integral}");
            }
        }
    }

    #[test]
    fn a_projected_cosine_evaluates_to_its_lobe() {
        let normal = Vec3::new(0.36, 0.48, 0.8);
        let terms = project_cosine(normal);
        for d in directions() {
            let value: f32 = terms.iter().zip(basis(d)).map(|(t, y)| t * y).sum();
            assert!((value - cosine_lobe(normal.dot(d))).abs() < 1e-5);
        }
        assert!((cosine_lobe(1.0) - 1.0625).abs() < 1e-6);
        assert!((cosine_lobe(0.0) - 0.093_75).abs() < 1e-6);
        assert!((cosine_lobe(-1.0) - 0.0625).abs() < 1e-6);
    }
}
