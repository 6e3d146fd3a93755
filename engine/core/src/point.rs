//! The point: one disc of surface with the light that leaves it, 32 bytes.

use crate::limits::HALF_MAX;
use crate::octahedral;
use bytemuck::{Pod, Zeroable};
use glam::Vec3;
use half::f16;

/// One oriented disc (surfel), as it lies in files, pages and sort runs.
///
/// ```text
/// byte 0          12       16       20           26          32
///      | position  | radius | normal | front      | back      |
///      | 3 x f32   | f32    | 2 x i16| 3 x f16    | 3 x f16   |
/// ```
///
/// The paper keeps one colour; a thin surface that is lit from both sides needs two, so each side carries the radiance that
/// leaves it. The normal is octahedral to make room.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct PointRecord {
    /// Centre, world space.
    pub position: [f32; 3],
    /// Radius of the disc whose area the point stands for (`area = pi r^2`), world units, positive.
    pub radius: f32,
    /// Unit normal, octahedral ([`crate::octahedral`]); it points to the front side.
    pub normal_code: [i16; 2],
    /// Outgoing radiance of the front side, W/(m2 sr), diffuse: equal in all directions.
    pub front_radiance: [f16; 3],
    /// Outgoing radiance of the back side.
    pub back_radiance: [f16; 3],
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

impl PointRecord {
    /// Checks and packs one point. Radiance above [`HALF_MAX`] is clamped to it (see [`Self::clamps`]).
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
        let pack = |rgb: [f32; 3]| rgb.map(|value| f16::from_f32(value.min(HALF_MAX)));
        Ok(Self {
            position,
            radius,
            normal_code: octahedral::encode(normal),
            front_radiance: pack(sides.front),
            back_radiance: pack(sides.back),
        })
    }

    /// Whether packing these radiances would clamp any of them.
    pub fn clamps(sides: &Sides) -> bool {
        sides.front.iter().chain(&sides.back).any(|&value| value > HALF_MAX)
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
        for value in self.front_radiance.iter().chain(&self.back_radiance) {
            if !value.is_finite() {
                return Err(InvalidPoint::NotFinite("radiance"));
            }
            if value.to_f32() < 0.0 {
                return Err(InvalidPoint::NegativeRadiance);
            }
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
            front: self.front_radiance.map(f16::to_f32),
            back: self.back_radiance.map(f16::to_f32),
        }
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
        assert!(PointRecord::clamps(&sides));
        let point = PointRecord::new([0.0; 3], [0.0, 1.0, 0.0], 1.0, sides).unwrap();
        assert_eq!(point.sides().front, [HALF_MAX, 1.0, 0.0]);
        point.validate().unwrap();
    }

    #[test]
    fn normals_of_any_length_are_taken() {
        for length in [1e-30f32, 1.0, 1e30] {
            let point = PointRecord::new([0.0; 3], [0.0, length, 0.0], 1.0, Sides::default()).unwrap();
            assert!(point.normal().distance(Vec3::Y) < 1e-4);
        }
    }
}
