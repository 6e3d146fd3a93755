//! Three numbers from zero up in 32 bits: nine bits each below one shared exponent of five, as graphics hardware has it (OpenGL's
//! `RGB9_E5`). A number is off by at most 1/512 of the largest of the three.

/// Largest number that has a code.
pub const RGB9E5_MAX: f32 = 65_408.0;

/// Mantissa bits of a number.
const BITS: u32 = 9;
const MANTISSA_MAX: u32 = (1 << BITS) - 1;
/// What a code's exponent stands above that of the scale of its mantissas.
const BIAS: u32 = 15 + BITS;
/// Of `f32`.
const FLOAT_BIAS: u32 = 127;
const FLOAT_MANTISSA_BITS: u32 = 23;

/// Packs, rounding to nearest. What is above [`RGB9E5_MAX`] is clamped to it; what is below zero, or no number, becomes zero.
#[inline]
pub fn encode(rgb: [f32; 3]) -> u32 {
    let rgb = rgb.map(|value| value.clamp(0.0, RGB9E5_MAX));
    let largest = rgb[0].max(rgb[1]).max(rgb[2]);
    // The exponent that puts the largest just below one, unless it is too small for any.
    let mut exponent = ((largest.to_bits() >> FLOAT_MANTISSA_BITS) + 1 + BIAS - BITS).saturating_sub(FLOAT_BIAS);
    if (largest / scale(exponent)).round() > MANTISSA_MAX as f32 {
        exponent += 1;
    }
    let scale = scale(exponent);
    let mantissa = rgb.map(|value| (value / scale).round() as u32);
    mantissa[0] | mantissa[1] << BITS | mantissa[2] << (2 * BITS) | exponent << (3 * BITS)
}

/// The numbers of a code; every code has some, finite and not below zero.
#[inline]
pub fn decode(code: u32) -> [f32; 3] {
    let scale = scale(code >> (3 * BITS));
    [0, BITS, 2 * BITS].map(|shift| (code >> shift & MANTISSA_MAX) as f32 * scale)
}

/// What the last bit of a mantissa stands for.
#[inline]
fn scale(exponent: u32) -> f32 {
    f32::from_bits((exponent + FLOAT_BIAS - BIAS) << FLOAT_MANTISSA_BITS)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_come_back_within_a_share_of_the_largest() {
        for step in 0..4000 {
            let largest = 1e-4 * 1.005f32.powi(step);
            if largest > RGB9E5_MAX {
                break;
            }
            let rgb = [largest, largest * 0.37, largest * 0.011];
            for (value, back) in rgb.into_iter().zip(decode(encode(rgb))) {
                assert!((value - back).abs() <= largest / 511.9, "{value} became {back}");
            }
        }
    }

    #[test]
    fn what_was_decoded_keeps_its_numbers() {
        for step in 0..100_000u32 {
            let numbers = decode(step.wrapping_mul(0x9E37_79B9));
            assert_eq!(decode(encode(numbers)), numbers);
            assert!(numbers.iter().all(|value| value.is_finite() && *value >= 0.0));
        }
    }

    #[test]
    fn ends_of_the_range_hold() {
        assert_eq!(decode(encode([0.0; 3])), [0.0; 3]);
        assert_eq!(decode(encode([1.0, 0.5, 0.25])), [1.0, 0.5, 0.25]);
        assert_eq!(decode(encode([1e9, -1.0, f32::NAN])), [RGB9E5_MAX, 0.0, 0.0]);
        assert_eq!(decode(encode([f32::INFINITY; 3])), [RGB9E5_MAX; 3]);
        assert_eq!(decode(encode([511.9; 3])), [512.0; 3]);
        let small = decode(encode([1e-7, 1e-9, 0.0]));
        assert!((small[0] - 1e-7).abs() < 6e-8 && small[1] == 0.0);
        assert_eq!(decode(u32::MAX), [RGB9E5_MAX; 3]);
    }
}
