//! What a daemon tells of itself and of scenes: `info`, `status`, `shutdown`.

use super::args::{RunningArgs, ServerArgs};
use super::failure::Failure;
use super::files;
use super::interrupt::Interrupt;
use super::progress::Progress;
use super::session;
use super::summary::grouped;
use clap::Args;
use pbgi_client::size::format_bytes;
use pbgi_client::{Client, DaemonStatus, Pool};
use pbgi_core::{PageKind, SceneInfo};
use std::path::PathBuf;

/// `info`
#[derive(Args, Debug)]
pub(crate) struct InfoArgs {
    /// A scene made by build
    #[arg(value_name = "NAME.pbgi")]
    scene: PathBuf,
    #[command(flatten)]
    server: ServerArgs,
}

pub(crate) async fn info(args: InfoArgs, interrupt: &Interrupt) -> Result<(), Failure> {
    let scene = files::input(&args.scene)?;
    let info = {
        let mut progress = Progress::new();
        let client = session::connect(&args.server, interrupt, &progress).await?;
        progress.stage("verifying");
        interrupt.guard(async { Ok(client.scene(&scene).await?) }).await?
    };
    print!("{}", describe(&info));
    Ok(())
}

fn describe(info: &SceneInfo) -> String {
    let vector = |v: [f32; 3]| format!("{} {} {}", v[0], v[1], v[2]);
    let bounds = match &info.bounds {
        Some(bounds) => format!("{} to {}", vector(bounds.min), vector(bounds.max)),
        None => "none: the scene is empty".to_owned(),
    };
    let pages = |kind| {
        let bytes = format_bytes(info.page_bytes(kind) as u64);
        format!("{} of {bytes}", grouped(info.page_count(kind)))
    };
    let rows = [
        ("build id", info.build_id.to_string()),
        ("points", grouped(info.point_count)),
        ("nodes", grouped(info.node_count)),
        ("bounds", bounds),
        ("largest radius", info.radius_max.to_string()),
        ("node pages", pages(PageKind::Node)),
        ("point pages", pages(PageKind::Point)),
        ("all pages", format_bytes(info.out_of_core_bytes())),
        ("leaf max", info.settings.leaf_max.to_string()),
        ("chunk levels", info.settings.chunk_levels.to_string()),
    ];
    rows.iter()
        .map(|(name, value)| format!("{name:14}  {value}\n"))
        .collect()
}

/// `status`
#[derive(Args, Debug)]
pub(crate) struct StatusArgs {
    #[command(flatten)]
    running: RunningArgs,
}

pub(crate) async fn status(args: StatusArgs, interrupt: &Interrupt) -> Result<(), Failure> {
    let answers = interrupt.guard(async {
        let mut answers = Vec::new();
        for client in session::running(&args.running).await? {
            let status = client.status().await?;
            answers.push((client, status));
        }
        Ok(answers)
    });
    for (client, status) in answers.await? {
        print!("{}", describe_daemon(&client, &status));
    }
    Ok(())
}

fn describe_daemon(client: &Client, status: &DaemonStatus) -> String {
    let pool = |pool: Pool| {
        format!(
            "{} of {} hold a page",
            grouped(pool.resident.into()),
            grouped(pool.frames.into())
        )
    };
    let mut rows = vec![
        ("daemon", format!("pid {}, version {}", status.pid, status.version)),
        ("address", client.address().to_owned()),
        (
            "memory",
            format!(
                "{}, {} of them the page cache",
                format_bytes(status.memory_bytes),
                format_bytes(status.segment_bytes)
            ),
        ),
        ("node frames", pool(status.nodes)),
        ("point frames", pool(status.points)),
        (
            "jobs",
            format!("{} running, {} waiting", status.jobs_running, status.jobs_queued),
        ),
    ];
    for worker in &status.workers {
        let doing = if worker.busy { "shading" } else { "idle" };
        let held = grouped(worker.frames_pinned.into());
        rows.push((
            "worker",
            format!("{}: pid {}, {doing}, holds {held} frames", worker.slot, worker.pid),
        ));
    }
    for mount in &status.mounts {
        let pages = grouped(mount.pages_loaded);
        rows.push(("scene", format!("{}: {pages} pages read", mount.scene)));
    }
    rows.iter()
        .map(|(name, value)| format!("{name:12}  {value}\n"))
        .collect()
}

/// `shutdown`
#[derive(Args, Debug)]
pub(crate) struct ShutdownArgs {
    #[command(flatten)]
    running: RunningArgs,
}

pub(crate) async fn shutdown(args: ShutdownArgs, interrupt: &Interrupt) -> Result<(), Failure> {
    let stopped = interrupt.guard(async {
        let mut stopped = Vec::new();
        for client in session::running(&args.running).await? {
            client.shutdown().await?;
            stopped.push(client);
        }
        Ok(stopped)
    });
    for client in stopped.await? {
        println!("the daemon at {} is stopping", client.address());
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use pbgi_core::{BuildId, BuildSettings};

    #[test]
    fn an_empty_scene_is_described() {
        let info = SceneInfo {
            build_id: BuildId(5),
            point_count: 0,
            node_count: 0,
            node_slots: 0,
            root: None,
            bounds: None,
            quantizer: None,
            radius_max: 0.0,
            settings: BuildSettings::default(),
        };
        let text = describe(&info);
        assert!(
            text.contains("the scene is empty") && text.contains("0 of 28.0 KiB"),
            "{text}"
        );
    }
}
