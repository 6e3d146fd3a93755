//! Half-precision packing of a cluster's harmonics (paper section 6).
//!
//! Coefficients are divided by an upper bound of the projected area that a voxel of the level can show, so that they keep
//! their precision at every level. The factor follows from the level and is not stored.

use crate::limits::HALF_MAX;
use crate::sh::SH_TERMS;
use half::f16;
use half::slice::HalfFloatSliceExt;
use std::f32::consts::PI;

/// Area of a disc as wide as the diagonal of a voxel with this edge: `0.75 pi edge^2` (paper section 6).
#[inline]
pub fn area_normaliser(voxel_edge: f32) -> f32 {
    0.75 * PI * voxel_edge * voxel_edge
}

/// Packs harmonics of (area, r, g, b); the second value counts coefficients that left the range of a half and were clamped.
pub fn pack_harmonics(sh: &[[f64; 4]; SH_TERMS], voxel_edge: f64) -> ([[f16; 4]; SH_TERMS], u32) {
    let scale = 1.0 / (0.75 * std::f64::consts::PI * voxel_edge * voxel_edge);
    let limit = f64::from(HALF_MAX);
    let mut clamped = 0;
    let mut scaled = [0.0; 4 * SH_TERMS];
    for (scaled, value) in scaled.iter_mut().zip(sh.as_flattened()) {
        let value = value * scale;
        clamped += u32::from(value.abs() > limit);
        *scaled = value.clamp(-limit, limit) as f32;
    }
    let mut packed = [[f16::ZERO; 4]; SH_TERMS];
    packed.as_flattened_mut().convert_from_f32_slice(&scaled);
    (packed, clamped)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sh::project_cosine;
    use glam::Vec3;

    #[test]
    fn a_full_voxel_packs_within_range_at_every_level() {
        for level in 0..=21 {
            let edge = 1e3 / f64::from(1u32 << level);
            let area = f64::from(area_normaliser(edge as f32));
            let terms = project_cosine(Vec3::Z).map(|t| [f64::from(t) * area; 4]);
            let (packed, clamped) = pack_harmonics(&terms, edge);
            assert_eq!(clamped, 0);
            assert!(
                (packed[0][0].to_f32() - 0.886).abs() < 1e-3,
                "level {level}: {}",
                packed[0][0]
            );
        }
    }

    #[test]
    fn values_out_of_range_are_clamped_and_counted() {
        let (packed, clamped) = pack_harmonics(&[[1e30, -1e30, 1.0, 0.0]; SH_TERMS], 1.0);
        assert_eq!(clamped, 18);
        assert!(packed.iter().flatten().all(|value| value.is_finite()));
    }
}
