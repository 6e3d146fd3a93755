//! The daemon's queue: gRPC over a Unix socket, as one seat.

use crate::error::WorkerError;
use hyper_util::rt::TokioIo;
use pbgi_core::limits::IMAGE_PIXELS_MAX;
use pbgi_proto::v1;
use pbgi_proto::v1::queue_service_client::QueueServiceClient;
use std::path::Path;
use std::time::Duration;
use tokio::net::UnixStream;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::transport::{Channel, Endpoint};
use tonic::{Code, Request, Status};

/// Metadata that carries the token of the welcome.
const TOKEN_KEY: &str = "pbgi-token";
/// The daemon answers a lease request within seconds, with or without a lease.
const LEASE_SECS: u64 = 60;
const REQUEST_SECS: u64 = 30;
/// A task may bring the largest environment map there is.
const MESSAGE_BYTES_MAX: usize = IMAGE_PIXELS_MAX as usize * 12 + (1 << 20);

/// The queue, as this worker's seat sees it.
#[derive(Clone, Debug)]
pub(crate) struct Queue {
    client: QueueServiceClient<Channel>,
    seat: v1::WorkerSeat,
    token: MetadataValue<Ascii>,
}

impl Queue {
    pub(crate) async fn connect(socket: &Path, seat: v1::WorkerSeat, token: String) -> Result<Self, WorkerError> {
        let unreachable = |reason: String| WorkerError::Connect {
            path: socket.to_owned(),
            reason,
        };
        let path = socket.to_owned();
        let connector = tower::service_fn(move |_| {
            let path = path.clone();
            async move { UnixStream::connect(path).await.map(TokioIo::new) }
        });
        let channel = Endpoint::from_static("http://localhost")
            .connect_with_connector(connector)
            .await
            .map_err(|error| unreachable(error.to_string()))?;
        let token = token
            .parse()
            .map_err(|_| WorkerError::Defect("a token that is no text".to_owned()))?;
        let client = QueueServiceClient::new(channel)
            .max_decoding_message_size(MESSAGE_BYTES_MAX)
            .max_encoding_message_size(MESSAGE_BYTES_MAX);
        Ok(Self { client, seat, token })
    }

    /// The next tile; `None` when there is none yet.
    pub(crate) async fn lease(&mut self) -> Result<Option<v1::Lease>, WorkerError> {
        let request = self.request(v1::LeaseTileRequest { seat: Some(self.seat) }, LEASE_SECS);
        match self.client.lease_tile(request).await {
            Ok(answer) => Ok(answer.into_inner().lease),
            // Nothing is lost: the daemon keeps no lease that it could not hand out.
            Err(status) if matches!(status.code(), Code::DeadlineExceeded | Code::Cancelled) => Ok(None),
            Err(status) => Err(failed("lease a tile", &status)),
        }
    }

    /// What a job is about; `None` if it has ended since its tile was handed out.
    pub(crate) async fn task(&mut self, task_id: u64) -> Result<Option<v1::Task>, WorkerError> {
        let seat = Some(self.seat);
        let request = self.request(v1::GetTaskRequest { seat, task_id }, REQUEST_SECS);
        match self.client.get_task(request).await {
            Ok(answer) => Ok(Some(answer.into_inner())),
            Err(status) if status.code() == Code::NotFound => Ok(None),
            Err(status) => Err(failed("describe a task", &status)),
        }
    }

    /// Hands in a tile; `false` if the lease had ended.
    pub(crate) async fn complete(
        &mut self,
        lease_id: u64,
        outcome: v1::complete_tile_request::Outcome,
    ) -> Result<bool, WorkerError> {
        let message = v1::CompleteTileRequest {
            seat: Some(self.seat),
            lease_id,
            outcome: Some(outcome),
        };
        let request = self.request(message, REQUEST_SECS);
        let answer = self.client.complete_tile(request).await;
        let answer = answer.map_err(|status| failed("take a tile", &status))?;
        Ok(answer.into_inner().accepted)
    }

    /// Keeps a lease alive; `false` if it has ended.
    pub(crate) async fn heartbeat(&mut self, lease_id: u64) -> Result<bool, WorkerError> {
        let seat = Some(self.seat);
        let request = self.request(v1::HeartbeatRequest { seat, lease_id }, REQUEST_SECS);
        let answer = self.client.heartbeat(request).await;
        let answer = answer.map_err(|status| failed("take a heartbeat", &status))?;
        Ok(answer.into_inner().lease_valid)
    }

    fn request<T>(&self, message: T, seconds: u64) -> Request<T> {
        let mut request = Request::new(message);
        request.set_timeout(Duration::from_secs(seconds));
        request.metadata_mut().insert(TOKEN_KEY, self.token.clone());
        request
    }
}

/// A closed socket is the daemon's way to say goodbye; everything else is a refusal.
fn failed(action: &'static str, status: &Status) -> WorkerError {
    let broken = std::error::Error::source(status).is_some();
    match status.code() {
        Code::Unavailable => WorkerError::Gone,
        Code::Unknown | Code::Internal if broken => WorkerError::Gone,
        code => WorkerError::Refused {
            action,
            reason: format!("{code:?}: {}", status.message()),
        },
    }
}
