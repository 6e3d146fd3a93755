//! A whole stage: opened, walked, and put into our world, y up.

use super::contain::Pulse;
use super::files::Files;
use super::lights::Put;
use super::materials::Materials;
use super::values::Values;
use super::walk::{Branch, Walk};
use crate::error::PointsError;
use crate::geometry::Geometry;
use crate::scene::{Room, SceneParts};
use glam::{DAffine3, DMat3, DVec3};
use openusd::usd::Stage;
use std::path::{Path, PathBuf};

/// What a file holds, and the files it is made of.
pub(super) struct Read {
    pub(super) parts: SceneParts,
    pub(super) files: Vec<PathBuf>,
}

pub(super) fn read(path: &Path, room: Room, pulse: &Pulse) -> Result<Read, PointsError> {
    let files = Files::new(path, room, pulse)?;
    let made = compose(path, &files, room, pulse);
    // What was refused is the cause of whatever else was said.
    match files.refused() {
        Some(refused) => Err(refused),
        None => Ok(Read {
            parts: made?,
            files: files.opened(),
        }),
    }
}

fn compose(path: &Path, files: &Files, room: Room, pulse: &Pulse) -> Result<SceneParts, PointsError> {
    let name = path
        .to_str()
        .ok_or_else(|| PointsError::invalid(path, "the name of a USD file must be UTF-8: rename it"))?;
    let stage = Stage::builder().resolver(files.clone()).open(name);
    let stage = stage.map_err(|error| PointsError::invalid(path, format!("not a usable USD file: {error:#}")))?;
    let values = Values::new(path, stage)?;
    let world_from_stage = match values.up_is_z()? {
        true => DAffine3::from_mat3(DMat3::from_cols(DVec3::X, DVec3::NEG_Z, DVec3::Y)),
        false => DAffine3::IDENTITY,
    };
    let mut walk = Walk::new(&values, Materials::new(files.clone()), room, pulse);
    let branch = walk.stage(&world_from_stage);
    // Arcs that lead nowhere leave out what they stand for: a picture without it is not the one that was asked for.
    if let Some(error) = values.stage.composition_errors().into_iter().next() {
        return Err(PointsError::invalid(
            path,
            format!("the stage does not compose: {error}"),
        ));
    }
    gather(path, branch?, walk, room)
}

/// Everything to its places in the world.
fn gather(path: &Path, branch: Branch, walk: Walk<'_>, room: Room) -> Result<SceneParts, PointsError> {
    let Walk {
        mut materials,
        geometries,
        ..
    } = walk;
    let mut parts = SceneParts::default();
    let mut places = vec![Vec::new(); geometries.len()];
    for (geometry, place) in branch.meshes {
        places[geometry].push(place);
    }
    let mut world = Geometry::default();
    for (geometry, places) in geometries.into_iter().zip(places) {
        if !places.is_empty() {
            parts.place(path, &mut world, geometry, places.len(), places.into_iter())?;
        }
    }
    for (lamp, place) in branch.lamps {
        match lamp.put(&place) {
            Put::Light(light) => parts.lights.push(light),
            Put::Surface(mut surface, material) => {
                surface.materials = vec![materials.own(*material); surface.triangles.len()];
                world.append(path, &surface, &place)?;
                room.fits(world.memory_bytes() as u64)?;
            }
        }
    }
    parts.place_once(world);
    parts.environment = branch.skies.into_iter().next();
    parts.cameras = branch
        .cameras
        .iter()
        .map(|(camera, place)| camera.moved(place))
        .collect();
    (parts.materials, parts.textures) = (materials.materials, materials.textures);
    Ok(parts)
}
