//! From paths to one stream of points, whatever the files are.

use crate::cloud::las::{LasPoints, common_origin};
use crate::cloud::ptc::PtcPoints;
use crate::cloud::scene_points::ScenePoints;
use crate::cloud::{Cloud, CloudOptions, Missing, Radius};
use crate::error::PointsError;
use crate::estimate::{Estimated, Means};
use crate::limits;
use crate::ply::{self, PlyPoints};
use crate::sample::MeshPoints;
use crate::scene::MeshScene;
use pbgi_core::{Bounds, PointRecord, PointStream};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// How densely meshes are sampled.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Density {
    /// Distance between neighbouring points, world units: each stands for an area of its square.
    Spacing(f32),
    /// About this many points on all surfaces of all mesh files together, before masked texels are cut out.
    Points(u64),
    /// As finely as a camera sees them.
    View(ViewDensity),
}

/// Points of the size of pixels: near ones are close together, far ones and those that the camera does not see are not.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ViewDensity {
    /// Number of the scene's camera.
    pub camera: usize,
    /// Width and height of its picture, pixels.
    pub size: [u32; 2],
    /// Distance between neighbouring points, pixels.
    pub pixels: f32,
    /// Least distance, world units; `None` for a 20,000th of the scene's diagonal.
    pub floor: Option<f32>,
    /// Greatest distance, world units; `None` for a 200th of the diagonal.
    pub ceiling: Option<f32>,
}

/// How meshes become points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SampleOptions {
    /// How densely.
    pub density: Density,
    /// Threads that light the points; the points do not depend on it.
    pub threads: usize,
}

impl Default for SampleOptions {
    /// [`limits::POINTS_DEFAULT`] points, [`limits::THREADS_DEFAULT`] threads.
    fn default() -> Self {
        Self {
            density: Density::Points(limits::POINTS_DEFAULT),
            threads: limits::THREADS_DEFAULT,
        }
    }
}

/// How files become points.
#[derive(Clone, Debug, PartialEq)]
pub struct InputOptions {
    /// How densely meshes are sampled.
    pub density: Density,
    /// For clouds.
    pub cloud: CloudOptions,
    /// Threads that light points or look for their neighbours; the points do not depend on it.
    pub threads: usize,
    /// Memory for all that the input keeps: geometry, textures, points on their way to normals and radii.
    pub memory_bytes: u64,
    /// Where points go that do not fit it.
    pub scratch_dir: PathBuf,
}

impl Default for InputOptions {
    /// [`limits::INPUT_MEMORY_DEFAULT`], the system's folder for temporary files.
    fn default() -> Self {
        Self {
            density: SampleOptions::default().density,
            cloud: CloudOptions::default(),
            threads: limits::THREADS_DEFAULT,
            memory_bytes: limits::INPUT_MEMORY_DEFAULT,
            scratch_dir: std::env::temp_dir(),
        }
    }
}

/// Files as one stream of points.
pub struct Input {
    streams: Vec<Source>,
    current: usize,
    origin: [f64; 3],
}

/// What a stream is made of.
enum Source {
    Meshes(Box<MeshPoints>),
    Cloud(Box<dyn Cloud>, Option<f32>),
    Estimated(Box<Estimated>),
}

/// Kinds of files, told by their names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    Mesh,
    Ply,
    Las,
    Ptc,
    Scene,
}

/// Opens files as one stream of points. Mesh files (`.gltf`, `.glb`, `.obj`, `.usd*`, `.ply` with faces, scene files `.toml`) are put into one scene, so that each is lit
/// by the lights and shadowed by the surfaces of all; they come first, then the clouds (`.ply`, `.las`, `.laz`, `.ptc`, and
/// the points of built scenes, `.pbgi`) in the order given, those last whose normals or radii are estimated: they come in
/// Z-order, all files that lack the same together.
///
/// # Errors
/// No path, an unknown kind, a file that cannot be read, a cloud without normals or radii where they are not to be
/// estimated, or a density that makes no sense.
pub fn open_input(paths: &[PathBuf], options: &InputOptions) -> Result<Input, PointsError> {
    if paths.is_empty() {
        return Err(PointsError::Request("no input file is given".to_owned()));
    }
    let kinds: Vec<(Kind, &Path)> = paths
        .iter()
        .map(|path| Ok((kind(path)?, path.as_path())))
        .collect::<Result<_, PointsError>>()?;
    let meshes: Vec<&Path> = of_kind(&kinds, Kind::Mesh);
    let mut input = Input {
        streams: Vec::new(),
        current: 0,
        origin: origin(&kinds, &options.cloud)?,
    };
    if !meshes.is_empty() {
        let scene = MeshScene::load_within(&meshes, options.memory_bytes)?;
        let sample = SampleOptions {
            density: options.density,
            threads: options.threads,
        };
        input
            .streams
            .push(Source::Meshes(Box::new(MeshPoints::new(scene, &sample)?)));
    }
    let mut lacking: BTreeMap<(Missing, bool), Vec<Box<dyn Cloud>>> = BTreeMap::new();
    for (kind, path) in kinds {
        if kind == Kind::Mesh {
            continue;
        }
        let cloud = open_cloud(path, input.origin, &options.cloud)?;
        let missing = cloud.missing();
        check_missing(path, missing, &options.cloud)?;
        match options.cloud.radius {
            Some(Radius::Fixed(radius)) if missing.radii && !missing.normals => {
                input.streams.push(Source::Cloud(cloud, Some(radius)));
            }
            _ if missing == Missing::default() => input.streams.push(Source::Cloud(cloud, None)),
            _ => {
                let key = (missing, cloud.is_aerial());
                lacking.entry(key).or_default().push(cloud);
            }
        }
    }
    let share = options.memory_bytes / lacking.len().max(1) as u64;
    for clouds in lacking.into_values() {
        let means = Means {
            threads: options.threads,
            memory_bytes: share,
            scratch_dir: &options.scratch_dir,
        };
        let estimated = Estimated::new(clouds, &options.cloud, &means)?;
        input.streams.push(Source::Estimated(Box::new(estimated)));
    }
    Ok(input)
}

/// Opens one cloud; positions are relative to `origin`.
pub(crate) fn open_cloud(path: &Path, origin: [f64; 3], options: &CloudOptions) -> Result<Box<dyn Cloud>, PointsError> {
    Ok(match kind_by_name(path)? {
        Kind::Mesh => return Err(PointsError::unsupported(path, "a mesh as a cloud", "sample it first")),
        Kind::Ply => Box::new(PlyPoints::open(path, origin, options)?),
        Kind::Las => Box::new(LasPoints::open(path, origin, options)?),
        Kind::Ptc => Box::new(PtcPoints::open(path, origin, options)?),
        Kind::Scene => Box::new(ScenePoints::open(path, origin, options)?),
    })
}

/// What [`open_input`] will subtract from the positions of clouds, read from headers.
///
/// # Errors
/// A header that cannot be read.
pub fn origin_of(paths: &[PathBuf], options: &CloudOptions) -> Result<[f64; 3], PointsError> {
    let kinds: Vec<(Kind, &Path)> = paths
        .iter()
        .map(|path| Ok((kind(path)?, path.as_path())))
        .collect::<Result<_, PointsError>>()?;
    origin(&kinds, options)
}

fn origin(kinds: &[(Kind, &Path)], options: &CloudOptions) -> Result<[f64; 3], PointsError> {
    match options.origin {
        Some(origin) if origin.iter().all(|axis| axis.is_finite()) => Ok(origin),
        Some(origin) => Err(PointsError::Request(format!("origin is {origin:?}, must be finite"))),
        // Meshes are not moved, and the clouds beside them must not be either.
        None if kinds.iter().any(|(kind, _)| *kind == Kind::Mesh) => Ok([0.0; 3]),
        None => common_origin(&of_kind(kinds, Kind::Las)),
    }
}

fn of_kind<'a>(kinds: &[(Kind, &'a Path)], wanted: Kind) -> Vec<&'a Path> {
    let chosen = kinds.iter().filter(|(kind, _)| *kind == wanted);
    chosen.map(|(_, path)| *path).collect()
}

/// What a build makes of a file: a PLY file with faces is a mesh.
fn kind(path: &Path) -> Result<Kind, PointsError> {
    Ok(match kind_by_name(path)? {
        Kind::Ply if ply::mesh::has_faces(path)? => Kind::Mesh,
        kind => kind,
    })
}

/// What a file is by its name alone, whether it is there or not: the vertices of a PLY file are a cloud.
pub(crate) fn kind_by_name(path: &Path) -> Result<Kind, PointsError> {
    Ok(match extension(path).as_str() {
        "gltf" | "glb" | "obj" | "toml" | "usd" | "usda" | "usdc" | "usdz" => Kind::Mesh,
        "ply" => Kind::Ply,
        "las" | "laz" => Kind::Las,
        "ptc" => Kind::Ptc,
        "pbgi" => Kind::Scene,
        other => {
            let what = format!("input of kind {other:?}");
            return Err(PointsError::unsupported(
                path,
                what,
                "convert it to .glb, .gltf, .usd, .obj, .ply, .las, .laz or .ptc, or describe it in a scene file, .toml",
            ));
        }
    })
}

fn check_missing(path: &Path, missing: Missing, options: &CloudOptions) -> Result<(), PointsError> {
    if missing.normals && options.estimate_normals.is_none() {
        let what = "the points have no normals (nx, ny, nz): give --estimate-normals, or a file with normals";
        return Err(PointsError::invalid(path, what));
    }
    if missing.radii && options.radius.is_none() {
        let what =
            "the points have no radius: give --radius auto, or --radius with about 0.56 of the distance between points";
        return Err(PointsError::invalid(path, what));
    }
    if let Some(Radius::Fixed(radius)) = options.radius
        && !(radius > 0.0 && radius.is_finite())
    {
        return Err(PointsError::Request(format!(
            "radius is {radius}, must be a length above 0"
        )));
    }
    Ok(())
}

/// The part of the file name after the last dot, lower case; empty without one.
pub(crate) fn extension(path: &Path) -> String {
    let extension = path.extension().unwrap_or_default();
    extension.to_string_lossy().to_ascii_lowercase()
}

impl Input {
    /// Bytes that the input keeps while it is read, at most.
    pub fn memory_bytes(&self) -> u64 {
        let kept = |source: &Source| match source {
            Source::Meshes(points) => points.scene().memory_bytes(),
            Source::Cloud(..) => 0,
            Source::Estimated(estimated) => estimated.memory_bytes(),
        };
        self.streams.iter().map(kept).sum()
    }

    /// Points that could not be used and were dropped, since the start of this reading.
    pub fn skipped(&self) -> u64 {
        let skipped = |source: &Source| match source {
            Source::Meshes(_) => 0,
            Source::Cloud(cloud, _) => cloud.skipped(),
            Source::Estimated(estimated) => estimated.skipped(),
        };
        self.streams.iter().map(skipped).sum()
    }
}

impl Source {
    fn stream(&self) -> &dyn PointStream<Error = PointsError> {
        match self {
            Self::Meshes(points) => points.as_ref(),
            Self::Cloud(cloud, _) => cloud.as_ref(),
            Self::Estimated(estimated) => estimated.as_ref(),
        }
    }

    fn stream_mut(&mut self) -> &mut dyn PointStream<Error = PointsError> {
        match self {
            Self::Meshes(points) => points.as_mut(),
            Self::Cloud(cloud, _) => cloud.as_mut(),
            Self::Estimated(estimated) => estimated.as_mut(),
        }
    }
}

impl PointStream for Input {
    type Error = PointsError;

    fn bounds(&self) -> Option<Bounds> {
        let mut all = Bounds::EMPTY;
        for source in &self.streams {
            all.merge(&source.stream().bounds()?);
        }
        Some(all)
    }

    fn len_hint(&self) -> Option<u64> {
        self.streams.iter().map(|source| source.stream().len_hint()).sum()
    }

    fn origin(&self) -> [f64; 3] {
        if self.origin != [0.0; 3] {
            return self.origin;
        }
        // Scenes whose points were moved once, and are not moved again.
        let mut origins = self.streams.iter().map(|source| source.stream().origin());
        let first = origins.next().unwrap_or_default();
        if origins.all(|origin| origin == first) {
            first
        } else {
            [0.0; 3]
        }
    }

    fn next_batch(&mut self, batch: &mut Vec<PointRecord>) -> Result<bool, PointsError> {
        while let Some(source) = self.streams.get_mut(self.current) {
            let before = batch.len();
            if source.stream_mut().next_batch(batch)? {
                if let Source::Cloud(_, Some(radius)) = source {
                    batch[before..].iter_mut().for_each(|point| point.radius = *radius);
                }
                return Ok(true);
            }
            self.current += 1;
        }
        Ok(false)
    }

    fn rewind(&mut self) -> Result<(), PointsError> {
        self.current = 0;
        self.streams
            .iter_mut()
            .try_for_each(|source| source.stream_mut().rewind())
    }
}
