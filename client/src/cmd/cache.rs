//! What the daemons' page caches hold: `cache`.

use super::answer::say;
use super::args::{FormArgs, RunningArgs};
use super::failure::Failure;
use super::interrupt::Interrupt;
use super::session;
use super::summary::{at_address, grouped};
use clap::Args;
use pbgi_client::size::format_bytes;
use pbgi_client::{CachePool, CacheStatus, CachedFile, Client};

const NOTES: &str = "\
A worker looks for a page in its own cache (local), then in the shared one, then asks the daemon, which reads it (miss).
Reloads are pages that were evicted and read again: many of them mean that the frames a receiver needs do not fit; give the
daemon more --memory. Redundant reads, loads of a page that was there, are 0 unless something is broken.";

/// `cache`
#[derive(Args, Debug)]
#[command(after_help = NOTES)]
pub(crate) struct CacheArgs {
    #[command(flatten)]
    form: FormArgs,
    #[command(flatten)]
    running: RunningArgs,
}

pub(crate) async fn cache(args: CacheArgs, interrupt: &Interrupt) -> Result<(), Failure> {
    let answers = session::ask_running(&args.running, interrupt, async |client| client.cache().await).await?;
    if args.form.json {
        return say(&at_address(&answers));
    }
    for (client, status) in answers {
        say(&describe(&client, &status))?;
    }
    Ok(())
}

fn describe(client: &Client, status: &CacheStatus) -> String {
    format!("{:12}  {}\n{}", "address", client.address(), table(status))
}

fn table(status: &CacheStatus) -> String {
    let mut rows = vec![(
        "segment",
        format!(
            "{}; pages {}, {} at most so far",
            format_bytes(status.segment_bytes),
            format_bytes(status.resident_bytes),
            format_bytes(status.resident_bytes_peak)
        ),
    )];
    for (name, pool) in [("node pool", &status.nodes), ("point pool", &status.points)] {
        rows.push((name, held(pool)));
        rows.push(("", done(pool)));
    }
    let lookups = status.lookups;
    let all = lookups.local_hits + lookups.shared_hits + lookups.misses;
    rows.push((
        "look-ups",
        format!(
            "{}: {} local, {} shared ({} of other jobs), {} read",
            grouped(all),
            percent(lookups.local_hits, all),
            percent(lookups.shared_hits, all),
            grouped(lookups.shared_hits_other_job),
            percent(lookups.misses, all)
        ),
    ));
    for worker in &status.workers {
        rows.push((
            "worker",
            format!(
                "{}: pid {}, pins {} of {} node and {} of {} point frames",
                worker.slot,
                worker.pid,
                grouped(worker.node_frames.into()),
                grouped(status.nodes.local_frames),
                grouped(worker.point_frames.into()),
                grouped(status.points.local_frames)
            ),
        ));
    }
    for scene in &status.scenes {
        rows.push(("scene", scene.scene.clone()));
        rows.push(("  nodes", file(&scene.nodes)));
        rows.push(("  points", file(&scene.points)));
    }
    rows.iter()
        .map(|(name, value)| format!("{name:12}  {value}\n"))
        .collect()
}

fn held(pool: &CachePool) -> String {
    let mut text = format!(
        "{} of {} frames of {} hold a page",
        grouped(pool.resident),
        grouped(pool.frames),
        format_bytes(pool.frame_bytes)
    );
    if pool.doomed > 0 {
        text += &format!(", {} one of a closed scene", grouped(pool.doomed));
    }
    if pool.loading > 0 {
        text += &format!(", {} are being loaded", grouped(pool.loading));
    }
    text
}

fn done(pool: &CachePool) -> String {
    format!(
        "{} asked for, {} read ({}), {} evicted, {} reloads, {} redundant reads, {} failed",
        grouped(pool.fetches),
        grouped(pool.loads),
        format_bytes(pool.bytes_loaded),
        grouped(pool.evictions),
        grouped(pool.reloads),
        grouped(pool.redundant_reads),
        grouped(pool.failed_loads)
    )
}

fn file(file: &CachedFile) -> String {
    format!(
        "{} of {} pages held ({}), {} asked for, {} read, {} evicted, {} reloads",
        grouped(file.resident),
        grouped(file.pages),
        percent(file.resident, file.pages),
        grouped(file.fetches),
        grouped(file.loads),
        grouped(file.evictions),
        grouped(file.reloads)
    )
}

fn percent(part: u64, whole: u64) -> String {
    match whole {
        0 => "none".to_owned(),
        whole => format!("{:.3} %", part as f64 * 100.0 / whole as f64),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pbgi_client::{CachePins, CachedScene, Lookups};

    #[test]
    fn the_table_tells_pools_scenes_and_workers() {
        let pool = CachePool {
            frames: 4_096,
            frame_bytes: 28 << 10,
            local_frames: 1_024,
            resident: 1_000,
            ..CachePool::default()
        };
        let nodes = CachedFile {
            pages: 2_000,
            resident: 1_000,
            reloads: 17,
            ..CachedFile::default()
        };
        let status = CacheStatus {
            nodes: pool,
            points: pool,
            scenes: vec![CachedScene {
                scene: "/s/city.pbgi".into(),
                nodes,
                ..CachedScene::default()
            }],
            workers: vec![CachePins {
                slot: 1,
                pid: 77,
                node_frames: 5,
                point_frames: 6,
            }],
            lookups: Lookups {
                local_hits: 998,
                shared_hits: 1,
                misses: 1,
                ..Lookups::default()
            },
            ..CacheStatus::default()
        };
        let text = table(&status);
        for words in [
            "1,000 of 4,096 frames of 28.0 KiB",
            "99.800 % local",
            "1: pid 77, pins 5 of 1,024 node and 6 of",
            "/s/city.pbgi",
            "1,000 of 2,000 pages held (50.000 %)",
            "17 reloads",
            "0 redundant reads",
        ] {
            assert!(text.contains(words), "no {words:?} in:\n{text}");
        }
    }
}
