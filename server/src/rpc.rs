//! The edge: gRPC in, plain types onward. The only place that knows tonic.
//!
//! Listeners that are never mixed: clients' ([`serve_jobs`], and [`serve_tcp`] if configured) and workers' ([`serve_queue`], on a
//! Unix socket only).

mod accept;
mod cache;
mod caught;
mod convert;
mod gate;
mod jobs;
mod live;
mod queue;
pub mod status;

use crate::access::Auth;
use crate::dispatcher::Dispatcher;
use crate::error::{JobError, ServerError};
use crate::job::Request;
use crate::limits;
use accept::{Connection, connections};
use caught::CatchPanics;
pub use gate::Gate;
use pbgi_proto::v1;
use pbgi_proto::v1::daemon_service_server::DaemonServiceServer;
use pbgi_proto::v1::job_service_server::JobServiceServer;
use pbgi_proto::v1::queue_service_server::QueueServiceServer;
use pbgi_proto::v1::scene_service_server::SceneServiceServer;
use pbgi_proto::v1::shade_service_server::ShadeServiceServer;
use std::sync::Arc;
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, UnixListener};
use tokio::sync::watch;
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::server::Connected;
use tonic::transport::{Certificate, Identity, Server, ServerTlsConfig};
use tonic_health::ServingStatus;
use tonic_health::server::HealthReporter;

/// How long a request may take that is no stream.
const REQUEST_MAX: Duration = Duration::from_secs(30);

/// Services that clients see, by name.
const CLIENT_SERVICES: [&str; 4] = [
    "pbgi.v1.JobService",
    "pbgi.v1.SceneService",
    "pbgi.v1.ShadeService",
    "pbgi.v1.DaemonService",
];

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

/// Serves clients on this machine until `stop` becomes true.
///
/// # Errors
/// The server cannot be set up or fails as a whole.
pub async fn serve_jobs(
    listener: UnixListener,
    gate: Gate,
    dispatcher: Arc<Dispatcher>,
    stop: watch::Receiver<bool>,
) -> Result<(), ServerError> {
    serve_clients(server(), gate, connections(listener), dispatcher, stop).await
}

/// How clients over TCP are served, with its secrets read.
pub struct Remote {
    server: Server,
    gate: Gate,
}

impl Remote {
    /// Who is let in.
    pub fn gate(&self) -> Gate {
        self.gate.clone()
    }

    /// Reads certificates, key and token.
    ///
    /// # Errors
    /// One that is missing, unusable, or readable by others.
    pub fn new(auth: &Auth) -> Result<Self, ServerError> {
        let gate = Gate::remote(auth)?;
        let Auth::MutualTls {
            cert, key, client_ca, ..
        } = auth
        else {
            return Ok(Self { server: server(), gate });
        };
        let read = |path: &std::path::PathBuf| {
            std::fs::read_to_string(path).map_err(ServerError::io("read a certificate", path))
        };
        let tls = ServerTlsConfig::new()
            .identity(Identity::from_pem(read(cert)?, gate::read_secret(key)?))
            .client_ca_root(Certificate::from_pem(read(client_ca)?))
            .client_auth_optional(false)
            .timeout(limits::HANDSHAKE_MAX);
        let server = server().tls_config(tls).map_err(|error| ServerError::Setup {
            action: "set up TLS",
            reason: format!("{error:?}, with {} and {}", cert.display(), client_ca.display()),
        })?;
        Ok(Self { server, gate })
    }
}

/// Serves clients over TCP until `stop` becomes true.
///
/// # Errors
/// The server cannot be set up or fails as a whole.
pub async fn serve_tcp(
    listener: TcpListener,
    remote: Remote,
    dispatcher: Arc<Dispatcher>,
    stop: watch::Receiver<bool>,
) -> Result<(), ServerError> {
    serve_clients(remote.server, remote.gate, connections(listener), dispatcher, stop).await
}

async fn serve_clients<S>(
    server: Server,
    gate: Gate,
    incoming: ReceiverStream<std::io::Result<Connection<S>>>,
    dispatcher: Arc<Dispatcher>,
    mut stop: watch::Receiver<bool>,
) -> Result<(), ServerError>
where
    S: AsyncRead + AsyncWrite + Connected + Unpin + Send + 'static,
{
    let service = jobs::Jobs::new(dispatcher.clone());
    let live = live::LiveShading::new(dispatcher.clone());
    let limit = limits::JOBS_MESSAGE_BYTES_MAX;
    let (health, health_service) = tonic_health::server::health_reporter();
    let mut healthy = dispatcher.health();
    // Before the first call is answered: nobody must be told that a service is unknown.
    let serving = *healthy.borrow_and_update();
    publish_health(&health, serving).await;
    let report = tokio::spawn(async move {
        while healthy.changed().await.is_ok() {
            let serving = *healthy.borrow_and_update();
            publish_health(&health, serving).await;
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
    let served = server
        .layer(CatchPanics)
        .layer(gate)
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
        .add_service(
            ShadeServiceServer::new(live)
                .max_decoding_message_size(limits::LIVE_MESSAGE_BYTES_MAX)
                .max_encoding_message_size(limits::LIVE_MESSAGE_BYTES_MAX),
        )
        .serve_with_incoming_shutdown(incoming, async move {
            // An error means that the daemon is gone.
            let _ = stop.wait_for(|stop| *stop).await;
        })
        .await;
    report.abort();
    served.map_err(failed)
}

async fn publish_health(health: &HealthReporter, serving: bool) {
    let status = if serving {
        ServingStatus::Serving
    } else {
        ServingStatus::NotServing
    };
    for name in CLIENT_SERVICES.into_iter().chain([""]) {
        health.set_service_status(name, status).await;
    }
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
    let gate = Gate::own();
    server()
        .layer(CatchPanics)
        .layer(gate)
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
