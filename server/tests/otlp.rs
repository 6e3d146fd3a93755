//! Spans as a collector sees them: cargo test -p pbgi-server --features otlp --test otlp
#![cfg(feature = "otlp")]
#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod harness;

use harness::site::{Site, disguised, work_in_disguise, write_cloud, write_gbuffer};
use harness::{Daemon, free_port};
use opentelemetry_proto::tonic::collector::trace::v1::trace_service_server::{TraceService, TraceServiceServer};
use opentelemetry_proto::tonic::collector::trace::v1::{ExportTraceServiceRequest, ExportTraceServiceResponse};
use opentelemetry_proto::tonic::common::v1::any_value::Value;
use opentelemetry_proto::tonic::trace::v1::Span;
use pbgi_proto::v1;
use std::sync::{Arc, Mutex};
use tonic::{Request, Response, Status};

#[test]
#[ignore = "the worker's part, run by the daemon of the other tests"]
fn disguised_worker() {
    work_in_disguise();
}

/// A collector that keeps what it gets.
#[derive(Clone, Default)]
struct Collector(Arc<Mutex<Vec<Span>>>);

#[tonic::async_trait]
impl TraceService for Collector {
    async fn export(
        &self,
        request: Request<ExportTraceServiceRequest>,
    ) -> Result<Response<ExportTraceServiceResponse>, Status> {
        let resources = request.into_inner().resource_spans.into_iter();
        let scopes = resources.flat_map(|resource| resource.scope_spans);
        self.0.lock().unwrap().extend(scopes.flat_map(|scope| scope.spans));
        Ok(Response::new(ExportTraceServiceResponse::default()))
    }
}

/// An attribute as text; empty if it is not there.
fn attribute(span: &Span, key: &str) -> String {
    let found = span.attributes.iter().find(|pair| pair.key == key);
    match found.and_then(|pair| pair.value.as_ref()?.value.as_ref()) {
        Some(Value::StringValue(text)) => text.clone(),
        Some(Value::IntValue(number)) => number.to_string(),
        _ => String::new(),
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn collector_gets_jobs_with_their_tiles_and_the_pages_that_these_loaded() {
    let collector = Collector::default();
    let (port, address) = (free_port(), "127.0.0.1");
    let service = TraceServiceServer::new(collector.clone()).max_decoding_message_size(64 << 20);
    let server = tonic::transport::Server::builder()
        .add_service(service)
        .serve(format!("{address}:{port}").parse().unwrap());
    let server = tokio::spawn(server);
    let mut file = std::path::PathBuf::new();
    let mut daemon = Daemon::start(
        |folder| {
            file = folder.join("server.toml");
            std::fs::write(&file, format!("[otlp]\nendpoint = \"http://{address}:{port}\"\n")).unwrap();
            disguised(folder)
        },
        |command| {
            // Spans are sent whatever is logged.
            let folder = command
                .get_args()
                .skip_while(|word| *word != "--worker-binary")
                .nth(1)
                .unwrap();
            let file = std::path::Path::new(folder).with_file_name("server.toml");
            command.arg("--config").arg(file).args(["--log", "warn"]);
        },
    );
    write_cloud(&daemon.folder.path().join("in.ply"), 20_000);
    let gbuffer = write_gbuffer(&daemon.folder.path().join("g.exr"), 128, 128);
    let site = Site { daemon, gbuffer };
    site.succeed("build", site.build("s.pbgi")).await;
    let options = v1::JobOptions {
        user: "ann".into(),
        labels: [("show".to_owned(), "dune".to_owned())].into(),
        ..Default::default()
    };
    site.submit_with("shade", site.shade("a.exr"), options).await.unwrap();
    let pages = site.wait("shade").await.statistics.unwrap().rows["pages_loaded"];
    daemon = site.daemon;
    // What is left is sent when the daemon ends.
    daemon.signal("-TERM");
    assert!(daemon.wait().success(), "{}", daemon.log());
    server.abort();

    let spans = collector.0.lock().unwrap();
    let named = |name: &'static str| spans.iter().filter(move |span| span.name == name);
    assert_eq!(named("job").count(), 2, "{}", daemon.log());
    let job = named("job").find(|span| attribute(span, "id") == "shade").unwrap();
    assert_eq!(
        (
            attribute(job, "user"),
            attribute(job, "labels"),
            attribute(job, "title")
        ),
        ("ann".into(), "show=dune".into(), "shade a.exr".into())
    );
    let tiles: Vec<&Span> = named("tile")
        .filter(|tile| tile.parent_span_id == job.span_id)
        .collect();
    let mut numbers: Vec<u32> = tiles
        .iter()
        .map(|tile| attribute(tile, "tile").parse().unwrap())
        .collect();
    numbers.sort_unstable();
    assert_eq!(numbers, (0..16).collect::<Vec<u32>>());
    let loaded = |page: &&Span| {
        let parent = tiles.iter().any(|tile| tile.span_id == page.parent_span_id);
        parent
            && page.trace_id == job.trace_id
            && attribute(page, "origin") == "Loaded"
            && !attribute(page, "page").is_empty()
    };
    assert_eq!(
        named("page").filter(loaded).count() as f64,
        pages,
        "{:?}",
        named("page").next()
    );
    println!(
        "{} spans reached the collector: 2 jobs, {} tiles of the picture under its job, {pages} page loads under these",
        spans.len(),
        tiles.len()
    );
}
