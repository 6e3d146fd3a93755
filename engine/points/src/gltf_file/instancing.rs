//! Many places of one mesh in one node: EXT_mesh_gpu_instancing.

use super::accessor::Accessors;
use crate::error::PointsError;
use glam::{DAffine3, DMat4, DQuat, DVec3, Quat, Vec3};
use std::path::Path;

/// Its name; the `gltf` crate does not know it.
pub(super) const EXTENSION: &str = "EXT_mesh_gpu_instancing";

/// A node whose mesh is placed more than once.
pub(super) struct Instancing {
    node: usize,
    world: DMat4,
    /// Accessors.
    translation: Option<usize>,
    rotation: Option<usize>,
    scale: Option<usize>,
}

/// Where the places are, relative to their node; what is absent is empty.
pub(super) struct Places {
    world: DMat4,
    count: usize,
    translations: Vec<[f32; 3]>,
    rotations: Vec<[f32; 4]>,
    scales: Vec<[f32; 3]>,
}

impl Instancing {
    /// What a node says of the places of its mesh; `None` if it is placed once.
    pub(super) fn read(path: &Path, node: &gltf::Node<'_>, world: DMat4) -> Result<Option<Self>, PointsError> {
        let Some(extension) = node.extension_value(EXTENSION) else {
            return Ok(None);
        };
        let attribute = |name: &str| match extension.get("attributes").and_then(|attributes| attributes.get(name)) {
            None => Ok(None),
            Some(index) => {
                let index = index.as_u64().and_then(|index| usize::try_from(index).ok());
                let what = || format!("node {}: {name} of {EXTENSION} is no accessor's number", node.index());
                index.map(Some).ok_or_else(|| PointsError::invalid(path, what()))
            }
        };
        Ok(Some(Self {
            node: node.index(),
            world,
            translation: attribute("TRANSLATION")?,
            rotation: attribute("ROTATION")?,
            scale: attribute("SCALE")?,
        }))
    }

    /// Reads the places.
    pub(super) fn places(&self, path: &Path, accessors: &Accessors<'_>) -> Result<Places, PointsError> {
        let invalid = |what: String| PointsError::invalid(path, format!("node {}: {what}", self.node));
        let named = [
            (self.translation, "TRANSLATION"),
            (self.rotation, "ROTATION"),
            (self.scale, "SCALE"),
        ];
        let mut count = None;
        for (accessor, name) in named {
            let Some(index) = accessor else { continue };
            let its = accessors.count(index);
            let its = its.ok_or_else(|| invalid(format!("{name} names accessor {index}, which is not in the file")))?;
            if *count.get_or_insert(its) != its {
                return Err(invalid(format!(
                    "{name} of {EXTENSION} has {its} elements, others have more or fewer"
                )));
            }
        }
        let count = count.ok_or_else(|| invalid(format!("{EXTENSION} has neither TRANSLATION, ROTATION nor SCALE")))?;
        let place = format!("node {}", self.node);
        Ok(Places {
            world: self.world,
            count,
            translations: accessors.optional::<3>(self.translation, &place)?,
            rotations: accessors.optional::<4>(self.rotation, &place)?,
            scales: accessors.optional::<3>(self.scale, &place)?,
        })
    }
}

impl Places {
    /// How many.
    pub(super) fn count(&self) -> usize {
        self.count
    }

    /// World transforms, one after the other; they may be infinite if the file says so.
    pub(super) fn transforms(&self) -> impl Iterator<Item = DAffine3> + '_ {
        (0..self.count).map(|index| {
            let vector = |of: &[[f32; 3]], absent| of.get(index).map_or(absent, |&v| Vec3::from(v).as_dvec3());
            let turn = |turn: &[f32; 4]| Quat::from_array(*turn).as_dquat().normalize();
            let local = DMat4::from_scale_rotation_translation(
                vector(&self.scales, DVec3::ONE),
                self.rotations.get(index).map_or(DQuat::IDENTITY, turn),
                vector(&self.translations, DVec3::ZERO),
            );
            DAffine3::from_mat4(self.world * local)
        })
    }
}
