//! The segment's life: who may make, find and remove one, and what happens where it does not fit.
#![cfg(not(loom))]
#![allow(clippy::unwrap_used, reason = "a failed step of a test is a failed test")]

mod support;

use pbgi_cache::channel::{PageReply, Welcome, receive, send};
use pbgi_cache::{CacheBudget, CacheError, CacheView, Seat, Segment};
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::net::UnixStream;
use std::os::unix::process::ExitStatusExt;
use std::process::{Command, Stdio};
use support::*;

const ROLE: &str = "PBGI_CACHE_TEST_ROLE";
const SIGKILL: i32 = 9;
/// What the test in a tiny file system says at its end.
const TINY_DONE: &str = "refused as it should be";

/// Does nothing unless a test of this file started it.
#[test]
fn other_process() {
    match std::env::var(ROLE).as_deref() {
        Ok("tiny") => tiny_file_system(),
        Ok("owner") => owner_until_killed(),
        _ => {}
    }
}

#[test]
fn foreign_layout_is_refused() {
    let owner = owner(1, 16, 4, 2);
    let refused = CacheView::attach(owner.segment().name(), owner.layout().hash() ^ 1, 0);
    assert!(matches!(
        refused,
        Err(CacheError::Mismatch {
            what: "layout hash",
            ..
        })
    ));
    let text = refused.unwrap_err().to_string();
    assert!(text.contains(&format!("{:#x}", owner.layout().hash())), "{text}");
    for name in [
        "/pbgi-",
        "/other",
        "/pbgi-../../../../etc/passwd",
        &owner.segment().name()[1..],
    ] {
        assert!(
            matches!(CacheView::attach(name, 0, 0), Err(CacheError::Name { .. })),
            "{name}"
        );
        assert!(matches!(Segment::unlink(name), Err(CacheError::Name { .. })), "{name}");
        assert!(
            matches!(Segment::create(name, owner.layout()), Err(CacheError::Name { .. })),
            "{name}"
        );
    }
}

#[test]
fn segment_is_private_unique_and_gone_after_drop() {
    use std::os::unix::fs::MetadataExt;
    let owner = owner(1, 16, 4, 2);
    let name = owner.segment().name().to_owned();
    let path = format!("/dev/shm{name}");
    let metadata = std::fs::metadata(&path).unwrap();
    assert_eq!(metadata.mode() & 0o777, 0o600);
    assert!(metadata.blocks() * 512 >= owner.layout().total_bytes(), "not reserved");
    assert!(matches!(
        Segment::create(&name, owner.layout()),
        Err(CacheError::Exists { .. })
    ));
    assert!(owner.segment().linked().unwrap());
    drop(owner);
    assert!(std::fs::metadata(&path).is_err());
    assert!(!Segment::unlink(&name).unwrap());
}

#[test]
fn stale_segment_is_unlinked_by_name_and_seen_as_gone() {
    let owner = owner(2, 16, 4, 2);
    let mut running = worker(&owner, 0);
    load(&owner, 0, node(1), 1);
    assert!(Segment::unlink(owner.segment().name()).unwrap());
    assert!(!owner.segment().linked().unwrap());
    check(running.get(node(1)).unwrap(), node(1));
    load(&owner, 0, node(2), 1);
    check(running.get(node(2)).unwrap(), node(2));
    assert!(matches!(
        CacheView::attach(owner.segment().name(), owner.layout().hash(), 1),
        Err(CacheError::Os { .. })
    ));
    // Somebody else takes the name: it is not ours to remove.
    let successor = Segment::create(owner.segment().name(), owner.layout()).unwrap();
    assert!(!owner.segment().linked().unwrap());
    drop(running);
    drop(owner);
    assert!(successor.linked().unwrap());
}

#[test]
fn segment_larger_than_the_file_system_is_refused_and_leaves_nothing() {
    let status = nix::sys::statvfs::statvfs("/dev/shm").unwrap();
    let size = status.blocks() * status.fragment_size();
    if size > 1 << 44 {
        eprintln!("SKIPPED: /dev/shm of {size} bytes is too large to exceed");
        return;
    }
    let layout = CacheBudget::new(size + (64 << 20), 2, 16 << 20, 16 << 20, 4)
        .plan()
        .unwrap();
    assert!(layout.total_bytes() > size);
    let name = Segment::unique_name().unwrap();
    match Segment::create(&name, &layout) {
        Err(CacheError::NoSpace { needed, available }) => {
            assert_eq!(needed, layout.total_bytes());
            assert!(available > 0 && available <= size);
        }
        other => panic!("{other:?}"),
    }
    assert!(!Segment::unlink(&name).unwrap(), "a segment was left");
}

/// In a user namespace with a `/dev/shm` of 16 MiB: a cache of 64 MiB is refused, one of 8 MiB is not.
#[test]
fn cache_larger_than_a_tiny_file_system_is_refused_without_a_signal() {
    let script = format!(
        "mount -t tmpfs -o size=16m tmpfs /dev/shm || exit 77; exec '{}' --exact other_process --nocapture",
        std::env::current_exe().unwrap().display()
    );
    let child = Command::new("unshare")
        .args(["-r", "-m", "sh", "-c", &script])
        .env(ROLE, "tiny")
        .output();
    match child {
        Ok(output) if output.status.success() => {
            assert!(
                String::from_utf8_lossy(&output.stdout).contains(TINY_DONE),
                "did not run"
            );
        }
        Ok(output) if output.status.code() == Some(101) || output.status.signal().is_some() => {
            panic!("{}: {}", output.status, String::from_utf8_lossy(&output.stderr))
        }
        other => eprintln!("SKIPPED: no mount namespace here: {other:?}"),
    }
}

fn tiny_file_system() {
    let create = |bytes: u64| {
        let layout = CacheBudget::new(bytes, 2, 4096, 4096, 2).plan().unwrap();
        Segment::create(&Segment::unique_name().unwrap(), &layout)
    };
    match create(64 << 20) {
        Err(CacheError::NoSpace { needed, available }) => assert!(needed > available && available <= 16 << 20),
        other => panic!("{other:?}"),
    }
    assert_eq!(std::fs::read_dir("/dev/shm").unwrap().count(), 0, "a segment was left");
    let first = create(8 << 20).unwrap();
    assert!(
        matches!(create(12 << 20), Err(CacheError::NoSpace { .. })),
        "what is left does not suffice"
    );
    drop(first);
    create(12 << 20).unwrap();
    assert_eq!(std::fs::read_dir("/dev/shm").unwrap().count(), 0);
    println!("{TINY_DONE}");
}

/// Says the name first, as a daemon writes its state file first, then creates, then waits for its end.
fn owner_until_killed() {
    let channel = UnixStream::from(std::io::stdin().as_fd().try_clone_to_owned().unwrap());
    let name = Segment::unique_name().unwrap();
    let layout = layout(1, 16, 4, 2);
    let welcome = |epoch| Welcome {
        segment: name.clone(),
        layout_hash: layout.hash(),
        seat: Seat { slot: 0, epoch },
        token: [0; 16],
        daemon_pid: 0,
        local_node_frames: 0,
        local_point_frames: 0,
    };
    send(&channel, &welcome(0)).unwrap();
    let _segment = Segment::create(&name, &layout).unwrap();
    send(&channel, &welcome(1)).unwrap();
    let _ = receive::<PageReply>(&channel);
}

#[test]
fn segment_of_a_killed_owner_is_removed_by_its_name() {
    for messages in [1, 2] {
        for _ in 0..20 {
            let (ours, theirs) = UnixStream::pair().unwrap();
            let mut command = Command::new(std::env::current_exe().unwrap());
            command
                .args(["--exact", "other_process", "--nocapture"])
                .env(ROLE, "owner");
            let mut child = command
                .stdin(OwnedFd::from(theirs))
                .stdout(Stdio::null())
                .spawn()
                .unwrap();
            let mut name = String::new();
            for _ in 0..messages {
                name = receive::<Welcome>(&ours).unwrap().unwrap().segment;
            }
            child.kill().unwrap();
            assert_eq!(child.wait().unwrap().signal(), Some(SIGKILL));
            let existed = Segment::unlink(&name).unwrap();
            assert!(existed || messages == 1, "a created segment was not found");
            assert!(std::fs::metadata(format!("/dev/shm{name}")).is_err());
        }
    }
}
