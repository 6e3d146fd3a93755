//! The one mapping from our errors to gRPC codes.

use crate::error::{JobError, JobErrorKind};
use std::collections::HashMap;
use std::time::Duration;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

/// Whose reasons they are.
const DOMAIN: &str = "pbgi";
/// When a full queue is worth another try.
const RETRY_DELAY: Duration = Duration::from_secs(5);

/// A client's answer to an error of ours: code and text, and as details the reason out of a closed list, and when to try again
/// where that helps.
pub fn status(error: JobError) -> Status {
    let (code, reason) = match error.kind {
        JobErrorKind::Invalid => (Code::InvalidArgument, "INVALID"),
        JobErrorKind::NotFound => (Code::NotFound, "NOT_FOUND"),
        JobErrorKind::Exists => (Code::AlreadyExists, "EXISTS"),
        JobErrorKind::Busy => (Code::Aborted, "BUSY"),
        JobErrorKind::Precondition => (Code::FailedPrecondition, "PRECONDITION"),
        JobErrorKind::Exhausted => (Code::ResourceExhausted, "EXHAUSTED"),
        JobErrorKind::Corrupt => (Code::DataLoss, "CORRUPT"),
        JobErrorKind::Unauthenticated => (Code::Unauthenticated, "UNAUTHENTICATED"),
        JobErrorKind::Denied => (Code::PermissionDenied, "DENIED"),
        JobErrorKind::Unavailable => (Code::Unavailable, "UNAVAILABLE"),
        JobErrorKind::Internal => (Code::Internal, "INTERNAL"),
    };
    let mut details = ErrorDetails::with_error_info(reason, DOMAIN, HashMap::new());
    if error.kind == JobErrorKind::Exhausted {
        details.set_retry_info(Some(RETRY_DELAY));
    }
    Status::with_error_details(code, error.text, details)
}
