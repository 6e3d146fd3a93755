//! From a binary PLY of lit points to a published scene: time and rate of every stage, what was read and written, and what
//! the same bytes cost the disk alone, in the same run.
//!
//! `cargo bench -p pbgi-tests --bench build -- [--points 20000000] [--memory 4G] [--dir DIR]`

#![allow(clippy::unwrap_used, reason = "a benchmark asserts")]

use nix::fcntl::OFlag;
use pbgi_build::{BuildReport, BuildRequest, Stage, build};
use pbgi_core::point::Sides;
use pbgi_core::{Bounds, BuildSettings, PointRecord, PointStream};
use pbgi_points::{InputOptions, PlyForm, PointsError, open_input, write_point_ply};
use pbgi_store::Overwrite;
use pbgi_store::limits::SECTOR_BYTES;
use pbgi_tests::forget;
use std::fs::{self, OpenOptions};
use std::io::{Read, Write};
use std::ops::ControlFlow;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// A landscape with houses, in an order without pattern, made as it is read.
struct Landscape {
    next: u64,
    points: u64,
}

/// Points a batch.
const BATCH: u64 = 8192;

impl Landscape {
    fn point(&self, index: u64) -> PointRecord {
        let noise = index.wrapping_mul(0x9e37_79b9_7f4a_7c15);
        let noise = (noise ^ noise >> 29).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let unit = |bits: u64| (bits & 0xff_ffff) as f32 / 16_777_216.0;
        let (u, v) = (unit(noise), unit(noise >> 24));
        let (x, z) = (100.0 * u, 100.0 * v);
        let radius = 100.0 / (self.points as f32 * std::f32::consts::PI).sqrt();
        let sides = Sides {
            front: [0.2 + 0.6 * u, 0.5, 0.2 + 0.6 * v],
            back: [0.0; 3],
        };
        // Every third point stands on a wall.
        let (position, normal) = if noise >> 48 & 3 == 0 {
            ([x.floor(), 3.0 * unit(noise >> 40), z], [1.0, 0.0, 0.0])
        } else {
            let height = (0.3 * x).sin() * (0.2 * z).cos();
            let slope = [
                -0.3 * (0.3 * x).cos() * (0.2 * z).cos(),
                1.0,
                0.2 * (0.3 * x).sin() * (0.2 * z).sin(),
            ];
            ([x, height, z], slope)
        };
        PointRecord::new(position, normal, radius, sides).unwrap()
    }
}

impl PointStream for Landscape {
    type Error = PointsError;

    fn bounds(&self) -> Option<Bounds> {
        None
    }

    fn len_hint(&self) -> Option<u64> {
        Some(self.points)
    }

    fn next_batch(&mut self, batch: &mut Vec<PointRecord>) -> Result<bool, PointsError> {
        let end = (self.next + BATCH).min(self.points);
        batch.extend((self.next..end).map(|index| self.point(index)));
        let more = end > self.next;
        self.next = end;
        Ok(more)
    }

    fn rewind(&mut self) -> Result<(), PointsError> {
        self.next = 0;
        Ok(())
    }
}

struct Options {
    points: u64,
    memory: u64,
    dir: PathBuf,
}

fn options() -> Options {
    let mut options = Options {
        points: 20_000_000,
        memory: 4 << 30,
        dir: std::env::temp_dir(),
    };
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--points" => options.points = arguments.next().unwrap().parse().unwrap(),
            "--memory" => options.memory = bytes(&arguments.next().unwrap()),
            "--dir" => options.dir = arguments.next().unwrap().into(),
            // Said by cargo.
            "--bench" => {}
            other => panic!("unknown option {other}"),
        }
    }
    options
}

fn bytes(text: &str) -> u64 {
    let digits = text.trim_end_matches(['M', 'G']);
    let unit = match text.as_bytes().last() {
        Some(b'M') => 1 << 20,
        Some(b'G') => 1 << 30,
        _ => 1,
    };
    digits.parse::<u64>().unwrap() * unit
}

/// Bytes of a transfer of the disk alone.
const TRANSFER: usize = 1 << 20;

/// The faster of two ways to the disk, through the page cache and past it.
fn faster(mut transfer: impl FnMut(OFlag) -> f64) -> f64 {
    transfer(OFlag::empty()).min(transfer(OFlag::O_DIRECT))
}

/// Seconds to read the whole file, front to back.
fn raw_read(path: &Path) -> f64 {
    let mut memory = vec![0; TRANSFER + SECTOR_BYTES];
    let at = memory.as_ptr().align_offset(SECTOR_BYTES);
    faster(|flags| {
        forget(path);
        let mut file = OpenOptions::new()
            .read(true)
            .custom_flags(flags.bits())
            .open(path)
            .unwrap();
        let started = Instant::now();
        while file.read(&mut memory[at..at + TRANSFER]).unwrap() > 0 {}
        started.elapsed().as_secs_f64()
    })
}

/// Seconds to write so many bytes, but for the last that make no transfer, and to make them durable.
fn raw_write(path: &Path, bytes: u64) -> f64 {
    let memory: Vec<u8> = (0..(TRANSFER + SECTOR_BYTES) as u32)
        .map(|i| (i.wrapping_mul(2_654_435_761) >> 13) as u8)
        .collect();
    let at = memory.as_ptr().align_offset(SECTOR_BYTES);
    faster(|flags| {
        let mut options = OpenOptions::new();
        options.write(true).create_new(true).custom_flags(flags.bits());
        let started = Instant::now();
        let mut file = options.open(path).unwrap();
        for _ in 0..bytes / TRANSFER as u64 {
            file.write_all(&memory[at..at + TRANSFER]).unwrap();
        }
        file.sync_all().unwrap();
        let seconds = started.elapsed().as_secs_f64();
        fs::remove_file(path).unwrap();
        seconds
    })
}

/// Largest physical memory of this process so far, and its processor time.
fn process_figures() -> (u64, f64) {
    let usage = nix::sys::resource::getrusage(nix::sys::resource::UsageWho::RUSAGE_SELF).unwrap();
    let seconds = |time: nix::sys::time::TimeVal| time.tv_sec() as f64 + time.tv_usec() as f64 * 1e-6;
    let cpu = seconds(usage.user_time()) + seconds(usage.system_time());
    (usage.max_rss() as u64 * 1024, cpu)
}

fn main() {
    let options = options();
    let dir = tempfile::tempdir_in(&options.dir).unwrap();
    let (input, scratch) = (dir.path().join("points.ply"), dir.path().join("scratch"));
    fs::create_dir(&scratch).unwrap();
    let mut landscape = Landscape {
        next: 0,
        points: options.points,
    };
    write_point_ply(&input, PlyForm::Records, &mut landscape, &mut |_| {
        ControlFlow::Continue(())
    })
    .unwrap();
    let input_bytes = fs::metadata(&input).unwrap().len();
    forget(&input);
    let raw_read_seconds = raw_read(&input);
    forget(&input);

    let mut stream = open_input(std::slice::from_ref(&input), &InputOptions::default()).unwrap();
    let request = BuildRequest {
        output: dir.path().join("scene.pbgi"),
        overwrite: Overwrite::Refuse,
        scratch_dir: scratch,
        memory_bytes: options.memory,
        settings: BuildSettings::default(),
        input_key: None,
    };
    let (_, cpu_before) = process_figures();
    let disk_before = disk_figures();
    let started = Instant::now();
    let mut last = None;
    let mut log = Vec::new();
    let report = build(&mut stream, &request, &mut |progress| {
        if last != Some(progress.stage) {
            last = Some(progress.stage);
            log.push((progress.stage, started.elapsed().as_secs_f64()));
        }
        ControlFlow::Continue(())
    })
    .unwrap();
    let seconds = started.elapsed().as_secs_f64();
    let (peak, cpu) = process_figures();
    let disk = disk_figures();
    let scene_bytes: u64 = fs::read_dir(&request.output)
        .unwrap()
        .map(|entry| entry.unwrap().metadata().unwrap().len())
        .sum();
    fs::remove_dir_all(&request.output).unwrap();
    let raw_write_seconds = raw_write(&dir.path().join("raw"), scene_bytes);
    print(&options, &report, seconds, cpu - cpu_before, peak);
    let mega = |bytes: u64, seconds: f64| bytes as f64 / 1e6 / seconds;
    println!(
        "input {:.2} GB, scene {:.2} GB",
        input_bytes as f64 / 1e9,
        scene_bytes as f64 / 1e9
    );
    println!(
        "disk alone: read {:.0} MB/s ({raw_read_seconds:.2} s for the input), written and synced {:.0} MB/s \
         ({raw_write_seconds:.2} s for the scene)",
        mega(input_bytes, raw_read_seconds),
        mega(scene_bytes, raw_write_seconds)
    );
    let (read, written) = (disk.0 - disk_before.0, disk.1 - disk_before.1);
    let alone =
        read as f64 * raw_read_seconds / input_bytes as f64 + written as f64 * raw_write_seconds / scene_bytes as f64;
    println!(
        "the disk gave {:.2} GB and took {:.2} GB: {alone:.2} s alone; share of its rate {:.2}, of input and scene {:.2}",
        read as f64 / 1e9,
        written as f64 / 1e9,
        alone / seconds,
        (raw_read_seconds + raw_write_seconds) / seconds
    );
    if let Some((_, first)) = log.iter().find(|(stage, _)| *stage == Stage::Building) {
        println!("construction began after {first:.2} s");
    }
}

/// Bytes that the disk gave this process, and that it has to take: what goes before it was written does not count.
fn disk_figures() -> (u64, u64) {
    let text = fs::read_to_string("/proc/self/io").unwrap();
    let figure = |name: &str| -> u64 {
        let line = text.lines().find_map(|line| line.strip_prefix(name)).unwrap();
        line.trim().parse().unwrap()
    };
    let given_up = figure("cancelled_write_bytes:");
    (figure("read_bytes:"), figure("write_bytes:") - given_up)
}

fn print(options: &Options, report: &BuildReport, seconds: f64, cpu: f64, peak: u64) {
    let points = report.info.point_count as f64;
    println!(
        "{} points, {} nodes, --memory {} MB, {} runs",
        report.info.point_count,
        report.info.node_count,
        options.memory >> 20,
        report.runs
    );
    println!(
        "whole build {seconds:.2} s: {:.2} M points/s, {cpu:.2} s of processor time, {:.2} cores busy, peak memory {} MB",
        points / seconds / 1e6,
        cpu / seconds,
        peak >> 20
    );
    println!("stage                  seconds  ns/point");
    let (stages, busy) = (report.stages, report.busy);
    for (name, value) in [
        ("reading", stages.reading),
        ("sorting", stages.sorting),
        ("merging", stages.merging),
        ("building", stages.building),
        ("  planning, merging", busy.planning),
        ("  making nodes (sum)", busy.nodes),
        ("  writing", busy.writing),
        ("  syncing", busy.syncing),
        ("runs, beside reading", busy.spilling),
    ] {
        println!("{name:<20} {value:>9.2} {:>9.1}", value / points * 1e9);
    }
    println!(
        "bytes read {:.2} GB, written {:.2} GB, write-out queues at most {} KB",
        report.bytes_read as f64 / 1e9,
        report.bytes_written as f64 / 1e9,
        report.queue_peak_bytes >> 10
    );
}
