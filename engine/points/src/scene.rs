//! A mesh scene in memory: triangles, where they are placed, what they are made of, lights and cameras.

use crate::camera::Camera;
use crate::error::PointsError;
use crate::geometry::{Barycentric, Geometry, Instance, area_vector};
use crate::light::Light;
use crate::material::{Material, Texture};
use crate::surroundings::Surroundings;
use crate::trace::Tracer;
use crate::{gltf_file, limits, obj_file, ply, scene_file, usd_file};
use glam::{DAffine3, Vec3};
use pbgi_core::Bounds;
use std::path::Path;

/// Triangles with materials and textures, lights and cameras, ready to be sampled and traced. A mesh that is placed many
/// times is kept once.
pub struct MeshScene {
    pub(crate) geometries: Vec<Geometry>,
    pub(crate) instances: Vec<Instance>,
    pub(crate) materials: Vec<Material>,
    pub(crate) textures: Vec<Texture>,
    lights: Vec<Light>,
    cameras: Vec<Camera>,
    environment: Option<Surroundings>,
    area: f64,
    tracer: Tracer,
}

/// A place on a surface.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SurfaceId {
    pub(crate) instance: u32,
    pub(crate) triangle: u32,
    pub(crate) barycentric: Barycentric,
}

/// What a place on a surface looks like.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Appearance {
    pub(crate) albedo: Vec3,
    /// Radiance of the front, and of the back if `double_sided`.
    pub(crate) emission: Vec3,
    pub(crate) double_sided: bool,
}

/// What a reader makes of a file, before it is checked and indexed.
#[derive(Default)]
pub(crate) struct SceneParts {
    pub(crate) geometries: Vec<Geometry>,
    pub(crate) instances: Vec<Instance>,
    pub(crate) materials: Vec<Material>,
    pub(crate) textures: Vec<Texture>,
    pub(crate) lights: Vec<Light>,
    pub(crate) cameras: Vec<Camera>,
    pub(crate) environment: Option<Surroundings>,
}

impl MeshScene {
    /// Reads a mesh file, `.gltf`, `.glb`, `.obj`, `.ply` or (with the feature `usd`) `.usd*`, with the buffers and textures it
    /// names, or a scene file, `.toml`, with all the mesh files it names.
    ///
    /// # Errors
    /// No or a damaged file, a missing buffer or texture, an unsupported feature, no triangles, a vertex that is not finite.
    pub fn load(path: &Path) -> Result<Self, PointsError> {
        Self::load_all(&[path])
    }

    /// Reads several mesh files into one scene.
    ///
    /// # Errors
    /// As [`Self::load`], for the first file that cannot be read.
    pub fn load_all(paths: &[&Path]) -> Result<Self, PointsError> {
        Self::load_within(paths, u64::MAX)
    }

    /// As [`Self::load_all`], with a bound on the memory that the scene takes while it is read and indexed.
    ///
    /// # Errors
    /// As [`Self::load`]; [`PointsError::Memory`] with what is needed.
    pub fn load_within(paths: &[&Path], memory_bytes: u64) -> Result<Self, PointsError> {
        let mut all = SceneParts::default();
        let room = Room::new(memory_bytes);
        for path in paths {
            let left = room.less(all.memory_bytes());
            let parts = match crate::open::extension(path).as_str() {
                "toml" => {
                    let beside = |mesh: &Path, parts: &SceneParts| read_mesh(mesh, left.less(parts.memory_bytes()));
                    let parts = scene_file::read(path, &beside)?;
                    parts.check(path)?;
                    parts
                }
                _ => read_mesh(path, left)?,
            };
            all.append(parts);
            room.fits(all.memory_bytes())?;
        }
        Ok(Self::from_parts(all))
    }

    fn from_parts(mut parts: SceneParts) -> Self {
        for geometry in &mut parts.geometries {
            geometry.index();
        }
        let area_of = |instance: &Instance| {
            let geometry = &parts.geometries[instance.geometry()];
            match instance.area_scale() {
                Some(scale) => geometry.area() * scale,
                None => instance
                    .triangles(geometry)
                    .map(|corners| area_vector(&corners).length())
                    .sum(),
            }
        };
        let area = parts.instances.iter().map(area_of).sum();
        let tracer = Tracer::new(&parts.geometries, &parts.instances);
        Self {
            geometries: parts.geometries,
            instances: parts.instances,
            materials: parts.materials,
            textures: parts.textures,
            lights: parts.lights,
            cameras: parts.cameras,
            environment: parts.environment,
            area,
            tracer,
        }
    }

    /// The exact box of all triangles, world space.
    pub fn bounds(&self) -> Bounds {
        self.tracer.bounds()
    }

    /// Area of all triangles, square world units, cut-outs included.
    pub fn area(&self) -> f64 {
        self.area
    }

    /// Triangles, placed ones counted each time.
    pub fn triangle_count(&self) -> u64 {
        let count = |instance: &Instance| self.geometries[instance.geometry()].triangles.len() as u64;
        self.instances.iter().map(count).sum()
    }

    /// The punctual lights.
    pub fn lights(&self) -> &[Light] {
        &self.lights
    }

    /// The cameras, in the file's order.
    pub fn cameras(&self) -> &[Camera] {
        &self.cameras
    }

    /// What surrounds it, where a scene file or a USD stage says so.
    pub fn environment(&self) -> Option<&Surroundings> {
        self.environment.as_ref()
    }

    /// Camera number `index`; the first of a file without cameras is one that sees everything ([`Camera::framing`]).
    ///
    /// # Errors
    /// There is no such camera.
    pub fn camera(&self, index: usize) -> Result<Camera, PointsError> {
        if self.cameras.is_empty() && index == 0 {
            return Ok(Camera::framing(&self.bounds()));
        }
        self.cameras.get(index).cloned().ok_or_else(|| {
            let count = self.cameras.len();
            PointsError::Request(format!(
                "camera {index} is asked for, the scene has {count} (counted from 0)"
            ))
        })
    }

    /// Bytes that it takes at its peak, while it is indexed.
    pub fn memory_bytes(&self) -> u64 {
        memory_bytes(&self.geometries, &self.instances, &self.textures)
    }

    pub(crate) fn tracer(&self) -> &Tracer {
        &self.tracer
    }

    /// How far a ray must start from a surface not to hit it: a few hundred roundings of the largest coordinate at play.
    pub(crate) fn ray_offset(&self, position: Vec3) -> f32 {
        const ROUNDINGS: f32 = 256.0 * f32::EPSILON / 2.0;
        /// Surfaces of a scene far smaller than its place in the world.
        const EXTENT_SHARE: f32 = 0.1;
        (position.abs().max_element() + EXTENT_SHARE * self.bounds().diagonal()) * ROUNDINGS
    }

    /// Whether there is surface at this place of a triangle: its opacity reaches the cutoff.
    pub(crate) fn is_opaque(&self, geometry: usize, triangle: usize, barycentric: Barycentric) -> bool {
        let geometry = &self.geometries[geometry];
        let material = &self.materials[geometry.materials[triangle] as usize];
        let Some(cutoff) = material.cutoff else {
            return true;
        };
        let texture = material.opacity_texture.as_ref().or(material.albedo_texture.as_ref());
        let textured = texture.map_or(1.0, |slot| {
            let uv = geometry.uv(slot.uv_set, triangle, barycentric);
            self.textures[slot.texture].alpha(slot, uv)
        });
        textured * material.alpha >= cutoff
    }

    pub(crate) fn appearance(&self, geometry: usize, triangle: usize, barycentric: Barycentric) -> Appearance {
        let geometry = &self.geometries[geometry];
        let material = &self.materials[geometry.materials[triangle] as usize];
        let textured = |slot: &Option<crate::material::TextureSlot>| {
            slot.as_ref().map_or(Vec3::ONE, |slot| {
                let uv = geometry.uv(slot.uv_set, triangle, barycentric);
                let [r, g, b, _] = self.textures[slot.texture].sample(slot, uv);
                Vec3::new(r, g, b)
            })
        };
        let emission = if material.emits() {
            Vec3::from(material.emission) * textured(&material.emission_texture)
        } else {
            Vec3::ZERO
        };
        Appearance {
            albedo: Vec3::from(material.albedo)
                * textured(&material.albedo_texture)
                * geometry.color(triangle, barycentric),
            emission,
            double_sided: material.double_sided,
        }
    }
}

/// Reads and checks one mesh file.
fn read_mesh(path: &Path, room: Room) -> Result<SceneParts, PointsError> {
    // What is not there is reported by its reader.
    let length = std::fs::metadata(path).map_or(0, |metadata| metadata.len());
    room.fits(length)?;
    let parts = match crate::open::extension(path).as_str() {
        "gltf" | "glb" => gltf_file::read(path, room)?,
        "obj" => obj_file::read(path)?,
        "ply" => ply::mesh::read(path)?,
        "usd" | "usda" | "usdc" | "usdz" => usd_file::read(path, room)?,
        other => {
            let what = format!("a mesh of kind {other:?}");
            let remedy = "convert it to .glb, .gltf, .obj or a .ply with faces";
            return Err(PointsError::unsupported(path, what, remedy));
        }
    };
    parts.check(path)?;
    Ok(parts)
}

/// Memory that a scene may take while it is read and indexed, and what of it is taken.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Room {
    available: u64,
    taken: u64,
}

impl Room {
    pub(crate) fn new(available: u64) -> Self {
        Self { available, taken: 0 }
    }

    /// What is left when so many more bytes are taken.
    fn less(self, bytes: u64) -> Self {
        Self {
            taken: self.taken.saturating_add(bytes),
            ..self
        }
    }

    /// Whether so many bytes are to be had.
    pub(crate) fn fits(&self, bytes: u64) -> Result<(), PointsError> {
        let needed = self.taken.saturating_add(bytes);
        match needed <= self.available {
            true => Ok(()),
            false => Err(PointsError::Memory {
                what: "the geometry",
                needed,
                available: self.available,
            }),
        }
    }
}

/// Bytes of a scene at its peak, while its charts and BVHs are made.
fn memory_bytes(geometries: &[Geometry], instances: &[Instance], textures: &[Texture]) -> u64 {
    let geometry: usize = geometries.iter().map(Geometry::memory_bytes).sum();
    let textures: usize = textures.iter().map(|texture| size_of_val(&texture.texels[..])).sum();
    (geometry + textures + instances.len() * limits::INSTANCE_BYTES) as u64
}

impl SceneParts {
    pub(crate) fn memory_bytes(&self) -> u64 {
        memory_bytes(&self.geometries, &self.instances, &self.textures)
    }

    /// Puts a geometry to its `count` places: few triangles are copied into `world`, which [`Self::place_once`] takes in the end, for
    /// one BVH is faster; many are kept once.
    pub(crate) fn place(
        &mut self,
        path: &Path,
        world: &mut Geometry,
        local: Geometry,
        count: usize,
        mut places: impl Iterator<Item = DAffine3>,
    ) -> Result<(), PointsError> {
        let placed = local.triangles.len().saturating_mul(count);
        if count == 1 || placed <= limits::COPIED_TRIANGLES_MAX {
            return places.try_for_each(|place| world.append(path, &local, &place));
        }
        let geometry = self.geometries.len();
        self.instances.reserve_exact(count);
        self.instances
            .extend(places.map(|place| Instance::new(geometry, &place)));
        self.geometries.push(local);
        Ok(())
    }

    /// Takes a geometry that is in the world already.
    pub(crate) fn place_once(&mut self, world: Geometry) {
        if !world.triangles.is_empty() {
            self.instances
                .push(Instance::new(self.geometries.len(), &DAffine3::IDENTITY));
            self.geometries.push(world);
        }
    }

    pub(crate) fn append(&mut self, mut other: Self) {
        let (geometries, materials, textures) = (self.geometries.len(), self.materials.len(), self.textures.len());
        for geometry in &mut other.geometries {
            geometry
                .materials
                .iter_mut()
                .for_each(|material| *material += materials as u32);
        }
        for instance in &mut other.instances {
            instance.renumber(geometries);
        }
        for material in &mut other.materials {
            let slots = [
                &mut material.albedo_texture,
                &mut material.opacity_texture,
                &mut material.emission_texture,
            ];
            slots.into_iter().flatten().for_each(|slot| slot.texture += textures);
        }
        self.geometries.append(&mut other.geometries);
        self.instances.append(&mut other.instances);
        self.materials.append(&mut other.materials);
        self.textures.append(&mut other.textures);
        self.lights.append(&mut other.lights);
        self.cameras.append(&mut other.cameras);
        self.environment = self.environment.take().or(other.environment);
    }

    /// What no later code looks at again: there are triangles, and every placed vertex is a finite f32.
    fn check(&self, path: &Path) -> Result<(), PointsError> {
        let placed = |instance: &Instance| self.geometries[instance.geometry()].triangles.len();
        let triangles: usize = self.instances.iter().map(placed).sum();
        if triangles == 0 {
            let what =
                "the file has no triangles of any area in its scene: export a mesh, not only points, lines or curves";
            return Err(PointsError::invalid(path, what));
        }
        if self.instances.len() > limits::INSTANCES_MAX {
            return Err(PointsError::Limit {
                what: "number of placed meshes",
                value: self.instances.len() as u64,
                limit: limits::INSTANCES_MAX as u64,
                path: path.to_owned(),
            });
        }
        self.instances
            .iter()
            .try_for_each(|instance| instance.check(path, &self.geometries[instance.geometry()]))
    }
}
