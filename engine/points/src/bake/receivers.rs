//! The points of a cloud as receivers, along the Z-curve: [`Receivers`].

use crate::cloud::{Cloud, CloudOptions, Facing, place_of};
use crate::error::PointsError;
use crate::estimate::{Estimated, Means};
use crate::open::{InputOptions, Kind, kind_by_name, open_cloud};
use pbgi_core::{Bounds, PointRecord, PointStream};
use std::path::Path;

/// A point where light is gathered, world space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Receiver {
    /// Which point of the file it is, from 0.
    pub place: u64,
    /// Position.
    pub position: [f32; 3],
    /// Unit normal.
    pub normal: [f32; 3],
}

/// The points of a cloud, neighbours together. Points of a scene come in its order, others are brought into order, through
/// scratch where they do not fit the memory; points without normals get them from their neighbours, as in a build.
pub struct Receivers {
    source: Source,
    points: Vec<PointRecord>,
    count: u64,
}

enum Source {
    InOrder(Box<dyn Cloud>),
    Ordered(Box<Estimated>),
}

impl Receivers {
    /// Opens a cloud; its positions are relative to `options.cloud.origin`.
    ///
    /// # Errors
    /// A mesh, a file that cannot be read, or too little memory.
    pub fn open(path: &Path, options: &InputOptions) -> Result<Self, PointsError> {
        let origin = options.cloud.origin.unwrap_or_default();
        let mut cloud = open_cloud(path, origin, &options.cloud)?;
        let missing = cloud.missing();
        let count = cloud.len_hint().unwrap_or(0);
        cloud.number();
        let source = if kind_by_name(path)? == Kind::Scene {
            Source::InOrder(cloud)
        } else {
            let wanted = CloudOptions {
                estimate_normals: missing
                    .normals
                    .then(|| options.cloud.estimate_normals.unwrap_or(Facing::Auto)),
                radius: None,
                ..options.cloud
            };
            let means = Means {
                threads: options.threads,
                memory_bytes: options.memory_bytes,
                scratch_dir: &options.scratch_dir,
            };
            Source::Ordered(Box::new(Estimated::new(vec![cloud], &wanted, &means)?))
        };
        Ok(Self {
            source,
            points: Vec::new(),
            count,
        })
    }

    /// Points of the file.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// A box that holds them, where known.
    pub fn bounds(&self) -> Option<Bounds> {
        match &self.source {
            Source::InOrder(cloud) => cloud.bounds(),
            Source::Ordered(estimated) => estimated.bounds(),
        }
    }

    /// Points that could not be used and are no receivers, so far.
    pub fn skipped(&self) -> u64 {
        match &self.source {
            Source::InOrder(cloud) => cloud.skipped(),
            Source::Ordered(estimated) => estimated.skipped(),
        }
    }

    /// Appends the next ones; `false` when there was none left. Bringing them into order takes many calls that give none.
    ///
    /// # Errors
    /// Unreadable input or an invalid point.
    pub fn next_batch(&mut self, batch: &mut Vec<Receiver>) -> Result<bool, PointsError> {
        let more = match &mut self.source {
            Source::InOrder(cloud) => cloud.next_batch(&mut self.points)?,
            Source::Ordered(estimated) => estimated.next_batch(&mut self.points)?,
        };
        batch.extend(self.points.drain(..).map(|point| Receiver {
            place: place_of(&point),
            position: point.position,
            normal: point.normal().to_array(),
        }));
        Ok(more)
    }
}
