//! The program as people may meet it: started by hand, it says that it is not for them.
#![allow(clippy::unwrap_used, reason = "tests assert")]

use std::process::{Command, Stdio};

fn worker() -> Command {
    Command::new(env!("CARGO_BIN_EXE_pbgi-worker"))
}

#[test]
fn without_a_channel_the_worker_says_who_starts_it() {
    let output = worker()
        .args(["--queue", "/nonexistent/queue.sock"])
        .stdin(Stdio::null())
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{text}");
    assert!(text.contains("pbgi-server starts this program"), "{text}");
}

#[test]
fn a_channel_that_closes_at_once_is_a_dead_daemon() {
    let (ours, theirs) = std::os::unix::net::UnixStream::pair().unwrap();
    drop(ours);
    let mut command = worker();
    command.args(["--page-channel", "0", "--queue", "/nonexistent/queue.sock"]);
    let output = command.stdin(std::os::fd::OwnedFd::from(theirs)).output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(text.contains("is gone"), "{text}");
}

#[test]
fn a_welcome_of_another_build_ends_with_code_3() {
    let (mut ours, theirs) = std::os::unix::net::UnixStream::pair().unwrap();
    std::io::Write::write_all(&mut ours, &[0xff; 4096]).unwrap();
    let mut command = worker();
    command.args(["--queue", "/nonexistent/queue.sock"]);
    let output = command.stdin(std::os::fd::OwnedFd::from(theirs)).output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(3), "{text}");
    drop(ours);
}
