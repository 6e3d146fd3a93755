//! Receivers in, irradiance and occlusion out.

use crate::cut::{Scratch, Walk, gather};
use crate::environment::ProbeMap;
use crate::frame::Frame;
use crate::raster::{Raster, RasterTables};
use crate::simd::Simd;
use crate::source::{SceneSource, SourceError};
use bytemuck::{Pod, Zeroable};
use glam::Vec3;
use pbgi_core::{Environment, SceneInfo, SettingsError, ShadeSettings};
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
    /// Receivers shaded, holes not counted.
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
    raster: Raster,
    scratch: Scratch,
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
            raster: Raster::new(),
            scratch: Scratch::default(),
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
        for (receiver, result) in receivers.iter().zip(results) {
            *result = self.shade(receiver, source)?;
        }
        Ok(())
    }

    /// Work done since the start.
    pub fn counters(&self) -> ShadeCounters {
        self.counters
    }

    fn shade<S: SceneSource>(&mut self, receiver: &Receiver, source: &mut S) -> Result<Shaded, ShadeError> {
        let Some(normal) = receiver.normal.try_normalize() else {
            return Ok(Shaded::default());
        };
        if !receiver.position.is_finite() {
            return Ok(Shaded::default());
        }
        let receiver = Receiver {
            position: receiver.position,
            normal,
        };
        let frame = Frame::from_normal(normal);
        source.begin_receiver();
        self.raster.clear();
        let walk = Walk {
            info: &self.info,
            settings: &self.settings,
            tables: &self.tables,
            simd: self.simd,
        };
        let (raster, scratch, counters) = (&mut self.raster, &mut self.scratch, &mut self.counters);
        let seen = gather(&walk, &receiver, &frame, source, raster, scratch, counters)?;
        self.counters.receivers += 1;
        let mut radiance = seen.radiance;
        if let Some(probe) = &self.probe {
            self.raster.for_each_open(&self.tables, |row, column| {
                radiance += probe.radiance(frame.world_from_local(self.tables.direction(row, column)));
            });
        }
        let bit = 1.0 / self.tables.bits() as f32;
        let bent = frame.world_from_local(self.raster.bent_normal(&self.tables));
        Ok(Shaded {
            irradiance: (radiance * (PI * bit)).to_array(),
            occlusion: seen.occlusion * bit,
            bent_normal: bent.to_array(),
        })
    }
}
