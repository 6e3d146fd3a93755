//! Processes that die: what is left of them, and who does their work.

#![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

use pbgi_tests::{DAEMON, House, PATIENCE, Picture, Signal, assert_same, signal, wait_for};
use std::collections::{BTreeSet, HashSet};
use std::time::{Duration, Instant};

#[test]
fn the_tile_of_a_killed_worker_is_done_by_another() {
    let house = House::new();
    house.furnish(60_000, "128x128");
    let line = |run: &str| format!("shade demo.pbgi --gbuffer g.exr -o {run}.exr {DAEMON}");
    let mut job = house.start(&line("killed"));
    let mut before = None;
    wait_for(PATIENCE, || {
        before = house.kill_workers(false);
        before.is_some() || !job.runs()
    });
    let before = before.expect("the job was over before a worker was killed");
    job.end().ok();
    // The dead one has a successor, and nobody is left over.
    assert!(wait_for(PATIENCE, || house.running("pbgi-worker").len() == 2));
    let after = house.running("pbgi-worker");
    let survivors = before.iter().filter(|pid| after.contains(pid)).count();
    assert_eq!((before.len(), survivors), (2, 1));
    house.line(&line("calm")).ok();
    assert_same(
        &Picture::read(&house.path("killed.exr")),
        &Picture::read(&house.path("calm.exr")),
    );
    house.shutdown();
    assert_eq!(house.processes(), vec![]);
    assert_eq!(house.segments(), vec![]);
}

#[test]
fn a_killed_daemon_leaves_no_worker_no_picture_and_no_segment() {
    let house = House::new();
    house.furnish(60_000, "128x128");
    std::fs::create_dir(house.path("out")).unwrap();
    let line = format!("shade demo.pbgi --gbuffer g.exr -o out/o.exr {DAEMON}");
    let mut job = house.start(&line);
    // Stopped workers die with their daemon like others.
    let mut under_way = false;
    wait_for(PATIENCE, || {
        under_way = house.stop_workers().is_some();
        under_way || !job.runs()
    });
    assert!(under_way, "the job was over before the daemon was killed");
    let daemons = house.running("pbgi-server");
    assert_eq!(daemons.len(), 1);
    let segments = house.segments();
    assert_eq!(segments.len(), 1);
    assert!(segments[0].1.metadata().is_ok(), "{segments:?}");
    signal(daemons[0], Signal::SIGKILL);
    assert!(
        wait_for(PATIENCE, || house.running("pbgi-worker").is_empty()),
        "workers outlived their daemon"
    );
    let run = job.end();
    run.fails_naming(&["error: "]);
    let left = || std::fs::read_dir(house.path("out")).unwrap().count();
    assert_eq!(left(), 0, "the killed daemon left a file at the output");

    // The next one sweeps up and works.
    house.line(&line).ok();
    assert!(house.path("out/o.exr").metadata().unwrap().len() > 1_000);
    assert_eq!(left(), 1);
    assert!(segments[0].1.metadata().is_err(), "the stale segment is still there");
    let fresh = house.segments();
    assert_eq!(fresh.len(), 1);
    assert_eq!(fresh[0].0, segments[0].0);
    assert_ne!(fresh[0].1, segments[0].1);
    assert!(fresh[0].1.metadata().is_ok());
    assert_eq!(house.running("pbgi-server").len(), 1);
    house.shutdown();
    assert!(fresh[0].1.metadata().is_err(), "a segment outlived its daemon");
}

/// Workers that shade now, by process id; none before there is a daemon.
fn shading(house: &House) -> Vec<i32> {
    let status = house.line("status").stdout;
    let workers = status
        .lines()
        .filter(|line| line.starts_with("worker") && line.contains(", shading"));
    let pid = |line: &str| line.split("pid ").nth(1)?.split(',').next()?.parse().ok();
    workers.filter_map(pid).collect()
}

#[test]
#[ignore = "minutes: cargo test --release -p pbgi-tests --test kill -- --ignored"]
fn a_tile_that_kills_three_workers_fails_its_job_and_no_other() {
    let house = House::new();
    house.furnish(60_000, "32x32");
    let line = |run: &str, quality: &str| format!("shade demo.pbgi --gbuffer g.exr -o {run}.exr {quality} {DAEMON}");
    house.line(&line("before", "")).ok();
    // One tile, made slow. A worker that the tile itself brings down ends by such a signal; a fault's own would be swallowed by
    // the runtime's handler, which expects the fault to come again.
    let mut job = house.start(&line("poison", "--max-solid-angle 0.0001"));
    // A daemon that has not noticed yet shows a dead worker as shading.
    let mut dead = HashSet::new();
    while job.runs() {
        for pid in shading(&house)
            .into_iter()
            .filter(|pid| !dead.contains(pid))
            .collect::<Vec<_>>()
        {
            signal(pid, Signal::SIGABRT);
            assert!(
                wait_for(PATIENCE, || !house.running("pbgi-worker").contains(&pid)),
                "{pid} lives"
            );
            dead.insert(pid);
        }
        assert!(dead.len() <= 3, "the job goes on after {} deaths", dead.len());
    }
    let (run, deaths) = (job.end(), dead.len());
    assert_eq!(deaths, 3, "{run:?}");
    println!("RELIABILITY P6: {deaths} deaths");
    run.fails_naming(&["tile 0", "3 workers died on it"]);
    assert!(house.path("poison.exr").metadata().is_err());
    house.line(&line("after", "")).ok();
    assert_same(
        &Picture::read(&house.path("before.exr")),
        &Picture::read(&house.path("after.exr")),
    );
}

fn hung_workers(count: usize) {
    let house = House::new();
    house.furnish(60_000, "128x128");
    house
        .line(&format!("shade demo.pbgi --gbuffer g.exr -o calm.exr {DAEMON}"))
        .ok();
    for round in 0..count {
        let mut job = house.start(&format!("shade demo.pbgi --gbuffer g.exr -o hung{round}.exr {DAEMON}"));
        let mut hung = None;
        let stopped = wait_for(PATIENCE, || {
            hung = shading(&house).first().copied();
            hung.is_some() || !job.runs()
        });
        assert!(stopped && job.runs(), "the job was over before a worker hung");
        let hung = hung.unwrap();
        signal(hung, Signal::SIGSTOP);
        let start = Instant::now();
        // Ten seconds without a heartbeat, then it is killed, then its tile goes to another.
        assert!(
            wait_for(PATIENCE, || !house.running("pbgi-worker").contains(&hung)),
            "the hung worker lives"
        );
        let seconds = start.elapsed().as_secs_f64();
        job.end().ok();
        println!("RELIABILITY P5: round {round}: killed after {seconds:.2} s, the same picture");
        assert_same(
            &Picture::read(&house.path("calm.exr")),
            &Picture::read(&house.path(&format!("hung{round}.exr"))),
        );
    }
}

#[test]
#[ignore = "minutes: cargo test --release -p pbgi-tests --test kill -- --ignored"]
fn a_hung_worker_is_killed_and_its_tile_done_by_another() {
    hung_workers(1);
}

#[test]
#[ignore = "minutes: cargo test --release -p pbgi-tests --test kill -- --ignored"]
fn twenty_hung_workers_are_killed_and_their_tiles_done_by_others() {
    hung_workers(20);
}

#[test]
#[ignore = "minutes: cargo test --release -p pbgi-tests --test kill -- --ignored"]
fn a_hundred_killed_workers_change_no_pixel_and_fail_no_job() {
    let house = House::new();
    house.furnish(60_000, "512x512");
    // Short tiles, so that some are done between two kills.
    let line = |run: &str| format!("shade demo.pbgi --gbuffer g.exr -o {run}.exr --max-solid-angle 1 {DAEMON}");
    let start = Instant::now();
    house.line(&line("calm")).ok();
    let calm = start.elapsed();
    let (mut kills, mut rounds) = (0, 0);
    let mut disturbed = Duration::ZERO;
    while kills < 100 {
        let start = Instant::now();
        let mut job = house.start(&line(&format!("killed{rounds}")));
        while job.runs() {
            std::thread::sleep(Duration::from_millis(200));
            let workers = house.running("pbgi-worker");
            if let Some(&pid) = workers.get(kills % workers.len().max(1)) {
                signal(pid, Signal::SIGKILL);
                kills += 1;
            }
        }
        job.end().ok();
        disturbed += start.elapsed();
        assert_same(
            &Picture::read(&house.path("calm.exr")),
            &Picture::read(&house.path(&format!("killed{rounds}.exr"))),
        );
        rounds += 1;
    }
    let slowdown = disturbed.as_secs_f64() / (calm.as_secs_f64() * f64::from(rounds));
    println!("RELIABILITY P4: {kills} kills in {rounds} frames, {slowdown:.2} times the time of a calm one");
}

#[test]
#[ignore = "minutes: cargo test --release -p pbgi-tests --test kill -- --ignored"]
fn twenty_killed_daemons_leave_no_worker_and_no_partial_picture() {
    let house = House::new();
    house.furnish(60_000, "128x128");
    std::fs::create_dir(house.path("out")).unwrap();
    let (mut workers_gone, mut ready) = (Duration::ZERO, Duration::ZERO);
    for round in 0..20u64 {
        let mut job = house.start(&format!("shade demo.pbgi --gbuffer g.exr -o out/o{round}.exr {DAEMON}"));
        let under_way = wait_for(PATIENCE, || !shading(&house).is_empty() || !job.runs());
        assert!(under_way && job.runs(), "the job was over before the daemon was killed");
        std::thread::sleep(Duration::from_millis(37 * (round % 7)));
        for pid in house.running("pbgi-server") {
            signal(pid, Signal::SIGKILL);
        }
        let start = Instant::now();
        assert!(
            wait_for(PATIENCE, || house.running("pbgi-worker").is_empty()),
            "orphans"
        );
        workers_gone = workers_gone.max(start.elapsed());
        job.end().fails_naming(&["error: "]);
        assert_eq!(
            std::fs::read_dir(house.path("out")).unwrap().count(),
            0,
            "a partial picture"
        );
        let start = Instant::now();
        house.line(&format!("info demo.pbgi {DAEMON}")).ok();
        ready = ready.max(start.elapsed());
        assert_eq!(house.segments().len(), 1);
        house.shutdown();
        // What was finished by the daemon in between is not partial; the next round starts with an empty folder again.
        for file in std::fs::read_dir(house.path("out")).unwrap().flatten() {
            Picture::read(&file.path());
            std::fs::remove_file(file.path()).unwrap();
        }
    }
    println!("RELIABILITY P8: 20 kills: workers gone within {workers_gone:?}, the next daemon ready within {ready:?}");
}

#[test]
#[ignore = "minutes: cargo test --release -p pbgi-tests --test kill -- --ignored"]
fn a_daemon_killed_at_any_moment_of_its_start_leaves_at_most_a_segment_that_the_next_removes() {
    let house = House::new();
    house.furnish(2_000, "32x32");
    house.shutdown();
    let mut seen = BTreeSet::new();
    for round in 0..20u64 {
        let mut start = house.start(&format!("info demo.pbgi {DAEMON}"));
        wait_for(PATIENCE, || !house.running("pbgi-server").is_empty() || !start.runs());
        std::thread::sleep(Duration::from_micros(1_500 * round));
        for pid in house.running("pbgi-server") {
            signal(pid, Signal::SIGKILL);
        }
        seen.extend(house.segments().into_iter().map(|(_, segment)| segment));
        start.end();
        assert!(
            wait_for(PATIENCE, || house.processes().is_empty()),
            "{:?}",
            house.processes()
        );
    }
    house.line(&format!("info demo.pbgi {DAEMON}")).ok();
    let now: Vec<_> = house.segments().into_iter().map(|(_, segment)| segment).collect();
    assert_eq!(now.len(), 1);
    let left: Vec<_> = seen
        .iter()
        .filter(|segment| segment.metadata().is_ok() && !now.contains(segment))
        .collect();
    assert!(left.is_empty(), "stale: {left:?}");
    println!("RELIABILITY S1: 20 kills, {} segments seen, all gone", seen.len());
}

#[test]
#[ignore = "minutes: cargo test --release -p pbgi-tests --test kill -- --ignored"]
fn a_segment_that_somebody_removes_lets_the_job_finish_and_the_daemon_leave() {
    let house = House::new();
    house.furnish(60_000, "128x128");
    let line = |run: &str| format!("shade demo.pbgi --gbuffer g.exr -o {run}.exr {DAEMON}");
    house.line(&line("calm")).ok();
    let mut job = house.start(&line("removed"));
    let under_way = wait_for(PATIENCE, || !shading(&house).is_empty() || !job.runs());
    assert!(under_way && job.runs(), "the job was over too soon");
    let daemons = house.running("pbgi-server");
    std::fs::remove_file(&house.segments()[0].1).unwrap();
    let run = job.end();
    assert!(
        wait_for(PATIENCE, || house.running("pbgi-server").is_empty()),
        "a daemon without a segment stays"
    );
    // What was leased was finished; the rest is for the next daemon.
    if run.code != Some(0) {
        run.fails_naming(&["error: "]);
        house.line(&line("removed")).ok();
    }
    assert_ne!(house.running("pbgi-server"), daemons);
    println!("RELIABILITY S4: the daemon left, the same picture");
    assert_same(
        &Picture::read(&house.path("calm.exr")),
        &Picture::read(&house.path("removed.exr")),
    );
}
