//! Metrics for Prometheus, made from a look at the daemon at each scrape: the rows of the paper's Table 1 for each job, what they
//! come to for each mounted scene, and what the cache, the workers and the queue do. Labels are bounded: so many jobs, so many
//! mounts, nothing for each tile or page.

use crate::dispatcher::{Dispatcher, JobFigures, SceneFigures};
use crate::job::JobState;
use crate::shade_job::Counters;
use prometheus_client::encoding::text::encode;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::Registry;
use std::sync::atomic::AtomicU64;

/// What [`text`] is.
pub const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";
/// Ended jobs whose rows are shown: enough for scrapes a minute apart, few enough for a time series database.
pub const JOBS_ENDED_SHOWN: usize = 32;
/// Labels of jobs that become labels of metrics.
const JOB_LABELS: [&str; 3] = ["show", "shot", "department"];

type Labels = Vec<(String, String)>;

struct Page(Registry);

impl Page {
    fn gauges(&mut self, name: &str, help: &str, values: impl IntoIterator<Item = (Labels, f64)>) {
        let family = Family::<Labels, Gauge<f64, AtomicU64>>::default();
        for (labels, value) in values {
            // Scenes may share name and content.
            family.get_or_create(&labels).inc_by(value);
        }
        self.0.register(name, help, family);
    }

    fn counters(&mut self, name: &str, help: &str, values: impl IntoIterator<Item = (Labels, f64)>) {
        let family = Family::<Labels, Counter<f64, AtomicU64>>::default();
        for (labels, value) in values {
            family.get_or_create(&labels).inc_by(value);
        }
        self.0.register(name, help, family);
    }
}

fn labels<const N: usize>(pairs: [(&str, String); N]) -> Labels {
    pairs
        .into_iter()
        .map(|(name, value)| (name.to_owned(), value))
        .collect()
}

/// The metrics as text.
///
/// # Errors
/// Never in practice.
pub fn text(dispatcher: &Dispatcher) -> Result<String, std::fmt::Error> {
    let mut page = Page(Registry::with_prefix("pbgi"));
    daemon(&mut page, dispatcher);
    scenes(&mut page, &dispatcher.scene_figures());
    jobs(&mut page, &dispatcher.figures(JOBS_ENDED_SHOWN));
    let mut text = String::new();
    encode(&mut text, &page.0)?;
    Ok(text)
}

fn daemon(page: &mut Page, dispatcher: &Dispatcher) {
    let (status, totals) = (dispatcher.status(), dispatcher.totals());
    let one = |value: f64| [(Labels::new(), value)];
    let up = *dispatcher.health().borrow();
    page.gauges(
        "healthy",
        "Whether the daemon can do its work",
        one(f64::from(u8::from(up))),
    );
    page.gauges("memory_limit_bytes", "The memory cap", one(status.memory_bytes as f64));
    page.gauges("segment_bytes", "The shared segment", one(status.segment_bytes as f64));
    page.gauges(
        "memory_private_bytes",
        "Private memory of all processes",
        one(totals.private_bytes as f64),
    );
    let states = [("waiting", status.jobs_queued), ("running", status.jobs_running)];
    let states = states.map(|(state, count)| (labels([("state", state.to_owned())]), count as f64));
    page.gauges("jobs", "Jobs that have not ended", states);
    let ended = totals.ended.iter().map(|(state, count)| {
        let state = match state {
            JobState::Succeeded => "succeeded",
            JobState::Cancelled => "cancelled",
            _ => "failed",
        };
        (labels([("state", state.to_owned())]), *count as f64)
    });
    page.counters("jobs_ended", "Jobs that ended since the start", ended);
    page.counters("tiles_shaded", "Tiles shaded since the start", one(totals.tiles as f64));
    page.counters(
        "receivers_shaded",
        "Receivers shaded since the start",
        one(totals.counters.receivers as f64),
    );
    page.counters(
        "cut_elements",
        "Elements on the cuts of all receivers",
        one(totals.counters.cut_elements as f64),
    );
    page.counters(
        "shading_cpu_seconds",
        "Processor time of shading",
        one(totals.counters.cpu_nanos as f64 * 1e-9),
    );
    page.counters(
        "shading_io_seconds",
        "Time that workers waited for pages",
        one(totals.counters.io_nanos as f64 * 1e-9),
    );
    let hits = [
        ("local", totals.counters.local_hits),
        ("shared", totals.counters.shared_hits),
        ("miss", totals.counters.cache_misses),
    ];
    let hits = hits.map(|(level, count)| (labels([("level", level.to_owned())]), count as f64));
    page.counters(
        "page_requests",
        "Pages that shading asked for, by where they were found",
        hits,
    );
    page.counters(
        "worker_deaths",
        "Workers that died or were killed",
        one(totals.worker_deaths as f64),
    );
    page.gauges(
        "live_sessions",
        "Clients that stream receivers",
        one(totals.live_sessions as f64),
    );
    let pools = [("node", status.cache.node), ("point", status.cache.point)];
    let pool = |value: fn(&pbgi_cache::PoolCounters) -> u64| {
        pools.map(|(pool, counters)| (labels([("pool", pool.to_owned())]), value(&counters) as f64))
    };
    page.gauges("cache_frames", "Frames of the page cache", pool(|pool| pool.frames));
    page.gauges(
        "cache_frames_resident",
        "Frames that hold a page",
        pool(|pool| pool.resident),
    );
    page.counters("cache_evictions", "Pages that made room", pool(|pool| pool.evictions));
    page.counters("cache_loads", "Pages read from disk", pool(|pool| pool.loads));
    page.counters(
        "cache_reloads",
        "Pages read again after they made room",
        pool(|pool| pool.reloads),
    );
    page.counters(
        "cache_redundant_reads",
        "Pages read while they were resident",
        pool(|pool| pool.redundant_reads),
    );
    let slot = |birth: &crate::supervisor::WorkerBirth| labels([("slot", birth.seat.slot.to_string())]);
    let busy = status
        .workers
        .iter()
        .map(|(birth, busy, _)| (slot(birth), f64::from(u8::from(*busy))));
    page.gauges("worker_busy", "Whether the worker shades a tile", busy);
    let pins = status
        .workers
        .iter()
        .map(|(birth, _, pins)| (slot(birth), f64::from(*pins)));
    page.gauges("worker_frames_pinned", "Frames that the worker holds", pins);
}

fn scenes(page: &mut Page, figures: &[SceneFigures]) {
    let of = |scene: &SceneFigures| {
        let name = scene.mount.path.file_name().unwrap_or_default();
        labels([
            ("scene", name.to_string_lossy().into_owned()),
            ("build_id", scene.mount.build_id.to_string()),
        ])
    };
    let with = |scene: &SceneFigures, name: &str, value: &str| {
        let mut all = of(scene);
        all.push((name.to_owned(), value.to_owned()));
        all
    };
    let kinds = |value: fn(&pbgi_cache::SceneCounters) -> u64| {
        figures.iter().flat_map(move |scene| {
            let kinds = ["node", "point"].into_iter().zip(&scene.cache);
            kinds.map(move |(kind, counters)| (with(scene, "kind", kind), value(counters) as f64))
        })
    };
    page.gauges("scene_pages", "Pages of a scene", kinds(|counters| counters.pages));
    page.gauges(
        "scene_frames_resident",
        "Frames that hold a page of the scene",
        kinds(|counters| counters.resident),
    );
    page.counters(
        "scene_cache_loads",
        "Pages of a scene read from disk for the cache",
        kinds(|counters| counters.loads),
    );
    page.counters(
        "scene_cache_reloads",
        "Pages of a scene read again after they made room",
        kinds(|counters| counters.reloads),
    );
    page.counters(
        "scene_cache_evictions",
        "Pages of a scene that made room",
        kinds(|counters| counters.evictions),
    );
    page.counters(
        "scene_cache_redundant_reads",
        "Pages of a scene read while they were resident",
        kinds(|counters| counters.redundant_reads),
    );
    let levels = figures.iter().flat_map(|scene| {
        let counters = &scene.counters;
        let levels = [
            ("local", counters.local_hits),
            ("shared", counters.shared_hits),
            ("miss", counters.cache_misses),
        ];
        levels.map(|(level, count)| (with(scene, "level", level), count as f64))
    });
    page.counters(
        "scene_page_requests",
        "Pages that shading asked a scene for, by where they were found",
        levels,
    );
    let sums = |value: fn(&Counters) -> f64| figures.iter().map(move |scene| (of(scene), value(&scene.counters)));
    page.counters(
        "scene_receivers_shaded",
        "Receivers shaded with a scene",
        sums(|counters| counters.receivers as f64),
    );
    page.counters(
        "scene_cut_elements",
        "Elements on the cuts of a scene's receivers",
        sums(|counters| counters.cut_elements as f64),
    );
    page.counters(
        "scene_nodes_traversed",
        "Nodes visited to find a scene's cuts",
        sums(|counters| counters.nodes_visited as f64),
    );
    page.counters(
        "scene_traversal_bytes",
        "Bytes of the pages that each receiver of a scene touched",
        sums(|counters| counters.traversal_bytes as f64),
    );
    page.counters(
        "scene_shading_cpu_seconds",
        "Processor time of shading with a scene",
        sums(|counters| counters.cpu_nanos as f64 * 1e-9),
    );
    page.counters(
        "scene_shading_io_seconds",
        "Time that workers waited for a scene's pages",
        sums(|counters| counters.io_nanos as f64 * 1e-9),
    );
}

fn jobs(page: &mut Page, figures: &[JobFigures]) {
    let of = |job: &JobFigures| {
        let status = &job.status;
        let mut all = labels([
            ("job", status.id.clone()),
            ("scene", job.scene.clone()),
            ("user", status.options.user.clone()),
        ]);
        for name in JOB_LABELS {
            all.push((
                name.to_owned(),
                status.options.labels.get(name).cloned().unwrap_or_default(),
            ));
        }
        all
    };
    let running: Vec<&JobFigures> = figures.iter().filter(|job| !job.status.state.ended()).collect();
    let done = running.iter().map(|job| (of(job), job.status.done as f64));
    page.gauges(
        "job_units_done",
        "Tiles or points of a running job's stage that are done",
        done,
    );
    let total = running.iter().map(|job| (of(job), job.status.total as f64));
    page.gauges("job_units", "Tiles or points of a running job's stage", total);
    // The names of the rows are the same for every job.
    let names = pbgi_core::Statistics::default().rows();
    for (index, row) in names.iter().enumerate() {
        let value = |job: &JobFigures| Some((of(job), job.statistics.rows().get(index)?.value?));
        let values: Vec<(Labels, f64)> = figures.iter().filter_map(value).collect();
        if !values.is_empty() {
            page.gauges(&format!("job_{}", row.name), row.label, values);
        }
    }
}
