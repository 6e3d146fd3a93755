//! A build's life in the daemon: a child process does the work, so that a crash, a hostile file or too much memory costs one job.

use crate::build_child::{Report, Spec};
use crate::confine::Confine;
use crate::dispatcher::Dispatcher;
use crate::error::JobError;
use crate::job::BuildTask;
use crate::limits;
use crate::roots::Want;
use crate::scheduler::JobNo;
use crate::supervisor::BuildChild;
use pbgi_core::Statistics;
use pbgi_store::{OsVolume, sweep_scratch, sweep_temporaries};
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{ChildStderr, ChildStdout, ExitStatus};
use std::sync::Arc;
use tokio::sync::watch;

/// Runs a build to its end.
///
/// # Errors
/// A text for people.
pub async fn run(
    dispatcher: &Arc<Dispatcher>,
    job: JobNo,
    task: &BuildTask,
    abort: watch::Receiver<bool>,
) -> Result<Statistics, String> {
    let spec = spec(dispatcher, task).map_err(|error| error.text)?;
    let built = run_child(dispatcher, job, &spec, abort).await;
    let mut statistics = built.map_err(|error| hide(dispatcher, task, error))?;
    statistics.peak_memory_bytes = Some(dispatcher.peaks(job).0 as f64);
    Ok(statistics)
}

/// Runs a build child to its end.
///
/// # Errors
/// A text for people, with real paths.
pub(crate) async fn run_child(
    dispatcher: &Arc<Dispatcher>,
    job: JobNo,
    spec: &Spec,
    mut abort: watch::Receiver<bool>,
) -> Result<Statistics, String> {
    let memory = &dispatcher.config.memory;
    let megabytes = (memory.build_bytes >> 20) as u32;
    let _memory = tokio::select! {
        permit = dispatcher.work_memory.acquire_many(megabytes) => permit.map_err(|error| error.to_string())?,
        _ = abort.wait_for(|stop| *stop) => return Err("stopped".into()),
    };
    let started = dispatcher.supervisor.build(job.0).await;
    let child = started.map_err(|error| format!("cannot start a build process: {error}"))?;
    dispatcher.build_started(job, child.pid);
    let (supervisor, stop_abort) = (dispatcher.supervisor.clone(), abort.clone());
    let stopper = tokio::spawn(async move {
        let mut abort = stop_abort;
        if abort.wait_for(|stop| *stop).await.is_ok() {
            supervisor.stop_build(job.0);
        }
    });
    let outcome = follow(dispatcher, job, spec, child).await;
    stopper.abort();
    dispatcher.build_ended(job);
    if outcome.is_err() {
        let (output, scratch) = (spec.output.clone(), spec.scratch_dir.clone());
        // What a killed child could not remove is not locked any more.
        let swept = tokio::task::spawn_blocking(move || sweep(&output, &scratch));
        if let Err(error) = swept.await {
            tracing::error!(%error, "sweep after a failed build panicked");
        }
    }
    outcome
}

/// What the child must know; its paths are real ones, and it is kept to their roots.
fn spec(dispatcher: &Dispatcher, task: &BuildTask) -> Result<Spec, JobError> {
    let (memory, roots) = (&dispatcher.config.memory, dispatcher.roots());
    let scratch_dir = dispatcher.config.options.scratch_dir.clone();
    let real = |path: &PathBuf| roots.real(path, Want::Read);
    let real_root = |path: &PathBuf| roots.root_of(path).map(|(root, _)| root);
    let output = roots.real(&task.output, Want::output(task.overwrite))?;
    let confine = (!roots.is_empty()).then(|| Confine {
        read: task.inputs.iter().filter_map(real_root).collect(),
        write: output
            .parent()
            .map(Path::to_owned)
            .into_iter()
            .chain([scratch_dir.clone()])
            .collect(),
    });
    Ok(Spec {
        inputs: task.inputs.iter().map(real).collect::<Result<_, _>>()?,
        received: None,
        output,
        overwrite: task.overwrite,
        settings: task.settings,
        density: task.density,
        cloud: task.cloud,
        scratch_dir,
        memory_bytes: memory.build_bytes,
        data_limit_bytes: memory.total_bytes,
        daemon_pid: std::process::id(),
        confine,
    })
}

/// Real paths of a task as the client knows them.
fn hide(dispatcher: &Dispatcher, task: &BuildTask, text: String) -> String {
    let (mut text, roots) = (text, dispatcher.roots());
    for (real, name) in task
        .inputs
        .iter()
        .chain([&task.output])
        .filter_map(|path| roots.root_of(path))
    {
        let real = format!("{}/", real.to_string_lossy().trim_end_matches('/'));
        text = text.replace(&real, &format!("{name}:"));
    }
    text
}

fn sweep(output: &Path, scratch: &Path) {
    if let Err(error) = sweep_temporaries(&OsVolume, output) {
        tracing::warn!(%error, "cannot sweep beside the output");
    }
    if let Err(error) = sweep_scratch(&OsVolume, scratch) {
        tracing::warn!(%error, "cannot sweep scratch");
    }
}

async fn follow(
    dispatcher: &Arc<Dispatcher>,
    job: JobNo,
    spec: &Spec,
    child: BuildChild,
) -> Result<Statistics, String> {
    let BuildChild {
        mut stdin,
        stdout,
        stderr,
        exit,
        ..
    } = child;
    let spec = serde_json::to_vec(spec).map_err(|error| error.to_string())?;
    let this = dispatcher.clone();
    let lines = tokio::task::spawn_blocking(move || {
        // A child that dies at once says more by its status than this error does.
        let _ = stdin.write_all(&spec);
        drop(stdin);
        read_reports(stdout, |stage, done, total| this.progress(job, stage, done, total))
    });
    let words = tokio::task::spawn_blocking(move || last_words(stderr));
    let (report, words) = (lines.await, words.await);
    dispatcher.supervisor.look();
    let status = exit.await.map_err(|_| "the build process was lost".to_owned())?;
    let report = report.map_err(|error| error.to_string())?;
    match report {
        Some(Report::Done { statistics }) if status.success() => Ok(*statistics),
        Some(Report::Failed { error }) => Err(error),
        _ => Err(death(status, &words.unwrap_or_default())),
    }
}

/// Reads progress until the end; returns the last report that ends a build.
fn read_reports(stdout: ChildStdout, progress: impl Fn(&'static str, u64, u64)) -> Option<Report> {
    let mut reader = BufReader::new(stdout);
    let mut end = None;
    loop {
        let mut line = String::new();
        match reader
            .by_ref()
            .take(limits::PROGRESS_LINE_BYTES_MAX)
            .read_line(&mut line)
        {
            Ok(0) | Err(_) => return end,
            Ok(_) => {}
        }
        match serde_json::from_str(&line) {
            Ok(Report::Progress { stage, done, total }) => progress(stage_name(&stage), done, total),
            Ok(report) => end = Some(report),
            Err(error) => tracing::warn!(%error, line, "build child says something strange"),
        }
    }
}

fn stage_name(stage: &str) -> &'static str {
    ["reading", "sorting", "merging", "building"]
        .into_iter()
        .find(|name| *name == stage)
        .unwrap_or("building")
}

fn last_words(mut stderr: ChildStderr) -> String {
    let mut kept = Vec::new();
    let mut buffer = [0; 4096];
    while let Ok(count @ 1..) = stderr.read(&mut buffer) {
        kept.extend_from_slice(&buffer[..count]);
        let excess = kept.len().saturating_sub(limits::STDERR_TAIL_BYTES);
        kept.drain(..excess);
    }
    String::from_utf8_lossy(&kept).trim().to_owned()
}

fn death(status: ExitStatus, words: &str) -> String {
    let how = match status.signal() {
        Some(9) => "it was killed, perhaps because memory ran out".to_owned(),
        Some(6) if words.contains("memory allocation") => {
            "it reached its memory limit; give the daemon more --memory".to_owned()
        }
        Some(signal) => format!("it died of signal {signal}"),
        None => format!("{status} without a report"),
    };
    let words = if words.is_empty() {
        String::new()
    } else {
        format!(": {words}")
    };
    format!("the build process failed: {how}{words}")
}
