//! Much at once and for long: named commands, not part of the quick suite.
//!
//!     cargo test -p pbgi-server --test load -- --ignored --nocapture load
//!     cargo test -p pbgi-server --test load -- --ignored --nocapture soak
#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod harness;

use harness::children;
use harness::site::{Site, work_in_disguise};
use pbgi_proto::v1;
use pbgi_proto::v1::daemon_service_client::DaemonServiceClient;
use pbgi_proto::v1::job_service_client::JobServiceClient;
use pbgi_proto::v1::submit_job_request::Task;
use std::os::unix::net::UnixStream;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};
use tonic::Code;
use tonic::transport::Channel;
use tonic_types::StatusExt;

#[test]
#[ignore = "the worker's part, run by the daemon of the other tests"]
fn disguised_worker() {
    work_in_disguise();
}

fn anonymous_kb(pid: u32) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
    let line = status.lines().find(|line| line.starts_with("RssAnon")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse().unwrap()
}

fn descriptors(pid: u32) -> usize {
    std::fs::read_dir(format!("/proc/{pid}/fd")).unwrap().count()
}

fn percentile(times: &mut [Duration], share: f64) -> Duration {
    times.sort_unstable();
    times[((times.len() - 1) as f64 * share) as usize]
}

async fn submit(client: &mut JobServiceClient<Channel>, id: String, task: Task) -> Result<v1::Job, tonic::Status> {
    let request = v1::SubmitJobRequest {
        job_id: id,
        task: Some(task),
        ..Default::default()
    };
    client.submit_job(request).await.map(tonic::Response::into_inner)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "minutes: ten thousand jobs, 256 connections, slow readers"]
async fn load_of_ten_thousand_jobs_and_slow_readers_is_carried() {
    const JOBS: usize = 10_000;
    let site = Site::new(8, 8);
    let pid = site.daemon.child.id();
    site.succeed("build", site.build("s.pbgi")).await;
    let before = anonymous_kb(pid);
    // A job that rests holds the others, so that all of them wait at once.
    let paused = v1::JobOptions {
        paused: true,
        ..Default::default()
    };
    site.submit_with("gate", site.shade("gate.exr"), paused).await.unwrap();
    let mut client = site.daemon.jobs().await;
    let (mut times, folder) = (Vec::new(), site.daemon.folder.path().to_owned());
    let wait_for_gate = |number: usize| v1::SubmitJobRequest {
        job_id: format!("job-{number}"),
        task: Some(site.shade(&format!("{number}.exr"))),
        options: Some(v1::JobOptions {
            after: vec!["gate".into()],
            user: format!("user-{}", number % 10),
            ..Default::default()
        }),
        attach: false,
    };
    // The gate waits too: it is one of the ten thousand.
    for number in 1..JOBS {
        let begun = Instant::now();
        client.submit_job(wait_for_gate(number)).await.unwrap();
        times.push(begun.elapsed());
    }
    let p99 = percentile(&mut times, 0.99);
    let grown = anonymous_kb(pid).saturating_sub(before);
    println!(
        "RELIABILITY R4: {JOBS} jobs wait, submit p99 {p99:.1?}, {} MiB of memory more",
        grown >> 10
    );
    let refused = client.submit_job(wait_for_gate(JOBS)).await.unwrap_err();
    let retry = refused.get_details_retry_info().and_then(|info| info.retry_delay);
    assert!(
        refused.code() == Code::ResourceExhausted && retry.is_some(),
        "{refused:?}"
    );
    println!(
        "RELIABILITY R5: job {} is refused with RESOURCE_EXHAUSTED, try again in {retry:?}",
        JOBS + 1
    );

    // Slow readers: watchers that never read a message.
    let mut slow = Vec::new();
    for number in 0..100 {
        let mut client = JobServiceClient::new(site.daemon.channel("jobs.sock").await);
        let request = v1::WatchJobRequest {
            job_id: format!("job-{}", 1 + number),
            ..Default::default()
        };
        slow.push((client.watch_job(request).await.unwrap(), client));
    }
    // Idle connections up to the limit, and thousands that come and go; an honest client is answered beside them.
    let path = site.daemon.folder.path().join("run/jobs.sock");
    let mut honest = DaemonServiceClient::new(site.daemon.channel("jobs.sock").await);
    let idle: Vec<UnixStream> = (0..140).map(|_| UnixStream::connect(&path).unwrap()).collect();
    let connects = Arc::new(AtomicU64::new(0));
    let flood = {
        let (path, connects) = (path.clone(), connects.clone());
        std::thread::spawn(move || {
            for _ in 0..5_000 {
                connects.fetch_add(u64::from(UnixStream::connect(&path).is_ok()), Ordering::Relaxed);
            }
        })
    };
    let mut answers = Vec::new();
    while !flood.is_finished() || answers.len() < 100 {
        let begun = Instant::now();
        honest.get_status(v1::GetStatusRequest {}).await.unwrap();
        answers.push(begun.elapsed());
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    flood.join().unwrap();
    let answered = percentile(&mut answers, 0.99);
    println!(
        "RELIABILITY R7: {} connects beside {} idle ones, an honest client answered with p99 {answered:.1?}",
        connects.load(Ordering::Relaxed),
        idle.len()
    );
    drop(idle);
    let begun = Instant::now();
    let job_id = "gate".to_owned();
    client.resume_job(v1::ResumeJobRequest { job_id }).await.unwrap();
    loop {
        let status = site.daemon.status().await;
        if status.jobs_queued + status.jobs_running == 0 {
            break;
        }
        tokio::time::sleep(Duration::from_millis(200)).await;
    }
    let pictures = std::fs::read_dir(&folder).unwrap().flatten();
    let pictures = pictures.filter(|entry| entry.path().extension().is_some_and(|extension| extension == "exr"));
    assert_eq!(pictures.count(), JOBS + 1, "a job is missing");
    println!(
        "RELIABILITY load: {JOBS} jobs done in {:.0?} with {} slow readers attached",
        begun.elapsed(),
        slow.len()
    );
    assert!(grown < 64 << 10, "{grown} KiB");
    site.daemon.stop();
}

#[tokio::test]
#[ignore = "minutes: thousands of jobs, one after the other"]
async fn soak_leaves_memory_descriptors_and_processes_as_they_were() {
    let jobs: usize = std::env::var("PBGI_SOAK_JOBS").map_or(10_000, |text| text.parse().unwrap());
    let site = Site::new(32, 32);
    let pid = site.daemon.child.id();
    site.succeed("build", site.build("s.pbgi")).await;
    let mut client = site.daemon.jobs().await;
    let (mut first, mut slope) = (None, 0.0);
    for number in 0..jobs {
        let id = format!("job-{number}");
        let output = format!("{number}.exr");
        submit(&mut client, id.clone(), site.shade(&output)).await.unwrap();
        assert_eq!(site.wait(&id).await.state(), v1::JobState::Succeeded);
        std::fs::remove_file(site.path(&output)).unwrap();
        // What is remembered of ended jobs has its full size by then.
        if number == jobs / 3 {
            first = Some((number, anonymous_kb(pid), descriptors(pid)));
        }
    }
    let (start, kilobytes, open) = first.unwrap();
    let (end_kilobytes, end_open) = (anonymous_kb(pid), descriptors(pid));
    slope += (end_kilobytes as f64 - kilobytes as f64) / (jobs - start) as f64 * 1_000.0;
    let zombies = children(pid).into_iter().filter(|child| {
        let stat = std::fs::read_to_string(format!("/proc/{child}/stat")).unwrap_or_default();
        stat.contains(") Z ")
    });
    let zombies = zombies.count();
    println!(
        "RELIABILITY O7: {jobs} jobs, {slope:.0} KiB of memory per 1,000 jobs, {open} descriptors then, {end_open} now, \
         {zombies} zombies"
    );
    assert!(slope < 1_024.0 && end_open <= open + 2 && zombies == 0);
    site.daemon.stop();
}
