//! From paths to one stream of points, whatever the files are.

use crate::error::PointsError;
use crate::limits;
use crate::ply::PlyPoints;
use crate::sample::MeshPoints;
use crate::scene::MeshScene;
use pbgi_core::{Bounds, PointRecord, PointStream};
use std::path::{Path, PathBuf};

/// How densely meshes are sampled.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Density {
    /// Distance between neighbouring points, world units: each stands for an area of its square.
    Spacing(f32),
    /// About this many points on all surfaces of all mesh files together, before masked texels are cut out.
    Points(u64),
}

/// How meshes become points. Clouds are taken as they are.
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

/// A stream of points from files, whatever their kinds.
pub type BoxedPointStream = Box<dyn PointStream<Error = PointsError> + Send>;

/// Opens files as one stream of points. Mesh files (`.gltf`, `.glb`, `.obj`) are put into one scene, so that each is lit
/// by the lights and shadowed by the surfaces of all; they come first, then the clouds (`.ply`) in the order given.
///
/// # Errors
/// No path, an unknown kind, a file that cannot be read, or a density that makes no sense.
pub fn open_input(paths: &[PathBuf], options: &SampleOptions) -> Result<BoxedPointStream, PointsError> {
    if paths.is_empty() {
        return Err(PointsError::Request("no input file is given".to_owned()));
    }
    let mut meshes = Vec::new();
    let mut streams: Vec<BoxedPointStream> = Vec::new();
    for path in paths {
        match extension(path).as_str() {
            "gltf" | "glb" | "obj" => meshes.push(path.as_path()),
            "ply" => streams.push(Box::new(PlyPoints::open(path)?)),
            other => {
                let what = format!("input of kind {other:?}");
                return Err(PointsError::unsupported(
                    path,
                    what,
                    "convert it to .glb, .gltf, .obj or .ply",
                ));
            }
        }
    }
    if !meshes.is_empty() {
        let scene = MeshScene::load_all(&meshes)?;
        streams.insert(0, Box::new(MeshPoints::new(scene, options)?));
    }
    if streams.len() == 1 {
        return Ok(streams.remove(0));
    }
    Ok(Box::new(Chain { streams, current: 0 }))
}

/// The part of the file name after the last dot, lower case; empty without one.
pub(crate) fn extension(path: &Path) -> String {
    let extension = path.extension().unwrap_or_default();
    extension.to_string_lossy().to_ascii_lowercase()
}

/// Streams one after another.
struct Chain {
    streams: Vec<BoxedPointStream>,
    current: usize,
}

impl PointStream for Chain {
    type Error = PointsError;

    fn bounds(&self) -> Option<Bounds> {
        let mut all = Bounds::EMPTY;
        for stream in &self.streams {
            all.merge(&stream.bounds()?);
        }
        Some(all)
    }

    fn len_hint(&self) -> Option<u64> {
        self.streams.iter().map(|stream| stream.len_hint()).sum()
    }

    fn next_batch(&mut self, batch: &mut Vec<PointRecord>) -> Result<bool, PointsError> {
        while let Some(stream) = self.streams.get_mut(self.current) {
            if stream.next_batch(batch)? {
                return Ok(true);
            }
            self.current += 1;
        }
        Ok(false)
    }

    fn rewind(&mut self) -> Result<(), PointsError> {
        self.current = 0;
        self.streams.iter_mut().try_for_each(|stream| stream.rewind())
    }
}
