//! GLB files of our own making: [`GlbScene`].

use crate::camera::Camera;
use glam::{Mat4, Quat, Vec3};
use serde_json::{Value, json};

/// Triangles of one material.
#[derive(Default)]
pub(crate) struct GlbMesh {
    positions: Vec<Vec3>,
    normals: Vec<Vec3>,
    indices: Vec<u32>,
}

impl GlbMesh {
    pub(crate) fn is_empty(&self) -> bool {
        self.indices.is_empty()
    }

    /// A parallelogram that faces along `u` cross `v`.
    pub(crate) fn rectangle(&mut self, corner: Vec3, u: Vec3, v: Vec3) {
        let base = self.positions.len() as u32;
        self.positions.extend([corner, corner + u, corner + u + v, corner + v]);
        self.normals.extend([u.cross(v).normalize_or(Vec3::Y); 4]);
        self.indices.extend([0, 1, 2, 0, 2, 3].map(|index| base + index));
    }

    /// A grid of quads over `point`, which gives position and normal; rows and columns count quads.
    pub(crate) fn grid(&mut self, rows: u32, columns: u32, point: impl Fn(u32, u32) -> (Vec3, Vec3)) {
        let base = self.positions.len() as u32;
        for row in 0..=rows {
            for column in 0..=columns {
                let (position, normal) = point(row, column);
                self.positions.push(position);
                self.normals.push(normal);
            }
        }
        for row in 0..rows {
            for column in 0..columns {
                let a = base + row * (columns + 1) + column;
                let b = a + columns + 1;
                self.indices.extend([a, b, a + 1, a + 1, b, b + 1]);
            }
        }
    }
}

/// A file under construction: one mesh with a primitive a material, lights, a camera.
#[derive(Default)]
pub(crate) struct GlbScene {
    bin: Vec<u8>,
    materials: Vec<Value>,
    primitives: Vec<Value>,
    views: Vec<Value>,
    accessors: Vec<Value>,
    lights: Vec<Value>,
    cameras: Vec<Value>,
    /// After the first, which is the mesh.
    nodes: Vec<Value>,
}

impl GlbScene {
    pub(crate) fn mesh(&mut self, material: Value, mesh: &GlbMesh) {
        let vectors = |list: &[Vec3]| {
            let floats = list.iter().flat_map(|v| v.to_array());
            floats.flat_map(f32::to_le_bytes).collect()
        };
        let indices: Vec<u8> = mesh.indices.iter().flat_map(|index| index.to_le_bytes()).collect();
        let pieces: [(Vec<u8>, usize, u32, &str, u32); 3] = [
            (vectors(&mesh.positions), mesh.positions.len(), 5126, "VEC3", 34962),
            (vectors(&mesh.normals), mesh.normals.len(), 5126, "VEC3", 34962),
            (indices, mesh.indices.len(), 5125, "SCALAR", 34963),
        ];
        let first = self.accessors.len();
        for (bytes, count, component, shape, target) in pieces {
            self.views.push(json!({
                "buffer": 0, "byteOffset": self.bin.len(), "byteLength": bytes.len(), "target": target,
            }));
            self.accessors.push(json!({
                "bufferView": self.views.len() - 1, "componentType": component, "count": count, "type": shape,
            }));
            self.bin.extend(bytes);
        }
        let low = mesh.positions.iter().copied().fold(Vec3::INFINITY, Vec3::min);
        let high = mesh.positions.iter().copied().fold(Vec3::NEG_INFINITY, Vec3::max);
        self.accessors[first]["min"] = json!(low.to_array());
        self.accessors[first]["max"] = json!(high.to_array());
        self.primitives.push(json!({
            "attributes": { "POSITION": first, "NORMAL": first + 1 },
            "indices": first + 2,
            "material": self.materials.len(),
        }));
        self.materials.push(material);
    }

    /// A lamp at a place, W/sr.
    pub(crate) fn lamp(&mut self, color: [f32; 3], intensity: f32, at: Vec3) {
        self.light(
            json!({ "type": "point", "color": color, "intensity": intensity }),
            Mat4::from_translation(at),
        );
    }

    /// A light from infinitely far that travels along `direction`; `irradiance` is that of a surface that faces it.
    pub(crate) fn sun(&mut self, irradiance: [f32; 3], direction: Vec3) {
        let turn = Quat::from_rotation_arc(Vec3::NEG_Z, direction.normalize_or(Vec3::NEG_Y));
        self.light(
            json!({ "type": "directional", "color": irradiance, "intensity": 1.0 }),
            Mat4::from_quat(turn),
        );
    }

    fn light(&mut self, light: Value, world_from_light: Mat4) {
        self.nodes.push(json!({
            "matrix": world_from_light.to_cols_array(),
            "extensions": { "KHR_lights_punctual": { "light": self.lights.len() } },
        }));
        self.lights.push(light);
    }

    pub(crate) fn camera(&mut self, camera: &Camera) {
        let matrix = camera.world_from_camera.to_cols_array();
        self.nodes
            .push(json!({ "matrix": matrix, "camera": self.cameras.len() }));
        let mut perspective = json!({ "yfov": camera.fov_y, "znear": 0.01 });
        if let Some(ratio) = camera.aspect_ratio {
            perspective["aspectRatio"] = json!(ratio);
        }
        self.cameras
            .push(json!({ "type": "perspective", "perspective": perspective }));
    }

    /// The bytes of the file.
    pub(crate) fn finish(self, generator: &str) -> Vec<u8> {
        let mut nodes = vec![json!({ "mesh": 0 })];
        nodes.extend(self.nodes);
        let document = json!({
            "asset": { "version": "2.0", "generator": generator },
            "extensionsUsed": ["KHR_lights_punctual", "KHR_materials_emissive_strength"],
            "extensions": { "KHR_lights_punctual": { "lights": self.lights } },
            "scene": 0,
            "scenes": [{ "nodes": (0..nodes.len()).collect::<Vec<usize>>() }],
            "nodes": nodes,
            "cameras": self.cameras,
            "meshes": [{ "primitives": self.primitives }],
            "materials": self.materials,
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{ "byteLength": self.bin.len() }],
        });
        container(document.to_string().into_bytes(), self.bin)
    }
}

/// Two chunks in a GLB container.
fn container(mut json: Vec<u8>, mut bin: Vec<u8>) -> Vec<u8> {
    json.resize(json.len().next_multiple_of(4), b' ');
    bin.resize(bin.len().next_multiple_of(4), 0);
    let word = |value: usize| (value as u32).to_le_bytes();
    let total = 12 + 8 + json.len() + 8 + bin.len();
    let header = [b"glTF".as_slice(), &word(2), &word(total), &word(json.len()), b"JSON"].concat();
    [header, json, word(bin.len()).to_vec(), b"BIN\0".to_vec(), bin].concat()
}
