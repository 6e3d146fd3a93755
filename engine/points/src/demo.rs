//! A small scene made on the spot, for the first picture of somebody who has no scene yet.

use crate::camera::Camera;
use crate::error::PointsError;
use crate::glb::{GlbMesh, GlbScene};
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

/// A block on the floor, turned about the vertical, without its underside.
fn block(mesh: &mut GlbMesh, centre: [f32; 2], size: Vec3, turn: f32) {
    let (x, z) = (
        Vec3::new(turn.cos(), 0.0, -turn.sin()),
        Vec3::new(turn.sin(), 0.0, turn.cos()),
    );
    let (x, y, z) = (x * size.x, Vec3::Y * size.y, z * size.z);
    let low = Vec3::new(centre[0], 0.0, centre[1]) - x / 2.0 - z / 2.0;
    mesh.rectangle(low + z, x, y);
    mesh.rectangle(low + x, -x, y);
    mesh.rectangle(low, z, y);
    mesh.rectangle(low + x + z, -z, y);
    mesh.rectangle(low + y + z, x, -z);
}

fn sphere(mesh: &mut GlbMesh, centre: Vec3, radius: f32) {
    const ROWS: u32 = 48;
    const COLUMNS: u32 = 96;
    mesh.grid(ROWS, COLUMNS, |row, column| {
        let (theta, phi) = (row as f32 / ROWS as f32 * PI, column as f32 / COLUMNS as f32 * TAU);
        let normal = Vec3::new(theta.sin() * phi.cos(), theta.cos(), -theta.sin() * phi.sin());
        (centre + normal * radius, normal)
    });
}

/// The room is 2 wide and high, 2.4 deep, open to the camera.
fn meshes() -> Vec<(Value, GlbMesh)> {
    let (w, h, d) = (Vec3::X * 2.0, Vec3::Y * 2.0, Vec3::Z * 2.4);
    let back = Vec3::new(-1.0, 0.0, -1.2);
    let mut white = GlbMesh::default();
    white.rectangle(back + d, w, -d);
    white.rectangle(back + h, w, d);
    white.rectangle(back, w, h);
    block(&mut white, [-0.38, -0.45], Vec3::new(0.56, 1.2, 0.56), 0.3);
    let mut red = GlbMesh::default();
    red.rectangle(back + d, -d, h);
    let mut blue = GlbMesh::default();
    blue.rectangle(back + w, d, h);
    let mut amber = GlbMesh::default();
    block(&mut amber, [-0.35, 0.42], Vec3::new(0.34, 0.34, 0.34), -0.5);
    let mut pale = GlbMesh::default();
    sphere(&mut pale, Vec3::new(0.42, 0.38, 0.1), 0.38);
    let mut panel = GlbMesh::default();
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
    let mut scene = GlbScene::default();
    for (material, mesh) in meshes() {
        scene.mesh(material, &mesh);
    }
    scene.camera(&Camera {
        name: None,
        world_from_camera: Mat4::from_translation(Vec3::new(0.0, 1.0, 5.0)),
        fov_y: 0.5,
        aspect_ratio: Some(1.0),
    });
    scene.lamp([1.0, 0.85, 0.65], 2.0, Vec3::new(0.0, 1.85, 0.0));
    scene.finish("pbgi demo")
}
