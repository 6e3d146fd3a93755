//! Processes that die: what is left of them, and who does their work.

use pbgi_tests::{DAEMON, House, Picture, Signal, assert_same, signal, wait_for};
use std::time::Duration;

const WAIT: Duration = Duration::from_secs(10);

#[test]
fn the_tile_of_a_killed_worker_is_done_by_another() {
    let house = House::new();
    house.furnish(60_000, "128x128");
    let line = |run: &str| format!("shade demo.pbgi --gbuffer g.exr -o {run}.exr {DAEMON}");
    let mut job = house.start(&line("killed"));
    let mut before = vec![];
    let killed = wait_for(Duration::from_secs(30), || {
        before = house.running("pbgi-worker");
        house.kill_workers(false) || !job.runs()
    });
    assert!(killed && job.runs(), "the job was over before a worker was killed");
    job.end().ok();
    // The dead one has a successor, and nobody is left over.
    assert!(wait_for(WAIT, || house.running("pbgi-worker").len() == 2));
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
    let under_way = wait_for(Duration::from_secs(30), || {
        house.share().is_some_and(|share| share > 0.0 && share < 1.0) || !job.runs()
    });
    assert!(under_way && job.runs(), "the job was over before the daemon was killed");
    let daemons = house.running("pbgi-server");
    assert_eq!(daemons.len(), 1);
    let segments = house.segments();
    assert_eq!(segments.len(), 1);
    assert!(segments[0].1.metadata().is_ok(), "{segments:?}");
    signal(daemons[0], Signal::SIGKILL);
    assert!(
        wait_for(WAIT, || house.running("pbgi-worker").is_empty()),
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
