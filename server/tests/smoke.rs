//! The program itself: starts, refuses a second daemon, ends without a trace.
#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod harness;

use harness::site::{Site, work_in_disguise};
use harness::{Daemon, PATIENCE, children, command, first_line, sleeper, wait_until};
use std::time::{Duration, Instant};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

#[test]
#[ignore = "the worker's part, run by the daemon of the other tests"]
fn disguised_worker() {
    work_in_disguise();
}

#[test]
fn daemon_starts_and_ends_without_a_trace() {
    let daemon = Daemon::start(sleeper, |_| {});
    wait_until("two workers", || children(daemon.child.id()).len() == 2);
    daemon.stop();
}

#[test]
fn second_daemon_on_a_state_directory_is_refused_and_the_first_named() {
    let daemon = Daemon::start(sleeper, |_| {});
    let worker = daemon.folder.path().join("sleeper");
    let mut second = command(daemon.folder.path(), &worker).spawn().unwrap();
    let line = first_line(&mut second);
    assert_eq!(second.wait().unwrap().code(), Some(2));
    let holder = format!("already in use by pbgi-server with process id {}", daemon.child.id());
    assert!(line.starts_with("ERROR ") && line.contains(&holder), "{line}");
    println!("RELIABILITY P12: the second daemon exits with 2 and names the process of the first");
    daemon.stop();
}

#[test]
fn memory_that_is_not_there_is_refused_with_both_numbers() {
    let folder = tempfile::tempdir().unwrap();
    let mut command = command(folder.path(), &sleeper(folder.path()));
    let mut child = command.args(["--memory", "100T"]).spawn().unwrap();
    let line = first_line(&mut child);
    assert_eq!(child.wait().unwrap().code(), Some(78));
    assert!(
        line.contains("bytes needed") && line.contains("bytes available"),
        "{line}"
    );
}

#[test]
fn segment_and_sockets_of_a_killed_daemon_are_cleaned_up_by_the_next() {
    let mut first = Daemon::start(sleeper, |_| {});
    let stale = first.segment();
    first.child.kill().unwrap();
    first.child.wait().unwrap();
    assert!(stale.metadata().is_ok(), "the kill left no segment to clean up");
    first.restart();
    assert!(stale.metadata().is_err(), "stale segment left");
    first.stop();
}

#[tokio::test]
async fn sigterm_finishes_what_is_leased_and_a_second_one_ends_at_once() {
    let mut site = Site::new(64, 64);
    let shade = async |site: &Site, id: &str, output: &str| {
        site.hold_after(2);
        site.submit(id, site.shade(output)).await.unwrap();
        site.reaches(id, 2).await;
        // Both workers have a tile, and keep it.
        let deadline = Instant::now() + PATIENCE;
        while !site.daemon.status().await.workers.iter().all(|worker| worker.busy) {
            assert!(Instant::now() < deadline, "{}", site.daemon.log());
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        site.daemon.signal("-TERM");
        wait_until("it stops", || site.daemon.log().contains("stopping"));
    };
    site.succeed("build", site.build("s.pbgi")).await;
    let segment = site.daemon.segment();
    shade(&site, "patient", "a.exr").await;
    std::thread::sleep(Duration::from_millis(300));
    assert!(site.daemon.child.try_wait().unwrap().is_none(), "leased tiles are lost");
    site.release();
    assert!(site.daemon.wait().success(), "{}", site.daemon.log());
    assert!(
        site.path("a.exr")
            .parse::<std::path::PathBuf>()
            .unwrap()
            .metadata()
            .is_ok()
    );
    assert!(segment.metadata().is_err());

    std::fs::write(site.daemon.folder.path().join("log"), "").unwrap();
    site.daemon.restart();
    let segment = site.daemon.segment();
    shade(&site, "urgent", "b.exr").await;
    let begun = Instant::now();
    site.daemon.signal("-TERM");
    assert!(site.daemon.wait().success(), "{}", site.daemon.log());
    let took = begun.elapsed();
    // Thirty seconds is what leased tiles would have been given.
    assert!(took < Duration::from_secs(15), "{took:?}");
    assert!(segment.metadata().is_err());
    for name in ["run/jobs.sock", "run/queue.sock", "run/http.sock", "state/segment"] {
        let path = site.daemon.folder.path().join(name);
        assert!(path.symlink_metadata().is_err(), "{name} left");
    }
    println!(
        "RELIABILITY P11: the first SIGTERM waited for 2 leased tiles and exited with 0, a second one ended it within \
         {took:.0?}; no segment and no socket left"
    );
}

#[test]
fn private_daemon_ends_when_idle() {
    let mut daemon = Daemon::start(sleeper, |command| {
        command.args(["--private", "--idle-seconds", "1"]);
    });
    // It may have left by now.
    let segment = daemon.noted_segment();
    assert!(daemon.wait().success());
    assert!(segment.is_none_or(|segment| segment.metadata().is_err()));
    assert!(daemon.noted_segment().is_none());
    let log = std::fs::read_to_string(daemon.folder.path().join("state/server.log")).unwrap();
    assert!(log.contains("idle for long enough"), "{log}");
}

#[test]
fn every_unusable_directory_is_named_on_one_line() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["run", "scratch"] {
        std::fs::write(folder.path().join(name), "").unwrap();
    }
    let mut child = command(folder.path(), &sleeper(folder.path())).spawn().unwrap();
    let line = first_line(&mut child);
    assert_eq!(child.wait().unwrap().code(), Some(1));
    assert_eq!(line.matches("cannot use directory").count(), 2, "{line}");
    println!("RELIABILITY O6: 2 unusable directories, 2 lines, nothing started");
}

async fn health(daemon: &Daemon) -> ServingStatus {
    let mut client = HealthClient::new(daemon.channel("jobs.sock").await);
    let service = "pbgi.v1.JobService".into();
    let answer = client.check(HealthCheckRequest { service }).await.unwrap();
    answer.into_inner().status()
}

#[tokio::test]
async fn daemon_whose_workers_cannot_start_says_so_and_lives() {
    let daemon = Daemon::start(|_| "/bin/false".into(), |_| {});
    let deadline = Instant::now() + PATIENCE;
    while health(&daemon).await != ServingStatus::NotServing {
        assert!(Instant::now() < deadline, "still serving: {}", daemon.log());
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    assert_eq!(
        daemon.log().matches("worker died").count(),
        10,
        "five deaths for each of two slots"
    );
    println!("RELIABILITY P7: 2 slots parked after 5 spawns each, health NOT_SERVING, the daemon answers");
    daemon.stop();
}

#[tokio::test]
async fn health_and_both_reflections_answer_clients() {
    use tonic_reflection::pb::{v1, v1alpha};
    let daemon = Daemon::start(sleeper, |_| {});
    assert_eq!(health(&daemon).await, ServingStatus::Serving);
    macro_rules! services {
        ($version:ident) => {{
            let channel = daemon.channel("jobs.sock").await;
            let mut client = $version::server_reflection_client::ServerReflectionClient::new(channel);
            let request = $version::ServerReflectionRequest {
                host: String::new(),
                message_request: Some($version::server_reflection_request::MessageRequest::ListServices(
                    String::new(),
                )),
            };
            let stream = client
                .server_reflection_info(tokio_stream::once(request))
                .await
                .unwrap();
            let answer = stream
                .into_inner()
                .message()
                .await
                .unwrap()
                .unwrap()
                .message_response
                .unwrap();
            let $version::server_reflection_response::MessageResponse::ListServicesResponse(list) = answer else {
                panic!("not a list: {answer:?}")
            };
            list.service
                .into_iter()
                .map(|service| service.name)
                .collect::<Vec<String>>()
        }};
    }
    for names in [services!(v1), services!(v1alpha)] {
        assert!(names.iter().any(|name| name == "pbgi.v1.JobService"), "{names:?}");
        assert!(!names.iter().any(|name| name.contains("Queue")), "{names:?}");
    }
    daemon.stop();
}
