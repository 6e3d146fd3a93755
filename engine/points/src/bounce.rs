//! Light that was reflected more than once: the points of a scene as receivers ([`BounceReceivers`]), and the same points with
//! what these received reflected too ([`BouncedPoints`]), to be built into the scene of one bounce more (design: a derived scene).
//!
//! Indirect light changes slowly, and what is gathered from these points is averaged over clusters of them: neighbours on
//! one flat piece of surface share a receiver. Which do follows from the points and their order alone.

use crate::cloud::CloudOptions;
use crate::cloud::scene_points::ScenePoints;
use crate::error::PointsError;
use glam::Vec3;
use pbgi_core::point::Sides;
use pbgi_core::{Bounds, PointRecord, PointStream};
use std::f32::consts::PI;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};

/// Most points that share a receiver.
const GROUP_POINTS_MAX: usize = 8;
/// Cosine of the largest angle between the normals of points that share one: 20 degrees.
const GROUP_COSINE_MIN: f32 = 0.94;
/// How far from each other such points lie at most, in radii.
const GROUP_REACH: f32 = 6.0;
/// How far beside each other's plane.
const GROUP_DEPTH: f32 = 0.5;

/// Bytes of what a receiver received in the file that [`BouncedPoints`] reads: red, green, blue, little-endian floats, W/m2.
pub const RECEIVED_BYTES: usize = 12;

/// The points of a scene, cut into groups that share receivers.
struct Groups {
    points: ScenePoints,
    read: Vec<PointRecord>,
    /// Points before this one have been given.
    start: usize,
    ended: bool,
}

impl Groups {
    fn open(scene: &Path) -> Result<Self, PointsError> {
        Ok(Self {
            points: ScenePoints::open(scene, [0.0; 3], &CloudOptions::default())?,
            read: Vec::new(),
            start: 0,
            ended: false,
        })
    }

    /// The next group, in the scene's order; empty at the end.
    fn next(&mut self) -> Result<&[PointRecord], PointsError> {
        while self.read.len() - self.start < GROUP_POINTS_MAX && !self.ended {
            self.read.drain(..self.start);
            self.start = 0;
            self.ended = !self.points.next_batch(&mut self.read)?;
        }
        let rest = &self.read[self.start..];
        let group = &rest[..group_length(rest)];
        self.start += group.len();
        Ok(group)
    }

    fn rewind(&mut self) -> Result<(), PointsError> {
        self.read.clear();
        (self.start, self.ended) = (0, false);
        self.points.rewind()
    }
}

/// How many of the first points share a receiver.
fn group_length(points: &[PointRecord]) -> usize {
    let Some(first) = points.first() else { return 0 };
    let (normal, center) = (first.normal(), Vec3::from(first.position));
    let belongs = |point: &&PointRecord| {
        let apart = Vec3::from(point.position) - center;
        let radius = point.radius.min(first.radius);
        point.normal().dot(normal) >= GROUP_COSINE_MIN
            && apart.length() <= GROUP_REACH * radius
            && apart.dot(normal).abs() <= GROUP_DEPTH * radius
    };
    1 + points[1..]
        .iter()
        .take(GROUP_POINTS_MAX - 1)
        .take_while(belongs)
        .count()
}

/// Which sides of a group's points reflect.
fn reflecting(group: &[PointRecord]) -> [bool; 2] {
    [
        group.iter().any(PointRecord::reflects),
        group.iter().any(|point| point.reflectance().both_sides),
    ]
}

/// Where a group receives: at the point nearest to its middle, in the mean of its directions.
fn middle(group: &[PointRecord]) -> (Vec3, Vec3) {
    let count = group.len() as f32;
    let center = group.iter().map(|point| Vec3::from(point.position)).sum::<Vec3>() / count;
    let distance = |point: &&PointRecord| Vec3::from(point.position).distance_squared(center);
    let nearest = group.iter().min_by(|a, b| distance(a).total_cmp(&distance(b)));
    let normal = group.iter().map(PointRecord::normal).sum::<Vec3>();
    let place = nearest.map_or(center, |point| point.position.into());
    (place, normal.normalize_or(Vec3::Y))
}

/// The receivers of a scene's points: for every group of neighbours whose fronts reflect one on that side, then, where their
/// backs do, one on the other.
pub struct BounceReceivers {
    groups: Groups,
    points_done: u64,
}

impl BounceReceivers {
    /// Of a scene directory.
    ///
    /// # Errors
    /// No scene, or a damaged one.
    pub fn open(scene: &Path) -> Result<Self, PointsError> {
        Ok(Self {
            groups: Groups::open(scene)?,
            points_done: 0,
        })
    }

    /// Points of the scene.
    pub fn points(&self) -> u64 {
        self.groups.points.len_hint().unwrap_or(0)
    }

    /// How many of them have been looked at.
    pub fn points_done(&self) -> u64 {
        self.points_done
    }

    /// Appends position and unit normal (world space) of the next receivers, at least `count` unless the end comes before.
    ///
    /// # Errors
    /// A page that cannot be read.
    pub fn next(&mut self, count: usize, receivers: &mut Vec<[[f32; 3]; 2]>) -> Result<(), PointsError> {
        let wanted = receivers.len() + count;
        while receivers.len() < wanted {
            let group = self.groups.next()?;
            if group.is_empty() {
                return Ok(());
            }
            let [front, back] = reflecting(group);
            let (place, normal) = middle(group);
            let sides = [(front, normal), (back, -normal)];
            receivers.extend(
                sides
                    .into_iter()
                    .filter(|(reflects, _)| *reflects)
                    .map(|(_, normal)| [place.to_array(), normal.to_array()]),
            );
            self.points_done += group.len() as u64;
        }
        Ok(())
    }
}

/// The points of a scene as they are, but that each side sends out, beside its own radiance L, what it reflects of the irradiance E
/// that its receiver received: `L + albedo E / pi`.
pub struct BouncedPoints {
    groups: Groups,
    received: BufReader<File>,
    path: PathBuf,
}

impl BouncedPoints {
    /// Of a scene directory and a file with [`RECEIVED_BYTES`] for each of its receivers, in their order.
    ///
    /// # Errors
    /// Neither can be read.
    pub fn open(scene: &Path, received: &Path) -> Result<Self, PointsError> {
        let file = File::open(received).map_err(PointsError::io("open", received))?;
        Ok(Self {
            groups: Groups::open(scene)?,
            received: BufReader::with_capacity(1 << 18, file),
            path: received.to_owned(),
        })
    }
}

fn next_received(received: &mut BufReader<File>, path: &Path) -> Result<[f32; 3], PointsError> {
    let mut bytes = [0; RECEIVED_BYTES];
    received.read_exact(&mut bytes).map_err(PointsError::io("read", path))?;
    let [r, g, b] = [0, 4, 8].map(|at| f32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]));
    Ok([r, g, b])
}

impl PointStream for BouncedPoints {
    type Error = PointsError;

    fn bounds(&self) -> Option<Bounds> {
        self.groups.points.bounds()
    }

    fn len_hint(&self) -> Option<u64> {
        self.groups.points.len_hint()
    }

    fn origin(&self) -> [f64; 3] {
        self.groups.points.origin()
    }

    fn next_batch(&mut self, batch: &mut Vec<PointRecord>) -> Result<bool, PointsError> {
        let wanted = batch.len() + crate::limits::BATCH_POINTS;
        let before = batch.len();
        while batch.len() < wanted {
            let group = self.groups.next()?;
            if group.is_empty() {
                break;
            }
            let mut light = [Vec3::ZERO; 2];
            for (light, reflects) in light.iter_mut().zip(reflecting(group)) {
                if reflects {
                    *light = next_received(&mut self.received, &self.path)?.into();
                }
            }
            batch.extend(group.iter().map(|point| bounced(point, light)));
        }
        Ok(batch.len() > before)
    }

    fn rewind(&mut self) -> Result<(), PointsError> {
        use std::io::Seek;
        self.received.rewind().map_err(PointsError::io("read", &self.path))?;
        self.groups.rewind()
    }
}

fn bounced(point: &PointRecord, irradiance: [Vec3; 2]) -> PointRecord {
    let (sides, reflectance) = (point.sides(), point.reflectance());
    let albedo = Vec3::from(reflectance.albedo);
    let share = if reflectance.both_sides { albedo } else { Vec3::ZERO };
    let [front, back] = irradiance;
    point.with_sides(Sides {
        front: (Vec3::from(sides.front) + albedo * front / PI).to_array(),
        back: (Vec3::from(sides.back) + share * back / PI).to_array(),
    })
}
