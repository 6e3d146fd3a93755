//! What can go wrong between a client and the daemon.

use std::path::PathBuf;

/// A request that did not succeed: what was wanted, why it failed, and what to do where that is known.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ClientError {
    /// The server's address has an unknown form.
    #[error("server address {0:?} is not understood: write unix:/path/to/jobs.sock or https://host:port")]
    Address(String),
    /// Nobody listens on the socket.
    #[error("no daemon answers on {path:?}: {reason}")]
    Connect {
        /// The socket.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// The daemon answered with an error.
    #[error("cannot {action}: {message}")]
    Refused {
        /// What was wanted.
        action: String,
        /// Kind of refusal.
        refusal: Refusal,
        /// The daemon's words.
        message: String,
    },
    /// The daemon went away; whether it did what was wanted is unknown.
    #[error("cannot {action}: the daemon went away ({message}); run the command again")]
    Lost {
        /// What was wanted.
        action: String,
        /// What the connection reported.
        message: String,
    },
    /// No answer in time.
    #[error("cannot {action}: no answer within {seconds} s")]
    Deadline {
        /// What was wanted.
        action: String,
        /// The deadline.
        seconds: u64,
    },
    /// An answer that makes no sense: a daemon of another version, or a defect.
    #[error("cannot {action}: the daemon's answer has {fault}")]
    Malformed {
        /// What was wanted.
        action: String,
        /// What is wrong with the answer.
        fault: String,
    },
    /// A private daemon did not come up.
    #[error("cannot start a private daemon: {0}")]
    Start(String),
    /// A file or folder of the private daemon.
    #[error("cannot {action} {path:?}: {source}")]
    Io {
        /// What was wanted.
        action: &'static str,
        /// The file or folder.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
}

/// Kinds of refusal, a closed list.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// The request is wrong, whatever the daemon's state.
    Invalid,
    /// No such job, scene or file.
    NotFound,
    /// The output or the job exists.
    Exists,
    /// The state of files or daemon forbids it.
    Precondition,
    /// A limit is reached; later may work.
    Limit,
    /// Another request is at it.
    Conflict,
    /// Not allowed.
    Denied,
    /// Damaged data.
    Corrupt,
    /// A defect of the daemon, or anything else.
    Internal,
}
