//! Whole jobs through a real daemon: its build child is the real one, its workers are this test program in disguise.
#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod harness;

use harness::children;
use harness::site::{Site, check_picture, work_in_disguise, write_cloud};
use pbgi_proto::v1;
use pbgi_proto::v1::queue_service_client::QueueServiceClient;
use pbgi_proto::v1::scene_service_client::SceneServiceClient;
use pbgi_proto::v1::submit_job_request::Task;
use std::path::Path;
use std::process::Command;
use std::time::Duration;
use tonic::{Code, Request};

#[test]
#[ignore = "the worker's part, run by the daemon of the other tests"]
fn disguised_worker() {
    work_in_disguise();
}

fn row(job: &v1::Job, name: &str) -> f64 {
    *job.statistics
        .as_ref()
        .unwrap()
        .rows
        .get(name)
        .unwrap_or_else(|| panic!("no row {name} in {job:?}"))
}

#[tokio::test]
async fn scene_is_built_and_picture_shaded_with_all_statistics() {
    let site = Site::new(150, 90);
    let built = site.succeed("build-1", site.build("s.pbgi")).await;
    assert_eq!(row(&built, "points"), 20_000.0);
    for name in [
        "nodes",
        "sort_seconds",
        "build_seconds",
        "out_of_core_bytes",
        "bytes_written",
        "peak_memory_bytes",
    ] {
        assert!(row(&built, name) > 0.0, "{name}");
    }
    let cold = site.succeed("shade-1", site.shade("a.exr")).await;
    let image = check_picture(&site.daemon.folder.path().join("a.exr"), &site.gbuffer);
    assert_eq!(image.metadata["pbgi/points"], "20000");
    assert_eq!((cold.done, cold.total), (15, 15));
    assert_eq!(row(&cold, "holes"), 90.0);
    assert_eq!(row(&cold, "shading_calls"), 150.0 * 90.0);
    assert_eq!(row(&cold, "redundant_reads"), 0.0);
    assert!(row(&cold, "pages_loaded") > 1.0 && row(&cold, "cache_io_ratio") > 0.0);
    assert!(row(&cold, "cache_peak_bytes") > 0.0 && row(&cold, "peak_memory_bytes") > 1e8);
    let warm = site.succeed("shade-2", site.shade("b.exr")).await;
    assert_eq!(row(&warm, "pages_loaded"), 0.0);
    assert_eq!(row(&warm, "cache_hit_ratio"), 1.0);
    assert_eq!(site.daemon.status().await.mounts.len(), 1);
    site.daemon.stop();
}

#[tokio::test]
async fn picture_is_whole_however_often_workers_are_killed() {
    let site = Site::new(512, 512);
    const KILLS: u32 = 6;
    site.succeed("build", site.build("s.pbgi")).await;
    // Not done before enough have died.
    site.hold_after(200);
    site.submit("shade", site.shade("a.exr")).await.unwrap();
    let mut kills = 0;
    let job = loop {
        let mut client = site.daemon.jobs().await;
        let job = client
            .get_job(v1::GetJobRequest { job_id: "shade".into() })
            .await
            .unwrap()
            .into_inner();
        if job.state() != v1::JobState::Running && job.state() != v1::JobState::Queued {
            break job;
        }
        let workers = site.daemon.status().await.workers;
        // A tile must not lose three workers in a row: only one seat is at risk.
        if let Some(worker) = workers.iter().find(|worker| worker.slot == 1 && worker.busy) {
            let killed = Command::new("kill")
                .args(["-KILL", &worker.pid.to_string()])
                .status()
                .unwrap();
            kills += u32::from(killed.success());
            if kills == KILLS {
                site.release();
            }
        }
        tokio::time::sleep(Duration::from_millis(150)).await;
    };
    assert_eq!(
        job.state(),
        v1::JobState::Succeeded,
        "{}: {}",
        job.error,
        site.daemon.log()
    );
    assert!(kills >= KILLS, "only {kills} kills");
    println!("RELIABILITY P4: {kills} workers killed in mid-frame, 256 of 256 tiles counted once, 0 pixels differ");
    assert_eq!((job.done, job.total), (256, 256));
    check_picture(&site.daemon.folder.path().join("a.exr"), &site.gbuffer);
    site.daemon.stop();
}

#[tokio::test]
async fn cancelled_job_leaves_no_file_and_the_next_one_runs() {
    let site = Site::new(1024, 256);
    site.succeed("build", site.build("s.pbgi")).await;
    site.hold_after(2);
    site.submit("first", site.shade("a.exr")).await.unwrap();
    let same = site.submit("first", site.shade("a.exr")).await.unwrap();
    assert_eq!(same.job_id, "first");
    let other = site.submit("first", site.shade("b.exr")).await.unwrap_err();
    assert_eq!(other.code(), Code::AlreadyExists);
    let rival = site.submit("rival", site.shade("a.exr")).await.unwrap_err();
    assert_eq!(rival.code(), Code::Aborted);
    site.daemon
        .jobs()
        .await
        .cancel_job(v1::CancelJobRequest {
            job_id: "first".into(),
            ..Default::default()
        })
        .await
        .unwrap();
    assert_eq!(site.wait("first").await.state(), v1::JobState::Cancelled);
    site.release();
    assert!(site.daemon.folder.path().join("a.exr").metadata().is_err());
    site.succeed("second", site.shade("a.exr")).await;
    let refused = site.submit("third", site.shade("a.exr")).await.unwrap();
    assert_eq!(refused.job_id, "third");
    let third = site.wait("third").await;
    assert!(third.error.contains("--overwrite"), "{}", third.error);
    site.daemon.stop();
}

#[tokio::test]
async fn bad_input_is_named_and_nothing_is_left() {
    let site = Site::new(8, 8);
    let missing = site.submit("no-scene", site.shade("a.exr")).await.unwrap();
    assert_eq!(missing.title, "shade a.exr");
    let job = site.wait("no-scene").await;
    assert!(
        job.state() == v1::JobState::Failed && job.error.contains("s.pbgi"),
        "{}",
        job.error
    );
    std::fs::write(site.path("bad.ply"), "ply\nnonsense").unwrap();
    let task = Task::Build(v1::BuildTask {
        inputs: vec![site.path("bad.ply")],
        output: site.path("bad.pbgi"),
        ..Default::default()
    });
    site.submit("bad", task).await.unwrap();
    let job = site.wait("bad").await;
    assert!(
        job.state() == v1::JobState::Failed && job.error.contains("bad.ply"),
        "{}",
        job.error
    );
    let names: Vec<String> = std::fs::read_dir(site.daemon.folder.path())
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .filter(|name| name.contains("pbgi"))
        .collect();
    assert_eq!(names, Vec::<String>::new());
    for (id, code) in [("", Code::InvalidArgument), ("a b", Code::InvalidArgument)] {
        assert_eq!(site.submit(id, site.build("x.pbgi")).await.unwrap_err().code(), code);
    }
    let mut client = site.daemon.jobs().await;
    let unknown = client
        .get_job(v1::GetJobRequest {
            job_id: "unknown".into(),
        })
        .await
        .unwrap_err();
    assert_eq!(unknown.code(), Code::NotFound);
    site.daemon.stop();
}

/// Changes some bytes of a page file's header, or of a manifest, and makes its checksum anew.
fn forge(scene: &Path, file: &str, at: usize, bytes: &[u8]) {
    const HEADER_CRC_AT: usize = 4_092;
    let path = scene.join(file);
    let mut all = std::fs::read(&path).unwrap();
    all[at..at + bytes.len()].copy_from_slice(bytes);
    if file == "manifest.toml" {
        let mark = b"# crc32c ";
        let line = all.windows(mark.len()).rposition(|window| window == mark).unwrap();
        let sum = format!("{:08x}", crc32c::crc32c(&all[..line]));
        all[line + mark.len()..][..8].copy_from_slice(sum.as_bytes());
    } else {
        let sum = crc32c::crc32c(&all[..HEADER_CRC_AT]);
        all[HEADER_CRC_AT..][..4].copy_from_slice(&sum.to_le_bytes());
    }
    std::fs::write(path, all).unwrap();
}

#[tokio::test]
async fn scene_of_another_version_page_size_or_endianness_is_refused_naming_both_values() {
    let site = Site::new(8, 8);
    site.succeed("build", site.build("s.pbgi")).await;
    let folder = site.daemon.folder.path();
    let manifest = std::fs::read_to_string(folder.join("s.pbgi/manifest.toml")).unwrap();
    let version_at = manifest.find("version = 4").unwrap() + "version = ".len();
    let per_page = |count: u32| count.to_le_bytes().to_vec();
    let cases: [(&str, usize, Vec<u8>, [&str; 2]); 8] = [
        ("manifest.toml", version_at, b"9".to_vec(), ["4", "9"]),
        ("nodes.pages", 8, vec![9, 0, 0, 0], ["4", "9"]),
        // The version as a big-endian machine would write it.
        ("points.pages", 8, vec![0, 0, 0, 1], ["4", "16777216"]),
        (
            "nodes.pages",
            0,
            b"\x89PBG\n\x1a\n\0".to_vec(),
            ["895042470d0a1a0a", "895042470a1a0a00"],
        ),
        ("nodes.pages", 12, vec![2, 0, 0, 0], ["1", "2"]),
        ("points.pages", 16, vec![40, 0, 0, 0], ["32", "40"]),
        ("nodes.pages", 20, per_page(1), ["records", "1"]),
        ("points.pages", 20, per_page(1 << 30), ["records", "1073741824"]),
    ];
    let mut scenes = SceneServiceClient::new(site.daemon.channel("jobs.sock").await);
    for (number, (file, at, bytes, words)) in cases.iter().enumerate() {
        let scene = folder.join(format!("{number}.pbgi"));
        std::fs::create_dir(&scene).unwrap();
        for name in ["manifest.toml", "nodes.pages", "points.pages"] {
            std::fs::copy(folder.join("s.pbgi").join(name), scene.join(name)).unwrap();
        }
        forge(&scene, file, *at, bytes);
        let scene = scene.to_str().unwrap().to_owned();
        let told = scenes.get_scene(v1::GetSceneRequest { scene }).await.unwrap_err();
        assert_eq!(told.code(), Code::FailedPrecondition, "{told}");
        let text = told.message();
        let named = text.contains(file) && words.iter().all(|word| text.contains(word));
        assert!(named, "{words:?}: {text}");
    }
    println!(
        "RELIABILITY F10: {} foreign headers with valid checksums, each refused with FAILED_PRECONDITION, file and both values",
        cases.len()
    );
    site.daemon.stop();
}

/// Process id of the build child that runs.
fn build_child(site: &Site) -> Option<u32> {
    let builds = |pid: &u32| {
        let line = std::fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        String::from_utf8_lossy(&line).contains("build-child")
    };
    children(site.daemon.child.id()).into_iter().find(builds)
}

#[tokio::test]
async fn build_that_dies_costs_its_job_and_no_page_of_a_picture_beside_it() {
    let site = Site::new(256, 256);
    site.succeed("build", site.build("s.pbgi")).await;
    site.succeed("warm", site.shade("warm.exr")).await;
    site.hold_after(10);
    site.submit("shade", site.shade("a.exr")).await.unwrap();
    site.reaches("shade", 10).await;
    write_cloud(&site.daemon.folder.path().join("big.ply"), 1_000_000);
    // A fault, what the kernel does when memory runs out, and what an assertion does.
    for signal in ["-SEGV", "-KILL", "-ABRT"] {
        let mut attempt = 0;
        let job = loop {
            attempt += 1;
            let (id, output) = (format!("dies{signal}-{attempt}"), format!("d{signal}{attempt}.pbgi"));
            let task = Task::Build(v1::BuildTask {
                inputs: vec![site.path("big.ply")],
                output: site.path(&output),
                ..Default::default()
            });
            site.submit(&id, task).await.unwrap();
            // Again and again: a runtime takes the first SIGSEGV for a fault that will recur by itself.
            while matches!(
                site.job(&id).await.state(),
                v1::JobState::Queued | v1::JobState::Running
            ) {
                if let Some(pid) = build_child(&site) {
                    // It fails when the child has died in between.
                    Command::new("kill").args([signal, &pid.to_string()]).status().unwrap();
                }
            }
            let job = site.wait(&id).await;
            // On a machine with much to do it may be built before anybody looks.
            if job.state() != v1::JobState::Succeeded {
                assert!(std::fs::metadata(site.path(&output)).is_err(), "{output} is there");
                break job;
            }
            assert!(attempt < 20, "no build child was ever seen");
        };
        assert_eq!(job.state(), v1::JobState::Failed);
        assert!(job.error.contains("the build process failed"), "{}", job.error);
    }
    site.release();
    let job = site.wait("shade").await;
    assert_eq!(job.state(), v1::JobState::Succeeded, "{}", job.error);
    check_picture(&site.daemon.folder.path().join("a.exr"), &site.gbuffer);
    assert_eq!((row(&job, "pages_loaded"), row(&job, "cache_hit_ratio")), (0.0, 1.0));
    println!(
        "RELIABILITY P10: 3 build children killed (SIGSEGV, SIGKILL, SIGABRT), 3 jobs failed; the picture beside them: 0 pixels \
         differ, hit ratio 1, 0 pages read again"
    );
    site.daemon.stop();
}

#[tokio::test]
async fn clients_cannot_call_the_queue_and_strangers_cannot_call_it_either() {
    let site = Site::new(8, 8);
    let mut wrong_socket = QueueServiceClient::new(site.daemon.channel("jobs.sock").await);
    let refused = wrong_socket
        .lease_tile(v1::LeaseTileRequest::default())
        .await
        .unwrap_err();
    assert_eq!(refused.code(), Code::Unimplemented);
    let mut queue = QueueServiceClient::new(site.daemon.channel("queue.sock").await);
    let seat = Some(v1::WorkerSeat { slot: 0, epoch: 1 });
    let refused = queue.lease_tile(v1::LeaseTileRequest { seat }).await.unwrap_err();
    assert_eq!(refused.code(), Code::Unauthenticated);
    let mut request = Request::new(v1::LeaseTileRequest { seat });
    request
        .metadata_mut()
        .insert("pbgi-token", "0".repeat(32).parse().unwrap());
    assert_eq!(
        queue.lease_tile(request).await.unwrap_err().code(),
        Code::Unauthenticated
    );
    site.daemon.stop();
}
