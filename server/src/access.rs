//! Who may call, over what, and which files they may name: the part of the configuration that is about trust.

use nix::unistd::{Gid, Uid};
use std::collections::{BTreeMap, BTreeSet};
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
    /// A certificate that the client authority signed; where there are tokens, one of them as well.
    MutualTls {
        /// Our certificate chain, PEM.
        cert: PathBuf,
        /// Its key, PEM, readable by us alone.
        key: PathBuf,
        /// The authority of clients, PEM.
        client_ca: PathBuf,
        /// Tokens, and what they allow. Without any, a certificate allows everything.
        tokens: Vec<Token>,
    },
    /// Not at all, on a loopback address.
    DangerouslyInsecure,
}

/// A secret that a caller shows besides its certificate.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Token {
    /// A file with at least 32 characters, readable by us alone.
    pub file: PathBuf,
    /// What its bearer may do.
    pub calls: BTreeSet<Call>,
}

/// The sorts of calls.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Call {
    /// Looks at jobs, scenes, cache and daemon.
    Look,
    /// Submits and steers jobs, streams receivers, warms scenes.
    Work,
    /// Drops scenes and ends the daemon.
    Operate,
}

impl Call {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Look, Self::Work, Self::Operate];

    /// As the configuration names it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Look => "look",
            Self::Work => "work",
            Self::Operate => "operate",
        }
    }
}

impl Access {
    /// Whether anybody but our own user may call.
    pub fn others_may_call(&self) -> bool {
        self.tcp.is_some() || !self.users.is_empty()
    }

    /// The tokens of callers over TCP.
    pub(crate) fn tokens(&self) -> &[Token] {
        match self.tcp.as_ref().map(|tcp| &tcp.auth) {
            Some(Auth::MutualTls { tokens, .. }) => tokens,
            _ => &[],
        }
    }
}
