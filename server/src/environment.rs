//! The environment map as workers get it: small enough for a message, and finer than a raster can tell.

use crate::limits::ENVIRONMENT_WIDTH_MAX;
use pbgi_core::Environment;
use std::f64::consts::PI;

/// Averages a map down until it is at most [`ENVIRONMENT_WIDTH_MAX`] wide. Pixels count by their solid angle, so no light is
/// lost or made.
pub fn shrink(environment: Environment) -> Environment {
    let factor = environment.width().div_ceil(ENVIRONMENT_WIDTH_MAX);
    if factor <= 1 {
        return environment;
    }
    let (width, height) = (
        environment.width().div_ceil(factor),
        environment.height().div_ceil(factor),
    );
    let weight = |row: u32, rows: u32| {
        let edge = |row: u32| (PI * f64::from(row) / f64::from(rows)).cos();
        edge(row) - edge(row + 1)
    };
    let source = environment.pixels();
    let columns = environment.width();
    let mut pixels = Vec::with_capacity(width as usize * height as usize);
    for y in 0..height {
        for x in 0..width {
            let rows = y * factor..((y + 1) * factor).min(environment.height());
            let mut sum = [0.0; 3];
            let mut total = 0.0;
            for row in rows {
                let weight = weight(row, environment.height());
                for column in x * factor..((x + 1) * factor).min(columns) {
                    let pixel = source[row as usize * columns as usize + column as usize];
                    total += weight;
                    for (sum, value) in sum.iter_mut().zip(pixel) {
                        *sum += weight * f64::from(value);
                    }
                }
            }
            pixels.push(sum.map(|sum| (sum / total) as f32));
        }
    }
    // An average of radiances is one, and the size is right.
    Environment::new(width, height, pixels).unwrap_or(environment)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flux(environment: &Environment) -> f64 {
        let (width, height) = (environment.width() as usize, f64::from(environment.height()));
        let edge = |row: usize| (PI * row as f64 / height).cos();
        let row_flux = |(row, pixels): (usize, &[[f32; 3]])| {
            let sum: f64 = pixels.iter().map(|pixel| f64::from(pixel[1])).sum();
            sum * (edge(row) - edge(row + 1)) * 2.0 * PI / width as f64
        };
        environment.pixels().chunks(width).enumerate().map(row_flux).sum()
    }

    #[test]
    fn small_maps_stay_and_large_ones_keep_their_light() {
        let map = |width: u32, height: u32| {
            let pixels = (0..width * height)
                .map(|index| [(index % 97) as f32, (index % 1013) as f32, 1.0])
                .collect();
            Environment::new(width, height, pixels).unwrap()
        };
        assert_eq!(shrink(map(512, 256)), map(512, 256));
        let large = map(2048, 1024);
        let small = shrink(large.clone());
        assert_eq!((small.width(), small.height()), (512, 256));
        let (before, after) = (flux(&large), flux(&small));
        assert!((before - after).abs() < 1e-4 * before, "{before} {after}");
    }
}
