//! The promises of the store, kept on real files and on disks that fail and crash.
#![expect(clippy::unwrap_used, reason = "a test asserts")]

mod crash;
mod fault;
mod leftovers;
mod scene;
mod support;
