//! Jobs that outlive their daemon: killed or stopped in mid-frame, the next one goes on to the same bytes.
#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod harness;

use harness::site::{Site, check_picture, work_in_disguise};
use harness::{PATIENCE, wait_until};
use pbgi_proto::v1;
use std::time::{Duration, Instant};
use tonic::Code;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

#[test]
#[ignore = "the worker's part, run by the daemon of the other tests"]
fn disguised_worker() {
    work_in_disguise();
}

fn story(job: &v1::Job) -> String {
    job.history.iter().map(|event| format!("{}; ", event.text)).collect()
}

/// Tiles that the last daemon had stored, as the job's history tells.
fn stored(job: &v1::Job) -> u64 {
    let last = job
        .history
        .iter()
        .rev()
        .take_while(|event| event.text != "the daemon died");
    let mut counts = last.filter_map(|event| {
        event
            .text
            .strip_prefix("goes on with ")?
            .split(' ')
            .next()?
            .parse()
            .ok()
    });
    counts.next().unwrap_or(0)
}

#[tokio::test]
async fn killed_daemon_loses_no_job_and_the_next_one_goes_on_to_the_same_bytes() {
    const KILLS: u64 = 5;
    let mut site = Site::new(512, 512);
    site.succeed("build", site.build("s.pbgi")).await;
    site.hold_after(30);
    site.submit("shade", site.shade("a.exr")).await.unwrap();
    let after = v1::JobOptions {
        after: vec!["shade".into()],
        labels: [("show".to_owned(), "dune".to_owned())].into(),
        ..Default::default()
    };
    site.submit_with("later", site.shade("b.exr"), after).await.unwrap();
    let (mut kept, mut last, mut slowest) = (0, 0, Duration::ZERO);
    for _ in 0..KILLS {
        // Workers may finish ten more than are waited for: it dies at work, and never when all is done.
        site.reaches("shade", last + 20).await;
        slowest = slowest.max(site.daemon.kill_and_restart());
        site.hold_after(30);
        let job = site.reaches("shade", 1).await;
        // What was not on the disk yet is shaded again; what was, never.
        let found = stored(&job);
        assert!(found >= last, "{found} tiles kept, {last} before");
        last = found;
        kept += found;
        assert!(std::fs::metadata(site.path("a.exr")).is_err());
    }
    assert!(kept > 0, "no tile was ever kept");
    site.release();
    let job = site.wait("shade").await;
    assert_eq!(
        (job.state(), job.done, job.total),
        (v1::JobState::Succeeded, 256, 256),
        "{}",
        job.error
    );
    assert!(story(&job).contains("the daemon died"), "{}", story(&job));
    check_picture(&site.daemon.folder.path().join("a.exr"), &site.gbuffer);
    let later = site.wait("later").await;
    assert_eq!(later.state(), v1::JobState::Succeeded, "{}", later.error);
    assert_eq!(later.options.unwrap().labels["show"], "dune");
    check_picture(&site.daemon.folder.path().join("b.exr"), &site.gbuffer);
    println!(
        "RELIABILITY P8: {KILLS} kills of the daemon in mid-frame, {kept} finished tiles kept, \
         READY again within {slowest:.2?}, 0 pixels differ"
    );
    site.daemon.stop();
}

#[tokio::test]
async fn stopped_daemon_leaves_its_jobs_to_the_next() {
    let mut site = Site::new(512, 512);
    site.succeed("build", site.build("s.pbgi")).await;
    site.hold_after(20);
    site.submit("shade", site.shade("a.exr")).await.unwrap();
    site.reaches("shade", 20).await;
    let request = v1::WatchJobRequest {
        job_id: "shade".into(),
        ..Default::default()
    };
    let mut watch = site.daemon.jobs().await.watch_job(request).await.unwrap().into_inner();
    site.daemon.signal("-TERM");
    wait_until("it stops", || site.daemon.log().contains("stopping"));
    site.release();
    let told = loop {
        match watch.message().await {
            Ok(Some(_)) => {}
            Ok(None) => panic!("the stream ended without a word"),
            Err(status) => break status,
        }
    };
    assert_eq!(told.code(), Code::Unavailable, "{told}");
    assert!(site.daemon.wait().success(), "{}", site.daemon.log());
    site.daemon.restart();
    let job = site.wait("shade").await;
    assert_eq!(job.state(), v1::JobState::Succeeded, "{}", job.error);
    assert!(story(&job).contains("suspended"), "{}", story(&job));
    check_picture(&site.daemon.folder.path().join("a.exr"), &site.gbuffer);
    site.daemon.stop();
}

#[tokio::test]
async fn segment_that_somebody_unlinks_is_noticed_and_what_runs_is_finished() {
    let mut site = Site::new(512, 512);
    site.succeed("build", site.build("s.pbgi")).await;
    site.hold_after(20);
    site.submit("shade", site.shade("a.exr")).await.unwrap();
    site.reaches("shade", 20).await;
    let mut health = HealthClient::new(site.daemon.channel("jobs.sock").await);
    let segment = site.daemon.segment();
    let begun = Instant::now();
    std::fs::remove_file(&segment).unwrap();
    loop {
        let service = "pbgi.v1.JobService".into();
        let answer = health.check(HealthCheckRequest { service }).await.unwrap();
        if answer.into_inner().status() == ServingStatus::NotServing {
            break;
        }
        assert!(begun.elapsed() < PATIENCE, "still serving: {}", site.daemon.log());
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    let noticed = begun.elapsed();
    // Nobody new can attach, and is told so; the workers that there are finish what they have.
    let name = format!("/{}", segment.file_name().unwrap().to_str().unwrap());
    let refused = pbgi_cache::CacheView::attach(&name, 0, 0).err().unwrap();
    assert!(refused.to_string().contains(&name[1..]), "{refused}");
    site.release();
    assert!(site.daemon.wait().success(), "{}", site.daemon.log());
    site.daemon.restart();
    let job = site.wait("shade").await;
    assert_eq!(job.state(), v1::JobState::Succeeded, "{}", job.error);
    assert!(stored(&job) >= 20, "{}", story(&job));
    check_picture(&site.daemon.folder.path().join("a.exr"), &site.gbuffer);
    println!(
        "RELIABILITY S4: NOT_SERVING {noticed:.1?} after the segment was unlinked, attaching refused, leased tiles finished; \
         the next daemon went on with {} tiles to the same picture",
        stored(&job)
    );
    site.daemon.stop();
}

#[tokio::test]
async fn paused_picture_keeps_its_tiles_and_goes_on_when_resumed() {
    let mut site = Site::new(512, 512);
    site.succeed("build", site.build("s.pbgi")).await;
    site.hold_after(20);
    site.submit("shade", site.shade("a.exr")).await.unwrap();
    site.reaches("shade", 20).await;
    let job_id = || "shade".to_owned();
    let pause = v1::PauseJobRequest {
        job_id: job_id(),
        reason: "lunch".into(),
    };
    site.daemon.jobs().await.pause_job(pause).await.unwrap();
    site.release();
    let resting = loop {
        let job = site.job("shade").await;
        if job.stage == "paused" {
            break job;
        }
        tokio::time::sleep(Duration::from_millis(5)).await;
    };
    assert_eq!(resting.state(), v1::JobState::Queued);
    // It rests through the death of its daemon.
    site.daemon.kill_and_restart();
    site.succeed("other", site.shade("b.exr")).await;
    // The last tiles may not have been on the disk when it died.
    let rested = site.job("shade").await;
    assert!(
        rested.stage == "paused" && rested.done <= resting.done,
        "{resting:?} {rested:?}"
    );
    let resume = v1::ResumeJobRequest { job_id: job_id() };
    site.daemon.jobs().await.resume_job(resume).await.unwrap();
    let job = site.wait("shade").await;
    assert_eq!(job.state(), v1::JobState::Succeeded, "{}", job.error);
    assert!(
        story(&job).contains("paused: lunch; ") && story(&job).contains("tiles done"),
        "{}",
        story(&job)
    );
    check_picture(&site.daemon.folder.path().join("a.exr"), &site.gbuffer);
    site.daemon.stop();
}

#[tokio::test]
async fn failed_job_takes_its_dependents_along_and_can_be_tried_again() {
    let site = Site::new(64, 64);
    site.submit("first", site.shade("a.exr")).await.unwrap();
    let failed = site.wait("first").await;
    assert_eq!(failed.state(), v1::JobState::Failed);
    let after = |id: &str| v1::JobOptions {
        after: vec![id.into()],
        ..Default::default()
    };
    let refused = site
        .submit_with("second", site.shade("b.exr"), after("first"))
        .await
        .unwrap_err();
    assert_eq!(refused.code(), Code::FailedPrecondition);
    let unknown = site
        .submit_with("third", site.shade("b.exr"), after("nobody"))
        .await
        .unwrap_err();
    assert_eq!(unknown.code(), Code::NotFound);
    site.submit("build", site.build("s.pbgi")).await.unwrap();
    site.submit_with("shade", site.shade("b.exr"), after("build"))
        .await
        .unwrap();
    assert_eq!(site.wait("shade").await.state(), v1::JobState::Succeeded);
    assert_eq!(site.wait("build").await.state(), v1::JobState::Succeeded);
    let job_id = "first".to_owned();
    site.daemon
        .jobs()
        .await
        .retry_job(v1::RetryJobRequest { job_id })
        .await
        .unwrap();
    let job = site.wait("first").await;
    assert_eq!(job.state(), v1::JobState::Succeeded, "{}", job.error);
    assert!(story(&job).contains("tried again"), "{}", story(&job));
    site.daemon.stop();
}

#[tokio::test]
async fn the_same_task_is_found_under_way_when_asked_to_attach() {
    let site = Site::new(512, 512);
    site.succeed("build", site.build("s.pbgi")).await;
    site.hold_after(0);
    site.submit("shade", site.shade("a.exr")).await.unwrap();
    let request = |attach| v1::SubmitJobRequest {
        job_id: "again".into(),
        task: Some(site.shade("a.exr")),
        options: None,
        attach,
    };
    let mut client = site.daemon.jobs().await;
    assert_eq!(
        client.submit_job(request(false)).await.unwrap_err().code(),
        Code::Aborted
    );
    assert_eq!(
        client.submit_job(request(true)).await.unwrap().into_inner().job_id,
        "shade"
    );
    site.release();
    site.wait("shade").await;
    site.daemon.stop();
}
