//! The edge: gRPC in, plain types onward. The only place that knows tonic.
//!
//! Two sockets that are never mixed: clients' ([`serve_jobs`]) and workers' ([`serve_queue`]).

mod accept;
mod convert;
mod jobs;
mod queue;
pub mod status;

use crate::dispatcher::Dispatcher;
use crate::error::{JobError, ServerError};
use crate::job::Request;
use crate::limits;
use accept::{check_peer, connections};
use pbgi_proto::v1;
use pbgi_proto::v1::daemon_service_server::DaemonServiceServer;
use pbgi_proto::v1::job_service_server::JobServiceServer;
use pbgi_proto::v1::queue_service_server::QueueServiceServer;
use pbgi_proto::v1::scene_service_server::SceneServiceServer;
use std::sync::Arc;
use std::time::Duration;
use tokio::net::UnixListener;
use tokio::sync::watch;
use tonic::service::InterceptorLayer;
use tonic::transport::Server;
use tonic_health::ServingStatus;

/// How long a request may take that is no stream.
const REQUEST_MAX: Duration = Duration::from_secs(30);

/// Services that clients see, by name.
const CLIENT_SERVICES: [&str; 3] = ["pbgi.v1.JobService", "pbgi.v1.SceneService", "pbgi.v1.DaemonService"];

fn server() -> Server {
    Server::builder()
        .max_concurrent_streams(limits::STREAMS_MAX)
        .concurrency_limit_per_connection(limits::REQUESTS_IN_FLIGHT_MAX)
        .load_shed(true)
        .timeout(REQUEST_MAX)
        .http2_keepalive_interval(Some(limits::KEEPALIVE_INTERVAL))
        .http2_keepalive_timeout(Some(limits::KEEPALIVE_TIMEOUT))
        .http2_max_pending_accept_reset_streams(Some(limits::PENDING_RESETS_MAX))
        .http2_max_header_list_size(limits::HEADER_BYTES_MAX)
}

/// Serves clients until `stop` becomes true.
///
/// # Errors
/// The server cannot be set up or fails as a whole.
pub async fn serve_jobs(
    listener: UnixListener,
    dispatcher: Arc<Dispatcher>,
    mut stop: watch::Receiver<bool>,
) -> Result<(), ServerError> {
    let service = jobs::Jobs::new(dispatcher.clone());
    let limit = limits::JOBS_MESSAGE_BYTES_MAX;
    let (health, health_service) = tonic_health::server::health_reporter();
    let mut healthy = dispatcher.health();
    let report = tokio::spawn(async move {
        loop {
            let status = if *healthy.borrow_and_update() {
                ServingStatus::Serving
            } else {
                ServingStatus::NotServing
            };
            for name in CLIENT_SERVICES.into_iter().chain([""]) {
                health.set_service_status(name, status).await;
            }
            if healthy.changed().await.is_err() {
                return;
            }
        }
    });
    let reflection = || {
        let builder = tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(pbgi_proto::FILE_DESCRIPTOR_SET)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET);
        CLIENT_SERVICES
            .into_iter()
            .chain(["grpc.health.v1.Health"])
            .fold(builder, |b, name| b.with_service_name(name))
    };
    let setup = |error: tonic_reflection::server::Error| ServerError::Setup {
        action: "set up reflection",
        reason: error.to_string(),
    };
    let served = server()
        .layer(InterceptorLayer::new(check_peer))
        .add_service(health_service)
        .add_service(reflection().build_v1().map_err(setup)?)
        // Python's reflection client speaks this one only.
        .add_service(reflection().build_v1alpha().map_err(setup)?)
        .add_service(
            JobServiceServer::new(service.clone())
                .max_decoding_message_size(limit)
                .max_encoding_message_size(limit),
        )
        .add_service(SceneServiceServer::new(service.clone()).max_decoding_message_size(limit))
        .add_service(DaemonServiceServer::new(service).max_decoding_message_size(limit))
        .serve_with_incoming_shutdown(connections(listener), async move {
            // An error means that the daemon is gone.
            let _ = stop.wait_for(|stop| *stop).await;
        })
        .await;
    report.abort();
    served.map_err(failed)
}

/// Serves workers until `stop` becomes true.
///
/// # Errors
/// The server fails as a whole.
pub async fn serve_queue(
    listener: UnixListener,
    dispatcher: Arc<Dispatcher>,
    mut stop: watch::Receiver<bool>,
) -> Result<(), ServerError> {
    let limit = limits::QUEUE_MESSAGE_BYTES_MAX;
    let service = QueueServiceServer::new(queue::Queue::new(dispatcher));
    server()
        .layer(InterceptorLayer::new(check_peer))
        .add_service(
            service
                .max_decoding_message_size(limit)
                .max_encoding_message_size(limit),
        )
        .serve_with_incoming_shutdown(connections(listener), async move {
            // An error means that the daemon is gone.
            let _ = stop.wait_for(|stop| *stop).await;
        })
        .await
        .map_err(failed)
}

/// A request as it was kept from the wire.
///
/// # Errors
/// It is of another version.
pub fn stored_request(wire: &[u8]) -> Result<Request, JobError> {
    let request = <v1::SubmitJobRequest as prost::Message>::decode(wire);
    let request = request.map_err(|error| JobError::invalid(error.to_string()))?;
    convert::request(request.task)
}

fn failed(error: tonic::transport::Error) -> ServerError {
    ServerError::Setup {
        action: "serve",
        reason: error.to_string(),
    }
}
