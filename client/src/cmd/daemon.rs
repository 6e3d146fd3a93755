//! What a daemon tells of itself and of scenes: `info`, `status`, `shutdown`.

use super::answer::say;
use super::args::{FormArgs, RunningArgs, ServerArgs};
use super::failure::Failure;
use super::files;
use super::interrupt::Interrupt;
use super::progress::Progress;
use super::session;
use super::summary::{at_address, grouped, pretty};
use clap::Args;
use pbgi_client::size::format_bytes;
use pbgi_client::{Client, DaemonStatus, LevelShape, Pool, SceneShape};
use pbgi_core::{PageKind, SceneInfo};
use serde::Serialize;
use std::path::PathBuf;

/// `info`
#[derive(Args, Debug)]
pub(crate) struct InfoArgs {
    /// A scene made by build
    #[arg(value_name = "NAME.pbgi")]
    scene: PathBuf,
    #[command(flatten)]
    form: FormArgs,
    #[command(flatten)]
    server: ServerArgs,
}

pub(crate) async fn info(args: InfoArgs, interrupt: &Interrupt) -> Result<(), Failure> {
    let scene = files::input(&args.scene)?;
    let (info, shape) = {
        let mut progress = Progress::new();
        let client = session::connect(&args.server, interrupt, &progress).await?;
        progress.stage("verifying");
        let asked = async { Ok((client.scene(&scene).await?, client.scene_shape(&scene).await?)) };
        interrupt.guard(asked).await?
    };
    if args.form.json {
        return say(&pretty(&Described { info, shape }));
    }
    say(&(describe(&info) + &histogram(&shape)))
}

/// What `info --json` prints.
#[derive(Serialize)]
struct Described {
    #[serde(flatten)]
    info: SceneInfo,
    shape: SceneShape,
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
        ("origin", info.origin.map(|axis| axis.to_string()).join(" ")),
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

/// Nodes by level and leaves by how full they are, drawn in bars.
fn histogram(shape: &SceneShape) -> String {
    const BAR: u64 = 32;
    let bar = |value: u64, most: u64| {
        let length = (value * BAR).checked_div(most).unwrap_or(0);
        // What is there is seen.
        "#".repeat(length.max(u64::from(value > 0)) as usize)
    };
    let mut text = String::new();
    if shape.levels.is_empty() {
        return text;
    }
    let nodes = |level: &LevelShape| level.inner + level.leaves;
    let most = shape.levels.iter().map(nodes).max().unwrap_or(0);
    text += &format!(
        "\n{:>5} {:>13} {:>13} {:>13}\n",
        "level", "inner nodes", "leaves", "points"
    );
    for (number, level) in shape.levels.iter().enumerate() {
        let (inner, leaves, points) = (grouped(level.inner), grouped(level.leaves), grouped(level.points));
        text += &format!(
            "{number:>5} {inner:>13} {leaves:>13} {points:>13}  {}\n",
            bar(nodes(level), most)
        );
    }
    let most = shape.occupancy.iter().copied().max().unwrap_or(0);
    text += "\nleaves by how full they are\n";
    for (bin, &leaves) in shape.occupancy.iter().enumerate() {
        let full = format!("{:.0} %", (bin + 1) as f64 * 100.0 / shape.occupancy.len() as f64);
        text += &format!("{:>5} {:>13}  {}\n", full, grouped(leaves), bar(leaves, most));
    }
    text
}

/// `status`
#[derive(Args, Debug)]
pub(crate) struct StatusArgs {
    #[command(flatten)]
    form: FormArgs,
    #[command(flatten)]
    running: RunningArgs,
}

pub(crate) async fn status(args: StatusArgs, interrupt: &Interrupt) -> Result<(), Failure> {
    let answers = session::ask_running(&args.running, interrupt, async |client| client.status().await).await?;
    if args.form.json {
        return say(&at_address(&answers));
    }
    for (client, status) in answers {
        say(&describe_daemon(&client, &status))?;
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
        say(&format!("the daemon at {} is stopping", client.address()))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use pbgi_core::{BuildId, BuildSettings};

    #[test]
    fn a_tree_is_drawn_level_by_level() {
        let level = |inner, leaves, points| LevelShape { inner, leaves, points };
        let shape = SceneShape {
            levels: vec![level(1, 0, 0), level(1, 7, 70), level(0, 8, 1234)],
            occupancy: vec![1, 14],
        };
        let text = histogram(&shape);
        assert!(
            text.contains("    1             1             7            70  ################################\n"),
            "{text}"
        );
        assert!(
            text.contains("    0             1             0             0  ####\n"),
            "{text}"
        );
        assert!(
            text.contains(" 50 %             1  ##\n") && text.contains("1,234"),
            "{text}"
        );
        assert_eq!(histogram(&SceneShape::default()), "");
    }

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
            origin: [0.0; 3],
            settings: BuildSettings::default(),
        };
        let text = describe(&info);
        assert!(
            text.contains("the scene is empty") && text.contains("0 of 32.0 KiB"),
            "{text}"
        );
    }
}
