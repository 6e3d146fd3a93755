//! Receivers in, irradiance and occlusion out.

use crate::cut::{Pack, Scratch, Walk, gather};
use crate::environment::ProbeMap;
use crate::frame::Frame;
use crate::interpolate::patches;
use crate::raster::{Raster, RasterTables, bent_normal, for_each_open};
use crate::simd::{Floats, LANES, Simd, Task};
use crate::source::{SceneSource, SourceError};
use bytemuck::{Pod, Zeroable};
use glam::Vec3;
use pbgi_core::{Environment, MortonCode, SceneInfo, SettingsError, ShadeSettings};
use std::f32::consts::PI;

/// Where light is gathered, world space. A receiver without a normal (or with a number that is not finite) is a hole.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub struct Receiver {
    /// Position.
    pub position: Vec3,
    /// Normal on the side that looks at the light, of any length.
    pub normal: Vec3,
}

/// What arrives at a receiver; zeros at a hole.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub struct Shaded {
    /// Irradiance, W/m2, R G B: `pi L` in a closed room of radiance L.
    pub irradiance: [f32; 3],
    /// Cosine-weighted share of the hemisphere that surfaces cover: 0 open, 1 closed.
    pub occlusion: f32,
    /// Mean open direction, unit, world space; the normal where nothing is open.
    pub bent_normal: [f32; 3],
}

/// Work done so far, summed over receivers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ShadeCounters {
    /// Receivers shaded or interpolated, holes not counted.
    pub receivers: u64,
    /// Clusters and discs rastered.
    pub cut_elements: u64,
    /// Nodes looked at.
    pub nodes_visited: u64,
}

/// Why a group could not be shaded.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ShadeError {
    /// A setting is out of range.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// The scene did not deliver.
    #[error(transparent)]
    Source(#[from] SourceError),
    /// The octree is larger than any honest one: a forged file.
    #[error("a receiver would visit more than {nodes} nodes: the scene is hostile or the solid angle far too small")]
    Budget {
        /// The limit.
        nodes: u32,
    },
    /// More receivers than places for their results, or fewer.
    #[error("{receivers} receivers for {results} results")]
    Lengths {
        /// Receivers given.
        receivers: usize,
        /// Results asked for.
        results: usize,
    },
}

/// Shades groups of receivers against one scene with one set of settings. One per thread.
pub struct Shader {
    info: SceneInfo,
    settings: ShadeSettings,
    tables: RasterTables,
    probe: Option<ProbeMap>,
    simd: Simd,
    scratch: Scratch,
    order: Vec<(u64, u32)>,
    counters: ShadeCounters,
}

impl Shader {
    /// Prepares for a scene.
    ///
    /// # Errors
    /// A setting out of range.
    pub fn new(
        info: &SceneInfo,
        settings: ShadeSettings,
        environment: Option<&Environment>,
    ) -> Result<Self, ShadeError> {
        settings.validate()?;
        let resolution = settings.raster_resolution as usize;
        Ok(Self {
            info: info.clone(),
            settings,
            tables: RasterTables::new(resolution),
            probe: environment.map(|environment| ProbeMap::new(environment, resolution)),
            simd: Simd::detect(),
            scratch: Scratch::default(),
            order: Vec::new(),
            counters: ShadeCounters::default(),
        })
    }

    /// Keeps to the instructions that every processor has, to compare with or to rule out; the results are the same.
    pub fn use_scalar(&mut self) {
        self.simd = Simd::Scalar;
    }

    /// Shades a group of neighbouring receivers. The results depend on the scene, the settings and the receivers alone.
    ///
    /// # Errors
    /// A page that cannot be had, a scene that contradicts itself, or slices of different lengths.
    pub fn shade_group<S: SceneSource>(
        &mut self,
        receivers: &[Receiver],
        source: &mut S,
        results: &mut [Shaded],
    ) -> Result<(), ShadeError> {
        if receivers.len() != results.len() {
            return Err(ShadeError::Lengths {
                receivers: receivers.len(),
                results: results.len(),
            });
        }
        results.fill(Shaded::default());
        let mut order = std::mem::take(&mut self.order);
        order_receivers(receivers, &mut order);
        let done = if self.settings.interpolation > 0.0 {
            self.interpolate(receivers, &order, source, results)
        } else {
            self.shade(receivers, &order, source, results)
        };
        self.counters.receivers += order.len() as u64;
        self.order = order;
        done
    }

    /// Shades some receivers, and lets the others have what these tell.
    fn interpolate<S: SceneSource>(
        &mut self,
        receivers: &[Receiver],
        order: &[(u64, u32)],
        source: &mut S,
        results: &mut [Shaded],
    ) -> Result<(), ShadeError> {
        let mut shaded = vec![false; receivers.len()];
        let mut wanted = Vec::new();
        let mut level = patches(receivers, order);
        while !level.is_empty() {
            wanted.clear();
            level.iter().for_each(|patch| patch.wanted(&shaded, &mut wanted));
            for &index in &wanted {
                shaded[index as usize] = true;
            }
            let now: Vec<(u64, u32)> = order
                .iter()
                .filter(|(_, index)| wanted.contains(index))
                .copied()
                .collect();
            self.shade(receivers, &now, source, results)?;
            let error = self.settings.interpolation;
            let halves = level
                .drain(..)
                .filter_map(|patch| patch.fill(receivers, &shaded, error, results));
            level = halves.flatten().collect();
        }
        Ok(())
    }

    fn shade<S: SceneSource>(
        &mut self,
        receivers: &[Receiver],
        order: &[(u64, u32)],
        source: &mut S,
        results: &mut [Shaded],
    ) -> Result<(), ShadeError> {
        let group = Group {
            walk: Walk {
                info: &self.info,
                settings: &self.settings,
                tables: &self.tables,
            },
            probe: self.probe.as_ref(),
            receivers,
            order,
            source,
            results,
            scratch: &mut self.scratch,
            counters: &mut self.counters,
        };
        self.simd.dispatch(group)
    }

    /// Work done since the start.
    pub fn counters(&self) -> ShadeCounters {
        self.counters
    }
}

/// Receivers in the order in which they are packed: those that look the same way together, along a Z-curve. Holes are left
/// out.
fn order_receivers(receivers: &[Receiver], order: &mut Vec<(u64, u32)>) {
    let usable = |receiver: &Receiver| receiver.position.is_finite() && receiver.normal.try_normalize().is_some();
    let (mut low, mut high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
    for receiver in receivers.iter().filter(|receiver| usable(receiver)) {
        low = low.min(receiver.position);
        high = high.max(receiver.position);
    }
    let extent = (high - low).max_element().max(f32::MIN_POSITIVE);
    let key = |receiver: &Receiver| {
        /// Steps along an axis; more would not fit the key.
        const STEPS: f32 = 1023.0;
        let place = ((receiver.position - low) / extent * STEPS).as_uvec3().to_array();
        let code = MortonCode::from_cell(place).0;
        let axis = receiver.normal.abs().max_position() as u64;
        let side = u64::from(receiver.normal[axis as usize] < 0.0);
        (axis << 1 | side) << 32 | code
    };
    order.clear();
    let numbered = receivers.iter().zip(0u32..).filter(|(receiver, _)| usable(receiver));
    order.extend(numbered.map(|(receiver, index)| (key(receiver), index)));
    order.sort_unstable();
}

/// A group of receivers to shade.
struct Group<'a, S> {
    walk: Walk<'a>,
    probe: Option<&'a ProbeMap>,
    receivers: &'a [Receiver],
    order: &'a [(u64, u32)],
    source: &'a mut S,
    results: &'a mut [Shaded],
    scratch: &'a mut Scratch,
    counters: &'a mut ShadeCounters,
}

impl<S: SceneSource> Task for Group<'_, S> {
    type Output = Result<(), ShadeError>;

    #[inline(always)]
    fn run<F: Floats>(self) -> Self::Output {
        if self.walk.tables.resolution <= 32 {
            self.shade::<F, 1>()
        } else {
            self.shade::<F, 2>()
        }
    }
}

impl<S: SceneSource> Group<'_, S> {
    /// Shades pack by pack, on rasters of `WORDS` words a row.
    #[inline(always)]
    fn shade<F: Floats, const WORDS: usize>(self) -> Result<(), ShadeError> {
        let tables = self.walk.tables;
        let bit = 1.0 / tables.bits() as f32;
        let mut raster = Raster::<F, WORDS>::new();
        let mut stack = Vec::new();
        for order in self.order.chunks(LANES) {
            let mut receivers = [Receiver::default(); LANES];
            for (receiver, (_, index)) in receivers.iter_mut().zip(order) {
                let given = self.receivers[*index as usize];
                *receiver = Receiver {
                    position: given.position,
                    normal: given.normal.normalize(),
                };
            }
            let receivers = &receivers[..order.len()];
            let frames: [Frame; LANES] =
                std::array::from_fn(|lane| Frame::from_normal(receivers[lane.min(receivers.len() - 1)].normal));
            let pack = Pack::new(self.walk.info, receivers, &frames);
            self.source.begin_pack();
            let seen = gather(
                &self.walk,
                &pack,
                self.source,
                &mut raster,
                &mut stack,
                self.scratch,
                self.counters,
            )?;
            let (x, y, z) = (
                seen.radiance.x.to_array(),
                seen.radiance.y.to_array(),
                seen.radiance.z.to_array(),
            );
            let occlusion = seen.occlusion.to_array();
            for (lane, (_, index)) in order.iter().enumerate() {
                let frame = &frames[lane];
                let mut radiance = Vec3::new(x[lane], y[lane], z[lane]);
                let covered = raster.covered(lane);
                if let Some(probe) = self.probe {
                    for_each_open(&covered, tables, |row, column| {
                        radiance += probe.radiance(frame.world_from_local(tables.direction(row, column)));
                    });
                }
                let weighed = self.walk.settings.weighs_distance();
                let occluded = if weighed { raster.occluded(lane) } else { covered };
                self.results[*index as usize] = Shaded {
                    irradiance: (radiance * (PI * bit)).to_array(),
                    occlusion: occlusion[lane] * bit,
                    bent_normal: frame.world_from_local(bent_normal(&occluded, tables)).to_array(),
                };
            }
        }
        Ok(())
    }
}
