//! Faults that clients cause or suffer: each test bears the promise as its name and prints its number.
#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod harness;

use harness::site::{Site, disguised, work_in_disguise, write_cloud, write_gbuffer};
use harness::{Daemon, SERVER, wait_until};
use pbgi_proto::v1;
use pbgi_proto::v1::daemon_service_client::DaemonServiceClient;
use std::io::Write;
use std::os::unix::net::UnixStream;
use std::process::Command;
use std::time::{Duration, Instant};
use tonic::Code;

#[test]
#[ignore = "the worker's part, run by the daemon of the other tests"]
fn disguised_worker() {
    work_in_disguise();
}

/// SplitMix64.
fn random(state: &mut u64) -> u64 {
    *state = state.wrapping_add(0x9E37_79B9_7F4A_7C15);
    let mut z = *state;
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// Anonymous resident kilobytes of a process.
fn anonymous_kb(pid: u32) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
    let line = status.lines().find(|line| line.starts_with("RssAnon")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse().unwrap()
}

#[tokio::test]
async fn job_goes_on_when_its_client_vanishes() {
    const DISCONNECTS: usize = 50;
    let site = Site::new(64, 64);
    site.succeed("build", site.build("s.pbgi")).await;
    for number in 0..DISCONNECTS {
        let id = format!("shade-{number}");
        site.submit(&id, site.shade(&format!("{number}.exr"))).await.unwrap();
        let request = v1::WatchJobRequest {
            job_id: id,
            ..Default::default()
        };
        let mut watch = site.daemon.jobs().await.watch_job(request).await.unwrap().into_inner();
        assert!(watch.message().await.unwrap().is_some());
        // The connection goes with the client.
    }
    for number in 0..DISCONNECTS {
        let job = site.wait(&format!("shade-{number}")).await;
        assert_eq!(job.state(), v1::JobState::Succeeded, "{}", job.error);
    }
    println!("RELIABILITY P15: {DISCONNECTS} disconnects, {DISCONNECTS} jobs complete");
    site.daemon.stop();
}

#[tokio::test]
async fn job_is_cancelled_with_its_watcher_if_that_was_asked_for() {
    let site = Site::new(512, 512);
    site.succeed("build", site.build("s.pbgi")).await;
    site.hold_after(2);
    site.submit("shade", site.shade("a.exr")).await.unwrap();
    let request = v1::WatchJobRequest {
        job_id: "shade".into(),
        cancel_on_disconnect: true,
    };
    let mut client = site.daemon.jobs().await;
    let mut watch = client.watch_job(request).await.unwrap().into_inner();
    watch.message().await.unwrap();
    drop((watch, client));
    assert_eq!(site.wait("shade").await.state(), v1::JobState::Cancelled);
    site.daemon.stop();
}

#[tokio::test]
async fn cancelled_job_is_gone_within_a_second_and_leaves_no_file() {
    const CANCELS: u64 = 20;
    let site = Site::new(512, 512);
    site.succeed("build", site.build("s.pbgi")).await;
    let (mut seed, mut times) = (7, Vec::new());
    for number in 0..CANCELS {
        let (id, output) = (format!("shade-{number}"), format!("{number}.exr"));
        // However long the pause turns out, the picture is not done.
        site.hold_after(200);
        site.submit(&id, site.shade(&output)).await.unwrap();
        tokio::time::sleep(Duration::from_millis(random(&mut seed) % 800)).await;
        let begun = Instant::now();
        let request = v1::CancelJobRequest {
            job_id: id.clone(),
            reason: "test".into(),
        };
        site.daemon.jobs().await.cancel_job(request).await.unwrap();
        let job = site.wait(&id).await;
        times.push(begun.elapsed());
        assert_eq!(job.state(), v1::JobState::Cancelled, "{}", job.error);
        assert!(std::fs::metadata(site.path(&output)).is_err(), "{output} is there");
    }
    times.sort_unstable();
    let (middle, slowest) = (times[times.len() / 2], times[times.len() - 1]);
    // A machine with other things to do may stop for a second at any time, but not most of the time.
    assert!(middle < Duration::from_secs(1), "{times:?}");
    println!(
        "RELIABILITY P16: {CANCELS} cancels at random times, median {middle:.0?}, slowest {slowest:.0?}, 0 files left"
    );
    site.daemon.stop();
}

#[tokio::test]
async fn thousand_duplicate_submits_are_one_job() {
    const DUPLICATES: usize = 1_000;
    let site = Site::new(64, 64);
    site.succeed("build", site.build("s.pbgi")).await;
    let client = site.daemon.jobs().await;
    let task = site.shade("a.exr");
    let submits = (0..DUPLICATES).map(|_| {
        let (mut client, task) = (client.clone(), task.clone());
        tokio::spawn(async move {
            loop {
                let request = v1::SubmitJobRequest {
                    job_id: "same".into(),
                    task: Some(task.clone()),
                    ..Default::default()
                };
                match client.submit_job(request).await {
                    Ok(job) => return job.into_inner().job_id,
                    // More in flight than a connection may have, refused by the service or, before
                    // the client knew of the limit, by the transport: try again.
                    Err(status) => assert!(
                        matches!(status.code(), Code::ResourceExhausted | Code::Unavailable),
                        "{status}"
                    ),
                }
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        })
    });
    for submit in submits.collect::<Vec<_>>() {
        assert_eq!(submit.await.unwrap(), "same");
    }
    assert_eq!(site.wait("same").await.state(), v1::JobState::Succeeded);
    let listed = site
        .daemon
        .jobs()
        .await
        .list_jobs(v1::ListJobsRequest::default())
        .await
        .unwrap()
        .into_inner()
        .jobs;
    assert_eq!(listed.len(), 2);
    println!("RELIABILITY R6: {DUPLICATES} concurrent duplicates, 1 execution");
    site.daemon.stop();
}

#[tokio::test]
async fn oversized_message_is_refused_and_takes_no_memory() {
    let site = Site::new(8, 8);
    let before = anonymous_kb(site.daemon.child.id());
    let task = v1::submit_job_request::Task::Build(v1::BuildTask {
        inputs: vec!["x".repeat(64 << 20)],
        ..Default::default()
    });
    let refused = site.submit("large", task).await.unwrap_err();
    assert!(
        matches!(refused.code(), Code::OutOfRange | Code::ResourceExhausted),
        "{refused}"
    );
    let grown = anonymous_kb(site.daemon.child.id()).saturating_sub(before);
    assert!(grown < 16 << 10, "{grown} KiB more");
    println!(
        "RELIABILITY R1: 64 MiB sent, {:?}, {grown} KiB of memory more",
        refused.code()
    );
    site.daemon.stop();
}

#[tokio::test]
async fn garbage_on_the_socket_harms_its_sender_only() {
    const GARBAGE: u64 = 2_000;
    let site = Site::new(8, 8);
    let path = site.daemon.folder.path().join("run/jobs.sock");
    let mut client = DaemonServiceClient::new(site.daemon.channel("jobs.sock").await);
    let mut seed = 1;
    for round in 0..GARBAGE {
        let mut stream = UnixStream::connect(&path).unwrap();
        let mut bytes: Vec<u8> = if round % 2 == 0 {
            Vec::new()
        } else {
            b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n".to_vec()
        };
        bytes.extend((0..random(&mut seed) % 400).map(|_| random(&mut seed) as u8));
        // The daemon may hang up in the middle of it.
        let _ = stream.write_all(&bytes);
        drop(stream);
        if round % 100 == 0 {
            client.get_status(v1::GetStatusRequest {}).await.unwrap();
        }
    }
    assert!(!site.daemon.log().contains("panicked"), "{}", site.daemon.log());
    println!("RELIABILITY R2: {GARBAGE} connections of garbage, 0 panics, an honest client beside them was answered");
    site.daemon.stop();
}

#[tokio::test]
async fn few_descriptors_are_shared_out_and_running_jobs_go_on() {
    let daemon = Daemon::start(disguised, |command| {
        // The shell lowers the limit and keeps the process id.
        let server: Vec<_> = command.get_args().map(ToOwned::to_owned).collect();
        let mut shell = Command::new("sh");
        shell
            .args(["-c", "ulimit -n 64; exec \"$0\" \"$@\"", SERVER])
            .args(server);
        let log = std::fs::File::create(std::env::temp_dir().join(format!("pbgi-fd-{}", std::process::id()))).unwrap();
        shell
            .stdin(std::process::Stdio::null())
            .stdout(std::process::Stdio::piped())
            .stderr(log);
        *command = shell;
    });
    let _ = std::fs::remove_file(std::env::temp_dir().join(format!("pbgi-fd-{}", std::process::id())));
    write_cloud(&daemon.folder.path().join("in.ply"), 20_000);
    let gbuffer = write_gbuffer(&daemon.folder.path().join("g.exr"), 256, 256);
    let site = Site { daemon, gbuffer };
    site.succeed("build", site.build("s.pbgi")).await;
    site.submit("shade", site.shade("a.exr")).await.unwrap();
    let path = site.daemon.folder.path().join("run/jobs.sock");
    // The socket's own queue is finite too: a client that finds it full is refused at once.
    let crowd: Vec<UnixStream> = (0..200)
        .filter_map(|_| {
            let stream = socket_without_waiting(&path)?;
            Some(stream)
        })
        .collect();
    let held = crowd.len();
    let output = site.daemon.folder.path().join("a.exr");
    wait_until("the job goes on", || std::fs::metadata(&output).is_ok());
    drop(crowd);
    let begun = Instant::now();
    assert_eq!(site.wait("shade").await.state(), v1::JobState::Succeeded);
    let served = begun.elapsed();
    // The longest pause of an accept that failed is a minute.
    assert!(served < Duration::from_secs(20), "{served:?}");
    println!(
        "RELIABILITY O3: 64 descriptors, {held} idle clients, the job completed; a new client was served after {served:.0?}"
    );
    site.daemon.stop();
}

fn socket_without_waiting(path: &std::path::Path) -> Option<UnixStream> {
    use nix::sys::socket::{AddressFamily, SockFlag, SockType, UnixAddr, connect, socket};
    use std::os::fd::AsRawFd;
    let flags = SockFlag::SOCK_NONBLOCK | SockFlag::SOCK_CLOEXEC;
    let socket = socket(AddressFamily::Unix, SockType::Stream, flags, None).ok()?;
    connect(socket.as_raw_fd(), &UnixAddr::new(path).ok()?).ok()?;
    Some(UnixStream::from(socket))
}

/// The header of an EXR file that claims so many pixels a side, and nothing behind it.
fn absurd_exr(edge: i32) -> Vec<u8> {
    let mut bytes = vec![0x76, 0x2f, 0x31, 0x01, 2, 0, 0, 0];
    let mut attribute = |name: &str, kind: &str, value: &[u8]| {
        for word in [name, kind] {
            bytes.extend(word.bytes().chain([0]));
        }
        bytes.extend((value.len() as u32).to_le_bytes());
        bytes.extend(value);
    };
    let mut channels = Vec::new();
    for name in ["N.X", "N.Y", "N.Z", "P.X", "P.Y", "P.Z"] {
        channels.extend(name.bytes().chain([0]));
        // Floats, one a pixel.
        channels.extend([2, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0]);
    }
    channels.push(0);
    attribute("channels", "chlist", &channels);
    attribute("compression", "compression", &[0]);
    let window: Vec<u8> = [0, 0, edge - 1, edge - 1]
        .into_iter()
        .flat_map(i32::to_le_bytes)
        .collect();
    attribute("dataWindow", "box2i", &window);
    attribute("displayWindow", "box2i", &window);
    attribute("lineOrder", "lineOrder", &[0]);
    attribute("pixelAspectRatio", "float", &1_f32.to_le_bytes());
    attribute("screenWindowCenter", "v2f", &[0; 8]);
    attribute("screenWindowWidth", "float", &1_f32.to_le_bytes());
    bytes.push(0);
    bytes.extend([0; 4_096]);
    bytes
}

#[tokio::test]
async fn absurd_picture_is_refused_before_its_pixels() {
    let site = Site::new(8, 8);
    site.succeed("build", site.build("s.pbgi")).await;
    let before = anonymous_kb(site.daemon.child.id());
    let edges = [1_000_000_000, 100_000, 20_000];
    for edge in edges {
        std::fs::write(site.path("g.exr"), absurd_exr(edge)).unwrap();
        let id = format!("shade-{edge}");
        site.submit(&id, site.shade("a.exr")).await.unwrap();
        let job = site.wait(&id).await;
        assert_eq!(job.state(), v1::JobState::Failed);
        assert!(job.error.contains("g.exr"), "{}", job.error);
    }
    let grown = anonymous_kb(site.daemon.child.id()).saturating_sub(before);
    assert!(grown < 64 << 10, "{grown} KiB more");
    println!("RELIABILITY R8: pictures of {edges:?} pixels a side refused, {grown} KiB of memory more");
    site.daemon.stop();
}
