//! Where points come from, and what pictures are made of.
//!
//! [`open_input`] turns files into one stream of lit points: meshes ([`MeshScene`]: glTF, OBJ, PLY, USD, scene files) are sampled evenly and lit by
//! their lights with shadow rays, clouds ([`cloud`]: PLY, LAS, LAZ, COPC, PTC, built scenes) are read as they are, with
//! normals and radii estimated where they have none. [`GBuffer`] says what a camera sees, rendered from a
//! mesh or read from another renderer's EXR passes. [`bake`] gives the points of a cloud what was shaded
//! at them, [`bounce`] gives it back to the points of the scene itself. [`image`] writes the pictures. [`demo`] makes a scene on the spot, [`procedural`] one of any
//! size.
//!
//! World space is the file's, y up; radiance is linear, W/(m2 sr). Nothing here keeps all points in memory. This crate does
//! not build octrees and does not gather light.
#![forbid(unsafe_code)]

pub mod bake;
pub mod bounce;
pub mod camera;
pub mod cloud;
pub mod demo;
pub mod error;
pub mod gbuffer;
pub mod image;
pub mod light;
pub mod limits;
pub mod ply;
pub mod procedural;
pub mod raycast;
mod read_once;
pub mod scene;

mod charts;
mod estimate;
mod geometry;
mod glb;
mod gltf_file;
mod material;
mod named_file;
mod obj_file;
mod open;
mod output;
mod sample;
mod scene_file;
mod surroundings;
mod texture_file;
mod trace;
#[cfg(feature = "usd")]
mod usd_file;
#[cfg(not(feature = "usd"))]
#[path = "usd_file/refused.rs"]
mod usd_file;

pub use crate::image::{
    Attributes, Channel, Difference, LayerDifference, LayeredImage, Precision, ToneMap, Window, read_environment,
    write_png,
};
pub use bake::{BakeChannel, BakeOptions, Baked, BakedValues, LasForm, Receiver, Receivers, check_bake, write_baked};
pub use bounce::{BounceReceivers, BouncedPoints};
pub use camera::Camera;
pub use cloud::{CloudOptions, Facing, InvalidPoints, Radius};
pub use error::PointsError;
pub use gbuffer::{GBuffer, GBufferOptions, HitBuffer, PassThrough, RayHit, Space};
pub use light::{Light, LightKind};
pub use open::{Density, Input, InputOptions, SampleOptions, ViewDensity, open_input, origin_of};
pub use ply::{PlyForm, write_point_ply};
pub use procedural::{Kind, ProceduralScene};
pub use raycast::RayCast;
pub use sample::MeshPoints;
pub use scene::MeshScene;
pub use scene_file::scene_meshes;
pub use surroundings::Surroundings;
pub use usd_file::usd_files;
