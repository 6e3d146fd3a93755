//! A small scene made on the spot, for the first picture of somebody who has no scene yet.

use crate::error::PointsError;
use crate::output::write_file;
use glam::{Mat4, Vec3};
use serde_json::{Value, json};
use std::f32::consts::{PI, TAU};
use std::io::Write;
use std::path::Path;

/// Writes a room with a red and a blue wall, two blocks, a sphere, a glowing panel, a lamp and a camera, as a GLB file.
///
/// # Errors
/// A failing disk.
pub fn write_glb(path: &Path) -> Result<(), PointsError> {
    let bytes = glb();
    write_file(path, |file| file.write_all(&bytes))
}

/// Triangles of one material.
#[derive(Default)]
struct Mesh {
    positions: Vec<Vec3>,
    normals: Vec<Vec3>,
    indices: Vec<u32>,
}

impl Mesh {
    /// A rectangle that faces along `u` cross `v`.
    fn rectangle(&mut self, corner: Vec3, u: Vec3, v: Vec3) {
        let base = self.positions.len() as u32;
        self.positions.extend([corner, corner + u, corner + u + v, corner + v]);
        self.normals.extend([u.cross(v).normalize(); 4]);
        self.indices.extend([0, 1, 2, 0, 2, 3].map(|index| base + index));
    }

    /// A block on the floor, turned about the vertical, without its underside.
    fn block(&mut self, centre: [f32; 2], size: Vec3, turn: f32) {
        let (x, z) = (
            Vec3::new(turn.cos(), 0.0, -turn.sin()),
            Vec3::new(turn.sin(), 0.0, turn.cos()),
        );
        let (x, y, z) = (x * size.x, Vec3::Y * size.y, z * size.z);
        let low = Vec3::new(centre[0], 0.0, centre[1]) - x / 2.0 - z / 2.0;
        self.rectangle(low + z, x, y);
        self.rectangle(low + x, -x, y);
        self.rectangle(low, z, y);
        self.rectangle(low + x + z, -z, y);
        self.rectangle(low + y + z, x, -z);
    }

    fn sphere(&mut self, centre: Vec3, radius: f32) {
        const ROWS: u32 = 48;
        const COLUMNS: u32 = 96;
        let base = self.positions.len() as u32;
        for row in 0..=ROWS {
            for column in 0..=COLUMNS {
                let (theta, phi) = (row as f32 / ROWS as f32 * PI, column as f32 / COLUMNS as f32 * TAU);
                let normal = Vec3::new(theta.sin() * phi.cos(), theta.cos(), -theta.sin() * phi.sin());
                self.positions.push(centre + normal * radius);
                self.normals.push(normal);
            }
        }
        for row in 0..ROWS {
            for column in 0..COLUMNS {
                let a = base + row * (COLUMNS + 1) + column;
                let b = a + COLUMNS + 1;
                self.indices.extend([a, b, a + 1, a + 1, b, b + 1]);
            }
        }
    }
}

/// The room is 2 wide and high, 2.4 deep, open to the camera.
fn meshes() -> Vec<(Value, Mesh)> {
    let (w, h, d) = (Vec3::X * 2.0, Vec3::Y * 2.0, Vec3::Z * 2.4);
    let back = Vec3::new(-1.0, 0.0, -1.2);
    let mut white = Mesh::default();
    white.rectangle(back + d, w, -d);
    white.rectangle(back + h, w, d);
    white.rectangle(back, w, h);
    white.block([-0.38, -0.45], Vec3::new(0.56, 1.2, 0.56), 0.3);
    let mut red = Mesh::default();
    red.rectangle(back + d, -d, h);
    let mut blue = Mesh::default();
    blue.rectangle(back + w, d, h);
    let mut amber = Mesh::default();
    amber.block([-0.35, 0.42], Vec3::new(0.34, 0.34, 0.34), -0.5);
    let mut pale = Mesh::default();
    pale.sphere(Vec3::new(0.42, 0.38, 0.1), 0.38);
    let mut panel = Mesh::default();
    panel.rectangle(Vec3::new(-0.4, 1.985, -0.4), Vec3::X * 0.8, Vec3::Z * 0.8);
    vec![
        (material("white", [0.75, 0.74, 0.72], 0.0), white),
        (material("red", [0.65, 0.09, 0.06], 0.0), red),
        (material("blue", [0.08, 0.16, 0.55], 0.0), blue),
        (material("amber", [0.8, 0.45, 0.08], 0.0), amber),
        (material("pale", [0.82, 0.8, 0.78], 0.0), pale),
        (material("panel", [0.8, 0.8, 0.8], 5.0), panel),
    ]
}

fn material(name: &str, albedo: [f32; 3], glow: f32) -> Value {
    let [r, g, b] = albedo;
    let mut material = json!({
        "name": name,
        "doubleSided": glow == 0.0,
        "pbrMetallicRoughness": { "baseColorFactor": [r, g, b, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0 },
    });
    if glow > 0.0 {
        material["emissiveFactor"] = json!([1.0, 0.9, 0.75]);
        material["extensions"] = json!({ "KHR_materials_emissive_strength": { "emissiveStrength": glow } });
    }
    material
}

fn glb() -> Vec<u8> {
    let mut bin: Vec<u8> = Vec::new();
    let (mut materials, mut primitives, mut views, mut accessors) = (vec![], vec![], vec![], vec![]);
    for (material, mesh) in meshes() {
        let vectors = |list: &[Vec3]| {
            list.iter()
                .flat_map(|v| v.to_array())
                .flat_map(f32::to_le_bytes)
                .collect()
        };
        let indices: Vec<u8> = mesh.indices.iter().flat_map(|index| index.to_le_bytes()).collect();
        let pieces: [(Vec<u8>, usize, u32, &str, u32); 3] = [
            (vectors(&mesh.positions), mesh.positions.len(), 5126, "VEC3", 34962),
            (vectors(&mesh.normals), mesh.normals.len(), 5126, "VEC3", 34962),
            (indices, mesh.indices.len(), 5125, "SCALAR", 34963),
        ];
        let first = accessors.len();
        for (bytes, count, component, shape, target) in pieces {
            views.push(json!({ "buffer": 0, "byteOffset": bin.len(), "byteLength": bytes.len(), "target": target }));
            accessors.push(json!({
                "bufferView": views.len() - 1, "componentType": component, "count": count, "type": shape,
            }));
            bin.extend(bytes);
        }
        let low = mesh.positions.iter().copied().fold(Vec3::INFINITY, Vec3::min);
        let high = mesh.positions.iter().copied().fold(Vec3::NEG_INFINITY, Vec3::max);
        accessors[first]["min"] = json!(low.to_array());
        accessors[first]["max"] = json!(high.to_array());
        primitives.push(json!({
            "attributes": { "POSITION": first, "NORMAL": first + 1 }, "indices": first + 2, "material": materials.len(),
        }));
        materials.push(material);
    }
    let camera = Mat4::from_translation(Vec3::new(0.0, 1.0, 5.0));
    let lamp = Mat4::from_translation(Vec3::new(0.0, 1.85, 0.0));
    let document = json!({
        "asset": { "version": "2.0", "generator": "pbgi demo" },
        "extensionsUsed": ["KHR_lights_punctual", "KHR_materials_emissive_strength"],
        "extensions": { "KHR_lights_punctual": { "lights": [
            { "type": "point", "color": [1.0, 0.85, 0.65], "intensity": 2.0 },
        ] } },
        "scene": 0,
        "scenes": [{ "nodes": [0, 1, 2] }],
        "nodes": [
            { "name": "room", "mesh": 0 },
            { "name": "camera", "camera": 0, "matrix": camera.to_cols_array() },
            { "name": "lamp", "matrix": lamp.to_cols_array(), "extensions": { "KHR_lights_punctual": { "light": 0 } } },
        ],
        "cameras": [{ "type": "perspective", "perspective": { "yfov": 0.5, "aspectRatio": 1.0, "znear": 0.01 } }],
        "meshes": [{ "name": "room", "primitives": primitives }],
        "materials": materials,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{ "byteLength": bin.len() }],
    });
    container(document.to_string().into_bytes(), bin)
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
