//! Where something is: translation, rotation and scale, or a matrix.

use glam::{DAffine3, DMat3, DMat4, DQuat, DVec3};
use serde::Deserialize;

/// A transform as it is written.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Transform {
    pub(super) translate: Option<[f64; 3]>,
    /// Degrees about x, then y, then z.
    pub(super) rotate: Option<[f64; 3]>,
    pub(super) scale: Option<Scale>,
    /// Row by row.
    pub(super) matrix: Option<[f64; 16]>,
}

#[derive(Clone, Copy, Deserialize)]
#[serde(untagged, expecting = "scale is no number and no list of three numbers")]
pub(super) enum Scale {
    Uniform(f64),
    Axes([f64; 3]),
}

impl Transform {
    /// What it does to points.
    ///
    /// # Errors
    /// What is wrong with it.
    pub(super) fn matrix(&self) -> Result<DAffine3, String> {
        let affine = match &self.matrix {
            Some(_) if self.translate.is_some() || self.rotate.is_some() || self.scale.is_some() => {
                return Err("matrix stands for translate, rotate and scale: leave out one or the other".to_owned());
            }
            Some(rows) => {
                if rows[12..] != [0.0, 0.0, 0.0, 1.0] {
                    return Err("the last row of matrix must be 0, 0, 0, 1: write it row by row".to_owned());
                }
                DAffine3::from_mat4(DMat4::from_cols_array(rows).transpose())
            }
            None => {
                let scale = match self.scale {
                    None => DVec3::ONE,
                    Some(Scale::Uniform(factor)) => DVec3::splat(factor),
                    Some(Scale::Axes(factors)) => DVec3::from(factors),
                };
                let [x, y, z] = self.rotate.unwrap_or_default().map(f64::to_radians);
                let turn = DQuat::from_rotation_z(z) * DQuat::from_rotation_y(y) * DQuat::from_rotation_x(x);
                DAffine3 {
                    matrix3: DMat3::from_quat(turn) * DMat3::from_diagonal(scale),
                    translation: DVec3::from(self.translate.unwrap_or_default()),
                }
            }
        };
        let size = affine.matrix3.determinant();
        if !(affine.is_finite() && size.is_finite() && size != 0.0) {
            return Err(
                "the transform flattens or is not finite: scale must be other than 0, and all numbers finite"
                    .to_owned(),
            );
        }
        Ok(affine)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn affine(text: &str) -> Result<DAffine3, String> {
        toml::from_str::<Transform>(text).unwrap().matrix()
    }

    #[test]
    fn points_are_scaled_then_turned_then_moved() {
        let place = affine("translate = [10, 0, 0]\nrotate = [0, 90, 0]\nscale = [2, 1, 1]").unwrap();
        // x is doubled, turned to -z, moved along x.
        assert!(place.transform_point3(DVec3::X).distance(DVec3::new(10.0, 0.0, -2.0)) < 1e-12);
        let both = affine("rotate = [90, 0, 90]").unwrap();
        assert!(
            both.transform_point3(DVec3::Y).distance(DVec3::Z) < 1e-12,
            "about x first"
        );
        let rows = affine("matrix = [1, 0, 0, 5, 0, 1, 0, 6, 0, 0, 1, 7, 0, 0, 0, 1]").unwrap();
        assert_eq!(rows.transform_point3(DVec3::ZERO), DVec3::new(5.0, 6.0, 7.0));
    }

    #[test]
    fn what_makes_no_sense_is_told() {
        for (text, word) in [
            ("scale = 0", "flattens"),
            ("scale = [1, nan, 1]", "finite"),
            ("translate = [inf, 0, 0]", "finite"),
            (
                "scale = 2\nmatrix = [1, 0, 0, 5, 0, 1, 0, 6, 0, 0, 1, 7, 0, 0, 0, 1]",
                "leave out",
            ),
            (
                "matrix = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1]",
                "row by row",
            ),
        ] {
            let error = affine(text).unwrap_err();
            assert!(error.contains(word), "{text}: {error}");
        }
    }
}
