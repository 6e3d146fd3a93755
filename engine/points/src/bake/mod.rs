//! Baking: the points of a cloud become receivers, and what was shaded at them becomes numbers of the cloud.
//!
//! [`Receivers`] hands the points out along the Z-curve, where neighbours share most of their work, whatever the order of the
//! file; each knows its place there. [`BakedValues`] keeps what was shaded in a nameless file of scratch, by place.
//! [`write_baked`] then reads the cloud again from front to back and writes it with its new numbers: in its order, with
//! everything else that it had.

mod las;
mod receivers;
mod values;

pub use receivers::{Receiver, Receivers};
pub use values::BakedValues;

use crate::cloud::{CloudOptions, InvalidPoints, place_of};
use crate::error::PointsError;
use crate::open::{Kind, kind_by_name, open_cloud};
use crate::ply::{PlyForm, PlyPoints, PlyWriter, copy_ply};
use std::ops::ControlFlow;
use std::path::Path;
use values::Rows;

/// Numbers of a receiver: irradiance R G B, occlusion, bent normal x y z.
pub type Baked = [f32; 7];

/// What can be written for every point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BakeChannel {
    /// `occlusion`: cosine-weighted covered share of the hemisphere, 0 open, 1 closed.
    Occlusion,
    /// `sky_visibility`: 1 - occlusion.
    Sky,
    /// `irradiance_r`, `irradiance_g`, `irradiance_b`: W/m2.
    Irradiance,
    /// `bent_nx`, `bent_ny`, `bent_nz`: mean open direction, world space.
    BentNormal,
}

/// Where a cloud of the LAS family carries what was baked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LasForm {
    /// Extra dimensions of 32-bit floats, named like the properties of a PLY file.
    Extra,
    /// The intensity: sky visibility, 65,535 for open.
    Intensity,
    /// The colours, darkened by the sky visibility; points without colour are taken for white.
    Rgb,
}

/// What is written, and how.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BakeOptions {
    /// Numbers of every point, in file order.
    pub channels: Vec<BakeChannel>,
    /// For LAS and LAZ.
    pub las: Vec<LasForm>,
    /// The policy that the receivers were read with: points that were dropped there have zeros.
    pub invalid_points: InvalidPoints,
}

impl BakeChannel {
    /// Names of its numbers in a file.
    pub fn names(self) -> &'static [&'static str] {
        match self {
            Self::Occlusion => &["occlusion"],
            Self::Sky => &["sky_visibility"],
            Self::Irradiance => &["irradiance_r", "irradiance_g", "irradiance_b"],
            Self::BentNormal => &["bent_nx", "bent_ny", "bent_nz"],
        }
    }

    fn push(self, [r, g, b, occlusion, x, y, z]: Baked, numbers: &mut Vec<f32>) {
        match self {
            Self::Occlusion => numbers.push(occlusion),
            Self::Sky => numbers.push(sky_visibility([r, g, b, occlusion, x, y, z])),
            Self::Irradiance => numbers.extend([r, g, b]),
            Self::BentNormal => numbers.extend([x, y, z]),
        }
    }
}

/// 0 for a point that was not shaded, which is one without a bent normal.
fn sky_visibility([.., occlusion, x, y, z]: Baked) -> f32 {
    if [x, y, z] == [0.0; 3] { 0.0 } else { 1.0 - occlusion }
}

/// Checks by their names that what is baked onto `input` can be written as `output`.
///
/// # Errors
/// Kinds of files that do not fit.
pub fn check_bake(input: &Path, output: &Path) -> Result<(), PointsError> {
    let (from, to) = (kind_by_name(input)?, kind_by_name(output).ok());
    let remedy = match (from, to) {
        (Kind::Mesh, _) => {
            return Err(PointsError::unsupported(
                input,
                "baking onto a mesh",
                "give a cloud, or leave it away to bake onto the points of the scene",
            ));
        }
        (Kind::Las, Some(Kind::Las)) | (Kind::Ply | Kind::Ptc | Kind::Scene, Some(Kind::Ply)) => return Ok(()),
        (Kind::Las, _) => "name it .las or .laz",
        _ => "name it .ply",
    };
    let what = format!("an output of this kind for {:?}", input.file_name().unwrap_or_default());
    Err(PointsError::unsupported(output, what, remedy))
}

/// Writes the cloud `input` with what was baked onto its points to `output`, replaced if it is there: PLY and LAS with
/// everything they have, the points of PTC files and scenes as PLY. `observer` hears now and then of the points so far and
/// may stop it. Returns the number of points.
///
/// # Errors
/// Those of reading, a failing disk, or [`PointsError::Cancelled`]; there is no new file then.
pub fn write_baked(
    input: &Path,
    output: &Path,
    values: &BakedValues,
    options: &BakeOptions,
    observer: &mut dyn FnMut(u64) -> ControlFlow<()>,
) -> Result<u64, PointsError> {
    check_bake(input, output)?;
    let mut rows = values.rows(observer)?;
    let names: Vec<&str> = options
        .channels
        .iter()
        .flat_map(|channel| channel.names())
        .copied()
        .collect();
    let cloud = CloudOptions {
        // As the file has them.
        origin: Some([0.0; 3]),
        invalid_points: options.invalid_points,
        ..CloudOptions::default()
    };
    match kind_by_name(input)? {
        Kind::Las => las::copy_las(input, output, &mut rows, options)?,
        Kind::Ply if !PlyPoints::open(input, [0.0; 3], &cloud)?.holds_records() => {
            let mut next = |numbers: &mut Vec<f32>| {
                let baked = rows.next()?;
                options.channels.iter().for_each(|channel| channel.push(baked, numbers));
                Ok(())
            };
            copy_ply(input, output, &names, &mut next)?;
        }
        _ => write_points(input, output, &names, &mut rows, options, &cloud)?,
    }
    Ok(rows.count())
}

/// A cloud whose file cannot carry more numbers, as PLY.
fn write_points(
    input: &Path,
    output: &Path,
    names: &[&str],
    rows: &mut Rows<'_>,
    options: &BakeOptions,
    cloud: &CloudOptions,
) -> Result<(), PointsError> {
    let open = || open_cloud(input, [0.0; 3], cloud);
    // One reading for the points, one for their places: the same points are dropped in both.
    let (mut points, mut places) = (open()?, open()?);
    places.number();
    let mut writer = PlyWriter::create(output, PlyForm::Floats, names)?;
    let (mut batch, mut numbered, mut numbers) = (Vec::new(), Vec::new(), Vec::new());
    while points.next_batch(&mut batch)? {
        places.next_batch(&mut numbered)?;
        for (point, place) in batch.drain(..).zip(numbered.drain(..)) {
            let baked = rows.seek(place_of(&place))?;
            numbers.clear();
            options
                .channels
                .iter()
                .for_each(|channel| channel.push(baked, &mut numbers));
            writer.push(&point, &numbers)?;
        }
    }
    writer.finish().map(drop)
}
