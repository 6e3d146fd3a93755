//! Punctual lights (KHR_lights_punctual, units as they come) and what they bring to a surface.

use crate::scene::MeshScene;
use crate::trace::Ray;
use glam::{DVec3, Vec3};

/// A light without extent.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Light {
    /// Its form.
    pub kind: LightKind,
    /// Colour times intensity: W/sr for points and spots, W/m2 for directional lights.
    pub intensity: [f32; 3],
    /// World position; of no meaning for directional lights.
    pub position: Vec3,
    /// Unit direction that the light travels in; of no meaning for point lights.
    pub direction: Vec3,
    /// Distance at which it has faded to nothing, if it does; glTF's window `1 - (d / range)^4` is applied.
    pub range: Option<f32>,
}

/// Form of a light.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum LightKind {
    /// Shines everywhere: E = I cos / d^2.
    Point,
    /// Shines in a cone with a soft rim.
    Spot {
        /// Cosine of the half angle within which it is at full strength.
        cos_inner: f32,
        /// Cosine of the half angle beyond which it is dark.
        cos_outer: f32,
    },
    /// Shines from infinitely far: E = I cos.
    Directional,
}

/// Unshadowed light arriving at a point.
struct Arrival {
    /// Unit vector to the light.
    to_light: Vec3,
    /// How far the shadow ray goes.
    distance: f32,
    /// Irradiance of a surface that faces the light.
    facing: Vec3,
}

impl Light {
    fn arrive(&self, position: Vec3) -> Option<Arrival> {
        let intensity = Vec3::from(self.intensity);
        if self.kind == LightKind::Directional {
            return Some(Arrival {
                to_light: -self.direction,
                distance: f32::INFINITY,
                facing: intensity,
            });
        }
        let offset = self.position - position;
        let distance = offset.length();
        if distance <= 0.0 || self.range.is_some_and(|range| distance >= range) {
            return None;
        }
        let to_light = offset / distance;
        let window = self.range.map_or(1.0, |range| 1.0 - (distance / range).powi(4));
        let cone = match self.kind {
            LightKind::Spot { cos_inner, cos_outer } => {
                let width = (cos_inner - cos_outer).max(1e-4);
                let rim = ((-to_light.dot(self.direction) - cos_outer) / width).clamp(0.0, 1.0);
                rim * rim
            }
            LightKind::Point | LightKind::Directional => 1.0,
        };
        let strength = window * cone / (distance * distance);
        (strength > 0.0).then_some(Arrival {
            to_light,
            distance,
            facing: intensity * strength,
        })
    }
}

/// Irradiance of the two sides of a surface.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct SideIrradiance {
    /// Of the side that the normal points to.
    pub(crate) front: Vec3,
    /// Of the other side.
    pub(crate) back: Vec3,
}

impl MeshScene {
    /// What the punctual lights bring to each side of a surface at `position` with unit `normal`, W/m2, shadowed by both
    /// sides of every surface.
    pub(crate) fn direct_both_sides(&self, position: Vec3, normal: Vec3) -> SideIrradiance {
        let mut sides = SideIrradiance::default();
        for light in self.lights() {
            let Some(arrival) = light.arrive(position) else {
                continue;
            };
            let cosine = arrival.to_light.dot(normal);
            let (side, towards) = if cosine > 0.0 {
                (&mut sides.front, normal)
            } else {
                (&mut sides.back, -normal)
            };
            if cosine != 0.0 && !self.shadowed(position, towards, &arrival) {
                *side += arrival.facing * cosine.abs();
            }
        }
        sides
    }

    /// The same for one side, with a shading normal in place of the geometric one for the cosine.
    pub(crate) fn direct_one_side(&self, position: Vec3, geometric: Vec3, shading: Vec3) -> Vec3 {
        let mut irradiance = Vec3::ZERO;
        for light in self.lights() {
            let Some(arrival) = light.arrive(position) else {
                continue;
            };
            let cosine = arrival.to_light.dot(shading);
            let visible = cosine > 0.0 && arrival.to_light.dot(geometric) > 0.0;
            if visible && !self.shadowed(position, geometric, &arrival) {
                irradiance += arrival.facing * cosine;
            }
        }
        irradiance
    }

    /// Whether a surface stands between a point (lifted off its own surface along `towards`) and the light.
    fn shadowed(&self, position: Vec3, towards: Vec3, arrival: &Arrival) -> bool {
        let lift = self.ray_offset(position);
        let origin = (position.as_dvec3() + towards.as_dvec3() * f64::from(lift)).as_vec3();
        let (direction, distance) = if arrival.distance.is_finite() {
            // From the lifted origin, so that the ray ends at the light and not beside it.
            let target = position.as_dvec3() + arrival.to_light.as_dvec3() * f64::from(arrival.distance);
            let offset: DVec3 = target - origin.as_dvec3();
            (offset.normalize_or_zero().as_vec3(), offset.length() as f32 - lift)
        } else {
            (arrival.to_light, f32::INFINITY)
        };
        self.occluded(&Ray { origin, direction }, distance)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn light(kind: LightKind, range: Option<f32>) -> Light {
        Light {
            kind,
            intensity: [4.0; 3],
            position: Vec3::new(0.0, 2.0, 0.0),
            direction: Vec3::NEG_Y,
            range,
        }
    }

    #[test]
    fn a_point_light_falls_off_with_the_square_of_the_distance() {
        let arrival = light(LightKind::Point, None).arrive(Vec3::ZERO).unwrap();
        assert!((arrival.facing.x - 1.0).abs() < 1e-6);
        assert_eq!(arrival.to_light, Vec3::Y);
    }

    #[test]
    fn a_light_ends_at_its_range() {
        let ranged = light(LightKind::Point, Some(4.0));
        assert!(ranged.arrive(Vec3::new(0.0, -2.0, 0.0)).is_none());
        let arrival = ranged.arrive(Vec3::ZERO).unwrap();
        assert!((arrival.facing.x - (1.0 - 1.0 / 16.0)).abs() < 1e-6);
    }

    #[test]
    fn a_spot_is_dark_outside_of_its_cone() {
        let spot = light(
            LightKind::Spot {
                cos_inner: 0.9,
                cos_outer: 0.8,
            },
            None,
        );
        assert!((spot.arrive(Vec3::ZERO).unwrap().facing.x - 1.0).abs() < 1e-6);
        assert!(spot.arrive(Vec3::new(2.0, 0.0, 0.0)).is_none());
        assert!(spot.arrive(Vec3::new(0.0, 4.0, 0.0)).is_none(), "behind it");
    }
}
