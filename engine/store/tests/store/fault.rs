//! Operation 1 fails, then 2, ... until the workload runs clean: no wrong file, no leftover, and the next try succeeds.

use crate::support::{names, point, write};
use nix::errno::Errno;
use pbgi_store::limits::RUN_BLOCK_RECORDS;
use pbgi_store::testsuite::{CrashVolume, FaultPlan, FaultScope, FaultVolume};
use pbgi_store::{
    AtomicFile, DataFile, IoMode, Overwrite, RunWriter, Scene, ScratchDir, StoreError, Volume, sweep_temporaries,
};
use std::io::Write;
use std::path::Path;
use std::sync::Arc;

const PATH: &str = "/city.pbgi";

fn faulty(plan: FaultPlan) -> (CrashVolume, Arc<FaultVolume>, Arc<dyn Volume>) {
    let disk = CrashVolume::default();
    let fault = Arc::new(FaultVolume::new(Arc::new(disk.clone()), plan));
    (disk, fault.clone(), fault)
}

/// Fails operation n = 1, 2, ... of writing a scene; returns how many n made a difference.
fn fault_loop(persistent: bool, errno: Errno, scope: FaultScope) -> u64 {
    let path = Path::new(PATH);
    for at in 1.. {
        let plan = FaultPlan {
            at,
            persistent,
            errno,
            scope,
        };
        let (disk, fault, volume) = faulty(plan);
        let disk: Arc<dyn Volume> = Arc::new(disk);
        let result = write(&volume, path, Overwrite::Refuse, 100, 1);
        if fault.injected() == 0 {
            result.unwrap();
            return at - 1;
        }
        fault.heal();
        match &result {
            Ok(_) => Scene::open_on(&volume, path).unwrap().verify().unwrap(),
            Err(error) => {
                let full = matches!(error, StoreError::NoSpace { .. });
                assert!(errno != Errno::ENOSPC || full, "operation {at}: {error}");
                // Where nothing works any more, the rename cannot be taken back: the scene that stays is whole.
                if let Ok(scene) = Scene::open_on(&volume, path) {
                    assert!(
                        persistent && errno == Errno::EIO,
                        "operation {at}: {error}, yet the name is taken"
                    );
                    scene.verify().unwrap();
                }
            }
        }
        if persistent && scope == FaultScope::All {
            sweep_temporaries(disk.as_ref(), path).unwrap();
        }
        let left = names(disk.as_ref(), Path::new("/"));
        assert!(
            left.iter().all(|name| name == "city.pbgi"),
            "operation {at}: {left:?} left"
        );
        write(&volume, path, Overwrite::Replace, 50, 2).unwrap();
        assert_eq!(Scene::open_on(&volume, path).unwrap().info().point_count, 50);
    }
    unreachable!()
}

#[test]
fn a_full_disk_leaves_nothing_behind() {
    for persistent in [false, true] {
        assert!(fault_loop(persistent, Errno::ENOSPC, FaultScope::Space) >= 10);
    }
}

#[test]
fn an_io_error_anywhere_makes_no_wrong_file() {
    for persistent in [false, true] {
        assert!(fault_loop(persistent, Errno::EIO, FaultScope::All) >= 20);
    }
}

#[test]
fn reads_are_tried_again_where_the_failure_may_pass() {
    let path = Path::new(PATH);
    for (errno, passes) in [
        (Errno::EIO, true),
        (Errno::ESTALE, true),
        (Errno::EINTR, true),
        (Errno::EACCES, false),
    ] {
        for persistent in [false, true] {
            let plan = FaultPlan {
                at: 2,
                persistent,
                errno,
                scope: FaultScope::Reads,
            };
            let (_, fault, volume) = faulty(plan);
            write(&volume, path, Overwrite::Refuse, 100, 1).unwrap();
            let opened = Scene::open_on(&volume, path);
            assert_eq!(
                opened.is_ok(),
                passes && !persistent,
                "{errno}, persistent: {persistent}"
            );
            let tries = if persistent && passes { 3 } else { 1 };
            assert_eq!(fault.injected(), tries);
        }
    }
}

#[test]
fn after_a_failed_write_or_sync_a_file_takes_no_more() {
    for failing in [2, 3] {
        let plan = FaultPlan {
            at: failing,
            persistent: false,
            errno: Errno::EIO,
            scope: FaultScope::Space,
        };
        let (_, _, volume) = faulty(plan);
        let file = DataFile::create_new(&volume, Path::new("/x"), IoMode::Buffered).unwrap();
        let first = file.write_at(0, b"first").and_then(|()| file.sync());
        assert!(matches!(first, Err(StoreError::Io { .. })));
        for later in [file.sync(), file.write_at(0, b"again")] {
            assert!(matches!(later, Err(StoreError::Abandoned { .. })));
        }
    }
}

/// A run of six blocks: but for the last, they are written behind the caller's back.
#[test]
fn a_run_tells_of_any_write_that_failed_and_goes() {
    let points: Vec<_> = (0..6 * RUN_BLOCK_RECORDS as u32 - 1).map(point).collect();
    for at in 1.. {
        let plan = FaultPlan {
            at,
            persistent: false,
            errno: Errno::ENOSPC,
            scope: FaultScope::Space,
        };
        let (_, fault, volume) = faulty(plan);
        let written = ScratchDir::create(&volume, Path::new("/")).and_then(|scratch| {
            let mut writer = RunWriter::create(&scratch, 0)?;
            points.chunks(1000).try_for_each(|some| writer.append(some))?;
            writer.finish()
        });
        if fault.injected() == 0 {
            assert_eq!(written.unwrap().records(), points.len() as u64);
            // The folder, the file, six blocks.
            assert_eq!(at, 9);
            return;
        }
        assert!(matches!(written, Err(StoreError::NoSpace { .. })), "operation {at}");
        assert!(names(volume.as_ref(), Path::new("/")).is_empty(), "operation {at}");
    }
}

#[test]
fn a_full_disk_is_reported_with_needed_and_free_bytes() {
    let plan = FaultPlan {
        at: 2,
        persistent: true,
        errno: Errno::ENOSPC,
        scope: FaultScope::Space,
    };
    let (_, _, volume) = faulty(plan);
    let mut file = AtomicFile::create_on(&volume, Path::new("/x"), Overwrite::Refuse).unwrap();
    let text = file.write_all(&[0; 1234]).unwrap_err().to_string();
    assert!(text.contains("1234 bytes needed"), "{text}");
    assert!(matches!(file.publish(), Err(StoreError::Abandoned { .. })));
    assert!(names(volume.as_ref(), Path::new("/")).is_empty());
}
