//! Point clouds as files have them: `Cloud`, a stream whose points may lack normals or radii, and what all readers share.

pub(crate) mod las;
pub(crate) mod ptc;
pub(crate) mod scene_points;

use crate::error::PointsError;
use pbgi_core::point::Reflectance;
use pbgi_core::{InvalidPoint, PointRecord, PointStream};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// How clouds become points of a scene.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CloudOptions {
    /// Subtracted from every position of a cloud, in the file's own axes, before it is rounded to `f32`. `None`: zero, or
    /// for LAS inputs whose coordinates are too large for `f32` the lower corner, rounded down to whole thousands.
    pub origin: Option<[f64; 3]>,
    /// What happens to points that cannot be used.
    pub invalid_points: InvalidPoints,
    /// Whether boxes that headers declare are disbelieved and the points measured.
    pub recompute_bounds: bool,
    /// Estimates a normal for every point from its neighbours, turned to this side. Normals of the file are not looked at.
    pub estimate_normals: Option<Facing>,
    /// Where the radii of points come from whose file has none.
    pub radius: Option<Radius>,
    /// Albedo of points that have none, 0 to 1, of both sides: without one they reflect nothing that other surfaces send.
    pub albedo: Option<f32>,
}

/// What happens to points that cannot be used.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum InvalidPoints {
    /// The input is refused, with their number and the first of them.
    #[default]
    Refuse,
    /// They are dropped and counted.
    Skip,
}

/// Which of its two sides a normal that was estimated points to.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Facing {
    /// Up for aerial scans (LAS), outward for all others.
    Auto,
    /// Up: +y.
    Up,
    /// Out of the body that the points enclose; where they enclose none, away from the middle of their box, or the one way for a
    /// whole sheet.
    Outward,
    /// To a point: world space, such as where the scanner stood.
    Viewpoint([f32; 3]),
}

/// Radii for points whose file has none.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Radius {
    /// From the distances to their neighbours.
    Estimate,
    /// The same for all, world units.
    Fixed(f32),
}

/// What the points of a file do not have.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Missing {
    pub(crate) normals: bool,
    pub(crate) radii: bool,
}

/// A cloud file. A point that lacks its normal or radius has [`NORMAL_PLACEHOLDER`] or [`RADIUS_PLACEHOLDER`] there.
pub(crate) trait Cloud: PointStream<Error = PointsError> + Send {
    /// The same for all points of a file.
    fn missing(&self) -> Missing;

    /// Points dropped since the start of this reading.
    fn skipped(&self) -> u64;

    /// From now on points carry their place in the file instead of their light: see [`place_of`].
    fn number(&mut self);

    /// Whether the scan was made from above.
    fn is_aerial(&self) -> bool {
        false
    }
}

/// The point with its place in the file where its radiance was.
fn numbered(point: PointRecord, place: u64) -> PointRecord {
    PointRecord {
        front_code: place as u32,
        back_code: (place >> 32) as u32,
        ..point
    }
}

/// Place in its file of a point that a numbered cloud gave.
pub(crate) fn place_of(point: &PointRecord) -> u64 {
    u64::from(point.back_code) << 32 | u64::from(point.front_code)
}

pub(crate) const NORMAL_PLACEHOLDER: [f32; 3] = [0.0, 1.0, 0.0];
pub(crate) const RADIUS_PLACEHOLDER: f32 = 1.0;

/// Lets the usable points of a file in, and keeps count of the others: all of a file are looked at before it is refused.
pub(crate) struct Door {
    policy: InvalidPoints,
    path: PathBuf,
    /// Points that the file announces.
    count: u64,
    seen: u64,
    invalid: u64,
    first: Option<(u64, InvalidPoint)>,
    numbers: bool,
    albedo: Option<Reflectance>,
}

impl Door {
    pub(crate) fn new(path: &Path, count: u64, options: &CloudOptions) -> Self {
        Self {
            policy: options.invalid_points,
            albedo: options.albedo.map(|albedo| Reflectance {
                albedo: [albedo; 3],
                both_sides: true,
            }),
            path: path.to_owned(),
            count,
            seen: 0,
            invalid: 0,
            first: None,
            numbers: false,
        }
    }

    /// See [`Cloud::number`].
    pub(crate) fn number(&mut self) {
        self.numbers = true;
    }

    /// Takes the next point of the file.
    #[inline]
    pub(crate) fn take(&mut self, point: Result<PointRecord, InvalidPoint>, batch: &mut Vec<PointRecord>) {
        match point {
            Ok(point) if self.numbers => batch.push(numbered(point, self.seen)),
            Ok(point) => batch.push(match self.albedo {
                Some(reflectance) if !point.reflects() => point.with_reflectance(reflectance),
                _ => point,
            }),
            Err(reason) => self.turn_away(reason),
        }
        self.seen += 1;
    }

    #[cold]
    fn turn_away(&mut self, reason: InvalidPoint) {
        self.invalid += 1;
        self.first.get_or_insert((self.seen, reason));
    }

    /// At the end of the file.
    pub(crate) fn close(&self) -> Result<(), PointsError> {
        match (&self.first, self.policy) {
            (Some((index, reason)), InvalidPoints::Refuse) => Err(PointsError::InvalidPoint {
                index: *index,
                count: self.count,
                reason: reason.to_string(),
                invalid: self.invalid,
                path: self.path.clone(),
            }),
            _ => Ok(()),
        }
    }

    pub(crate) fn seen(&self) -> u64 {
        self.seen
    }

    pub(crate) fn skipped(&self) -> u64 {
        self.invalid
    }

    pub(crate) fn rewind(&mut self) {
        (self.seen, self.invalid, self.first) = (0, 0, None);
    }
}

/// A position of a file, relative to `origin`. Rounding keeps the order of numbers, so a box can be moved by its corners.
#[inline]
pub(crate) fn relative(position: [f64; 3], origin: [f64; 3]) -> [f32; 3] {
    std::array::from_fn(|axis| (position[axis] - origin[axis]) as f32)
}

/// The radiance of an sRGB number, 1 for white.
pub(crate) fn linear_from_srgb(encoded: f64) -> f64 {
    if encoded <= 0.040_45 {
        encoded / 12.92
    } else {
        ((encoded + 0.055) / 1.055).powf(2.4)
    }
}

/// The inverse of [`linear_from_srgb`].
pub(crate) fn srgb_from_linear(linear: f64) -> f64 {
    if linear <= 0.003_130_8 {
        linear * 12.92
    } else {
        1.055 * linear.powf(1.0 / 2.4) - 0.055
    }
}
