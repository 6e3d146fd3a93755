//! The light probe as the raster samples it: radiance on an octahedral map whose texels are about as wide as a raster bit,
//! so that one lookup a bit neither misses a small sun nor blurs it further than the raster does.

use glam::Vec3;
use pbgi_core::Environment;
use std::f32::consts::PI;

/// Texels along the edge for a raster of `resolution` rows: `8 / 3` of it makes a texel cover the solid angle of a bit.
fn edge_of(resolution: usize) -> usize {
    (resolution * 2).max(32)
}

/// Prefiltered radiance by direction.
#[derive(Clone, Debug)]
pub(crate) struct ProbeMap {
    edge: usize,
    texels: Vec<Vec3>,
}

impl ProbeMap {
    /// Averages a latitude-longitude picture into texels by solid angle, each texel from at least four samples.
    pub(crate) fn new(environment: &Environment, resolution: usize) -> Self {
        let edge = edge_of(resolution);
        let (width, height) = (environment.width() as usize, environment.height() as usize);
        let mut sums = vec![Vec3::ZERO; edge * edge];
        let mut weights = vec![0.0f32; edge * edge];
        // Small pictures are walked in steps finer than their pixels, so that no texel stays empty.
        let (columns, rows) = (width.max(edge * 8), height.max(edge * 4));
        for row in 0..rows {
            let theta = (row as f32 + 0.5) / rows as f32 * PI;
            let (sin, cos) = theta.sin_cos();
            for column in 0..columns {
                let phi = (column as f32 + 0.5) / columns as f32 * 2.0 * PI;
                let direction = Vec3::new(-sin * phi.cos(), cos, -sin * phi.sin());
                let texel = texel_of(direction, edge);
                let pixel = row * height / rows * width + column * width / columns;
                sums[texel] += Vec3::from(environment.pixels()[pixel]) * sin;
                weights[texel] += sin;
            }
        }
        let texels = sums
            .into_iter()
            .zip(weights)
            .map(|(sum, weight)| sum / weight.max(f32::MIN_POSITIVE))
            .collect();
        Self { edge, texels }
    }

    /// Radiance from a direction, unit, world space.
    #[inline(always)]
    pub(crate) fn radiance(&self, direction: Vec3) -> Vec3 {
        self.texels[texel_of(direction, self.edge)]
    }
}

#[inline(always)]
fn texel_of(d: Vec3, edge: usize) -> usize {
    let scale = 1.0 / (d.x.abs() + d.y.abs() + d.z.abs());
    let (x, z) = (d.x * scale, d.z * scale);
    let (u, v) = if d.y >= 0.0 {
        (x, z)
    } else {
        ((1.0 - z.abs()).copysign(x), (1.0 - x.abs()).copysign(z))
    };
    let place = |value: f32| (((value + 1.0) * 0.5 * edge as f32) as usize).min(edge - 1);
    place(v) * edge + place(u)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_constant_sky_stays_constant() {
        let sky = Environment::new(4, 2, vec![[1.0, 2.0, 3.0]; 8]).unwrap();
        let map = ProbeMap::new(&sky, 64);
        assert!(
            map.texels
                .iter()
                .all(|texel| texel.distance(Vec3::new(1.0, 2.0, 3.0)) < 1e-4)
        );
    }

    #[test]
    fn directions_follow_the_latitude_longitude_convention() {
        let mut pixels = vec![[0.0; 3]; 64 * 32];
        for (i, pixel) in pixels.iter_mut().enumerate() {
            let (row, column) = (i / 64, i % 64);
            *pixel = [
                f32::from(row < 4),
                f32::from((28..36).contains(&column)),
                f32::from((12..20).contains(&column)),
            ];
        }
        let map = ProbeMap::new(&Environment::new(64, 32, pixels).unwrap(), 64);
        assert_eq!(map.radiance(Vec3::Y).x, 1.0);
        assert_eq!(map.radiance(Vec3::X), Vec3::new(0.0, 1.0, 0.0));
        assert_eq!(map.radiance(-Vec3::Z), Vec3::new(0.0, 0.0, 1.0));
    }
}
