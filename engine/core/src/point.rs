//! The point: one disc of surface with the light that leaves it, 32 bytes.

use crate::octahedral;
use crate::rgb9e5::{self, RGB9E5_MAX};
use bytemuck::{Pod, Zeroable};
use glam::Vec3;

/// One oriented disc (surfel), as it lies in files, pages and sort runs.
///
/// ```text
/// byte 0          12       16       20       24       28           32
///      | position  | radius | normal | front  | back   | albedo     |
///      | 3 x f32   | f32    | 2 x i16| rgb9e5 | rgb9e5 | 3 x 10 bits|
/// ```
///
/// The paper keeps one colour; a thin surface that is lit from both sides needs two, so each side carries the radiance that
/// leaves it, and light that comes back from other surfaces needs to know how much of it is reflected. Shared exponents and an
/// octahedral normal make room.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct PointRecord {
    /// Centre, world space.
    pub position: [f32; 3],
    /// Radius of the disc whose area the point stands for (`area = pi r^2`), world units, positive.
    pub radius: f32,
    /// Unit normal, octahedral ([`crate::octahedral`]); it points to the front side.
    pub normal_code: [i16; 2],
    /// Outgoing radiance of the front side, W/(m2 sr), diffuse: equal in all directions ([`crate::rgb9e5`]).
    pub front_code: u32,
    /// Outgoing radiance of the back side.
    pub back_code: u32,
    /// What is reflected of light that arrives: red, green and blue in ten bits each, from the lowest, then one bit that is set
    /// where the back reflects too. See [`Reflectance`].
    pub albedo_code: u32,
}

const _: () = assert!(size_of::<PointRecord>() == 32);

/// A number of a point that cannot be used.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum InvalidPoint {
    /// NaN or infinity in the named field.
    #[error("{0} is not finite")]
    NotFinite(&'static str),
    /// The radius is zero or negative.
    #[error("radius is not positive")]
    Radius,
    /// The normal has no direction.
    #[error("normal is zero")]
    Normal,
    /// Radiance below zero.
    #[error("radiance is negative")]
    NegativeRadiance,
}

/// What one side of a disc sends out, before packing; used where points are made.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sides {
    /// Radiance of the side that the normal points to.
    pub front: [f32; 3],
    /// Radiance of the other side.
    pub back: [f32; 3],
}

/// How a disc reflects light that arrives from other surfaces: diffusely.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Reflectance {
    /// Share of each channel, 0 to 1.
    pub albedo: [f32; 3],
    /// Whether the back does as well as the front.
    pub both_sides: bool,
}

/// Bits of a channel of the albedo.
const ALBEDO_BITS: u32 = 10;
const ALBEDO_MAX: u32 = (1 << ALBEDO_BITS) - 1;
const BOTH_SIDES_BIT: u32 = 1 << (3 * ALBEDO_BITS);

impl PointRecord {
    /// Checks and packs one point that reflects nothing. Radiance above [`RGB9E5_MAX`] is clamped to it (see
    /// [`Self::is_clamped`]).
    ///
    /// # Errors
    /// The first field that cannot be used.
    pub fn new(position: [f32; 3], normal: [f32; 3], radius: f32, sides: Sides) -> Result<Self, InvalidPoint> {
        finite("position", &position)?;
        finite("normal", &normal)?;
        finite("radius", &[radius])?;
        finite("radiance", &sides.front)?;
        finite("radiance", &sides.back)?;
        if radius <= 0.0 {
            return Err(InvalidPoint::Radius);
        }
        // Scaled by its largest number first: the length of a very long or short normal would leave the range of f32.
        let normal = Vec3::from(normal);
        let normal = (normal / normal.abs().max_element())
            .try_normalize()
            .ok_or(InvalidPoint::Normal)?;
        if sides.front.iter().chain(&sides.back).any(|&value| value < 0.0) {
            return Err(InvalidPoint::NegativeRadiance);
        }
        Ok(Self {
            position,
            radius,
            normal_code: octahedral::encode(normal),
            front_code: rgb9e5::encode(sides.front),
            back_code: rgb9e5::encode(sides.back),
            albedo_code: 0,
        })
    }

    /// The same point with this reflectance; an albedo outside of 0 to 1 is clamped.
    #[must_use]
    pub fn with_reflectance(self, reflectance: Reflectance) -> Self {
        let [r, g, b] = reflectance
            .albedo
            .map(|share| (share.clamp(0.0, 1.0) * ALBEDO_MAX as f32).round() as u32);
        let albedo_code = match r | g << ALBEDO_BITS | b << (2 * ALBEDO_BITS) {
            0 => 0,
            code if reflectance.both_sides => code | BOTH_SIDES_BIT,
            code => code,
        };
        Self { albedo_code, ..self }
    }

    /// The same point with this radiance, from zero up; above [`RGB9E5_MAX`] it is clamped.
    #[must_use]
    pub fn with_sides(self, sides: Sides) -> Self {
        Self {
            front_code: rgb9e5::encode(sides.front),
            back_code: rgb9e5::encode(sides.back),
            ..self
        }
    }

    /// Whether a radiance is the largest there is: most likely it was larger.
    pub fn is_clamped(&self) -> bool {
        let sides = self.sides();
        sides.front.iter().chain(&sides.back).any(|&value| value >= RGB9E5_MAX)
    }

    /// Checks a record that came from a file: the same rules as [`Self::new`].
    ///
    /// # Errors
    /// The first field that cannot be used.
    pub fn validate(&self) -> Result<(), InvalidPoint> {
        finite("position", &self.position)?;
        finite("radius", &[self.radius])?;
        if self.radius <= 0.0 {
            return Err(InvalidPoint::Radius);
        }
        Ok(())
    }

    /// Unit normal.
    #[inline]
    pub fn normal(&self) -> Vec3 {
        octahedral::decode(self.normal_code)
    }

    /// Area of the disc, square world units.
    #[inline]
    pub fn area(&self) -> f32 {
        std::f32::consts::PI * self.radius * self.radius
    }

    /// Radiance of both sides.
    #[inline]
    pub fn sides(&self) -> Sides {
        Sides {
            front: rgb9e5::decode(self.front_code),
            back: rgb9e5::decode(self.back_code),
        }
    }

    /// How it reflects.
    #[inline]
    pub fn reflectance(&self) -> Reflectance {
        let channel = |shift: u32| (self.albedo_code >> shift & ALBEDO_MAX) as f32 / ALBEDO_MAX as f32;
        Reflectance {
            albedo: [0, ALBEDO_BITS, 2 * ALBEDO_BITS].map(channel),
            both_sides: self.albedo_code & BOTH_SIDES_BIT != 0,
        }
    }

    /// Whether it reflects anything.
    #[inline]
    pub fn reflects(&self) -> bool {
        self.albedo_code != 0
    }
}

fn finite(field: &'static str, values: &[f32]) -> Result<(), InvalidPoint> {
    if values.iter().all(|value| value.is_finite()) {
        Ok(())
    } else {
        Err(InvalidPoint::NotFinite(field))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_number_that_is_not_finite_is_refused() {
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            for field in 0..13 {
                let mut numbers = [0.5f32; 13];
                numbers[field] = bad;
                let [px, py, pz, nx, ny, nz, radius, fr, fg, fb, br, bg, bb] = numbers;
                let sides = Sides {
                    front: [fr, fg, fb],
                    back: [br, bg, bb],
                };
                let point = PointRecord::new([px, py, pz], [nx, ny, nz], radius, sides);
                assert!(
                    matches!(point, Err(InvalidPoint::NotFinite(_))),
                    "field {field}, value {bad}"
                );
            }
        }
    }

    #[test]
    fn impossible_discs_are_refused() {
        let lit = Sides {
            front: [1.0; 3],
            back: [0.0; 3],
        };
        let new = |normal, radius, sides| PointRecord::new([0.0; 3], normal, radius, sides);
        assert_eq!(new([0.0; 3], 1.0, lit), Err(InvalidPoint::Normal));
        assert_eq!(new([0.0, 1.0, 0.0], 0.0, lit), Err(InvalidPoint::Radius));
        assert_eq!(new([0.0, 1.0, 0.0], -1.0, lit), Err(InvalidPoint::Radius));
        let negative = Sides {
            front: [0.0, -1.0, 0.0],
            back: [0.0; 3],
        };
        assert_eq!(new([0.0, 1.0, 0.0], 1.0, negative), Err(InvalidPoint::NegativeRadiance));
    }

    #[test]
    fn bright_light_is_clamped_not_infinite() {
        let sides = Sides {
            front: [1e6, 1.0, 0.0],
            back: [0.0; 3],
        };
        let point = PointRecord::new([0.0; 3], [0.0, 1.0, 0.0], 1.0, sides).unwrap();
        assert!(point.is_clamped());
        assert_eq!(point.sides().front, [RGB9E5_MAX, 0.0, 0.0], "nothing shows beside it");
        point.validate().unwrap();
        assert!(!point.with_sides(Sides::default()).is_clamped());
    }

    #[test]
    fn reflectance_comes_back() {
        let point = PointRecord::new([0.0; 3], [0.0, 1.0, 0.0], 1.0, Sides::default()).unwrap();
        assert!(!point.reflects());
        for both_sides in [false, true] {
            let given = Reflectance {
                albedo: [0.0, 0.18, 1.0],
                both_sides,
            };
            let found = point.with_reflectance(given).reflectance();
            assert_eq!(found.both_sides, both_sides);
            for (a, b) in given.albedo.into_iter().zip(found.albedo) {
                assert!((a - b).abs() < 5e-4);
            }
        }
        let beyond = Reflectance {
            albedo: [2.0, -1.0, f32::NAN],
            both_sides: false,
        };
        assert_eq!(point.with_reflectance(beyond).reflectance().albedo, [1.0, 0.0, 0.0]);
    }

    #[test]
    fn normals_of_any_length_are_taken() {
        for length in [1e-30f32, 1.0, 1e30] {
            let point = PointRecord::new([0.0; 3], [0.0, length, 0.0], 1.0, Sides::default()).unwrap();
            assert!(point.normal().distance(Vec3::Y) < 1e-4);
        }
    }
}
