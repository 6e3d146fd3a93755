//! Who may call, over what, and which files they may name: the part of the configuration that is about trust.

use nix::unistd::{Gid, Uid};
use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::PathBuf;

/// What strangers may do. The default is nothing: one user, one Unix socket.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Access {
    /// Users that may call besides our own.
    pub users: Vec<Uid>,
    /// The group that may reach the clients' socket.
    pub group: Option<Gid>,
    /// Directories that jobs may name files in, by name. Without any, jobs name absolute paths, and our own user alone may call.
    pub roots: BTreeMap<String, Root>,
    /// Calls over TCP.
    pub tcp: Option<Tcp>,
    /// Metrics and the page over TCP, on a loopback address; they are on a Unix socket in any case.
    pub http: Option<SocketAddr>,
}

/// A directory that jobs may name files in.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Root {
    /// Where it is, absolute.
    pub path: PathBuf,
    /// Whether files may be read.
    pub read: bool,
    /// Whether new files may be written.
    pub write: bool,
    /// Whether files that are there may be replaced.
    pub overwrite: bool,
}

/// Calls over TCP.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Tcp {
    /// Where to listen.
    pub address: SocketAddr,
    /// How callers prove who they are.
    pub auth: Auth,
}

/// How callers over TCP prove who they are.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Auth {
    /// A certificate that the client authority signed; with a token file, its token as well.
    MutualTls {
        /// Our certificate chain, PEM.
        cert: PathBuf,
        /// Its key, PEM, readable by us alone.
        key: PathBuf,
        /// The authority of clients, PEM.
        client_ca: PathBuf,
        /// A file with a token of at least 32 characters, readable by us alone.
        token: Option<PathBuf>,
    },
    /// Not at all, on a loopback address.
    DangerouslyInsecure,
}
