//! Shading a scene that is larger than the memory, by the daemon and its workers, as a user would.

use crate::town::Town;
use crate::{Options, build_town, mib};
use pbgi_tests::House;

const WORKERS: u32 = 2;
/// What the daemon and its workers need beside pages, and the share of the rest that is pages: to find the budget for a cache.
const PRIVATE_BYTES: f64 = 32e6;
const SEGMENT_SHARE: f64 = 0.5;
/// Points of the curve, in average traversal memories.
const CURVE: [u32; 7] = [50, 20, 10, 5, 3, 2, 1];

/// One row: what a frame took within a budget.
fn frame(house: &House, memory: u64) -> Option<serde_json::Value> {
    let line = format!(
        "shade town.pbgi --gbuffer g.exr -o o.exr --overwrite --stats s.json --memory {memory} --workers {WORKERS}"
    );
    let run = house.line(&line);
    house.shutdown();
    if run.code != Some(0) {
        println!(
            "| {:.0} MiB | {} |",
            mib(memory),
            run.stderr.lines().last().unwrap_or_default()
        );
        return None;
    }
    let statistics = house.statistics("s.json");
    let row = |name: &str| statistics[name].as_f64().unwrap_or(0.0);
    let served = row("average_traversal_bytes") * row("shading_calls");
    println!(
        "| {:.0} | {:.0} MiB | {:.1} | {:.1} s | {:.2} % | {:.3} % | {:.4} % | {:.0} MiB | {} | {} | {} |",
        (memory as f64 - PRIVATE_BYTES) * SEGMENT_SHARE / row("average_traversal_bytes"),
        mib(memory),
        row("out_of_core_bytes") / memory as f64,
        row("shading_seconds"),
        row("shading_io_seconds") * 100.0 / (row("shading_seconds") * f64::from(WORKERS)),
        (1.0 - row("bytes_read") / served) * 100.0,
        row("cache_hit_ratio") * 100.0,
        mib(row("peak_memory_bytes") as u64),
        row("pages_loaded"),
        row("reloads"),
        row("redundant_reads"),
    );
    Some(statistics)
}

/// Prints the tables.
pub(crate) fn print(options: &Options) {
    let house = House::new();
    build_town(options.points, &house.path(""), "town.pbgi");
    let (width, height) = options.size;
    head(&house, options.points, (width, height));
    let Some(statistics) = frame(&house, options.memory) else {
        return;
    };
    // A quarter of the picture, so that it has room in the smallest of budgets.
    head(&house, options.points, (width / 2, height / 2));
    let traversal = statistics["average_traversal_bytes"].as_f64().unwrap_or(0.0);
    for times in CURVE {
        let pages = f64::from(times) * traversal;
        frame(&house, (PRIVATE_BYTES + pages / SEGMENT_SHARE) as u64);
    }
    println!();
}

/// Makes the receivers, and prints the head of their table.
fn head(house: &House, points: u64, (width, height): (u32, u32)) {
    let receivers = Town::new(points).gbuffer(width, height);
    receivers.write(&house.path("g.exr")).unwrap();
    println!(
        "out of core, {WORKERS} workers, {width} x {height} receivers spread over the whole town\n\n\
         | Pages over a traversal | memory | scene over memory | shading | waiting | hits a receiver | hits a look-up \
         | peak | loads | reloads | redundant |\n|---|---|---|---|---|---|---|---|---|---|---|"
    );
}
