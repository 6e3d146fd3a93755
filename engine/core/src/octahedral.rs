//! Unit vectors in two 16-bit numbers: the octahedral map, accurate to 0.003 degrees.

use glam::Vec3;

const SCALE: f32 = 32_767.0;

/// Encodes a unit vector. Of the two codes that a direction on the map's rim has, it is always the same one, so that
/// decoding and encoding again changes nothing.
#[inline]
pub fn encode(unit: Vec3) -> [i16; 2] {
    const RIM: i16 = SCALE as i16;
    let [x, y] = project(unit).map(|value| (value * SCALE).round() as i16);
    match (x.abs() == RIM, y.abs() == RIM) {
        (true, _) => [x, y.abs()],
        (_, true) => [x.abs(), y],
        _ => [x, y],
    }
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
        fn encoding_again_changes_nothing(a: i16, b: i16, rim in 0..5) {
            let code = match rim { 0 => [32_767, b], 1 => [-32_767, b], 2 => [a, 32_767], 3 => [a, -32_767], _ => [a, b] };
            let once = encode(decode(code));
            prop_assert_eq!(encode(decode(once)), once);
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
