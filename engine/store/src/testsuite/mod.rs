//! Doubles of the disk that fail or lose power on purpose.

mod crash;
mod fault;

pub use crash::{CrashImage, CrashVolume};
pub use fault::{FaultPlan, FaultScope, FaultVolume};
