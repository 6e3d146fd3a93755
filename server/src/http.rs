//! What is served to browsers and to Prometheus: a page, the JSON behind it, metrics, health. Everything is read-only.
//!
//! On a Unix socket always, on a loopback address if configured. Entry points: [`serve_unix`], [`serve_tcp`].

use crate::dispatcher::Dispatcher;
use crate::error::ServerError;
use crate::job::JobStatus;
use crate::metrics;
use axum::Router;
use axum::extract::{Path, Request, State};
use axum::http::{HeaderName, StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{Html, IntoResponse, Response};
use axum::routing::get;
use serde_json::{Value, json};
use std::sync::Arc;
use tokio::net::{TcpListener, UnixListener};
use tokio::sync::watch;

/// Jobs that the page lists.
const JOBS_SHOWN: usize = 100;

fn routes(dispatcher: Arc<Dispatcher>) -> Router {
    Router::new()
        .route("/", get(async || Html(include_str!("page.html"))))
        .route("/healthz", get(healthz))
        .route("/metrics", get(metrics_text))
        .route("/api/status", get(status))
        .route("/api/jobs", get(jobs))
        .route("/api/jobs/{id}/picture", get(picture))
        .layer(middleware::from_fn(protect))
        .with_state(dispatcher)
}

/// Serves until `stop` becomes true.
///
/// # Errors
/// The server fails as a whole.
pub async fn serve_unix(
    listener: UnixListener,
    dispatcher: Arc<Dispatcher>,
    stop: watch::Receiver<bool>,
) -> Result<(), ServerError> {
    let served = axum::serve(listener, routes(dispatcher)).with_graceful_shutdown(stopped(stop));
    served.await.map_err(ServerError::setup("serve the page"))
}

/// As [`serve_unix`], over TCP.
///
/// # Errors
/// The server fails as a whole.
pub async fn serve_tcp(
    listener: TcpListener,
    dispatcher: Arc<Dispatcher>,
    stop: watch::Receiver<bool>,
) -> Result<(), ServerError> {
    let served = axum::serve(listener, routes(dispatcher)).with_graceful_shutdown(stopped(stop));
    served.await.map_err(ServerError::setup("serve the page"))
}

async fn stopped(mut stop: watch::Receiver<bool>) {
    // An error means that the daemon is gone.
    let _ = stop.wait_for(|stop| *stop).await;
}

/// Other sites may neither name us by a name of theirs nor frame or script the page.
async fn protect(request: Request, next: Next) -> Response {
    let host = request.headers().get(header::HOST).and_then(|host| host.to_str().ok());
    let name = host
        .unwrap_or_default()
        .rsplit_once(':')
        .map_or(host.unwrap_or_default(), |(name, _)| name);
    if !["localhost", "127.0.0.1", "[::1]", ""].contains(&name) {
        return (StatusCode::FORBIDDEN, "this page is for this machine only\n").into_response();
    }
    let mut response = next.run(request).await;
    let policy = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; connect-src 'self'; frame-ancestors 'none'";
    for (name, value) in [
        (header::CONTENT_SECURITY_POLICY, policy),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::CACHE_CONTROL, "no-store"),
    ] {
        response
            .headers_mut()
            .insert(name, header::HeaderValue::from_static(value));
    }
    response
}

async fn healthz(State(dispatcher): State<Arc<Dispatcher>>) -> Response {
    if *dispatcher.health().borrow() {
        "serving\n".into_response()
    } else {
        (StatusCode::SERVICE_UNAVAILABLE, "not serving\n").into_response()
    }
}

async fn metrics_text(State(dispatcher): State<Arc<Dispatcher>>) -> Response {
    match metrics::text(&dispatcher) {
        Ok(text) => ([(header::CONTENT_TYPE, metrics::CONTENT_TYPE)], text).into_response(),
        Err(error) => (StatusCode::INTERNAL_SERVER_ERROR, error.to_string()).into_response(),
    }
}

async fn status(State(dispatcher): State<Arc<Dispatcher>>) -> Response {
    let status = dispatcher.status();
    let pool = |frames: u64, resident: u64| json!({ "frames": frames, "resident": resident });
    let workers = status.workers.iter().map(|(birth, busy, pinned)| {
        json!({ "slot": birth.seat.slot, "epoch": birth.seat.epoch, "pid": birth.pid, "busy": busy, "pinned": pinned })
    });
    let scenes = status.mounts.iter().map(|mount| {
        let name = mount
            .path
            .file_name()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned();
        json!({ "scene": name, "build_id": mount.build_id.to_string(), "pages_loaded": mount.pages_loaded })
    });
    let body = json!({
        "version": env!("CARGO_PKG_VERSION"),
        "pid": std::process::id(),
        "healthy": *dispatcher.health().borrow(),
        "memory_bytes": status.memory_bytes,
        "segment_bytes": status.segment_bytes,
        "nodes": pool(status.cache.node.frames, status.cache.node.resident),
        "points": pool(status.cache.point.frames, status.cache.point.resident),
        "workers": workers.collect::<Vec<Value>>(),
        "scenes": scenes.collect::<Vec<Value>>(),
        "jobs_queued": status.jobs_queued,
        "jobs_running": status.jobs_running,
    });
    as_json(&body)
}

async fn jobs(State(dispatcher): State<Arc<Dispatcher>>) -> Response {
    let jobs = dispatcher.jobs(JOBS_SHOWN).into_iter().map(|job| job_json(&job));
    as_json(&Value::Array(jobs.collect()))
}

fn job_json(job: &JobStatus) -> Value {
    let rows = job.statistics.rows().into_iter();
    let rows = rows.filter_map(|row| Some((row.name.to_owned(), json!(row.value?))));
    json!({
        "id": job.id,
        "title": job.title,
        "state": job.state,
        "stage": job.stage,
        "done": job.done,
        "total": job.total,
        "error": job.error,
        "user": job.options.user,
        "labels": job.options.labels,
        "priority": job.options.priority,
        "history": job.history,
        "statistics": rows.collect::<serde_json::Map<_, _>>(),
    })
}

/// A small version of a picture as far as it is, as RGBA bytes.
async fn picture(State(dispatcher): State<Arc<Dispatcher>>, Path(id): Path<String>) -> Response {
    let Some(preview) = dispatcher.preview(&id) else {
        return (StatusCode::NOT_FOUND, "no picture\n").into_response();
    };
    let headers = [
        (header::CONTENT_TYPE, "application/octet-stream".to_owned()),
        (HeaderName::from_static("x-width"), preview.width.to_string()),
        (HeaderName::from_static("x-height"), preview.height.to_string()),
    ];
    (headers, preview.rgba.clone()).into_response()
}

fn as_json(body: &Value) -> Response {
    ([(header::CONTENT_TYPE, "application/json")], body.to_string()).into_response()
}
