//! Spheres, cubes, cylinders, cones and planes as triangles, in their own space.

use super::values::Values;
use crate::error::PointsError;
use crate::geometry::Geometry;
use glam::{DAffine3, DVec3, Vec3};
use openusd::usd::Prim;
use std::f64::consts::{PI, TAU};

/// Pieces around an axis: as round as points on it can show.
const AROUND: usize = 48;
/// Pieces from pole to pole of a sphere.
const ALONG: usize = 24;

/// A circle of a surface of revolution.
#[derive(Clone, Copy)]
struct Rim {
    radius: f64,
    height: f64,
    /// Of the surface: away from the axis, along it.
    normal: [f64; 2],
}

/// The shape of a prim of this type, all of one material; `None` for other types.
pub(super) fn read(values: &Values, prim: &Prim, kind: &str, material: u32) -> Result<Option<Geometry>, PointsError> {
    let length = |name: &str, missing: f64| values.length(prim, name, missing);
    let axis = || values.token(prim, "axis").map(|axis| axis.unwrap_or_default());
    let shape = match kind {
        "Sphere" => sphere(length("radius", 1.0)?),
        "Cube" => cube(length("size", 2.0)?),
        "Cylinder" => along(&axis()?, cylinder(length("radius", 1.0)?, length("height", 2.0)?, true)),
        "Cone" => along(&axis()?, cone(length("radius", 1.0)?, length("height", 2.0)?)),
        "Plane" => plane(&axis()?, length("width", 2.0)?, length("length", 2.0)?),
        _ => return Ok(None),
    };
    let mut geometry = Geometry::default();
    geometry.append(values.file(), &dressed(shape, material), &DAffine3::IDENTITY)?;
    Ok(Some(geometry))
}

/// All triangles of one material.
fn dressed(mut shape: Geometry, material: u32) -> Geometry {
    shape.materials = vec![material; shape.triangles.len()];
    shape
}

pub(super) fn sphere(radius: f64) -> Geometry {
    let rim = |ring: usize| {
        let (sine, cosine) = (PI * ring as f64 / ALONG as f64).sin_cos();
        // The poles are points, whatever the sine of pi is.
        let sine = if ring == ALONG { 0.0 } else { sine };
        Rim {
            radius: radius * sine,
            height: -radius * cosine,
            normal: [sine, -cosine],
        }
    };
    let profile: Vec<Rim> = (0..=ALONG).map(rim).collect();
    revolve(&[&profile])
}

/// Around z, its middle at the origin.
pub(super) fn cylinder(radius: f64, height: f64, closed: bool) -> Geometry {
    let rim = |radius: f64, up: f64, normal: [f64; 2]| Rim {
        radius,
        height: up * height / 2.0,
        normal,
    };
    let side = [rim(radius, -1.0, [1.0, 0.0]), rim(radius, 1.0, [1.0, 0.0])];
    let bottom = [rim(0.0, -1.0, [0.0, -1.0]), rim(radius, -1.0, [0.0, -1.0])];
    let top = [rim(radius, 1.0, [0.0, 1.0]), rim(0.0, 1.0, [0.0, 1.0])];
    match closed {
        true => revolve(&[&bottom, &side, &top]),
        false => revolve(&[&side]),
    }
}

/// Around z, its tip up.
fn cone(radius: f64, height: f64) -> Geometry {
    let slope = DVec3::new(height, radius, 0.0).normalize_or(DVec3::X);
    let rim = |radius: f64, up: f64, normal: [f64; 2]| Rim {
        radius,
        height: up * height / 2.0,
        normal,
    };
    let side = [rim(radius, -1.0, [slope.x, slope.y]), rim(0.0, 1.0, [slope.x, slope.y])];
    let bottom = [rim(0.0, -1.0, [0.0, -1.0]), rim(radius, -1.0, [0.0, -1.0])];
    revolve(&[&bottom, &side])
}

/// In the plane z = 0, facing along -z as lights do.
pub(super) fn disk(radius: f64) -> Geometry {
    let rim = |radius: f64| Rim {
        radius,
        height: 0.0,
        normal: [0.0, -1.0],
    };
    revolve(&[&[rim(0.0), rim(radius)]])
}

/// In the plane z = 0, facing along -z as lights do.
pub(super) fn rectangle(width: f64, height: f64) -> Geometry {
    let (x, y) = (width / 2.0, height / 2.0);
    let corners = [[-x, -y], [-x, y], [x, y], [x, -y]];
    Geometry {
        positions: corners.map(|[x, y]| [x as f32, y as f32, 0.0]).to_vec(),
        triangles: vec![[0, 1, 2], [0, 2, 3]],
        ..Geometry::default()
    }
}

fn cube(size: f64) -> Geometry {
    let half = (size / 2.0) as f32;
    let mut cube = Geometry::default();
    for axis in 0..3 {
        for sign in [-1.0, 1.0] {
            let mut normal = Vec3::ZERO;
            normal[axis] = sign;
            let (mut u, mut v) = (Vec3::ZERO, Vec3::ZERO);
            (u[(axis + 1) % 3], v[(axis + 2) % 3]) = (sign, 1.0);
            let base = cube.positions.len() as u32;
            for corner in [-u - v, u - v, u + v, v - u] {
                cube.positions.push(((normal + corner) * half).to_array());
                cube.normals.push(normal.to_array());
            }
            cube.triangles
                .extend([[0, 1, 2], [0, 2, 3]].map(|corners| corners.map(|corner| base + corner)));
        }
    }
    cube
}

fn plane(axis: &str, width: f64, length: f64) -> Geometry {
    let (w, l) = ((width / 2.0) as f32, (length / 2.0) as f32);
    let corner = |along: f32, across: f32| match axis {
        "X" => [0.0, across * l, along * -w],
        "Y" => [along * w, 0.0, across * -l],
        _ => [along * w, across * l, 0.0],
    };
    Geometry {
        positions: vec![
            corner(-1.0, -1.0),
            corner(1.0, -1.0),
            corner(1.0, 1.0),
            corner(-1.0, 1.0),
        ],
        triangles: vec![[0, 1, 2], [0, 2, 3]],
        ..Geometry::default()
    }
}

/// What stands around z, around another axis; z is the fallback of the schemas.
pub(super) fn along(axis: &str, mut shape: Geometry) -> Geometry {
    let turned = |[x, y, z]: [f32; 3]| match axis {
        "X" => [z, x, y],
        "Y" => [y, z, x],
        _ => [x, y, z],
    };
    let lists = [&mut shape.positions, &mut shape.normals];
    lists.into_iter().flatten().for_each(|vector| *vector = turned(*vector));
    shape
}

/// Surfaces around z: each profile, walked along, has its front to the right.
fn revolve(profiles: &[&[Rim]]) -> Geometry {
    let mut surface = Geometry::default();
    for profile in profiles {
        let base = surface.positions.len() as u32;
        for rim in *profile {
            for step in 0..AROUND {
                let (y, x) = (TAU * step as f64 / AROUND as f64).sin_cos();
                let ring = |away: f64, up: f64| DVec3::new(x * away, y * away, up).as_vec3().to_array();
                surface.positions.push(ring(rim.radius, rim.height));
                surface.normals.push(ring(rim.normal[0], rim.normal[1]));
            }
        }
        let around = AROUND as u32;
        for ring in 0..(profile.len() as u32).saturating_sub(1) {
            for step in 0..around {
                let vertex = |ring: u32, step: u32| base + ring * around + step % around;
                let (a, b) = (vertex(ring, step), vertex(ring, step + 1));
                let (c, d) = (vertex(ring + 1, step + 1), vertex(ring + 1, step));
                surface.triangles.extend([[a, b, c], [a, c, d]]);
            }
        }
    }
    surface
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::area_vector;

    /// Area and enclosed volume; the latter is negative if fronts face inwards.
    fn measure(shape: &Geometry) -> (f64, f64) {
        let (mut area, mut volume) = (0.0, 0.0);
        for triangle in 0..shape.triangles.len() {
            let corners = shape.corners(triangle).map(|corner| corner.as_dvec3());
            let vector = area_vector(&corners);
            area += vector.length();
            volume += vector.dot(corners[0]) / 3.0;
            let normal = shape.vertex_normal(triangle, [0.3, 0.3]);
            assert!(vector.length() < 1e-12 || normal.is_none_or(|normal| normal.as_dvec3().dot(vector) > 0.0));
        }
        (area, volume)
    }

    #[test]
    fn shapes_have_their_area_and_face_outwards() {
        let near = |shape: Geometry, area: f64, volume: f64| {
            let found = measure(&shape);
            let close = |a: f64, b: f64| (a - b).abs() <= 0.02 * b.abs() + 1e-9;
            assert!(
                close(found.0, area) && close(found.1, volume),
                "{found:?} for {area} {volume}"
            );
        };
        near(sphere(2.0), 16.0 * PI, 32.0 / 3.0 * PI);
        near(cube(2.0), 24.0, 8.0);
        near(cylinder(1.0, 3.0, true), 8.0 * PI, 3.0 * PI);
        near(along("X", cylinder(1.0, 3.0, true)), 8.0 * PI, 3.0 * PI);
        near(cone(3.0, 4.0), 24.0 * PI, 12.0 * PI);
        near(disk(1.0), PI, 0.0);
        near(rectangle(2.0, 3.0), 6.0, 0.0);
        for (axis, up) in [("X", DVec3::X), ("Y", DVec3::Y), ("Z", DVec3::Z)] {
            let plane = plane(axis, 2.0, 3.0);
            let corners = plane.corners(0).map(|corner| corner.as_dvec3());
            assert!(area_vector(&corners).distance(up * 3.0) < 1e-9, "{axis}");
        }
        for light in [disk(1.0), rectangle(1.0, 1.0)] {
            let facing = |triangle| area_vector(&light.corners(triangle).map(|corner| corner.as_dvec3())).z;
            assert!((0..light.triangles.len()).all(|triangle| facing(triangle) <= 0.0));
        }
    }
}
