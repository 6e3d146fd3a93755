//! What can stop a build.

use pbgi_core::{InvalidPoint, SettingsError};
use pbgi_store::StoreError;
use std::convert::Infallible;
use std::io;

/// Why a build gave no scene. `E` is the error of the input.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BuildError<E = Infallible> {
    /// The input cannot be read.
    #[error(transparent)]
    Input(E),
    /// Scratch or output failed.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A setting is out of range.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// The memory limit is too small for these settings.
    #[error("memory limit of {given} bytes is too small: a build with these settings needs {needed}")]
    Memory {
        /// The limit.
        given: u64,
        /// The least that works.
        needed: u64,
    },
    /// The input declares a box that is no finite box.
    #[error("declared bounds {min:?} to {max:?} are not finite; correct them or let the build measure the points")]
    Bounds {
        /// Smallest corner.
        min: [f32; 3],
        /// Largest corner.
        max: [f32; 3],
    },
    /// Points lie outside the box that the input declares.
    #[error(
        "{count} points outside the declared bounds, the first is point {first} at {position:?}; \
         correct the bounds or let the build measure the points"
    )]
    OutsideBounds {
        /// How many.
        count: u64,
        /// Index of the first one in the input.
        first: u64,
        /// Where that one is.
        position: [f32; 3],
    },
    /// Points cannot be used.
    #[error("{count} invalid points, the first is point {first}: {reason}; repair or skip them")]
    InvalidPoints {
        /// How many.
        count: u64,
        /// Index of the first one in the input.
        first: u64,
        /// What is wrong with that one.
        reason: InvalidPoint,
    },
    /// More points or nodes than an index can count.
    #[error("too many {what}: more than {max}; split the scene or use fewer points")]
    Limit {
        /// What was counted.
        what: &'static str,
        /// How many fit.
        max: u64,
    },
    /// A thread could not be started.
    #[error("cannot start a thread: {0}")]
    Thread(io::Error),
    /// The observer asked to stop.
    #[error("build cancelled")]
    Cancelled,
}

impl BuildError<Infallible> {
    /// The same error for a build whose input can fail.
    pub fn widen<E>(self) -> BuildError<E> {
        match self {
            Self::Input(never) => match never {},
            Self::Store(error) => BuildError::Store(error),
            Self::Settings(error) => BuildError::Settings(error),
            Self::Memory { given, needed } => BuildError::Memory { given, needed },
            Self::Bounds { min, max } => BuildError::Bounds { min, max },
            Self::OutsideBounds { count, first, position } => BuildError::OutsideBounds { count, first, position },
            Self::InvalidPoints { count, first, reason } => BuildError::InvalidPoints { count, first, reason },
            Self::Limit { what, max } => BuildError::Limit { what, max },
            Self::Thread(error) => BuildError::Thread(error),
            Self::Cancelled => BuildError::Cancelled,
        }
    }
}
