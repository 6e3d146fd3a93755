//! `UsdLux`: what lights there are, and what becomes of them where they are put.
//!
//! A light of the radiance L = intensity 2^exposure color, divided by its area in the world if it is normalized, is a surface that
//! glows with L. One without extent (`treatAsPoint`, a radius of 0, or a cone, which our surfaces do not have) has what the disc of
//! its sphere sends, pi r^2 L, as intensity. A distant light has what its disc in the sky brings, pi sin^2(angle / 2) L, as irradiance.

use super::shapes;
use super::values::{Values, forward_of, scale_of};
use crate::error::PointsError;
use crate::geometry::{Geometry, area_vector};
use crate::light::{Light, LightKind};
use crate::material::Material;
use glam::{DAffine3, DVec3, Vec3};
use openusd::usd::Prim;
use std::f64::consts::{FRAC_PI_2, PI};

/// A light in its own space.
#[derive(Clone)]
pub(super) struct Lamp {
    form: Form,
    /// Radiance, before it is normalized.
    radiance: [f64; 3],
    normalized: bool,
}

#[derive(Clone)]
enum Form {
    /// Half of its angle, radians.
    Distant(f64),
    Point {
        radius: f64,
        /// Cosines of the angles where it begins to fade and where it ends.
        cone: Option<[f32; 2]>,
    },
    Sphere(f64),
    Disk(f64),
    Rectangle(f64, f64),
    Cylinder(f64, f64),
}

/// A lamp where it is put.
pub(super) enum Put {
    Light(Light),
    Surface(Box<Geometry>, Box<Material>),
}

/// The light of a prim of this type; `None` for other types.
pub(super) fn read(values: &Values, prim: &Prim, kind: &str) -> Result<Option<Lamp>, PointsError> {
    let length = |name: &str, missing: f64| values.length(prim, name, missing);
    let form = match kind {
        "DistantLight" => Form::Distant((values.number(prim, "inputs:angle", 0.53)?.to_radians() / 2.0).clamp(0.0, PI)),
        "SphereLight" => sphere(values, prim)?,
        "DiskLight" => Form::Disk(length("inputs:radius", 0.5)?),
        "RectLight" => Form::Rectangle(length("inputs:width", 1.0)?, length("inputs:height", 1.0)?),
        "CylinderLight" => Form::Cylinder(length("inputs:radius", 0.5)?, length("inputs:length", 1.0)?),
        _ => return Ok(None),
    };
    let strong = if kind == "DistantLight" { 50_000.0 } else { 1.0 };
    Ok(Some(Lamp {
        form,
        radiance: radiance(values, prim, strong)?,
        normalized: values.flag(prim, "inputs:normalize")?,
    }))
}

/// Intensity, exposure, colour and temperature together.
pub(super) fn radiance(values: &Values, prim: &Prim, missing: f64) -> Result<[f64; 3], PointsError> {
    let intensity = values.length(prim, "inputs:intensity", missing)?;
    let exposure = values.number(prim, "inputs:exposure", 0.0)?;
    let color = values.color(prim, "inputs:color")?.unwrap_or([1.0; 3]);
    let warm = match values.flag(prim, "inputs:enableColorTemperature")? {
        true => blackbody(values.number(prim, "inputs:colorTemperature", 6500.0)?),
        false => [1.0; 3],
    };
    let radiance = std::array::from_fn(|at| intensity * exposure.exp2() * f64::from(color[at]) * warm[at]);
    match radiance.iter().all(|value| (*value as f32).is_finite()) {
        true => Ok(radiance),
        false => Err(values.wrong(prim, "its intensity and exposure are too large")),
    }
}

fn sphere(values: &Values, prim: &Prim) -> Result<Form, PointsError> {
    let radius = values.length(prim, "inputs:radius", 0.5)?;
    let shaped = values.said(prim.has_api_schema("ShapingAPI"))?;
    let angle = values.number(prim, "inputs:shaping:cone:angle", if shaped { 90.0 } else { 180.0 })?;
    let soft = values
        .number(prim, "inputs:shaping:cone:softness", 0.0)?
        .clamp(0.0, 1.0);
    let angle = angle.to_radians().clamp(0.0, PI);
    let cone = (angle < PI).then(|| [(angle * (1.0 - soft)).cos() as f32, angle.cos() as f32]);
    Ok(
        match radius == 0.0 || cone.is_some() || values.flag(prim, "treatAsPoint")? {
            true => Form::Point { radius, cone },
            false => Form::Sphere(radius),
        },
    )
}

impl Lamp {
    /// What it is there.
    pub(super) fn put(&self, place: &DAffine3) -> Put {
        let (mut surface, area) = match self.form {
            Form::Distant(angle) => return Put::Light(self.distant(angle, place)),
            Form::Point { radius, cone } => return Put::Light(self.point(radius, cone, place)),
            Form::Sphere(radius) => (shapes::sphere(radius), 4.0 * PI * radius * radius),
            Form::Disk(radius) => (shapes::disk(radius), PI * radius * radius),
            Form::Rectangle(width, height) => (shapes::rectangle(width, height), width * height),
            Form::Cylinder(radius, length) => (
                shapes::along("X", shapes::cylinder(radius, length, false)),
                2.0 * PI * radius * length,
            ),
        };
        // Flat pieces have less area than what they stand for: a little larger, they send as much.
        let own = area_at(&surface, &DAffine3::IDENTITY);
        let grown = if own > 0.0 { (area / own).sqrt() } else { 1.0 };
        for position in &mut surface.positions {
            *position = (Vec3::from(*position).as_dvec3() * grown).as_vec3().to_array();
        }
        let size = if self.normalized { area_at(&surface, place) } else { 1.0 };
        let material = Material {
            albedo: [0.0; 3],
            emission: self.strength(if size > 0.0 { 1.0 / size } else { 0.0 }),
            double_sided: false,
            ..Material::default()
        };
        Put::Surface(Box::new(surface), Box::new(material))
    }

    fn strength(&self, factor: f64) -> [f32; 3] {
        self.radiance.map(|radiance| (radiance * factor) as f32)
    }

    fn distant(&self, angle: f64, place: &DAffine3) -> Light {
        let sine = angle.sin();
        let facing = PI * if angle > FRAC_PI_2 { 1.0 } else { sine * sine };
        let factor = match angle == 0.0 {
            true => 1.0,
            false if !self.normalized => facing,
            false if angle > FRAC_PI_2 => facing / ((2.0 - sine * sine) * PI),
            false => 1.0,
        };
        Light {
            kind: LightKind::Directional,
            intensity: self.strength(factor),
            position: Vec3::ZERO,
            direction: forward_of(place).as_vec3(),
            range: None,
        }
    }

    fn point(&self, radius: f64, cone: Option<[f32; 2]>, place: &DAffine3) -> Light {
        let radius = radius * scale_of(place);
        let disc = PI * radius * radius;
        let factor = match (self.normalized, disc > 0.0) {
            // The disc's share of the sphere, however small that is.
            (true, _) => 0.25,
            (false, true) => disc,
            // Nothing is there to multiply the intensity with.
            (false, false) => 1.0,
        };
        Light {
            kind: match cone {
                None => LightKind::Point,
                Some([cos_inner, cos_outer]) => LightKind::Spot { cos_inner, cos_outer },
            },
            intensity: self.strength(factor),
            position: place.translation.as_vec3(),
            direction: forward_of(place).as_vec3(),
            range: None,
        }
    }
}

fn area_at(shape: &Geometry, place: &DAffine3) -> f64 {
    let area = |triangle: usize| {
        let corners = shape
            .corners(triangle)
            .map(|corner| place.transform_point3(corner.as_dvec3()));
        area_vector(&corners).length()
    };
    (0..shape.triangles.len()).map(area).sum()
}

/// Colour of a black body of this temperature, kelvin, beside that of 6500, in linear light of sRGB's primaries and of unit
/// luminance: Planck's law seen through approximate matching functions (Wyman, Sloan and Shirley 2013).
fn blackbody(kelvin: f64) -> [f64; 3] {
    let white = body_color(6500.0);
    let color = body_color(kelvin.clamp(1000.0, 10_000.0));
    let color: [f64; 3] = std::array::from_fn(|at| (color[at] / white[at]).max(0.0));
    let luminance = LUMINANCE
        .iter()
        .zip(color)
        .map(|(share, value)| share * value)
        .sum::<f64>();
    color.map(|value| value / luminance)
}

/// Shares of red, green and blue in luminance.
const LUMINANCE: [f64; 3] = [0.2126, 0.7152, 0.0722];

fn body_color(kelvin: f64) -> [f64; 3] {
    /// Second radiation constant, nanometres times kelvin.
    const RADIATION: f64 = 1.438_776_9e7;
    let lobe = |wave: f64, middle: f64, below: f64, above: f64| {
        let off = (wave - middle) * if wave < middle { below } else { above };
        (-0.5 * off * off).exp()
    };
    let mut xyz = DVec3::ZERO;
    for wave in (380..=780).step_by(5).map(f64::from) {
        let power = (wave / 560.0).powi(-5) / ((RADIATION / (wave * kelvin)).exp() - 1.0);
        let x = 1.056 * lobe(wave, 599.8, 0.0264, 0.0323) + 0.362 * lobe(wave, 442.0, 0.0624, 0.0374)
            - 0.065 * lobe(wave, 501.1, 0.0490, 0.0382);
        let y = 0.821 * lobe(wave, 568.8, 0.0213, 0.0247) + 0.286 * lobe(wave, 530.9, 0.0613, 0.0322);
        let z = 1.217 * lobe(wave, 437.0, 0.0845, 0.0278) + 0.681 * lobe(wave, 459.0, 0.0385, 0.0725);
        xyz += DVec3::new(x, y, z) * power;
    }
    let [x, y, z] = xyz.to_array();
    [
        3.240_97 * x - 1.537_38 * y - 0.498_61 * z,
        -0.969_24 * x + 1.875_97 * y + 0.041_56 * z,
        0.055_63 * x - 0.203_98 * y + 1.056_97 * z,
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lamp(form: Form, normalized: bool) -> Lamp {
        Lamp {
            form,
            radiance: [6.0, 3.0, 0.0],
            normalized,
        }
    }

    fn light(lamp: &Lamp, place: &DAffine3) -> Light {
        match lamp.put(place) {
            Put::Light(light) => light,
            Put::Surface(..) => panic!("it is a surface"),
        }
    }

    /// What a surface sends in all, over pi.
    fn sent(lamp: &Lamp, place: &DAffine3) -> f64 {
        match lamp.put(place) {
            Put::Light(_) => panic!("it has no surface"),
            Put::Surface(shape, material) => f64::from(material.emission[0]) * area_at(&shape, place),
        }
    }

    #[test]
    fn surfaces_send_radiance_times_area_or_as_much_at_any_size() {
        let twice = DAffine3::from_scale(DVec3::splat(2.0));
        for (form, area) in [
            (Form::Sphere(0.5), PI),
            (Form::Disk(1.0), PI),
            (Form::Rectangle(2.0, 3.0), 6.0),
            (Form::Cylinder(0.5, 2.0), 2.0 * PI),
        ] {
            let [full, even] = [false, true].map(|normalized| lamp(form.clone(), normalized));
            assert!((sent(&full, &DAffine3::IDENTITY) / (6.0 * area) - 1.0).abs() < 1e-5);
            assert!((sent(&full, &twice) / (24.0 * area) - 1.0).abs() < 1e-5);
            assert!((sent(&even, &DAffine3::IDENTITY) / 6.0 - 1.0).abs() < 1e-5);
            assert!((sent(&even, &twice) / 6.0 - 1.0).abs() < 1e-5);
        }
    }

    #[test]
    fn distant_lights_bring_what_their_disc_in_the_sky_brings() {
        let facing = |angle: f64, normalized| {
            let lamp = lamp(Form::Distant(angle), normalized);
            f64::from(light(&lamp, &DAffine3::IDENTITY).intensity[0]) / 6.0
        };
        assert_eq!((facing(0.0, false), facing(0.0, true)), (1.0, 1.0));
        assert!((facing(0.3, false) - PI * 0.3f64.sin().powi(2)).abs() < 1e-6);
        assert!((facing(0.3, true) - 1.0).abs() < 1e-6);
        assert!((facing(PI, false) - PI).abs() < 1e-6 && (facing(PI, true) - 0.5).abs() < 1e-6);
    }

    #[test]
    fn points_have_what_the_disc_of_their_sphere_sends() {
        let point = |radius, normalized| lamp(Form::Point { radius, cone: None }, normalized);
        let (here, twice) = (DAffine3::IDENTITY, DAffine3::from_scale(DVec3::splat(2.0)));
        assert!((light(&point(0.5, false), &here).intensity[0] - 6.0 * PI as f32 / 4.0).abs() < 1e-5);
        assert!((light(&point(0.5, false), &twice).intensity[0] - 6.0 * PI as f32).abs() < 1e-5);
        assert_eq!(light(&point(0.5, true), &twice).intensity, [1.5, 0.75, 0.0]);
        assert_eq!(light(&point(0.0, true), &here).intensity, [1.5, 0.75, 0.0]);
        assert_eq!(light(&point(0.0, false), &here).intensity, [6.0, 3.0, 0.0]);
    }
}
