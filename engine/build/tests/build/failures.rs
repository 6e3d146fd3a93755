//! Whatever fails, and wherever a build is stopped or killed, there is the right scene or none, nothing is left, and
//! the next try succeeds.

use crate::support::{Cloud, Place, Tree, build_cloud, sheet, small_pages};
use nix::errno::Errno;
use pbgi_build::{BuildError, BuildHost, BuildReport};
use pbgi_core::point::Sides;
use pbgi_store::testsuite::{CrashImage, CrashVolume, FaultPlan, FaultScope, FaultVolume};
use pbgi_store::{OsVolume, Overwrite, StoreError, Volume, sweep_scratch, sweep_temporaries};
use std::ops::ControlFlow;
use std::path::Path;
use std::process::Command;
use std::sync::Arc;

/// Small runs, and few at once: every kind of operation happens.
fn busy_host(volume: &Arc<dyn Volume>) -> BuildHost {
    BuildHost {
        volume: volume.clone(),
        run_points_max: 200,
        fan_in_max: 3,
        ..BuildHost::default()
    }
}

fn cloud() -> Cloud {
    Cloud::new(sheet(1000)).bounded()
}

/// Fails operation 1, 2, ... until nothing fails any more; returns how many there were.
fn fault_loop(persistent: bool, errno: Errno, scope: FaultScope) -> u64 {
    for at in 1.. {
        let plan = FaultPlan {
            at,
            persistent,
            errno,
            scope,
        };
        let disk: Arc<dyn Volume> = Arc::new(CrashVolume::default());
        let place = Place::on(disk.clone(), Path::new("/"));
        let fault = Arc::new(FaultVolume::new(disk.clone(), plan));
        let volume: Arc<dyn Volume> = fault.clone();
        let result = build_cloud(&cloud(), &place, &busy_host(&volume), small_pages());
        if fault.injected() == 0 {
            result.unwrap();
            return at - 1;
        }
        fault.heal();
        if errno == Errno::ENOSPC {
            let full = matches!(result, Err(BuildError::Store(StoreError::NoSpace { .. })));
            assert!(full, "operation {at}: {result:?}");
            assert!(
                matches!(place.open(), Err(StoreError::Missing { .. })),
                "operation {at}"
            );
        }
        match (&result, place.open()) {
            (Ok(_), Ok(scene)) => drop(Tree::audit(&scene, &cloud().points)),
            (Err(_), Err(StoreError::Missing { .. })) => {}
            // The rename succeeded, and could not be taken back when its sync failed.
            (Err(_), Ok(scene)) if persistent => drop(Tree::audit(&scene, &cloud().points)),
            (result, _) => panic!("operation {at}: {result:?}, and the name disagrees"),
        }
        if persistent && scope == FaultScope::All {
            sweep_scratch(disk.as_ref(), &place.scratch()).unwrap();
            sweep_temporaries(disk.as_ref(), &place.output()).unwrap();
        }
        let left = place.leftovers(disk.as_ref());
        assert!(left.is_empty(), "operation {at}: {left:?} left");
        build_cloud(&cloud(), &place, &busy_host(&volume), small_pages()).unwrap();
        Tree::audit(&place.open().unwrap(), &cloud().points);
    }
    unreachable!()
}

#[test]
fn a_full_disk_at_any_write_leaves_nothing_and_a_retry_succeeds() {
    let mut writes = 0;
    for persistent in [false, true] {
        let failed = fault_loop(persistent, Errno::ENOSPC, FaultScope::Space);
        assert!(failed >= 25);
        writes += failed;
    }
    println!(
        "RELIABILITY F1: {writes} writes met a full disk: {writes} errors, 0 scenes, 0 temporary bytes, {writes} retries succeeded"
    );
}

#[test]
fn an_io_error_at_any_operation_makes_no_wrong_scene_and_a_retry_succeeds() {
    let mut operations = 0;
    for persistent in [false, true] {
        let failed = fault_loop(persistent, Errno::EIO, FaultScope::All);
        assert!(failed >= 60);
        operations += failed;
    }
    println!(
        "RELIABILITY F2: {operations} operations met EIO, once or for good: 0 wrong scenes, {operations} retries succeeded"
    );
}

#[test]
fn power_loss_at_any_sync_or_rename_leaves_the_old_scene_or_the_new_one() {
    let old = Cloud::new(sheet(500));
    let mut images = 0;
    for crash_at in 1.. {
        let disk = CrashVolume::default();
        let volume: Arc<dyn Volume> = Arc::new(disk.clone());
        let place = Place::on(volume.clone(), Path::new("/"));
        volume.sync_dir(Path::new("/")).unwrap();
        build_cloud(&old, &place, &place.host(), small_pages()).unwrap();
        disk.arm(Some(crash_at));
        let result = build_cloud(&cloud(), &place, &busy_host(&volume), small_pages());
        if !disk.crashed() {
            result.unwrap();
            assert!(crash_at > 10);
            break;
        }
        for image in std::iter::once(CrashImage::Durable).chain((0..10).map(CrashImage::Torn)) {
            images += 1;
            let next: Arc<dyn Volume> = Arc::new(disk.after_crash(image));
            let scene = pbgi_store::Scene::open_on(&next, &place.output()).unwrap();
            let expected = if scene.info().point_count == 500 {
                &old
            } else {
                &cloud()
            };
            Tree::audit(&scene, &expected.points);
        }
    }
    println!("RELIABILITY F3: {images} disks after a power loss, each with the old scene or the new one, whole");
}

#[test]
fn a_cancelled_build_leaves_nothing() {
    let place = Place::on_disk();
    let host = busy_host(&place.volume);
    let request = place.request(small_pages());
    for stop_at in 1.. {
        let mut calls = 0;
        let mut observer = |_| {
            calls += 1;
            if calls == stop_at {
                ControlFlow::Break(())
            } else {
                ControlFlow::Continue(())
            }
        };
        let result = pbgi_build::build_on(&mut cloud(), &request, &host, &mut observer);
        if calls < stop_at {
            result.unwrap();
            assert!(stop_at > 8, "{stop_at}");
            break;
        }
        assert!(matches!(result, Err(BuildError::Cancelled)));
        assert!(matches!(place.open(), Err(StoreError::Missing { .. })));
        assert!(place.leftovers(place.volume.as_ref()).is_empty());
    }
}

#[test]
fn of_two_builds_to_one_name_one_wins() {
    let place = Place::on_disk();
    let mut request = place.request(small_pages());
    request.overwrite = Overwrite::Refuse;
    for round in 0..100 {
        request.output = place.output().with_file_name(format!("{round}.pbgi"));
        let race = |points| {
            let mut cloud = Cloud::new(sheet(points));
            let build = pbgi_build::build(&mut cloud, &request, &mut |_| ControlFlow::Continue(()));
            (build, cloud)
        };
        let (first, second) = std::thread::scope(|scope| {
            let first = scope.spawn(|| race(300));
            (race(301), first.join().unwrap())
        });
        let winners: Vec<_> = [&first, &second]
            .into_iter()
            .filter(|(result, _)| result.is_ok())
            .collect();
        assert_eq!(winners.len(), 1);
        Tree::audit(&pbgi_store::Scene::open(&request.output).unwrap(), &winners[0].1.points);
        let lost = [first.0, second.0].into_iter().find_map(Result::err).unwrap();
        assert!(matches!(lost, BuildError::Store(StoreError::Exists { .. })), "{lost}");
    }
    assert_eq!(place.leftovers(place.volume.as_ref()).len(), 100);
    println!("RELIABILITY F13: 100 races, 100 winners, 100 whole scenes");
}

#[test]
fn a_disk_without_room_is_refused_before_runs_are_written() {
    struct Cramped(Arc<dyn Volume>);
    impl Volume for Cramped {
        fn create_new(&self, path: &Path, mode: pbgi_store::IoMode) -> std::io::Result<Box<dyn pbgi_store::Storage>> {
            self.0.create_new(path, mode)
        }
        fn open(&self, path: &Path) -> std::io::Result<Box<dyn pbgi_store::Storage>> {
            self.0.open(path)
        }
        fn create_dir(&self, path: &Path, mode: u32) -> std::io::Result<()> {
            self.0.create_dir(path, mode)
        }
        fn kind(&self, path: &Path) -> std::io::Result<Option<pbgi_store::EntryKind>> {
            self.0.kind(path)
        }
        fn rename(&self, from: &Path, to: &Path, mode: pbgi_store::RenameMode) -> std::io::Result<()> {
            self.0.rename(from, to, mode)
        }
        fn remove_file(&self, path: &Path) -> std::io::Result<()> {
            self.0.remove_file(path)
        }
        fn remove_dir(&self, path: &Path) -> std::io::Result<()> {
            self.0.remove_dir(path)
        }
        fn list(&self, dir: &Path) -> std::io::Result<Vec<pbgi_store::volume::Entry>> {
            self.0.list(dir)
        }
        fn sync_dir(&self, dir: &Path) -> std::io::Result<()> {
            self.0.sync_dir(dir)
        }
        fn free_bytes(&self, _dir: &Path) -> std::io::Result<u64> {
            Ok(20_000)
        }
        fn age(&self, dir: &Path) -> std::io::Result<std::time::Duration> {
            self.0.age(dir)
        }
        fn try_lock(&self, path: &Path) -> std::io::Result<Option<pbgi_store::volume::Lock>> {
            self.0.try_lock(path)
        }
    }
    let place = Place::on_disk();
    let cramped: Arc<dyn Volume> = Arc::new(Cramped(Arc::new(OsVolume)));
    // 1000 points of 32 bytes are expected, nine tenths of them for certain.
    let error = build_cloud(&cloud(), &place, &busy_host(&cramped), small_pages())
        .unwrap_err()
        .to_string();
    assert!(error.contains("28800 bytes needed, 20000 bytes free"), "{error}");
    let mut roomy = busy_host(&cramped);
    roomy.run_points_max = usize::MAX;
    let error = build_cloud(&cloud(), &place, &roomy, small_pages())
        .unwrap_err()
        .to_string();
    assert!(error.contains("32000 bytes needed, 20000 bytes free"), "{error}");
    assert!(place.leftovers(place.volume.as_ref()).is_empty());
}

const ABORT_AT: &str = "PBGI_TEST_ABORT_AT";
const ABORT_IN: &str = "PBGI_TEST_ABORT_IN";
const ABORT_KEY: &str = "PBGI_TEST_ABORT_KEY";

/// Not a promise by itself: the process that the next test kills.
#[test]
fn killed_build_child() {
    let (Ok(at), Ok(root)) = (std::env::var(ABORT_AT), std::env::var(ABORT_IN)) else {
        return;
    };
    let (mut left, place) = (at.parse::<u32>().unwrap(), Place::at(Path::new(&root)));
    let mut observer = |_| {
        left -= 1;
        if left == 0 {
            nix::sys::signal::raise(nix::sys::signal::Signal::SIGKILL).unwrap();
        }
        ControlFlow::Continue(())
    };
    let host = busy_host(&place.volume);
    let mut request = place.request(small_pages());
    request.input_key = std::env::var(ABORT_KEY).ok().map(|key| key.parse().unwrap());
    pbgi_build::build_on(&mut cloud(), &request, &host, &mut observer).unwrap();
}

/// Runs that process to its observer's call `at`; whether it was killed there.
fn killed_at(at: u32, place: &Place, key: Option<u64>) -> bool {
    let mut command = Command::new(std::env::current_exe().unwrap());
    command
        .args(["--exact", "failures::killed_build_child", "--quiet"])
        .env(ABORT_AT, at.to_string())
        .env(ABORT_IN, place.root())
        .stdout(std::process::Stdio::null());
    if let Some(key) = key {
        command.env(ABORT_KEY, key.to_string());
    }
    !command.status().unwrap().success()
}

/// Builds where a process was killed at `at`; the report and the pages.
fn build_again(cloud: &Cloud, place: &Place, key: u64) -> (BuildReport, [Vec<u8>; 2]) {
    let mut request = place.request(small_pages());
    request.input_key = Some(key);
    let host = busy_host(&place.volume);
    let watch = &mut |_| ControlFlow::Continue(());
    let report = pbgi_build::build_on(&mut cloud.clone(), &request, &host, watch).unwrap();
    Tree::audit(&place.open().unwrap(), &cloud.points);
    assert!(place.leftovers(&OsVolume).is_empty());
    (report, pages(place))
}

fn pages(place: &Place) -> [Vec<u8>; 2] {
    ["nodes.pages", "points.pages"].map(|name| std::fs::read(place.output().join(name)).unwrap())
}

/// The pages of a build that nobody disturbs, and the runs that it makes, merged ones included.
fn undisturbed(cloud: &Cloud) -> (u64, [Vec<u8>; 2]) {
    let place = Place::on_disk();
    let report = build_cloud(cloud, &place, &busy_host(&place.volume), small_pages()).unwrap();
    (report.runs, pages(&place))
}

#[test]
fn a_killed_build_goes_on_from_its_finished_runs_to_the_same_bytes() {
    let (runs, expected) = undisturbed(&cloud());
    let (mut kills, mut resumed, mut saved) = (0, 0, 0);
    for at in 1.. {
        let place = Place::on_disk();
        if !killed_at(at, &place, Some(7)) {
            break;
        }
        kills += 1;
        let swept = sweep_scratch(&OsVolume, &place.scratch()).unwrap();
        sweep_temporaries(&OsVolume, &place.output()).unwrap();
        // Another input gets nothing of it.
        let mut request = place.request(small_pages());
        request.input_key = Some(8);
        let host = busy_host(&place.volume);
        let other = pbgi_build::build_on(&mut cloud(), &request, &host, &mut |_| ControlFlow::Continue(())).unwrap();
        assert_eq!(other.runs_resumed, 0, "killed at {at}");
        let (report, bytes) = build_again(&cloud(), &place, 7);
        assert_eq!(report.runs_resumed > 0, swept.kept > 0, "killed at {at}");
        resumed += report.runs_resumed;
        // Runs that were merged are not made again.
        saved += runs - (report.runs - report.runs_resumed);
        assert!(bytes == expected, "killed at {at}");
    }
    assert!(
        kills >= 5 && resumed >= 10 && saved > resumed,
        "{kills} kills, {resumed} runs resumed, {saved} not made again"
    );
}

#[test]
fn runs_of_an_input_that_has_changed_since_are_not_used() {
    let mut shorter = cloud().points.to_vec();
    shorter.truncate(shorter.len() / 2);
    let mut brighter = cloud().points.to_vec();
    let middle = brighter.len() / 2;
    brighter[middle] = brighter[middle].with_sides(Sides {
        front: [9.0; 3],
        back: [0.0; 3],
    });
    let bounds = cloud().bounds;
    let changed = [shorter, brighter].map(|points| {
        let mut changed = Cloud::new(points);
        changed.bounds = bounds;
        (undisturbed(&changed).1, changed)
    });
    let mut tried = 0;
    for at in 1.. {
        let place = Place::on_disk();
        if !killed_at(at, &place, Some(7)) {
            break;
        }
        let swept = sweep_scratch(&OsVolume, &place.scratch()).unwrap();
        sweep_temporaries(&OsVolume, &place.output()).unwrap();
        tried += swept.kept;
        let (expected, changed) = &changed[at as usize % 2];
        let (_, bytes) = build_again(changed, &place, 7);
        assert!(bytes == *expected, "killed at {at}");
    }
    assert!(tried >= 4, "{tried} folders with runs");
}

#[test]
fn a_killed_build_leaves_no_scene_and_its_scratch_is_swept() {
    let place = Place::on_disk();
    let (mut kills, mut swept_bytes) = (0, 0);
    for at in (1..).step_by(2) {
        if !killed_at(at, &place, None) {
            break;
        }
        kills += 1;
        assert!(matches!(place.open(), Err(StoreError::Missing { .. })));
        let swept = sweep_scratch(&OsVolume, &place.scratch()).unwrap();
        assert!(swept.folders <= 1);
        swept_bytes += swept.bytes;
        sweep_temporaries(&OsVolume, &place.output()).unwrap();
        assert!(place.leftovers(&OsVolume).is_empty());
    }
    assert!(
        kills >= 5 && swept_bytes > 0,
        "{kills} kills, {swept_bytes} bytes swept"
    );
    Tree::audit(&place.open().unwrap(), &cloud().points);
    println!("RELIABILITY P9: {kills} kills of a build, no scene, {swept_bytes} bytes of scratch swept, nothing left");
}
