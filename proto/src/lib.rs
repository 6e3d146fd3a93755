//! Wire types of the `pbgi.v1` services, and nothing else: conversions live with those who speak.
#![forbid(unsafe_code)]
#![allow(missing_docs, clippy::all, reason = "generated code")]

/// Messages, clients and servers of package `pbgi.v1`.
pub mod v1 {
    tonic::include_proto!("pbgi.v1");
}

/// Encoded `FileDescriptorSet` of the package, for server reflection.
pub const FILE_DESCRIPTOR_SET: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/pbgi.v1.descriptors"));
