//! The build child: reads a spec on standard input, builds, and tells how it goes on standard output, a JSON object a line.

use crate::confine::{Confine, confine};
use crate::limits;
use nix::sys::prctl::set_pdeathsig;
use nix::sys::resource::{Resource, setrlimit};
use nix::sys::signal::{SigSet, Signal};
use pbgi_build::limits::MEMORY_MIN_BYTES;
use pbgi_build::{BuildProgress, BuildReport, BuildRequest, build};
use pbgi_core::{BuildSettings, PointStream, Statistics};
use pbgi_points::{BouncedPoints, CloudOptions, Density, InputOptions, PointsError};
use pbgi_store::Overwrite;
use serde::{Deserialize, Serialize};
use std::fs;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::io::{self, Read, Write};
use std::ops::ControlFlow;
use std::os::unix::fs::MetadataExt;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Everything the child must know.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Spec {
    /// Points or meshes.
    pub inputs: Vec<PathBuf>,
    /// Light that the points of the one input, a scene, received and reflect too; `None` for inputs as they are.
    pub received: Option<PathBuf>,
    /// The scene directory.
    pub output: PathBuf,
    /// Whether one that is there is replaced.
    pub overwrite: bool,
    /// How.
    pub settings: BuildSettings,
    /// How densely meshes are sampled; `None` for the sampler's default.
    pub density: Option<Density>,
    /// For clouds.
    pub cloud: CloudOptions,
    /// Where runs go.
    pub scratch_dir: PathBuf,
    /// The build's own limit.
    pub memory_bytes: u64,
    /// The limit that the system enforces.
    pub data_limit_bytes: u64,
    /// Who started this; the child ends with it.
    pub daemon_pid: u32,
    /// What it may use of the disk; `None` for what its user may.
    pub confine: Option<Confine>,
}

/// A line of the child.
#[derive(Debug, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case", deny_unknown_fields)]
pub enum Report {
    /// How far it is.
    Progress {
        /// What it is doing.
        stage: String,
        /// Points done.
        done: u64,
        /// Points in all, 0 while unknown.
        total: u64,
    },
    /// The scene is there.
    Done {
        /// What it took.
        statistics: Box<Statistics>,
    },
    /// It will not be.
    Failed {
        /// Why.
        error: String,
    },
}

/// Time between two progress lines.
const PROGRESS_INTERVAL: Duration = Duration::from_millis(100);

/// Runs the child's part; `true` if the scene was built.
pub fn run() -> bool {
    let outcome = read_spec().and_then(|spec| {
        obey_the_daemon(&spec)?;
        build_scene(&spec)
    });
    let (report, built) = match outcome {
        Ok(statistics) => {
            let statistics = Box::new(statistics);
            (Report::Done { statistics }, true)
        }
        Err(error) => (Report::Failed { error }, false),
    };
    say(&report) && built
}

fn read_spec() -> Result<Spec, String> {
    let mut text = String::new();
    let read = io::stdin().take(limits::SPEC_BYTES_MAX).read_to_string(&mut text);
    read.map_err(|error| format!("cannot read the build spec: {error}"))?;
    serde_json::from_str(&text).map_err(|error| format!("cannot understand the build spec: {error}"))
}

/// Dies with the daemon, stays within the limit.
fn obey_the_daemon(spec: &Spec) -> Result<(), String> {
    let cannot = |what: &str| {
        let what = what.to_owned();
        move |errno: nix::errno::Errno| format!("cannot {what}: {errno}")
    };
    set_pdeathsig(Signal::SIGKILL).map_err(cannot("arm the parent-death signal"))?;
    if nix::unistd::getppid().as_raw() != spec.daemon_pid as i32 {
        return Err("the daemon is gone".into());
    }
    let limit = spec.data_limit_bytes;
    setrlimit(Resource::RLIMIT_DATA, limit, limit).map_err(cannot("limit the memory"))?;
    // A crash must not write the user's data to a core file.
    setrlimit(Resource::RLIMIT_CORE, 0, 0).map_err(cannot("turn off core files"))
}

fn build_scene(spec: &Spec) -> Result<Statistics, String> {
    // Opened while it may be.
    let traffic = fs::File::open("/proc/self/io");
    if let Some(directories) = &spec.confine {
        confine(directories)?;
    }
    let cancelled = cancel_flag()?;
    let default = InputOptions::default();
    let options = InputOptions {
        density: spec.density.unwrap_or(default.density),
        cloud: spec.cloud,
        // What the build itself cannot do without comes first.
        memory_bytes: spec.memory_bytes.saturating_sub(MEMORY_MIN_BYTES),
        scratch_dir: spec.scratch_dir.clone(),
        ..default
    };
    let text = |error: PointsError| error.to_string();
    let (mut input, mut bounced) = (None, None);
    let (points, input_bytes): (&mut dyn PointStream<Error = PointsError>, u64) =
        match (&spec.received, &spec.inputs[..]) {
            (Some(received), [scene]) => (bounced.insert(BouncedPoints::open(scene, received).map_err(text)?), 0),
            _ => {
                let points = input.insert(pbgi_points::open_input(&spec.inputs, &options).map_err(text)?);
                let bytes = points.memory_bytes();
                (points, bytes)
            }
        };
    let request = BuildRequest {
        output: spec.output.clone(),
        overwrite: if spec.overwrite {
            Overwrite::Replace
        } else {
            Overwrite::Refuse
        },
        scratch_dir: spec.scratch_dir.clone(),
        memory_bytes: spec.memory_bytes.saturating_sub(input_bytes),
        settings: spec.settings,
        input_key: input_key(spec),
    };
    let mut last = None;
    let mut observer = |progress: BuildProgress| {
        let now = Instant::now();
        let due = last.is_none_or(|(at, stage)| now.duration_since(at) >= PROGRESS_INTERVAL || stage != progress.stage);
        if due {
            last = Some((now, progress.stage));
            // A daemon that does not listen any more is gone, and takes us with it.
            say(&Report::Progress {
                stage: progress.stage.name().into(),
                done: progress.done,
                total: progress.total.unwrap_or(0),
            });
        }
        if cancelled.load(Ordering::Relaxed) {
            ControlFlow::Break(())
        } else {
            ControlFlow::Continue(())
        }
    };
    let report = build(points, &request, &mut observer).map_err(|error| error.to_string())?;
    let (bytes_read, bytes_written) = traffic.map(transferred).unwrap_or_default();
    Ok(Statistics {
        points_skipped: Some(input.map_or(0, |input| input.skipped()) as f64),
        bytes_read,
        bytes_written,
        ..statistics(&report)
    })
}

/// Names the build, so that it finds its runs when it is submitted again. What decides about its points beside these (the files
/// that a mesh names) need not be here: points are compared before they are taken from runs.
fn input_key(spec: &Spec) -> Option<u64> {
    // Keys without state: the same in the next process.
    let mut hasher = DefaultHasher::new();
    for path in spec.inputs.iter().chain(&spec.received) {
        let file = fs::metadata(path).ok()?;
        (path, file.len(), file.ino(), file.mtime(), file.mtime_nsec()).hash(&mut hasher);
    }
    serde_json::to_string(&(&spec.cloud, &spec.density, env!("CARGO_PKG_VERSION")))
        .ok()?
        .hash(&mut hasher);
    Some(hasher.finish())
}

/// Set by SIGTERM. The signal is blocked in every thread and waited for in one, which needs no handler.
fn cancel_flag() -> Result<Arc<AtomicBool>, String> {
    let mut signals = SigSet::empty();
    signals.add(Signal::SIGTERM);
    signals
        .thread_block()
        .map_err(|errno| format!("cannot block SIGTERM: {errno}"))?;
    let flag = Arc::new(AtomicBool::new(false));
    let set = flag.clone();
    let wait = move || {
        if signals.wait().is_ok() {
            set.store(true, Ordering::Relaxed);
        }
    };
    let thread = std::thread::Builder::new().name("signals".into()).spawn(wait);
    thread.map_err(|error| format!("cannot start a thread: {error}"))?;
    Ok(flag)
}

fn statistics(report: &BuildReport) -> Statistics {
    let count = |value: u64| Some(value as f64);
    Statistics {
        points: count(report.info.point_count),
        nodes: count(report.info.node_count),
        sort_seconds: Some(report.sort_seconds),
        build_seconds: Some(report.build_seconds),
        out_of_core_bytes: count(report.info.out_of_core_bytes()),
        ..Statistics::default()
    }
}

/// Bytes that this process has read and written, as the system counts them: input, scratch and scene.
fn transferred(mut io: fs::File) -> (Option<f64>, Option<f64>) {
    let mut text = String::new();
    let _ = io.read_to_string(&mut text);
    let count = |name: &str| {
        text.lines()
            .find_map(|line| line.strip_prefix(name)?.trim().parse().ok())
    };
    (count("rchar:"), count("wchar:"))
}

fn say(report: &Report) -> bool {
    let Ok(mut line) = serde_json::to_vec(report) else {
        return false;
    };
    line.push(b'\n');
    let mut stdout = io::stdout().lock();
    stdout.write_all(&line).and_then(|()| stdout.flush()).is_ok()
}
