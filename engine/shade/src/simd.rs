//! The one place that names instruction sets: the raster's kernels compiled for AVX2 and for any processor, chosen at run
//! time.

#![allow(
    unsafe_code,
    reason = "calling a function compiled for more than the build's baseline needs `unsafe`"
)]

use crate::footprint::Footprint;
use crate::raster::{Covered, Ink, Raster, RasterTables};
use glam::Vec3;

/// Instruction set of the kernels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Simd {
    /// AVX2 with its companions of the same generation.
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// Whatever the build's baseline is.
    Scalar,
}

impl Simd {
    /// The best that this processor has.
    pub(crate) fn detect() -> Self {
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2")
            && is_x86_feature_detected!("fma")
            && is_x86_feature_detected!("bmi1")
            && is_x86_feature_detected!("bmi2")
            && is_x86_feature_detected!("lzcnt")
            && is_x86_feature_detected!("popcnt")
        {
            return Self::Avx2;
        }
        Self::Scalar
    }

    /// [`Raster::cover`]. Both ways compute the same bits: no operation is contracted or reordered.
    pub(crate) fn cover(self, raster: &mut Raster, tables: &RasterTables, footprint: &Footprint, ink: Ink) -> Covered {
        match self {
            #[cfg(target_arch = "x86_64")]
            // SAFETY: `Avx2` is only made by `detect`, after every feature that the function is compiled for was found.
            Self::Avx2 => unsafe { cover_avx2(raster, tables, footprint, ink) },
            Self::Scalar => raster.cover(tables, footprint, ink),
        }
    }

    /// [`Raster::hides_sphere`].
    pub(crate) fn hides_sphere(self, raster: &Raster, tables: &RasterTables, center: Vec3, radius: f32) -> bool {
        match self {
            #[cfg(target_arch = "x86_64")]
            // SAFETY: as in `cover`.
            Self::Avx2 => unsafe { hides_sphere_avx2(raster, tables, center, radius) },
            Self::Scalar => raster.hides_sphere(tables, center, radius),
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,bmi1,bmi2,lzcnt,popcnt")]
fn cover_avx2(raster: &mut Raster, tables: &RasterTables, footprint: &Footprint, ink: Ink) -> Covered {
    raster.cover(tables, footprint, ink)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,bmi1,bmi2,lzcnt,popcnt")]
fn hides_sphere_avx2(raster: &Raster, tables: &RasterTables, center: Vec3, radius: f32) -> bool {
    raster.hides_sphere(tables, center, radius)
}
