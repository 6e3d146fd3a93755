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
            "  {:8.0} MiB  {}",
            mib(memory),
            run.stderr.lines().last().unwrap_or_default()
        );
        return None;
    }
    let statistics = house.statistics("s.json");
    let row = |name: &str| statistics[name].as_f64().unwrap_or(0.0);
    let served = row("average_traversal_bytes") * row("shading_calls");
    println!(
        "  {:8.0} MiB {:9.1} s {:8.2} % {:11.4} % {:11.5} % {:9.1} MiB {:9} {:9} {:9.2} {:5}",
        mib(memory),
        row("shading_seconds"),
        row("shading_io_seconds") * 100.0 / (row("shading_seconds") * f64::from(WORKERS)),
        (1.0 - row("bytes_read") / served) * 100.0,
        row("cache_hit_ratio") * 100.0,
        row("peak_memory_bytes") / f64::from(1 << 20),
        row("pages_loaded"),
        row("reloads"),
        row("out_of_core_bytes") / memory as f64,
        row("redundant_reads"),
    );
    Some(statistics)
}

/// Prints the table.
pub(crate) fn print(options: &Options) {
    let house = House::new();
    build_town(options.points, &house.path(""), "town.pbgi");
    let (width, height) = options.size;
    Town::new(options.points)
        .gbuffer(width, height)
        .write(&house.path("g.exr"))
        .unwrap();
    println!("out of core, {WORKERS} workers, {width} x {height} receivers spread over the whole town");
    println!(
        "    memory       shading  waiting  hits/receiver  hits/look-up       peak     loads   reloads  size/cap  redundant"
    );
    let Some(statistics) = frame(&house, options.memory) else {
        return;
    };
    let traversal = statistics["average_traversal_bytes"].as_f64().unwrap_or(0.0);
    println!(
        "  the cache as multiples of the {:.2} MiB that a receiver touches:",
        traversal / f64::from(1 << 20)
    );
    for times in CURVE {
        print!("  {times:3} x");
        frame(
            &house,
            (PRIVATE_BYTES + f64::from(times) * traversal / SEGMENT_SHARE) as u64,
        );
    }
    println!();
}
