//! The promises of the store, kept on real files and on disks that fail and crash.

mod crash;
mod fault;
mod leftovers;
mod scene;
mod support;
