//! What a look at a page costs: locally, shared, and by asking the owner in the same process.
//!
//!     cargo bench -p pbgi-cache
//!
//! 2 cores (shared, so best of 7 rounds), Linux 6.18, 2026-11, release profile:
//!
//! ```text
//! plain memory, 64 pages in turn                                  0.5 ns
//! local hit, 64 pages in turn                                     2.9 ns
//! local hit, the same page                                        1.6 ns
//! local hit behind the front table, 1,000 pages                  19.9 ns
//! shared hit with eviction from the local cache                 208.2 ns
//! pin + unpin of one shared page                                 24.3 ns
//! pin + unpin, 2,048 shared pages in turn                        20.6 ns
//! look-up of a page that is not there                             2.9 ns
//! owner: fetch of one resident page                              56.5 ns
//! owner: fetch with eviction, empty load, reap                 1093.2 ns
//! ```
#![allow(clippy::unwrap_used, reason = "a bench that cannot run has nothing to say")]

#[cfg(loom)]
fn main() {}

#[cfg(not(loom))]
#[path = "../tests/support/mod.rs"]
mod support;

#[cfg(not(loom))]
use {pbgi_core::PageKey, std::hint::black_box, std::time::Instant, support::*};

#[cfg(not(loom))]
const ROUNDS: usize = 7;

/// Nanoseconds of one call, the best of some rounds.
#[cfg(not(loom))]
fn measure(calls: u32, mut call: impl FnMut(u32)) -> f64 {
    let round = |call: &mut dyn FnMut(u32)| {
        let start = Instant::now();
        (0..calls).for_each(call);
        start.elapsed().as_nanos() as f64 / f64::from(calls)
    };
    (0..ROUNDS).map(|_| round(&mut call)).fold(f64::INFINITY, f64::min)
}

#[cfg(not(loom))]
fn main() {
    let owner = owner(2, 4096, 1024, 4);
    let mut filler = worker(&owner, 1);
    for page in 0..2048 {
        fetch_into(&owner, &mut filler, node(page), 1);
    }
    let report = |name: &str, ns: f64| println!("{name:<58}{ns:>9.1} ns");

    // The same touches of the same frames, addresses known beforehand.
    let mut cache = worker(&owner, 0);
    let walk = |step: u32| step.wrapping_mul(29) % 64;
    let plain: Vec<Vec<u8>> = (0..64).map(|_| vec![1; 8192]).collect();
    report(
        "plain memory, 64 pages in turn",
        measure(10_000_000, |step| {
            black_box(plain[walk(step) as usize][64]);
        }),
    );
    let get = |cache: &mut pbgi_cache::LocalCache, key: PageKey| {
        black_box(cache.get(key).map(|page| page[64]));
    };
    report(
        "local hit, 64 pages in turn",
        measure(10_000_000, |step| get(&mut cache, node(walk(step)))),
    );
    report(
        "local hit, the same page",
        measure(10_000_000, |_| get(&mut cache, node(7))),
    );
    report(
        "local hit behind the front table, 1,000 pages",
        measure(1_000_000, |step| get(&mut cache, node(step % 1000))),
    );
    report(
        "shared hit with eviction from the local cache",
        measure(1_000_000, |step| get(&mut cache, node(step % 2048))),
    );
    drop(cache);

    let mut view = view(&owner, 0);
    report(
        "pin + unpin of one shared page",
        measure(5_000_000, |_| {
            black_box(view.pin(node(7)).is_some());
        }),
    );
    report(
        "pin + unpin, 2,048 shared pages in turn",
        measure(1_000_000, |step| {
            black_box(view.pin(node(step % 2048)).is_some());
        }),
    );
    report(
        "look-up of a page that is not there",
        measure(1_000_000, |step| {
            black_box(view.pin(node(2048 + step % 2048)).is_some());
        }),
    );
    drop(view);

    let seat = owner.seat(0).unwrap();
    report(
        "owner: fetch of one resident page",
        measure(1_000_000, |_| {
            black_box(owner.fetch(seat, node(7), 1, |_| unreachable!()).is_ok());
        }),
    );
    owner.reap(0).unwrap();
    let small = support::owner(1, 64, 8, 4);
    report(
        "owner: fetch with eviction, empty load, reap",
        measure(200_000, |step| {
            let seat = small.seat(0).unwrap();
            black_box(small.fetch(seat, node(step % PAGES), 1, |_| Ok(())).is_ok());
            small.reap(0).unwrap();
        }),
    );
}
