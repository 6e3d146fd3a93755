//! Light from far away that a scene has: a picture of it, how that is turned, and what it is multiplied with.

use crate::error::PointsError;
use crate::image::{LayeredImage, Precision, read_environment};
use glam::{DAffine3, Mat3, Vec3};
use pbgi_core::Environment;
use std::f32::consts::{PI, TAU};
use std::path::{Path, PathBuf};

/// Pixels of a picture that is the same everywhere.
const EVEN_SIZE: [u32; 2] = [8, 4];

/// What surrounds a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Surroundings {
    /// A latitude-longitude picture; white without.
    picture: Option<PathBuf>,
    /// Factor of each channel.
    factor: [f32; 3],
    /// Turns directions of the picture into the world's.
    world_from_picture: Mat3,
}

impl Surroundings {
    /// A picture as it is.
    pub(crate) fn picture(path: PathBuf) -> Self {
        Self {
            picture: Some(path),
            factor: [1.0; 3],
            world_from_picture: Mat3::IDENTITY,
        }
    }

    /// A picture, or white, times a factor.
    #[cfg(feature = "usd")]
    pub(crate) fn times(picture: Option<PathBuf>, factor: [f32; 3]) -> Self {
        Self {
            picture,
            factor,
            world_from_picture: Mat3::IDENTITY,
        }
    }

    /// As they are where `place` brings the scene: turned with it.
    pub(crate) fn moved(self, place: &DAffine3) -> Self {
        let (_, turn, _) = place.to_scale_rotation_translation();
        Self {
            world_from_picture: Mat3::from_quat(turn.as_quat()) * self.world_from_picture,
            ..self
        }
    }

    /// The picture, if it is taken as it is.
    pub fn file(&self) -> Option<&Path> {
        let plain = self.factor == [1.0; 3] && self.world_from_picture.abs_diff_eq(Mat3::IDENTITY, 1e-6);
        self.picture.as_deref().filter(|_| plain)
    }

    /// The picture turned and multiplied: one that [`Self::file`] would be.
    ///
    /// # Errors
    /// The picture cannot be read.
    pub fn bake(&self) -> Result<LayeredImage, PointsError> {
        let picture = self.picture.as_deref().map(read_environment).transpose()?;
        let [width, height] = picture
            .as_ref()
            .map_or(EVEN_SIZE, |picture| [picture.width(), picture.height()]);
        let picture_from_world = self.world_from_picture.transpose();
        let pixels = (0..height).flat_map(|row| (0..width).map(move |column| (column, row)));
        let baked: Vec<[f32; 3]> = pixels
            .map(|(column, row)| {
                let direction = direction((column as f32 + 0.5) / width as f32, (row as f32 + 0.5) / height as f32);
                let seen = picture
                    .as_ref()
                    .map_or(Vec3::ONE, |picture| sample(picture, picture_from_world * direction));
                (seen * Vec3::from(self.factor)).to_array()
            })
            .collect();
        let mut image = LayeredImage::new(width, height);
        image.add_rgb("", Precision::Float, &baked);
        Ok(image)
    }
}

/// Where a place of a picture, 0 to 1 along both edges, looks: [`Environment`]'s convention.
fn direction(across: f32, down: f32) -> Vec3 {
    let ((sine, cosine), (level, up)) = ((TAU * across).sin_cos(), (PI * down).sin_cos());
    Vec3::new(-cosine * level, up, -sine * level)
}

/// Radiance from a direction, bilinear.
fn sample(picture: &Environment, direction: Vec3) -> Vec3 {
    let (width, height) = (picture.width() as i64, picture.height() as i64);
    let across = (-direction.z).atan2(-direction.x) / TAU;
    let down = direction.y.clamp(-1.0, 1.0).acos() / PI;
    let (x, y) = (across * width as f32 - 0.5, down * height as f32 - 0.5);
    let (left, top) = (x.floor(), y.floor());
    let pixel = |column: i64, row: i64| {
        let at = row.clamp(0, height - 1) * width + column.rem_euclid(width);
        Vec3::from(picture.pixels()[at as usize])
    };
    let (column, row) = (left as i64, top as i64);
    let line = |row: i64| pixel(column, row).lerp(pixel(column + 1, row), x - left);
    line(row).lerp(line(row + 1), y - top)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_and_directions_are_inverse() {
        let pixels = (0..128).map(|index| [index as f32, 0.0, 1.0]).collect();
        let picture = Environment::new(16, 8, pixels).unwrap();
        for (column, row) in [(0, 0), (3, 2), (8, 4), (15, 7)] {
            let direction = direction((column as f32 + 0.5) / 16.0, (row as f32 + 0.5) / 8.0);
            let seen = sample(&picture, direction);
            assert!((seen.x - (row * 16 + column) as f32).abs() < 1e-2, "{seen}");
        }
        assert!(direction(0.5, 0.5).distance(Vec3::X) < 1e-6 && direction(0.25, 0.5).distance(Vec3::NEG_Z) < 1e-6);
    }

    #[test]
    fn a_quarter_turn_moves_columns_by_a_quarter() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("sky.exr");
        let pixels: Vec<[f32; 3]> = (0..32).map(|index| [(index % 8) as f32, 1.0, 2.0]).collect();
        let mut image = LayeredImage::new(8, 4);
        image.add_rgb("", Precision::Float, &pixels);
        image.write_exr(&file).unwrap();
        let plain = Surroundings::picture(file.clone());
        assert_eq!(plain.file(), Some(file.as_path()));
        let turned = Surroundings {
            factor: [2.0, 1.0, 0.5],
            ..plain.moved(&DAffine3::from_rotation_y(std::f64::consts::FRAC_PI_2))
        };
        assert_eq!(turned.file(), None);
        let baked = turned.bake().unwrap().triple("").unwrap();
        for (index, found) in baked.iter().enumerate() {
            // What was along +x, the middle, is now along -z, a quarter.
            let expected = [2.0 * ((index + 2) % 8) as f32, 1.0, 1.0];
            assert!(
                Vec3::from(*found).distance(Vec3::from(expected)) < 1e-3,
                "{index}: {found:?} {expected:?}"
            );
        }
    }
}
