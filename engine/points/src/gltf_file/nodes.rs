//! The node hierarchy: where meshes, lights and cameras are.

use super::instancing::Instancing;
use crate::camera::Camera;
use crate::error::PointsError;
use crate::light::{Light, LightKind};
use crate::limits;
use glam::{DAffine3, DMat4, DVec3, Mat4, Vec3};
use gltf::json::extensions::scene::khr_lights_punctual::{Light as LightJson, Type};
use gltf::json::validation::Checked;
use std::collections::BTreeMap;
use std::path::Path;

/// What the nodes of the scene place, in the order of a depth-first walk.
#[derive(Default)]
pub(super) struct Visited {
    /// By mesh.
    pub(super) uses: BTreeMap<usize, Uses>,
    pub(super) lights: Vec<Light>,
    /// In the order of the file's list of cameras, so that their numbers are the file's.
    pub(super) cameras: Vec<Camera>,
}

/// Where a mesh is.
#[derive(Default)]
pub(super) struct Uses {
    /// Once each.
    pub(super) places: Vec<DAffine3>,
    /// Many times each.
    pub(super) instanced: Vec<Instancing>,
}

/// Walks the default scene, or the first one.
pub(super) fn visit(path: &Path, document: &gltf::Document) -> Result<Visited, PointsError> {
    let scene = document.default_scene().or_else(|| document.scenes().next());
    let scene = scene.ok_or_else(|| PointsError::invalid(path, "the file has no scene"))?;
    let mut visited = Visited::default();
    let mut cameras = Vec::new();
    let mut open: Vec<(usize, DMat4, usize)> = scene.nodes().map(|node| (node.index(), DMat4::IDENTITY, 0)).collect();
    open.reverse();
    let nodes: Vec<gltf::Node<'_>> = document.nodes().collect();
    let mut count = 0;
    while let Some((index, parent, depth)) = open.pop() {
        count += 1;
        if depth > limits::NODE_DEPTH_MAX || count > limits::INSTANCES_MAX {
            return Err(PointsError::invalid(
                path,
                format!("the hierarchy of node {index} is a cycle or too deep"),
            ));
        }
        let Some(node) = nodes.get(index) else { continue };
        let local = Mat4::from_cols_array_2d(&node.transform().matrix());
        let world = parent * local.as_dmat4();
        if !world.is_finite() {
            return Err(PointsError::invalid(
                path,
                format!("the transform of node {index} is not finite"),
            ));
        }
        if let Some(mesh) = node.mesh() {
            let uses = visited.uses.entry(mesh.index()).or_default();
            match Instancing::read(path, node, world)? {
                Some(instancing) => uses.instanced.push(instancing),
                None => uses.places.push(DAffine3::from_mat4(world)),
            }
        }
        if let Some(light) = light_of(path, document, index, &world)? {
            visited.lights.push(light);
        }
        if let Some(camera) = document.as_json().nodes[index].camera {
            cameras.extend(camera_of(document, camera.value(), &world).map(|read| (camera.value(), read)));
        }
        let children: Vec<usize> = node.children().map(|child| child.index()).collect();
        open.extend(children.into_iter().rev().map(|child| (child, world, depth + 1)));
    }
    cameras.sort_by_key(|(number, _)| *number);
    visited.cameras = cameras.into_iter().map(|(_, camera)| camera).collect();
    Ok(visited)
}

fn light_of(path: &Path, document: &gltf::Document, node: usize, world: &DMat4) -> Result<Option<Light>, PointsError> {
    // From the JSON itself: the crate's own accessors trust the file.
    let root = document.as_json();
    let used = root.nodes[node]
        .extensions
        .as_ref()
        .and_then(|e| e.khr_lights_punctual.as_ref());
    let Some(number) = used.map(|used| used.light.value()) else {
        return Ok(None);
    };
    let lights = root.extensions.as_ref().and_then(|e| e.khr_lights_punctual.as_ref());
    let Some(json) = lights.and_then(|lights| lights.lights.get(number)) else {
        return Err(PointsError::invalid(
            path,
            format!("node {node} has light {number}, which is not in the file"),
        ));
    };
    let intensity = json.color.map(|channel| channel * json.intensity);
    let range = json.range.filter(|range| range.is_finite());
    let sound = intensity.iter().all(|value| value.is_finite() && *value >= 0.0) && range.is_none_or(|r| r > 0.0);
    let kind = kind_of(json).filter(|_| sound);
    let kind = kind.ok_or_else(|| {
        PointsError::invalid(
            path,
            format!("light {number} has a negative or infinite intensity, range or angle"),
        )
    })?;
    Ok(Some(Light {
        kind,
        intensity,
        position: world.w_axis.truncate().as_vec3(),
        direction: (-world.z_axis.truncate()).normalize_or(DVec3::NEG_Z).as_vec3(),
        range,
    }))
}

fn kind_of(json: &LightJson) -> Option<LightKind> {
    let Checked::Valid(kind) = json.type_ else {
        return None;
    };
    Some(match kind {
        Type::Directional => LightKind::Directional,
        Type::Point => LightKind::Point,
        Type::Spot => {
            // The extension's defaults.
            let (inner, outer) = match &json.spot {
                Some(spot) => (spot.inner_cone_angle, spot.outer_cone_angle),
                None => (0.0, std::f32::consts::FRAC_PI_4),
            };
            if !(inner >= 0.0 && outer >= inner && outer <= std::f32::consts::PI) {
                return None;
            }
            LightKind::Spot {
                cos_inner: inner.cos(),
                cos_outer: outer.cos(),
            }
        }
    })
}

/// `None` for cameras without perspective.
fn camera_of(document: &gltf::Document, number: usize, world: &DMat4) -> Option<Camera> {
    let json = document.as_json().cameras.get(number)?;
    let perspective = json.perspective.as_ref()?;
    let usable = perspective.yfov > 0.0 && perspective.yfov < std::f32::consts::PI;
    // Scale is no part of a camera.
    let column = |axis: usize, fallback: DVec3| world.col(axis).truncate().normalize_or(fallback).as_vec3();
    let (right, up, back) = (column(0, DVec3::X), column(1, DVec3::Y), column(2, DVec3::Z));
    let eye: Vec3 = world.w_axis.truncate().as_vec3();
    usable.then(|| Camera {
        name: json.name.clone(),
        world_from_camera: Mat4::from_cols(right.extend(0.0), up.extend(0.0), back.extend(0.0), eye.extend(1.0)),
        fov_y: perspective.yfov,
        aspect_ratio: perspective.aspect_ratio,
    })
}
