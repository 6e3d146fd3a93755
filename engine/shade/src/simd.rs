//! Eight numbers at a time: what the gather computes with, for AVX2 and for any processor, chosen at run time.
//!
//! A lane is a receiver. The gather is written once over [`Floats`]; [`Simd::dispatch`] compiles it twice. Both ways compute
//! the same bits: every operation is a correctly rounded one of IEEE 754, fused where it says so and nowhere else. This is the one
//! place that names instruction sets.

use crate::footprint::Footprint;
use crate::raster::{Covered, Ink, Raster, RasterTables};
use half::f16;
use std::fmt::Debug;
use std::ops::{Add, BitAnd, BitOr, BitXor, Div, Mul, Neg, Not, Sub};

/// Receivers shaded together.
pub(crate) const LANES: usize = 8;

/// Eight floats.
pub(crate) trait Floats:
    Copy + Debug + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self> + Neg<Output = Self>
{
    /// Eight words of the same width.
    type Words: Words<Floats = Self>;

    fn from_array(values: [f32; LANES]) -> Self;
    fn from_halves(halves: [f16; LANES]) -> Self;
    fn to_array(self) -> [f32; LANES];
    fn sqrt(self) -> Self;
    /// `self * factor + term`, rounded once.
    fn mul_add(self, factor: Self, term: Self) -> Self;
    /// The smaller; the second if either is not a number.
    fn min(self, other: Self) -> Self;
    /// The larger; the second if either is not a number.
    fn max(self, other: Self) -> Self;
    /// The smallest of the eight.
    fn min_lane(self) -> f32;
    /// The largest of the eight.
    fn max_lane(self) -> f32;
    /// All ones where `self < other`.
    fn less(self, other: Self) -> Self::Words;
    fn to_bits(self) -> Self::Words;

    /// [`Raster::cover`], compiled on its own.
    fn cover<const WORDS: usize, const N: usize, const PATTERN: bool>(
        raster: &mut Raster<Self, WORDS>,
        tables: &RasterTables,
        footprint: &Footprint<Self, N>,
        lanes: u8,
        ink: &Ink<Self>,
    ) -> Covered<Self>;

    #[inline(always)]
    fn splat(value: f32) -> Self {
        Self::from_array([value; LANES])
    }

    #[inline(always)]
    fn abs(self) -> Self {
        (self.to_bits() & Self::Words::splat(!SIGN)).to_floats()
    }

    /// With the sign of another.
    #[inline(always)]
    fn copysign(self, sign: Self) -> Self {
        let mask = Self::Words::splat(SIGN);
        ((self.to_bits() & !mask) | (sign.to_bits() & mask)).to_floats()
    }

    #[inline(always)]
    fn clamp(self, low: f32, high: f32) -> Self {
        self.max(Self::splat(low)).min(Self::splat(high))
    }
}

/// Eight words of 32 bits. As a mask, a lane counts by its highest bit.
pub(crate) trait Words:
    Copy + Debug + BitAnd<Output = Self> + BitOr<Output = Self> + BitXor<Output = Self> + Not<Output = Self>
{
    type Floats: Floats<Words = Self>;

    fn from_array(values: [u32; LANES]) -> Self;
    fn to_array(self) -> [u32; LANES];
    fn wrapping_add(self, other: Self) -> Self;
    fn wrapping_sub(self, other: Self) -> Self;
    /// Shifted left by so many bits; 0 from 32 on.
    fn shift_left(self, bits: Self) -> Self;
    /// The larger, of signed numbers.
    fn max_signed(self, other: Self) -> Self;
    /// All ones where the words differ.
    fn not_equal(self, other: Self) -> Self;
    /// All ones where the signed number is greater.
    fn greater_signed(self, other: Self) -> Self;
    fn count_ones(self) -> Self;
    /// The numbers as floats; they are below 2^31.
    fn as_floats(self) -> Self::Floats;
    /// The same bits read as floats.
    fn to_floats(self) -> Self::Floats;
    /// The lanes of a mask, one bit each.
    fn lanes(self) -> u8;
    /// By lane, `set` where the mask is set and `clear` elsewhere.
    fn select(self, set: Self::Floats, clear: Self::Floats) -> Self::Floats;

    #[inline(always)]
    fn splat(value: u32) -> Self {
        Self::from_array([value; LANES])
    }

    /// All ones in these lanes.
    #[inline(always)]
    fn from_lanes(lanes: u8) -> Self {
        Self::from_array(std::array::from_fn(|lane| {
            0u32.wrapping_sub(u32::from(lanes >> lane & 1))
        }))
    }
}

const SIGN: u32 = 0x8000_0000;

/// Work that is written for any [`Floats`].
pub(crate) trait Task {
    type Output;
    fn run<F: Floats>(self) -> Self::Output;
}

/// Instruction set of the gather.
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
        if avx2::is_available() {
            return Self::Avx2;
        }
        Self::Scalar
    }

    /// Runs a task with this instruction set.
    pub(crate) fn dispatch<T: Task>(self, task: T) -> T::Output {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => avx2::run(task),
            Self::Scalar => task.run::<ScalarFloats>(),
        }
    }
}

/// Eight floats without vector instructions.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ScalarFloats([f32; LANES]);

/// Eight words without vector instructions.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ScalarWords([u32; LANES]);

/// An operator by lane.
macro_rules! scalar_operator {
    ($kind:ident, $operator:ident, $method:ident) => {
        impl $operator for $kind {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                Self(std::array::from_fn(|lane| self.0[lane].$method(other.0[lane])))
            }
        }
    };
}

scalar_operator!(ScalarFloats, Add, add);
scalar_operator!(ScalarFloats, Sub, sub);
scalar_operator!(ScalarFloats, Mul, mul);
scalar_operator!(ScalarFloats, Div, div);
scalar_operator!(ScalarWords, BitAnd, bitand);
scalar_operator!(ScalarWords, BitOr, bitor);
scalar_operator!(ScalarWords, BitXor, bitxor);

impl Neg for ScalarFloats {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Self(self.0.map(|value| -value))
    }
}

impl Not for ScalarWords {
    type Output = Self;
    #[inline(always)]
    fn not(self) -> Self {
        Self(self.0.map(|value| !value))
    }
}

impl ScalarWords {
    #[inline(always)]
    fn zip(self, other: Self, f: impl Fn(u32, u32) -> u32) -> Self {
        Self(std::array::from_fn(|lane| f(self.0[lane], other.0[lane])))
    }
}

impl Floats for ScalarFloats {
    type Words = ScalarWords;

    #[inline(always)]
    fn from_array(values: [f32; LANES]) -> Self {
        Self(values)
    }

    #[inline(always)]
    fn from_halves(halves: [f16; LANES]) -> Self {
        Self(halves.map(f16::to_f32))
    }

    #[inline(always)]
    fn to_array(self) -> [f32; LANES] {
        self.0
    }

    #[inline(always)]
    fn sqrt(self) -> Self {
        Self(self.0.map(f32::sqrt))
    }

    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        Self(std::array::from_fn(|lane| {
            self.0[lane].mul_add(factor.0[lane], term.0[lane])
        }))
    }

    #[inline(always)]
    fn min(self, other: Self) -> Self {
        Self(std::array::from_fn(|lane| {
            if self.0[lane] < other.0[lane] {
                self.0[lane]
            } else {
                other.0[lane]
            }
        }))
    }

    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Self(std::array::from_fn(|lane| {
            if self.0[lane] > other.0[lane] {
                self.0[lane]
            } else {
                other.0[lane]
            }
        }))
    }

    #[inline(always)]
    fn min_lane(self) -> f32 {
        self.0.into_iter().fold(f32::INFINITY, f32::min)
    }

    #[inline(always)]
    fn max_lane(self) -> f32 {
        self.0.into_iter().fold(f32::NEG_INFINITY, f32::max)
    }

    #[inline(always)]
    fn less(self, other: Self) -> ScalarWords {
        ScalarWords(std::array::from_fn(|lane| all_ones_if(self.0[lane] < other.0[lane])))
    }

    #[inline(always)]
    fn to_bits(self) -> ScalarWords {
        ScalarWords(self.0.map(f32::to_bits))
    }

    fn cover<const WORDS: usize, const N: usize, const PATTERN: bool>(
        raster: &mut Raster<Self, WORDS>,
        tables: &RasterTables,
        footprint: &Footprint<Self, N>,
        lanes: u8,
        ink: &Ink<Self>,
    ) -> Covered<Self> {
        raster.cover::<N, PATTERN>(tables, footprint, lanes, ink)
    }
}

#[inline(always)]
fn all_ones_if(condition: bool) -> u32 {
    0u32.wrapping_sub(u32::from(condition))
}

impl Words for ScalarWords {
    type Floats = ScalarFloats;

    #[inline(always)]
    fn from_array(values: [u32; LANES]) -> Self {
        Self(values)
    }

    #[inline(always)]
    fn to_array(self) -> [u32; LANES] {
        self.0
    }

    #[inline(always)]
    fn wrapping_add(self, other: Self) -> Self {
        self.zip(other, u32::wrapping_add)
    }

    #[inline(always)]
    fn wrapping_sub(self, other: Self) -> Self {
        self.zip(other, u32::wrapping_sub)
    }

    #[inline(always)]
    fn shift_left(self, bits: Self) -> Self {
        self.zip(bits, |word, bits| word.checked_shl(bits).unwrap_or(0))
    }

    #[inline(always)]
    fn max_signed(self, other: Self) -> Self {
        self.zip(other, |a, b| (a as i32).max(b as i32) as u32)
    }

    #[inline(always)]
    fn not_equal(self, other: Self) -> Self {
        self.zip(other, |a, b| all_ones_if(a != b))
    }

    #[inline(always)]
    fn greater_signed(self, other: Self) -> Self {
        self.zip(other, |a, b| all_ones_if(a as i32 > b as i32))
    }

    #[inline(always)]
    fn count_ones(self) -> Self {
        Self(self.0.map(u32::count_ones))
    }

    #[inline(always)]
    fn as_floats(self) -> ScalarFloats {
        ScalarFloats(self.0.map(|word| word as i32 as f32))
    }

    #[inline(always)]
    fn to_floats(self) -> ScalarFloats {
        ScalarFloats(self.0.map(f32::from_bits))
    }

    #[inline(always)]
    fn lanes(self) -> u8 {
        let bit = |(lane, word): (usize, u32)| ((word >> 31) as u8) << lane;
        self.0
            .into_iter()
            .enumerate()
            .map(bit)
            .fold(0, |lanes, bit| lanes | bit)
    }

    #[inline(always)]
    fn select(self, set: ScalarFloats, clear: ScalarFloats) -> ScalarFloats {
        ScalarFloats(std::array::from_fn(|lane| {
            if self.0[lane] >> 31 == 1 {
                set.0[lane]
            } else {
                clear.0[lane]
            }
        }))
    }
}

/// The same on AVX2. Values of its types exist only inside [`avx2::run`], behind [`avx2::is_available`].
#[cfg(target_arch = "x86_64")]
#[allow(
    unsafe_code,
    reason = "instructions beyond the build's baseline are `unsafe` to use: the processor must have them"
)]
mod avx2 {
    use super::*;
    use std::arch::x86_64::*;
    use std::mem::transmute;

    /// Whether this processor has what the module is compiled for.
    pub(super) fn is_available() -> bool {
        is_x86_feature_detected!("avx2")
            && is_x86_feature_detected!("fma")
            && is_x86_feature_detected!("f16c")
            && is_x86_feature_detected!("bmi1")
            && is_x86_feature_detected!("bmi2")
            && is_x86_feature_detected!("lzcnt")
            && is_x86_feature_detected!("popcnt")
    }

    /// Runs a task on AVX2. Only [`Simd::dispatch`] calls this, with a [`Simd::Avx2`] that [`Simd::detect`] made.
    pub(super) fn run<T: Task>(task: T) -> T::Output {
        #[target_feature(enable = "avx2,fma,f16c,bmi1,bmi2,lzcnt,popcnt")]
        fn compiled<T: Task>(task: T) -> T::Output {
            task.run::<Avx2Floats>()
        }
        // SAFETY: `Simd::Avx2` is only made by `detect`, after every feature was found.
        unsafe { compiled(task) }
    }

    #[derive(Clone, Copy, Debug)]
    pub(super) struct Avx2Floats(__m256);

    #[derive(Clone, Copy, Debug)]
    pub(super) struct Avx2Words(__m256i);

    /// An operator that is one instruction.
    macro_rules! operator {
        ($kind:ident, $operator:ident, $method:ident, $instruction:ident) => {
            impl $operator for $kind {
                type Output = Self;
                #[inline(always)]
                fn $method(self, other: Self) -> Self {
                    // SAFETY: values of this type exist only where AVX2 does (see the module).
                    Self(unsafe { $instruction(self.0, other.0) })
                }
            }
        };
    }

    operator!(Avx2Floats, Add, add, _mm256_add_ps);
    operator!(Avx2Floats, Sub, sub, _mm256_sub_ps);
    operator!(Avx2Floats, Mul, mul, _mm256_mul_ps);
    operator!(Avx2Floats, Div, div, _mm256_div_ps);
    operator!(Avx2Words, BitAnd, bitand, _mm256_and_si256);
    operator!(Avx2Words, BitOr, bitor, _mm256_or_si256);
    operator!(Avx2Words, BitXor, bitxor, _mm256_xor_si256);

    impl Neg for Avx2Floats {
        type Output = Self;
        #[inline(always)]
        fn neg(self) -> Self {
            // SAFETY: as for the operators.
            Self(unsafe { _mm256_xor_ps(self.0, _mm256_set1_ps(-0.0)) })
        }
    }

    impl Not for Avx2Words {
        type Output = Self;
        #[inline(always)]
        fn not(self) -> Self {
            // SAFETY: as for the operators.
            Self(unsafe { _mm256_xor_si256(self.0, _mm256_set1_epi32(-1)) })
        }
    }

    impl Floats for Avx2Floats {
        type Words = Avx2Words;

        #[inline(always)]
        fn from_array(values: [f32; LANES]) -> Self {
            // SAFETY: both are 32 bytes that may hold anything.
            Self(unsafe { transmute::<[f32; LANES], __m256>(values) })
        }

        #[inline(always)]
        fn from_halves(halves: [f16; LANES]) -> Self {
            // SAFETY: both are 16 bytes that may hold anything; the instruction as for the operators.
            Self(unsafe { _mm256_cvtph_ps(transmute::<[f16; LANES], __m128i>(halves)) })
        }

        #[inline(always)]
        fn to_array(self) -> [f32; LANES] {
            // SAFETY: both are 32 bytes that may hold anything.
            unsafe { transmute::<__m256, [f32; LANES]>(self.0) }
        }

        #[inline(always)]
        fn splat(value: f32) -> Self {
            // SAFETY: as for the operators.
            Self(unsafe { _mm256_set1_ps(value) })
        }

        #[inline(always)]
        fn sqrt(self) -> Self {
            // SAFETY: as for the operators.
            Self(unsafe { _mm256_sqrt_ps(self.0) })
        }

        #[inline(always)]
        fn mul_add(self, factor: Self, term: Self) -> Self {
            // SAFETY: as for the operators; `detect` has found FMA beside AVX2.
            Self(unsafe { _mm256_fmadd_ps(self.0, factor.0, term.0) })
        }

        #[inline(always)]
        fn min(self, other: Self) -> Self {
            // SAFETY: as for the operators.
            Self(unsafe { _mm256_min_ps(self.0, other.0) })
        }

        #[inline(always)]
        fn max(self, other: Self) -> Self {
            // SAFETY: as for the operators.
            Self(unsafe { _mm256_max_ps(self.0, other.0) })
        }

        #[inline(always)]
        fn min_lane(self) -> f32 {
            // SAFETY: as for the operators.
            unsafe {
                let four = _mm_min_ps(_mm256_castps256_ps128(self.0), _mm256_extractf128_ps::<1>(self.0));
                let two = _mm_min_ps(four, _mm_movehl_ps(four, four));
                _mm_cvtss_f32(_mm_min_ss(two, _mm_shuffle_ps::<1>(two, two)))
            }
        }

        #[inline(always)]
        fn max_lane(self) -> f32 {
            // SAFETY: as for the operators.
            unsafe {
                let four = _mm_max_ps(_mm256_castps256_ps128(self.0), _mm256_extractf128_ps::<1>(self.0));
                let two = _mm_max_ps(four, _mm_movehl_ps(four, four));
                _mm_cvtss_f32(_mm_max_ss(two, _mm_shuffle_ps::<1>(two, two)))
            }
        }

        #[inline(always)]
        fn less(self, other: Self) -> Avx2Words {
            // SAFETY: as for the operators.
            Avx2Words(unsafe { _mm256_castps_si256(_mm256_cmp_ps::<_CMP_LT_OQ>(self.0, other.0)) })
        }

        #[inline(always)]
        fn to_bits(self) -> Avx2Words {
            // SAFETY: as for the operators.
            Avx2Words(unsafe { _mm256_castps_si256(self.0) })
        }

        #[inline(always)]
        fn cover<const WORDS: usize, const N: usize, const PATTERN: bool>(
            raster: &mut Raster<Self, WORDS>,
            tables: &RasterTables,
            footprint: &Footprint<Self, N>,
            lanes: u8,
            ink: &Ink<Self>,
        ) -> Covered<Self> {
            #[target_feature(enable = "avx2,fma,f16c,bmi1,bmi2,lzcnt,popcnt")]
            fn compiled<const WORDS: usize, const N: usize, const PATTERN: bool>(
                raster: &mut Raster<Avx2Floats, WORDS>,
                tables: &RasterTables,
                footprint: &Footprint<Avx2Floats, N>,
                lanes: u8,
                ink: &Ink<Avx2Floats>,
            ) -> Covered<Avx2Floats> {
                raster.cover::<N, PATTERN>(tables, footprint, lanes, ink)
            }
            // SAFETY: as for the operators.
            unsafe { compiled::<WORDS, N, PATTERN>(raster, tables, footprint, lanes, ink) }
        }
    }

    impl Words for Avx2Words {
        type Floats = Avx2Floats;

        #[inline(always)]
        fn from_array(values: [u32; LANES]) -> Self {
            // SAFETY: both are 32 bytes that may hold anything.
            Self(unsafe { transmute::<[u32; LANES], __m256i>(values) })
        }

        #[inline(always)]
        fn to_array(self) -> [u32; LANES] {
            // SAFETY: both are 32 bytes that may hold anything.
            unsafe { transmute::<__m256i, [u32; LANES]>(self.0) }
        }

        #[inline(always)]
        fn splat(value: u32) -> Self {
            // SAFETY: as for the operators.
            Self(unsafe { _mm256_set1_epi32(value as i32) })
        }

        #[inline(always)]
        fn from_lanes(lanes: u8) -> Self {
            // SAFETY: as for the operators.
            unsafe {
                let bit = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
                Self(_mm256_cmpeq_epi32(
                    _mm256_and_si256(_mm256_set1_epi32(i32::from(lanes)), bit),
                    bit,
                ))
            }
        }

        #[inline(always)]
        fn wrapping_add(self, other: Self) -> Self {
            // SAFETY: as for the operators.
            Self(unsafe { _mm256_add_epi32(self.0, other.0) })
        }

        #[inline(always)]
        fn wrapping_sub(self, other: Self) -> Self {
            // SAFETY: as for the operators.
            Self(unsafe { _mm256_sub_epi32(self.0, other.0) })
        }

        #[inline(always)]
        fn shift_left(self, bits: Self) -> Self {
            // SAFETY: as for the operators.
            Self(unsafe { _mm256_sllv_epi32(self.0, bits.0) })
        }

        #[inline(always)]
        fn max_signed(self, other: Self) -> Self {
            // SAFETY: as for the operators.
            Self(unsafe { _mm256_max_epi32(self.0, other.0) })
        }

        #[inline(always)]
        fn not_equal(self, other: Self) -> Self {
            // SAFETY: as for the operators.
            !Self(unsafe { _mm256_cmpeq_epi32(self.0, other.0) })
        }

        #[inline(always)]
        fn greater_signed(self, other: Self) -> Self {
            // SAFETY: as for the operators.
            Self(unsafe { _mm256_cmpgt_epi32(self.0, other.0) })
        }

        #[inline(always)]
        fn count_ones(self) -> Self {
            // SAFETY: as for the operators.
            unsafe {
                // A table of the bits in half a byte, looked up for both halves; then bytes are added up to words.
                let table = _mm256_setr_epi8(
                    0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4, 0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4,
                );
                let half = _mm256_set1_epi8(0x0f);
                let low = _mm256_shuffle_epi8(table, _mm256_and_si256(self.0, half));
                let high = _mm256_shuffle_epi8(table, _mm256_and_si256(_mm256_srli_epi32::<4>(self.0), half));
                let bytes = _mm256_add_epi8(low, high);
                let pairs = _mm256_maddubs_epi16(bytes, _mm256_set1_epi8(1));
                Self(_mm256_madd_epi16(pairs, _mm256_set1_epi16(1)))
            }
        }

        #[inline(always)]
        fn as_floats(self) -> Avx2Floats {
            // SAFETY: as for the operators.
            Avx2Floats(unsafe { _mm256_cvtepi32_ps(self.0) })
        }

        #[inline(always)]
        fn to_floats(self) -> Avx2Floats {
            // SAFETY: as for the operators.
            Avx2Floats(unsafe { _mm256_castsi256_ps(self.0) })
        }

        #[inline(always)]
        fn lanes(self) -> u8 {
            // SAFETY: as for the operators.
            unsafe { _mm256_movemask_ps(_mm256_castsi256_ps(self.0)) as u8 }
        }

        #[inline(always)]
        fn select(self, set: Avx2Floats, clear: Avx2Floats) -> Avx2Floats {
            // SAFETY: as for the operators.
            Avx2Floats(unsafe { _mm256_blendv_ps(clear.0, set.0, _mm256_castsi256_ps(self.0)) })
        }
    }
}
