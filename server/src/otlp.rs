//! Sends the spans of jobs, tiles and page loads to a collector, by OTLP over gRPC.

use opentelemetry::trace::TracerProvider;
use opentelemetry_otlp::{SpanExporter, WithExportConfig};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::trace::{BatchConfigBuilder, BatchSpanProcessor, SdkTracerProvider};
use pbgi_server::ServerError;
use tracing::{Level, Subscriber};
use tracing_subscriber::Layer;
use tracing_subscriber::filter::Targets;
use tracing_subscriber::registry::LookupSpan;

/// Spans that may wait for the collector; more are dropped, and counted in its log.
const SPANS_QUEUED_MAX: usize = 1 << 14;

/// The way to the collector.
pub(crate) struct Traces(SdkTracerProvider);

impl Traces {
    /// Spans go to the collector at `endpoint`, `http://HOST:PORT`, whenever it is there. To be called within the runtime.
    pub(crate) fn start(endpoint: &str) -> Result<Self, ServerError> {
        let exporter = SpanExporter::builder().with_tonic().with_endpoint(endpoint).build();
        let exporter = exporter.map_err(|error| ServerError::Setup {
            action: "send spans",
            reason: format!("{error}, to {endpoint}"),
        })?;
        let batches = BatchConfigBuilder::default().with_max_queue_size(SPANS_QUEUED_MAX);
        let processor = BatchSpanProcessor::builder(exporter)
            .with_batch_config(batches.build())
            .build();
        let resource = Resource::builder().with_service_name("pbgi-server").build();
        let provider = SdkTracerProvider::builder()
            .with_resource(resource)
            .with_span_processor(processor);
        Ok(Self(provider.build()))
    }

    /// What hears of spans: ours only, whatever is logged.
    pub(crate) fn layer<S>(&self) -> impl Layer<S>
    where
        S: Subscriber + for<'a> LookupSpan<'a>,
    {
        tracing_opentelemetry::layer()
            .with_tracer(self.0.tracer("pbgi"))
            .with_location(false)
            .with_threads(false)
            .with_tracked_inactivity(false)
            .with_filter(Targets::new().with_target("pbgi_server", Level::DEBUG))
    }

    /// Sends what is left.
    pub(crate) fn finish(&self) {
        if let Err(error) = self.0.shutdown() {
            tracing::warn!(%error, "the last spans did not reach their collector");
        }
    }
}
