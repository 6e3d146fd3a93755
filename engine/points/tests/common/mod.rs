//! Shared by the suites: where the data are, scenes made on the spot, reading streams.
#![allow(dead_code, unreachable_pub, reason = "each suite uses a part")]

use glam::Vec3;
use pbgi_core::{PointRecord, PointStream};
use pbgi_points::{Density, MeshPoints, MeshScene, PointsError, SampleOptions};
use serde_json::{Value, json};
use std::fs;
use std::path::{Path, PathBuf};

/// A file of the shared data, if it is there; a loud skip if not.
pub fn shared(relative: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../../shared")
        .join(relative);
    // In a worktree the data lie one folder further up.
    let further = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../../../shared")
        .join(relative);
    let found = [path, further].into_iter().find(|path| fs::metadata(path).is_ok());
    if found.is_none() {
        eprintln!("SKIPPED: ../shared/{relative} is not there");
    }
    found
}

/// All points of a stream.
pub fn collect(stream: &mut (impl PointStream<Error = PointsError> + ?Sized)) -> Vec<PointRecord> {
    let mut points = Vec::new();
    while stream.next_batch(&mut points).unwrap() {}
    points
}

pub fn sample(scene: MeshScene, density: Density) -> Vec<PointRecord> {
    let options = SampleOptions {
        density,
        ..SampleOptions::default()
    };
    collect(&mut MeshPoints::new(scene, &options).unwrap())
}

/// A glTF document under construction, written with its buffer beside it.
#[derive(Default)]
pub struct GltfScene {
    pub document: Value,
    pub bin: Vec<u8>,
}

impl GltfScene {
    pub fn new() -> Self {
        Self {
            document: json!({
                "asset": { "version": "2.0" }, "scene": 0, "scenes": [{ "nodes": [] }],
                "nodes": [], "meshes": [], "accessors": [], "bufferViews": [], "buffers": [],
                "materials": [], "textures": [], "images": [], "samplers": [], "cameras": [],
            }),
            bin: Vec::new(),
        }
    }

    pub fn push(&mut self, list: &str, value: Value) -> usize {
        let list = self.document[list].as_array_mut().unwrap();
        list.push(value);
        list.len() - 1
    }

    pub fn accessor(&mut self, bytes: &[u8], count: usize, component: u32, shape: &str) -> usize {
        let view = json!({ "buffer": 0, "byteOffset": self.bin.len(), "byteLength": bytes.len() });
        self.bin.extend_from_slice(bytes);
        let view = self.push("bufferViews", view);
        let mut accessor = json!({ "bufferView": view, "componentType": component, "count": count, "type": shape });
        if shape == "VEC3" {
            accessor["min"] = json!([-1e9, -1e9, -1e9]);
            accessor["max"] = json!([1e9, 1e9, 1e9]);
        }
        self.push("accessors", accessor)
    }

    pub fn floats(&mut self, values: &[f32], shape: &str) -> usize {
        let width = match shape {
            "VEC2" => 2,
            "VEC3" => 3,
            _ => 4,
        };
        let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        self.accessor(&bytes, values.len() / width, 5126, shape)
    }

    /// A mesh of one rectangle that faces along `u` cross `v`, with texture coordinates 0 to 1.
    pub fn rectangle(&mut self, corner: Vec3, u: Vec3, v: Vec3, material: Option<usize>) -> usize {
        let corners = [corner, corner + u, corner + u + v, corner + v];
        let positions: Vec<f32> = corners.iter().flat_map(|corner| corner.to_array()).collect();
        let positions = self.floats(&positions, "VEC3");
        let uvs = self.floats(&[0.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0], "VEC2");
        let indices: Vec<u8> = [0u16, 1, 2, 0, 2, 3]
            .iter()
            .flat_map(|index| index.to_le_bytes())
            .collect();
        let indices = self.accessor(&indices, 6, 5123, "SCALAR");
        let mut primitive = json!({ "attributes": { "POSITION": positions, "TEXCOORD_0": uvs }, "indices": indices });
        if let Some(material) = material {
            primitive["material"] = json!(material);
        }
        self.push("meshes", json!({ "primitives": [primitive] }))
    }

    /// Adds a node to the scene.
    pub fn node(&mut self, node: Value) -> usize {
        let node = self.push("nodes", node);
        self.document["scenes"][0]["nodes"]
            .as_array_mut()
            .unwrap()
            .push(json!(node));
        node
    }

    pub fn light(&mut self, light: Value, node: Value) {
        self.document["extensionsUsed"] = json!(["KHR_lights_punctual"]);
        let list = &mut self.document["extensions"]["KHR_lights_punctual"]["lights"];
        if list.is_null() {
            *list = json!([]);
        }
        let lights = list.as_array_mut().unwrap();
        lights.push(light);
        let number = lights.len() - 1;
        let mut node = node;
        node["extensions"] = json!({ "KHR_lights_punctual": { "light": number } });
        self.node(node);
    }

    /// Writes `scene.gltf` and `scene.bin` into `folder`.
    pub fn write(&self, folder: &Path) -> PathBuf {
        let mut document = self.document.clone();
        document["buffers"] = json!([{ "uri": "scene.bin", "byteLength": self.bin.len() }]);
        let members = document.as_object_mut().unwrap();
        members.retain(|_, value| value.as_array().is_none_or(|list| !list.is_empty()));
        fs::write(folder.join("scene.bin"), &self.bin).unwrap();
        let path = folder.join("scene.gltf");
        fs::write(&path, document.to_string()).unwrap();
        path
    }

    pub fn load(&self) -> Result<MeshScene, PointsError> {
        let folder = tempfile::tempdir().unwrap();
        MeshScene::load(&self.write(folder.path()))
    }
}

/// A PNG file with the given texels, as a data URI.
pub fn png_uri(width: u32, height: u32, texels: &[[u8; 4]]) -> String {
    let mut bytes = Vec::new();
    let encoder = image::codecs::png::PngEncoder::new(&mut bytes);
    let raw: Vec<u8> = texels.iter().flatten().copied().collect();
    image::ImageEncoder::write_image(encoder, &raw, width, height, image::ExtendedColorType::Rgba8).unwrap();
    format!("data:image/png;base64,{}", base64(&bytes))
}

fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::new();
    for chunk in bytes.chunks(3) {
        let mut word = 0u32;
        for i in 0..3 {
            word = word << 8 | u32::from(*chunk.get(i).unwrap_or(&0));
        }
        for i in 0..4 {
            let digit = DIGITS[(word >> (18 - 6 * i) & 63) as usize] as char;
            text.push(if i <= chunk.len() { digit } else { '=' });
        }
    }
    text
}

/// Asserts that an error text has all the parts that tell a user what to do.
pub fn assert_says<T>(result: Result<T, PointsError>, parts: &[&str]) {
    let text = match result {
        Ok(_) => panic!("must fail and say {parts:?}"),
        Err(error) => error.to_string(),
    };
    for part in parts {
        assert!(text.contains(part), "{text:?} does not say {part:?}");
    }
}

/// Changes one byte at a time and hands each damaged file to `read`, which must not panic. Prints the seed; PBGI_SEED reruns.
pub fn mutate(bytes: &[u8], range: std::ops::Range<usize>, count: usize, mut read: impl FnMut(&[u8])) {
    let seed = std::env::var("PBGI_SEED").ok().and_then(|seed| seed.parse().ok());
    let mut state: u64 = seed.unwrap_or(1);
    println!("PBGI_SEED={state}");
    let mut next = || {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        state >> 33
    };
    for _ in 0..count {
        let mut broken = bytes.to_vec();
        for _ in 0..1 + next() % 3 {
            let at = range.start + next() as usize % range.len();
            broken[at] = if next() % 2 == 0 {
                next() as u8
            } else {
                b'0' + (next() % 75) as u8
            };
        }
        read(&broken);
    }
}
