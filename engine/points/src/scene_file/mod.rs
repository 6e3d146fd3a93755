//! Scene files: TOML texts that put mesh files, lights and cameras together. docs/scenes.md describes them.

mod entries;
mod lights;
mod place;

use crate::camera::Camera;
use crate::error::PointsError;
use crate::geometry::Instance;
use crate::limits;
use crate::material::Material;
use crate::named_file::beside;
use crate::scene::SceneParts;
use crate::surroundings::Surroundings;
use entries::{Description, Mesh, View};
use glam::{DAffine3, Mat4, Vec3};
use place::Transform;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use toml::Spanned;

/// Reads a file and all that it names; `read_mesh` reads a mesh file beside what there is already.
pub(crate) fn read(
    path: &Path,
    read_mesh: &dyn Fn(&Path, &SceneParts) -> Result<SceneParts, PointsError>,
) -> Result<SceneParts, PointsError> {
    let mut text = Text::open(path)?;
    let description: Description = text.parse()?;
    let cameras = description.camera.iter();
    // Before those of files, so that their numbers do not depend on what these hold.
    let cameras = cameras
        .filter_map(|view| text.value(view, camera(view.as_ref())))
        .collect();
    let environment = description.environment.as_ref();
    let environment = environment.and_then(|environment| text.file(&environment.as_ref().file));
    let environment = environment.map(Surroundings::picture);
    let mut parts = SceneParts {
        cameras,
        environment,
        ..SceneParts::default()
    };
    lights::add(&description.light, &mut text, &mut parts)?;
    let mut meshes = Vec::new();
    for mesh in &description.mesh {
        let file = text.file(&mesh.as_ref().file);
        let places = places(mesh, &mut text);
        let albedo = mesh.as_ref().albedo;
        if albedo.is_some_and(|albedo| !albedo.iter().all(|value| (0.0..=1.0).contains(value))) {
            text.note(mesh.span().start, "albedo must be three numbers from 0 to 1");
        }
        meshes.extend(file.map(|file| (file, mesh.as_ref(), places)));
    }
    text.finish()?;
    for (file, mesh, places) in meshes {
        let read = read_mesh(&file, &parts)?;
        let count = read.instances.len().saturating_mul(places.len());
        if count > limits::INSTANCES_MAX {
            return Err(PointsError::Limit {
                what: "number of placed meshes",
                value: count as u64,
                limit: limits::INSTANCES_MAX as u64,
                path: path.to_owned(),
            });
        }
        parts.append(placed(read, mesh, &places));
    }
    Ok(parts)
}

/// The mesh files that a scene file names.
///
/// # Errors
/// It cannot be read, or is no scene file.
pub fn scene_meshes(path: &Path) -> Result<Vec<PathBuf>, PointsError> {
    let mut text = Text::open(path)?;
    let description: Description = text.parse()?;
    let meshes = description.mesh.iter();
    let files = meshes.filter_map(|mesh| text.file(&mesh.as_ref().file)).collect();
    text.finish()?;
    Ok(files)
}

/// Where each instance of a mesh is.
fn places(mesh: &Spanned<Mesh>, text: &mut Text<'_>) -> Vec<DAffine3> {
    let Some(own) = text.value(mesh, mesh.as_ref().own().matrix()) else {
        return Vec::new();
    };
    let instances = &mesh.as_ref().instances;
    if instances.is_empty() {
        return vec![own];
    }
    let world = |instance: &Spanned<Transform>| Some(text.value(instance, instance.as_ref().matrix())? * own);
    instances.iter().filter_map(world).collect()
}

/// What a mesh file holds, put where it is wanted.
fn placed(mut parts: SceneParts, mesh: &Mesh, places: &[DAffine3]) -> SceneParts {
    let (instances, lights, cameras) = (
        std::mem::take(&mut parts.instances),
        std::mem::take(&mut parts.lights),
        std::mem::take(&mut parts.cameras),
    );
    for (index, place) in places.iter().enumerate() {
        let moved = |instance: &Instance| Instance::new(instance.geometry(), &(*place * instance.world_from_local()));
        parts.instances.extend(instances.iter().map(moved));
        if mesh.lights {
            parts.lights.extend(lights.iter().map(|light| light.moved(place)));
        }
        // One camera of each is enough.
        if mesh.cameras && index == 0 {
            parts.cameras.extend(cameras.iter().map(|camera| camera.moved(place)));
        }
    }
    let surroundings = parts.environment.take().filter(|_| mesh.lights);
    parts.environment = surroundings.and_then(|all| Some(all.moved(places.first()?)));
    if let Some(albedo) = mesh.albedo {
        for material in &mut parts.materials {
            *material = Material {
                albedo,
                ..Material::default()
            };
        }
        for geometry in &mut parts.geometries {
            geometry.colors.clear();
        }
    }
    parts
}

fn camera(view: &View) -> Result<Camera, String> {
    let (eye, target, up) = (Vec3::from(view.position), Vec3::from(view.target), Vec3::from(view.up));
    if !(eye.is_finite() && target.is_finite() && up.is_finite()) {
        return Err("position, target and up must be finite numbers".to_owned());
    }
    if (target - eye)
        .normalize_or_zero()
        .cross(up.normalize_or_zero())
        .length()
        < 1e-4
    {
        return Err(
            "the camera needs a target other than its position, and an up that is not along its view".to_owned(),
        );
    }
    if !(view.fov > 0.0 && view.fov < 180.0) {
        return Err(format!(
            "fov is {}, must be a vertical angle above 0 and below 180 degrees",
            view.fov
        ));
    }
    if view.aspect.is_some_and(|aspect| !(aspect > 0.0 && aspect.is_finite())) {
        return Err("aspect must be a width over a height, above 0".to_owned());
    }
    Ok(Camera {
        name: view.name.clone(),
        aspect_ratio: view.aspect,
        ..Camera::look_at_upright(eye, target, up, view.fov.to_radians())
    })
}

/// A scene file's text, and the problems found in it.
struct Text<'a> {
    path: &'a Path,
    text: String,
    problems: Vec<String>,
}

impl<'a> Text<'a> {
    fn open(path: &'a Path) -> Result<Self, PointsError> {
        let file = File::open(path).map_err(PointsError::io("open", path))?;
        let mut bytes = Vec::new();
        let mut limited = file.take(limits::SCENE_FILE_BYTES_MAX + 1);
        limited.read_to_end(&mut bytes).map_err(PointsError::io("read", path))?;
        if bytes.len() as u64 > limits::SCENE_FILE_BYTES_MAX {
            return Err(PointsError::Limit {
                what: "number of bytes",
                value: bytes.len() as u64,
                limit: limits::SCENE_FILE_BYTES_MAX,
                path: path.to_owned(),
            });
        }
        let text = String::from_utf8(bytes).map_err(|_| PointsError::invalid(path, "the file is no UTF-8 text"))?;
        Ok(Self {
            path,
            text,
            problems: Vec::new(),
        })
    }

    fn parse(&self) -> Result<Description, PointsError> {
        toml::from_str(&self.text).map_err(|error| {
            let start = error.span().map_or(0, |span| span.start);
            PointsError::Scene(vec![self.line(start, &error.message().trim().replace('\n', ", "))])
        })
    }

    fn line(&self, start: usize, what: &str) -> String {
        let before = self.text.as_bytes().get(..start).unwrap_or_default();
        let line = 1 + before.iter().filter(|&&byte| byte == b'\n').count();
        format!("{}:{line}: {what}", self.path.display())
    }

    /// Notes what is wrong at a byte of the text.
    fn note(&mut self, start: usize, what: &str) {
        self.problems.push(self.line(start, what));
    }

    /// What was made of an entry, or a problem more.
    fn value<T, V>(&mut self, entry: &Spanned<T>, made: Result<V, String>) -> Option<V> {
        made.map_err(|what| self.note(entry.span().start, &what)).ok()
    }

    /// A file that is named, beside the scene or below.
    fn file(&mut self, name: &Spanned<String>) -> Option<PathBuf> {
        let found = beside(self.path, name.as_ref());
        let made = found.map_err(|_| {
            format!(
                "file {:?} is outside of the scene's folder: put it beside the scene file, or below",
                name.as_ref()
            )
        });
        let file = self.value(name, made)?;
        if std::fs::metadata(&file).is_err() {
            self.note(
                name.span().start,
                &format!("there is no file {:?}", file.display().to_string()),
            );
            return None;
        }
        Some(file)
    }

    fn finish(self) -> Result<(), PointsError> {
        match self.problems.is_empty() {
            true => Ok(()),
            false => Err(PointsError::Scene(self.problems)),
        }
    }
}

impl Camera {
    /// The camera where `place` brings it; scale is no part of a camera.
    pub(crate) fn moved(&self, place: &DAffine3) -> Self {
        let world = glam::DMat4::from(*place) * self.world_from_camera.as_dmat4();
        let axis = |index: usize| world.col(index).truncate().as_vec3();
        let back = axis(2).normalize_or(Vec3::Z);
        let right = axis(1).cross(back).normalize_or(Vec3::X);
        let up = back.cross(right);
        Self {
            world_from_camera: Mat4::from_cols(
                right.extend(0.0),
                up.extend(0.0),
                back.extend(0.0),
                axis(3).extend(1.0),
            ),
            ..self.clone()
        }
    }
}
