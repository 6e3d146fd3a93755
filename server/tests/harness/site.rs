//! A site with a cloud, a G-buffer and a daemon whose workers are the test program in disguise: they fetch pages as a worker does
//! and answer with values that tell where each receiver was. [`Site::hold_after`] keeps a picture from being done before its test
//! has looked.

use super::{Daemon, PATIENCE, script};
use hyper_util::rt::TokioIo;
use pbgi_cache::channel::{self, PageOutcome, PageRequest, Welcome};
use pbgi_cache::{CacheView, LocalCache};
use pbgi_core::point::Sides;
use pbgi_core::{MountId, PageKey, PageKind, PageNo, PointRecord};
use pbgi_points::ply::{PlyForm, PlyWriter};
use pbgi_points::{GBuffer, LayeredImage, Window};
use pbgi_proto::v1;
use pbgi_proto::v1::complete_tile_request::Outcome;
use pbgi_proto::v1::queue_service_client::QueueServiceClient;
use pbgi_proto::v1::submit_job_request::Task;
use std::os::fd::AsFd;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use tonic::Request;
use tonic::transport::{Channel, Endpoint};

const QUEUE_VARIABLE: &str = "PBGI_TEST_QUEUE";
/// While this folder is in the site's, a worker takes a file out of it for each tile that it finishes, and waits if there is none.
const HOLD: &str = "hold";

fn held(hold: &Path) -> bool {
    let taken = |entry: std::fs::DirEntry| std::fs::remove_file(entry.path()).is_ok();
    std::fs::read_dir(hold).is_ok_and(|entries| !entries.flatten().any(taken))
}

/// This program as a worker.
pub(crate) fn disguised(folder: &Path) -> PathBuf {
    let own = std::env::current_exe().unwrap();
    let body = format!(
        "{QUEUE_VARIABLE}=\"$4\" exec {} --ignored --exact disguised_worker --nocapture",
        own.display()
    );
    script(folder, "worker", &body)
}

/// The worker's part: each test program has an ignored test of the name `disguised_worker` that calls this.
pub(crate) fn work_in_disguise() {
    let Some(queue) = std::env::var_os(QUEUE_VARIABLE) else {
        return;
    };
    nix::sys::prctl::set_pdeathsig(nix::sys::signal::Signal::SIGKILL).unwrap();
    let socket = UnixStream::from(std::io::stdin().as_fd().try_clone_to_owned().unwrap());
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(work(&socket, PathBuf::from(queue)));
}

async fn connect(path: PathBuf) -> Channel {
    let connector = tower::service_fn(move |_| {
        let path = path.clone();
        async move { tokio::net::UnixStream::connect(path).await.map(TokioIo::new) }
    });
    Endpoint::from_static("http://localhost")
        .connect_with_connector(connector)
        .await
        .unwrap()
}

async fn work(socket: &UnixStream, queue: PathBuf) {
    let Some(welcome) = channel::receive::<Welcome>(socket).unwrap() else {
        return;
    };
    let view = CacheView::attach(&welcome.segment, welcome.layout_hash, welcome.seat.slot).unwrap();
    let mut cache = LocalCache::new(view);
    let token: String = welcome.token.iter().map(|byte| format!("{byte:02x}")).collect();
    let seat = Some(v1::WorkerSeat {
        slot: welcome.seat.slot.into(),
        epoch: welcome.seat.epoch,
    });
    let hold = queue.parent().unwrap().with_file_name(HOLD);
    let mut client = QueueServiceClient::new(connect(queue).await);
    let signed = |token: &str| token.parse::<tonic::metadata::MetadataValue<_>>().unwrap();
    macro_rules! signed {
        ($message:expr) => {{
            let mut request = Request::new($message);
            request.metadata_mut().insert("pbgi-token", signed(&token));
            request
        }};
    }
    loop {
        let Ok(answer) = client.lease_tile(signed!(v1::LeaseTileRequest { seat })).await else {
            return;
        };
        let Some(lease) = answer.into_inner().lease else {
            continue;
        };
        let task_id = lease.task_id;
        let Ok(task) = client.get_task(signed!(v1::GetTaskRequest { seat, task_id })).await else {
            return;
        };
        let task = task.into_inner();
        let heartbeat = v1::HeartbeatRequest {
            seat,
            lease_id: lease.lease_id,
        };
        // Slow enough to be killed in the middle.
        tokio::time::sleep(Duration::from_millis(10)).await;
        loop {
            let Ok(answer) = client.heartbeat(signed!(heartbeat)).await else {
                return;
            };
            // A job that was cancelled wants no more of it.
            if !answer.into_inner().lease_valid || !held(&hold) {
                break;
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        let misses = fetch(socket, &mut cache, &task, &lease);
        let counters = v1::TileCounters {
            receivers: lease.group_lengths.iter().map(|&length| u64::from(length)).sum(),
            cut_elements: 10,
            local_hits: 3,
            cache_misses: misses,
            cpu_nanos: 1_000_000,
            ..Default::default()
        };
        let outcome = Some(Outcome::Result(v1::TileResult {
            values: values(&lease.receivers),
            counters: Some(counters),
        }));
        let lease_id = lease.lease_id;
        let complete = v1::CompleteTileRequest {
            seat,
            lease_id,
            outcome,
        };
        if client.complete_tile(signed!(complete)).await.is_err() {
            return;
        }
    }
}

/// Has one page of each kind, a different one for each tile; returns how many the daemon was asked for.
fn fetch(socket: &UnixStream, cache: &mut LocalCache, task: &v1::Task, lease: &v1::Lease) -> u64 {
    let mount = MountId {
        slot: task.mount_slot as u8,
        generation: task.mount_generation as u16,
    };
    let scene = task.scene.as_ref().unwrap();
    let per_page = scene.settings.unwrap().nodes_per_page.unwrap();
    let pages = scene.node_slots.div_ceil(u64::from(per_page)) as u32;
    let keys: Vec<PageKey> = [(PageKind::Node, pages), (PageKind::Point, 1)]
        .map(|(kind, pages)| PageKey {
            mount,
            kind,
            page: PageNo(lease.tile % pages),
        })
        .into();
    cache.set_job(lease.task_id);
    let missing: Vec<PageKey> = keys.into_iter().filter(|&key| cache.get(key).is_none()).collect();
    if missing.is_empty() {
        return 0;
    }
    for key in &missing {
        cache.reserve(key.kind, 1);
    }
    let request = PageRequest::new(1, lease.task_id, missing.clone());
    let reply = channel::ask(socket, &request).unwrap().unwrap();
    for (key, outcome) in missing.iter().zip(&reply.outcomes) {
        let PageOutcome::Pinned(fetched) = outcome else {
            panic!("{}", reply.error)
        };
        cache.adopt(*key, fetched.frame).unwrap();
        assert!(cache.get(*key).unwrap().iter().any(|&byte| byte != 0));
    }
    missing.len() as u64
}

/// Irradiance is the receiver's position, occlusion a quarter, the bent normal the normal.
fn values(receivers: &[u8]) -> Vec<u8> {
    let mut values = Vec::new();
    for receiver in receivers.chunks(24) {
        values.extend_from_slice(&receiver[..12]);
        values.extend_from_slice(&0.25_f32.to_le_bytes());
        values.extend_from_slice(&receiver[12..]);
    }
    values
}

pub(crate) fn write_cloud(path: &Path, count: u32) {
    let mut writer = PlyWriter::create(path, PlyForm::Floats, &[]).unwrap();
    let sides = Sides {
        front: [1.0; 3],
        back: [0.0; 3],
    };
    for index in 0..count {
        let angle = index as f32 * 2.4;
        let position = [
            angle.cos() * index as f32,
            angle.sin() * index as f32,
            (index % 17) as f32,
        ];
        let point = PointRecord::new(position, [0.0, 1.0, 0.0], 0.5, sides).unwrap();
        writer.push(&point, &[]).unwrap();
    }
    writer.finish().unwrap();
}

/// A picture whose positions are the pixels' places; its last column is a hole.
pub(crate) fn write_gbuffer(path: &Path, width: u32, height: u32) -> GBuffer {
    let window = Window::of_size(width, height);
    let pixels = window.pixel_count();
    let place = |index: usize| [(index % width as usize) as f32, (index / width as usize) as f32, 7.0];
    let hole = |index: usize| index % width as usize == width as usize - 1;
    let gbuffer = GBuffer {
        data_window: window,
        display_window: window,
        world_to_camera: None,
        world_to_ndc: None,
        position: (0..pixels).map(place).collect(),
        normal: vec![[0.0, 0.0, 1.0]; pixels],
        coverage: (0..pixels).map(|index| if hole(index) { 0.0 } else { 1.0 }).collect(),
        albedo: None,
        direct: None,
        emission: None,
    };
    gbuffer.write(path).unwrap();
    gbuffer
}

pub(crate) fn check_picture(path: &Path, gbuffer: &GBuffer) -> LayeredImage {
    let image = LayeredImage::read_exr(path).unwrap();
    let expected: Vec<[f32; 3]> = (0..gbuffer.pixel_count())
        .map(|pixel| {
            if gbuffer.is_hole(pixel) {
                [0.0; 3]
            } else {
                gbuffer.position[pixel]
            }
        })
        .collect();
    assert!(image.triple("indirect").unwrap() == expected, "a pixel is wrong");
    assert!(image.triple("").unwrap() == expected, "a pixel of the root is wrong");
    image
}

pub(crate) struct Site {
    pub(crate) daemon: Daemon,
    pub(crate) gbuffer: GBuffer,
}

impl Site {
    pub(crate) fn path(&self, name: &str) -> String {
        self.daemon.folder.path().join(name).to_str().unwrap().to_owned()
    }

    pub(crate) fn new(width: u32, height: u32) -> Self {
        let daemon = Daemon::start(disguised, |_| {});
        write_cloud(&daemon.folder.path().join("in.ply"), 20_000);
        let gbuffer = write_gbuffer(&daemon.folder.path().join("g.exr"), width, height);
        Self { daemon, gbuffer }
    }

    pub(crate) fn build(&self, output: &str) -> Task {
        Task::Build(v1::BuildTask {
            inputs: vec![self.path("in.ply")],
            output: self.path(output),
            ..Default::default()
        })
    }

    pub(crate) fn shade(&self, output: &str) -> Task {
        Task::Shade(v1::ShadeTask {
            scene: self.path("s.pbgi"),
            gbuffer: self.path("g.exr"),
            output: self.path(output),
            ..Default::default()
        })
    }

    pub(crate) async fn submit(&self, id: &str, task: Task) -> Result<v1::Job, tonic::Status> {
        self.submit_with(id, task, v1::JobOptions::default()).await
    }

    pub(crate) async fn submit_with(
        &self,
        id: &str,
        task: Task,
        options: v1::JobOptions,
    ) -> Result<v1::Job, tonic::Status> {
        let request = v1::SubmitJobRequest {
            job_id: id.into(),
            task: Some(task),
            options: Some(options),
            attach: false,
        };
        Ok(self.daemon.jobs().await.submit_job(request).await?.into_inner())
    }

    pub(crate) async fn job(&self, id: &str) -> v1::Job {
        let request = v1::GetJobRequest { job_id: id.into() };
        self.daemon.jobs().await.get_job(request).await.unwrap().into_inner()
    }

    /// From now on so many tiles are finished and no more: a picture that has more is not done before [`Self::release`].
    pub(crate) fn hold_after(&self, tiles: u64) {
        let new = self.daemon.folder.path().join("hold.new");
        std::fs::create_dir(&new).unwrap();
        (0..tiles).for_each(|tile| std::fs::write(new.join(tile.to_string()), "").unwrap());
        self.release();
        std::fs::rename(new, self.path(HOLD)).unwrap();
    }

    /// Lets tiles be finished again.
    pub(crate) fn release(&self) {
        let old = self.daemon.folder.path().join("hold.old");
        // Workers take files out of it until it has another name; nothing may be held at all.
        if std::fs::rename(self.path(HOLD), &old).is_ok() {
            std::fs::remove_dir_all(old).unwrap();
        }
    }

    /// Waits until a job has so many tiles done.
    pub(crate) async fn reaches(&self, id: &str, done: u64) -> v1::Job {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let job = self.job(id).await;
            if job.stage == "shading" && job.done >= done {
                return job;
            }
            assert!(Instant::now() < deadline, "{job:?}: {}", self.daemon.log());
            assert!(
                matches!(job.state(), v1::JobState::Queued | v1::JobState::Running),
                "{job:?}"
            );
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    }

    pub(crate) async fn wait(&self, id: &str) -> v1::Job {
        let request = v1::WatchJobRequest {
            job_id: id.into(),
            ..Default::default()
        };
        let mut stream = self.daemon.jobs().await.watch_job(request).await.unwrap().into_inner();
        let mut last = None;
        while let Some(job) = stream.message().await.unwrap() {
            last = Some(job);
        }
        last.unwrap()
    }

    pub(crate) async fn succeed(&self, id: &str, task: Task) -> v1::Job {
        self.submit(id, task).await.unwrap();
        let job = self.wait(id).await;
        assert_eq!(
            job.state(),
            v1::JobState::Succeeded,
            "{}: {}",
            job.error,
            self.daemon.log()
        );
        job
    }
}
