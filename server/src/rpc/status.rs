//! The one mapping from our errors to gRPC codes.

use crate::error::{JobError, JobErrorKind};
use tonic::{Code, Status};

/// A client's answer to an error of ours.
pub fn status(error: JobError) -> Status {
    let code = match error.kind {
        JobErrorKind::Invalid => Code::InvalidArgument,
        JobErrorKind::NotFound => Code::NotFound,
        JobErrorKind::Exists => Code::AlreadyExists,
        JobErrorKind::Busy => Code::Aborted,
        JobErrorKind::Precondition => Code::FailedPrecondition,
        JobErrorKind::Exhausted => Code::ResourceExhausted,
        JobErrorKind::Corrupt => Code::DataLoss,
        JobErrorKind::Unauthenticated => Code::Unauthenticated,
        JobErrorKind::Unavailable => Code::Unavailable,
        JobErrorKind::Internal => Code::Internal,
    };
    Status::new(code, error.text)
}
