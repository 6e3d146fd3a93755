//! `UsdLuxDomeLight`: latitude-longitude pictures of what is far away, or the same light from everywhere.

use super::lights::radiance;
use super::values::Values;
use crate::error::PointsError;
use crate::surroundings::Surroundings;
use glam::{DAffine3, DMat3};
use openusd::ar::is_package_relative_path;
use openusd::sdf::Value;
use openusd::usd::Prim;
use std::f64::consts::FRAC_PI_2;
use std::path::PathBuf;

/// What a dome light surrounds the scene with. Its middle looks along +z, ours along +x.
pub(super) fn read(values: &Values, prim: &Prim, kind: &str, place: &DAffine3) -> Result<Surroundings, PointsError> {
    let format = values.token(prim, "inputs:texture:format")?;
    if let Some(other) = format.filter(|format| !matches!(format.as_str(), "automatic" | "latlong")) {
        let what = format!("a dome light of the format {other:?}");
        return Err(values.unsupported(prim, what, "convert its picture to latlong"));
    }
    let picture = match values.value(prim, "inputs:texture:file")? {
        Some(Value::AssetPath(asset)) if !asset.is_empty() => {
            let name = asset.asset_path().to_owned();
            let missing = || {
                let what = format!("picture {name:?} is named but cannot be read: copy it beside the scene");
                values.wrong(prim, what)
            };
            let resolved = asset.resolved_path().ok_or_else(missing)?;
            if is_package_relative_path(resolved) {
                let what = format!("the picture {name:?} of a dome light within a package");
                return Err(values.unsupported(prim, what, "unpack the .usdz"));
            }
            Some(PathBuf::from(resolved))
        }
        _ => None,
    };
    let up_z = kind == "DomeLight_1" && values.pole_is_z(prim)?;
    // Of the second kind, -y is in the middle where z is up.
    let stage_from_dome = match up_z {
        true => DMat3::from_rotation_x(FRAC_PI_2),
        false => DMat3::IDENTITY,
    };
    let factor = radiance(values, prim, 1.0)?.map(|value| value as f32);
    let turn = DAffine3::from_mat3(stage_from_dome * DMat3::from_rotation_y(-FRAC_PI_2));
    Ok(Surroundings::times(picture, factor).moved(&turn).moved(place))
}
