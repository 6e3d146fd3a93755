//! The memory limit holds for the whole process, code and input included.

use crate::support::Place;
use pbgi_build::build;
use pbgi_core::point::Sides;
use pbgi_core::{Bounds, BuildSettings, PointRecord, PointStream};
use std::convert::Infallible;
use std::ops::ControlFlow;
use std::process::Command;

const LIMIT: u64 = 64_000_000;
/// 192 MB: three times the limit, half a dozen runs and more.
const POINTS: u64 = 6_000_000;
const CHILD: &str = "PBGI_TEST_MEMORY_CHILD";

/// A wavy sheet made point by point, in an order without pattern.
struct Endless {
    next: u64,
}

impl PointStream for Endless {
    type Error = Infallible;

    fn bounds(&self) -> Option<Bounds> {
        Some(Bounds {
            min: [-1.0; 3],
            max: [1.0; 3],
        })
    }

    fn len_hint(&self) -> Option<u64> {
        Some(POINTS)
    }

    fn next_batch(&mut self, batch: &mut Vec<PointRecord>) -> Result<bool, Infallible> {
        let end = (self.next + 4096).min(POINTS);
        for i in self.next..end {
            let noise = i.wrapping_mul(0x9e37_79b9_7f4a_7c15);
            let unit = |bits: u64| (bits & 0xff_ffff) as f32 / 8_388_608.0 - 1.0;
            let (x, z) = (unit(noise >> 40), unit(noise >> 16));
            let position = [x, 0.5 * (9.0 * x).sin() * (7.0 * z).cos(), z];
            let point = PointRecord::new(position, [x, 1.0, z], 1e-3, Sides::default());
            batch.extend(point.ok());
        }
        let more = self.next < end;
        self.next = end;
        Ok(more)
    }

    fn rewind(&mut self) -> Result<(), Infallible> {
        self.next = 0;
        Ok(())
    }
}

/// Most physical memory that this process had at once, bytes.
fn peak_memory() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap();
    line.trim().trim_end_matches(" kB").parse::<u64>().unwrap() * 1024
}

/// Bytes that this process has read and written so far, as the system counts them.
fn transferred() -> (u64, u64) {
    let text = std::fs::read_to_string("/proc/self/io").unwrap();
    let count = |name| text.lines().find_map(|line| line.strip_prefix(name)).unwrap();
    (count("rchar: ").parse().unwrap(), count("wchar: ").parse().unwrap())
}

#[test]
fn a_build_three_times_its_memory_stays_within_it_and_moves_no_byte_twice() {
    if std::env::var_os(CHILD).is_none() {
        // In a process of its own: other tests run beside this one.
        let status = Command::new(std::env::current_exe().unwrap())
            .args([
                "--exact",
                "memory::a_build_three_times_its_memory_stays_within_it_and_moves_no_byte_twice",
                "--nocapture",
            ])
            .env(CHILD, "1")
            .status()
            .unwrap();
        assert!(status.success());
        return;
    }
    let place = Place::on_disk();
    let mut request = place.request(BuildSettings::default());
    request.memory_bytes = LIMIT;
    let before = transferred();
    let report = build(&mut Endless { next: 0 }, &request, &mut |_| ControlFlow::Continue(())).unwrap();
    let after = transferred();
    let peak = peak_memory();
    eprintln!(
        "peak memory {} of {LIMIT} bytes, {} runs, {:?}",
        peak, report.runs, report.stages
    );
    assert_eq!(report.info.point_count, POINTS);
    assert!(report.runs >= 6);
    assert!(peak <= LIMIT, "peak memory {peak} of {LIMIT} bytes");
    // Runs are written and read once, the scene is written once, and the report says so.
    let (read, written) = (after.0 - before.0, after.1 - before.1);
    assert!(
        read >= report.bytes_read && read * 20 <= report.bytes_read * 21,
        "{read} bytes read"
    );
    assert!(
        written >= report.bytes_written && written * 20 <= report.bytes_written * 21,
        "{written} bytes written"
    );
    assert_eq!(report.bytes_read, POINTS * 32);
    let scene_bytes = std::fs::read_dir(place.output())
        .unwrap()
        .map(|entry| entry.unwrap().metadata().unwrap().len());
    assert_eq!(report.bytes_written, POINTS * 32 + scene_bytes.sum::<u64>());
    let scene = place.open().unwrap();
    scene.verify().unwrap();
}
