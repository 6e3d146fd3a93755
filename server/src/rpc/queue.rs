//! What workers may say. Each message proves by its token that it comes from the seat it names.

use super::convert;
use super::status::status;
use crate::dispatcher::{Dispatcher, TileOutcome};
use crate::error::{JobError, JobErrorKind};
use crate::scheduler::{JobNo, LeaseId, Seat};
use pbgi_proto::v1;
use pbgi_proto::v1::complete_tile_request::Outcome;
use pbgi_proto::v1::queue_service_server::QueueService;
use std::sync::Arc;
use tonic::metadata::MetadataMap;
use tonic::{Request, Response, Status};

/// Metadata that carries the token of the welcome message, as 32 hexadecimal digits.
const TOKEN_KEY: &str = "pbgi-token";

pub(super) struct Queue {
    dispatcher: Arc<Dispatcher>,
}

impl Queue {
    pub(super) fn new(dispatcher: Arc<Dispatcher>) -> Self {
        Self { dispatcher }
    }

    fn seat(&self, metadata: &MetadataMap, seat: Option<v1::WorkerSeat>) -> Result<Seat, JobError> {
        let seat = seat.and_then(|seat| {
            let slot = seat.slot.try_into().ok()?;
            let epoch = seat.epoch;
            Some(Seat { slot, epoch })
        });
        let token = metadata.get(TOKEN_KEY).and_then(|token| token_bytes(token.as_bytes()));
        match (seat, token) {
            (Some(seat), Some(token)) => self.dispatcher.authenticate(seat, &token).map(|()| seat),
            _ => Err(JobError::new(JobErrorKind::Unauthenticated, "seat or token missing")),
        }
    }
}

fn token_bytes(hex: &[u8]) -> Option<[u8; 16]> {
    let mut token = [0; 16];
    let (pairs, rest) = hex.as_chunks::<2>();
    if pairs.len() != token.len() || !rest.is_empty() {
        return None;
    }
    let digit = |byte: u8| char::from(byte).to_digit(16);
    for (byte, &[high, low]) in token.iter_mut().zip(pairs) {
        *byte = (digit(high)? << 4 | digit(low)?) as u8;
    }
    Some(token)
}

#[tonic::async_trait]
impl QueueService for Queue {
    async fn lease_tile(
        &self,
        request: Request<v1::LeaseTileRequest>,
    ) -> Result<Response<v1::LeaseTileResponse>, Status> {
        let seat = self.seat(request.metadata(), request.get_ref().seat).map_err(status)?;
        let lease = self.dispatcher.lease(seat).await.map(|lease| v1::Lease {
            lease_id: lease.lease.0,
            task_id: lease.job.0,
            tile: lease.tile,
            receivers: lease.receivers.bytes,
            group_lengths: lease.receivers.group_lengths,
        });
        Ok(Response::new(v1::LeaseTileResponse { lease }))
    }

    async fn complete_tile(
        &self,
        request: Request<v1::CompleteTileRequest>,
    ) -> Result<Response<v1::CompleteTileResponse>, Status> {
        let seat = self.seat(request.metadata(), request.get_ref().seat).map_err(status)?;
        let request = request.into_inner();
        let outcome = match request.outcome {
            Some(Outcome::Result(result)) => TileOutcome::Values {
                counters: convert::counters(result.counters),
                values: result.values,
            },
            Some(Outcome::Failure(failure)) => TileOutcome::Failure(format!("{}: {}", failure.kind, failure.message)),
            None => return Err(status(JobError::invalid("the tile has no outcome"))),
        };
        let accepted = self.dispatcher.complete(seat, LeaseId(request.lease_id), outcome);
        Ok(Response::new(v1::CompleteTileResponse { accepted }))
    }

    async fn heartbeat(
        &self,
        request: Request<v1::HeartbeatRequest>,
    ) -> Result<Response<v1::HeartbeatResponse>, Status> {
        let seat = self.seat(request.metadata(), request.get_ref().seat).map_err(status)?;
        let lease_valid = self.dispatcher.heartbeat(seat, LeaseId(request.get_ref().lease_id));
        Ok(Response::new(v1::HeartbeatResponse { lease_valid }))
    }

    async fn get_task(&self, request: Request<v1::GetTaskRequest>) -> Result<Response<v1::Task>, Status> {
        self.seat(request.metadata(), request.get_ref().seat).map_err(status)?;
        let task = self.dispatcher.task(JobNo(request.get_ref().task_id)).map_err(status)?;
        Ok(Response::new(convert::task(&task)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn token_digits_are_read_in_order_and_nothing_else_is_taken() {
        let digits = b"00112233445566778899aabbccddeeff";
        let bytes = token_bytes(digits).unwrap();
        assert_eq!((bytes[0], bytes[1], bytes[15]), (0x00, 0x11, 0xff));
        let plus = b"+0112233445566778899aabbccddeeff";
        for bad in [
            &b""[..],
            b"00",
            &digits[1..],
            plus,
            b"00112233445566778899aabbccddeeff00",
        ] {
            assert_eq!(token_bytes(bad), None);
        }
    }
}
