//! Octree to irradiance: picks a cut of the octree for every receiver, rasters it front to back into a hemisphere of
//! bits that all carry the same cosine weight, and sums what they see (paper section 5; Christensen 2008, section 3.3 and on).
//!
//! The principal type is [`Shader`]; it takes receivers in groups and reads nodes and points through a [`SceneSource`].
//! [`Tracer`] finds what rays meet, for pictures of scenes that have no meshes.
//! This crate knows no files and no shared memory. See `README.md` beside it for the method and where it leaves the paper.
#![deny(unsafe_code)]

mod cluster;
mod cut;
mod environment;
mod footprint;
mod frame;
mod interpolate;
mod leaf;
mod painter;
mod primary;
mod raster;
mod shader;
mod simd;
mod source;
mod vector;

pub use primary::{Hit, Ray, Tracer};
pub use shader::{Receiver, ShadeCounters, ShadeError, Shaded, Shader};
pub use source::{ArraySource, SceneSource, SourceError, Upcoming, Wanted};
