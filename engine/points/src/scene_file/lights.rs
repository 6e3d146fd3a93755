//! The lights of a scene file: punctual ones as they are, rectangles as surfaces that glow.

use super::Text;
use super::entries::{DirectionalLight, Lights, PointLight, RectangleLight, SpotLight};
use crate::error::PointsError;
use crate::geometry::Geometry;
use crate::light::{Light, LightKind};
use crate::material::Material;
use crate::scene::SceneParts;
use glam::{DAffine3, Vec3};

/// Adds all lights to `parts`, and what is wrong with them to the problems of `text`.
pub(super) fn add(lights: &Lights, text: &mut Text<'_>, parts: &mut SceneParts) -> Result<(), PointsError> {
    for light in &lights.point {
        parts.lights.extend(text.value(light, point(light.as_ref())));
    }
    for light in &lights.spot {
        parts.lights.extend(text.value(light, spot(light.as_ref())));
    }
    for light in &lights.directional {
        parts.lights.extend(text.value(light, directional(light.as_ref())));
    }
    let mut glowing = Geometry::default();
    for light in &lights.rectangle {
        if let Some((geometry, material)) = text.value(light, rectangle(light.as_ref(), parts.materials.len() as u32)) {
            glowing.append(text.path, &geometry, &DAffine3::IDENTITY)?;
            parts.materials.push(material);
        }
    }
    parts.place_once(glowing);
    Ok(())
}

fn point(light: &PointLight) -> Result<Light, String> {
    Ok(Light {
        kind: LightKind::Point,
        intensity: strength("intensity", light.intensity, light.color)?,
        position: finite("position", light.position)?,
        direction: Vec3::NEG_Y,
        range: range(light.range)?,
    })
}

fn spot(light: &SpotLight) -> Result<Light, String> {
    let position = finite("position", light.position)?;
    let axis = finite("target", light.target)? - position;
    let (inner, outer) = (light.inner_angle, light.outer_angle);
    if !(inner >= 0.0 && outer > 0.0 && inner <= outer && outer <= 90.0) {
        return Err(format!(
            "inner_angle is {inner} and outer_angle {outer}, must be degrees from the axis, 0 to 90, the inner one no larger"
        ));
    }
    Ok(Light {
        kind: LightKind::Spot {
            cos_inner: inner.to_radians().cos(),
            cos_outer: outer.to_radians().cos(),
        },
        intensity: strength("intensity", light.intensity, light.color)?,
        position,
        direction: axis
            .try_normalize()
            .ok_or("target must be another place than position")?,
        range: range(light.range)?,
    })
}

fn directional(light: &DirectionalLight) -> Result<Light, String> {
    let direction = finite("direction", light.direction)?;
    Ok(Light {
        kind: LightKind::Directional,
        intensity: strength("irradiance", light.irradiance, light.color)?,
        position: Vec3::ZERO,
        direction: direction.try_normalize().ok_or("direction must not be 0, 0, 0")?,
        range: None,
    })
}

fn rectangle(light: &RectangleLight, material: u32) -> Result<(Geometry, Material), String> {
    let corner = finite("corner", light.corner)?;
    let (u, v) = (finite("edge_u", light.edge_u)?, finite("edge_v", light.edge_v)?);
    if u.as_dvec3().cross(v.as_dvec3()).length_squared() == 0.0 {
        return Err("edge_u and edge_v must span an area".to_owned());
    }
    let corners = [corner, corner + u, corner + u + v, corner + v];
    let geometry = Geometry {
        positions: corners.map(|corner| corner.to_array()).to_vec(),
        triangles: vec![[0, 1, 2], [0, 2, 3]],
        materials: vec![material; 2],
        ..Geometry::default()
    };
    let material = Material {
        albedo: [0.0; 3],
        emission: strength("radiance", light.radiance, light.color)?,
        double_sided: light.both_sides,
        ..Material::default()
    };
    Ok((geometry, material))
}

fn strength(name: &str, factor: f32, color: [f32; 3]) -> Result<[f32; 3], String> {
    let product = color.map(|channel| channel * factor);
    let sound = color
        .iter()
        .chain([&factor])
        .chain(&product)
        .all(|value| value.is_finite() && *value >= 0.0);
    match sound {
        true => Ok(product),
        false => Err(format!("{name} and color must be finite and not below 0")),
    }
}

fn finite(name: &str, vector: [f32; 3]) -> Result<Vec3, String> {
    let vector = Vec3::from(vector);
    match vector.is_finite() {
        true => Ok(vector),
        false => Err(format!("{name} must be three finite numbers")),
    }
}

fn range(range: Option<f32>) -> Result<Option<f32>, String> {
    match range {
        Some(range) if !(range > 0.0 && range.is_finite()) => Err(format!(
            "range is {range}, must be a distance above 0; without it the light has no end"
        )),
        range => Ok(range),
    }
}

impl Light {
    /// The light where `place` brings it; its strength stays.
    pub(super) fn moved(&self, place: &DAffine3) -> Self {
        Self {
            position: place.transform_point3(self.position.as_dvec3()).as_vec3(),
            direction: place
                .transform_vector3(self.direction.as_dvec3())
                .as_vec3()
                .normalize_or(self.direction),
            ..*self
        }
    }
}
