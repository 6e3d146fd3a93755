//! The promises of a build: the right tree, the same bytes whatever the memory, nothing left behind, honest limits.
#![expect(clippy::unwrap_used, reason = "a test asserts")]

mod failures;
mod input;
mod memory;
mod same_bytes;
mod shapes;
mod support;
