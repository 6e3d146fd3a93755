//! The one place that names instruction sets: the same code compiled for AVX2 and for any processor, chosen at run time.

#![allow(
    unsafe_code,
    reason = "calling a function compiled for more than the build's baseline needs `unsafe`"
)]

use crate::cut::{Scratch, Seen, Walk, gather};
use crate::frame::Frame;
use crate::raster::Raster;
use crate::shader::{Receiver, ShadeCounters, ShadeError};
use crate::source::SceneSource;

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
            && is_x86_feature_detected!("f16c")
            && is_x86_feature_detected!("bmi1")
            && is_x86_feature_detected!("bmi2")
            && is_x86_feature_detected!("lzcnt")
            && is_x86_feature_detected!("popcnt")
        {
            return Self::Avx2;
        }
        Self::Scalar
    }

    /// [`gather`] with this instruction set. Both ways compute the same bits: no operation is contracted or reordered.
    #[expect(clippy::too_many_arguments, reason = "the twin of `gather`")]
    pub(crate) fn gather<S: SceneSource>(
        self,
        walk: &Walk<'_>,
        receiver: &Receiver,
        frame: &Frame,
        source: &mut S,
        raster: &mut Raster,
        scratch: &mut Scratch,
        counters: &mut ShadeCounters,
    ) -> Result<Seen, ShadeError> {
        match self {
            #[cfg(target_arch = "x86_64")]
            // SAFETY: `Avx2` is only made by `detect`, after every feature that the function is compiled for was found.
            Self::Avx2 => unsafe { gather_avx2(walk, receiver, frame, source, raster, scratch, counters) },
            Self::Scalar => gather(walk, receiver, frame, source, raster, scratch, counters),
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,f16c,bmi1,bmi2,lzcnt,popcnt")]
fn gather_avx2<S: SceneSource>(
    walk: &Walk<'_>,
    receiver: &Receiver,
    frame: &Frame,
    source: &mut S,
    raster: &mut Raster,
    scratch: &mut Scratch,
    counters: &mut ShadeCounters,
) -> Result<Seen, ShadeError> {
    gather(walk, receiver, frame, source, raster, scratch, counters)
}
