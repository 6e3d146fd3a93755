//! How the daemon lives beside others: its configuration file, its service manager, its manual.
#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod harness;

use harness::{Daemon, PATIENCE, SERVER, children, command, sleeper, wait_until};
use std::os::unix::net::UnixDatagram;
use std::process::{Command, Output, Stdio};

fn run(arguments: &[&str]) -> Output {
    Command::new(SERVER)
        .args(arguments)
        .stdin(Stdio::null())
        .output()
        .unwrap()
}

#[test]
fn configuration_file_is_checked_with_a_line_for_each_problem() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("server.toml");
    std::fs::write(
        &file,
        "memroy = \"1G\"\nworkers = \"two\"\n[tcp]\naddress = \"0.0.0.0:1\"\n",
    )
    .unwrap();
    let output = run(&["check", "--config", file.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(2));
    let told = String::from_utf8(output.stderr).unwrap();
    for part in [
        "memroy is unknown; memory was meant?",
        "workers is \"two\"",
        "mutual TLS",
        "server.toml",
    ] {
        assert!(told.contains(part), "{part}: {told}");
    }
    assert_eq!(told.lines().count(), 3, "{told}");
    std::fs::write(&file, "memory = \"256M\"\nworkers = 2\n").unwrap();
    let output = run(&["check", "--config", file.to_str().unwrap(), "--workers", "1"]);
    assert!(output.status.success());
    let told = String::from_utf8(output.stdout).unwrap();
    assert!(
        told.contains("memory: 256 MiB;") && told.contains("1 workers"),
        "{told}"
    );
    assert!(told.contains("TCP: off"), "{told}");
}

#[test]
fn sample_configuration_is_accepted() {
    let sample = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/server.toml");
    let text = std::fs::read_to_string(sample).unwrap();
    pbgi_server::config_file::ConfigFile::parse(&text).unwrap();
    // What is commented out must be right too.
    let uncommented: String = text
        .lines()
        .map(|line| line.strip_prefix("#: ").unwrap_or(line).to_owned() + "\n")
        .collect();
    assert_ne!(uncommented, text);
    let config = pbgi_server::config_file::ConfigFile::parse(&uncommented).unwrap();
    assert!(config.access.tcp.is_some() && config.access.http.is_some());
}

#[test]
fn service_manager_hears_ready_watchdog_and_stopping() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("notify");
    let socket = UnixDatagram::bind(&path).unwrap();
    socket.set_read_timeout(Some(PATIENCE)).unwrap();
    let daemon = Daemon::start(sleeper, |command| {
        command.env("NOTIFY_SOCKET", &path).env("WATCHDOG_USEC", "30000000");
    });
    let hear = || {
        let mut bytes = [0; 512];
        let length = socket.recv(&mut bytes).unwrap();
        String::from_utf8(bytes[..length].to_vec()).unwrap()
    };
    assert!(hear().contains("READY=1"));
    assert!(hear().contains("WATCHDOG=1"));
    daemon.stop();
    let mut last = hear();
    while last.contains("WATCHDOG") {
        last = hear();
    }
    assert!(last.contains("STOPPING=1"), "{last}");
}

#[tokio::test]
async fn socket_that_the_service_manager_made_is_served_and_left() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("run")).unwrap();
    let path = folder.path().join("run/jobs.sock");
    let listener = std::os::unix::net::UnixListener::bind(&path).unwrap();
    let server = command(folder.path(), &sleeper(folder.path()));
    // The shell moves the socket to where a service manager puts it, and keeps the process id.
    let mut shell = Command::new("sh");
    shell
        .args([
            "-c",
            "exec 3<&0 </dev/null; LISTEN_PID=$$ LISTEN_FDS=1 exec \"$0\" \"$@\"",
            SERVER,
        ])
        .args(server.get_args())
        .stdin(std::os::fd::OwnedFd::from(listener))
        .stdout(Stdio::piped())
        .stderr(Stdio::null());
    let mut child = shell.spawn().unwrap();
    assert_eq!(harness::first_line(&mut child), "READY");
    wait_until("two workers", || children(child.id()).len() == 2);
    let inherited = children(child.id()).into_iter().filter(|pid| {
        let descriptor = std::fs::read_link(format!("/proc/{pid}/fd/3"));
        descriptor.is_ok_and(|target| target.to_string_lossy().starts_with("socket:"))
    });
    assert_eq!(inherited.count(), 0, "a worker has the clients' socket");
    let stream = tokio::net::UnixStream::connect(&path).await.unwrap();
    drop(stream);
    let pid = child.id().to_string();
    assert!(Command::new("kill").args(["-TERM", &pid]).status().unwrap().success());
    assert!(child.wait().unwrap().success());
    assert!(
        path.symlink_metadata().is_ok(),
        "the service manager's socket was removed"
    );
}

#[test]
fn hangup_reads_the_file_again_and_says_what_changed_and_what_needs_a_restart() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("server.toml");
    std::fs::write(&file, "workers = 2\n").unwrap();
    let daemon = Daemon::start(sleeper, |command| {
        command.arg("--config").arg(&file);
    });
    std::fs::write(&file, "wrokers = 2\n").unwrap();
    daemon.signal("-HUP");
    let wait = |text: &str| wait_until(text, || daemon.log().contains(text));
    wait("wrokers is unknown; workers was meant?");
    let text = "idle_seconds = 3600\nallow_users = [0]\nnodes_per_page = 128\n";
    std::fs::write(&file, text).unwrap();
    daemon.signal("-HUP");
    wait("others may call, so [roots.NAME] must say which files they may name");
    wait("the configuration stays as it was");
    std::fs::create_dir(folder.path().join("shots")).unwrap();
    let roots = format!("[roots.a]\npath = \"{}/shots\"\nread = true\n", folder.path().display());
    std::fs::write(&file, text.to_owned() + &roots).unwrap();
    daemon.signal("-HUP");
    wait("idle_seconds, allow_users, roots changed, nodes_per_page changes at the next start");
    // Options on the command line win here, too.
    assert!(!daemon.log().contains("is logged"), "{}", daemon.log());
    daemon.stop();
}

#[test]
fn manual_and_completions_come_from_the_parser() {
    let folder = tempfile::tempdir().unwrap();
    assert!(run(&["man", folder.path().to_str().unwrap()]).status.success());
    let page = std::fs::read_to_string(folder.path().join("pbgi-server.1")).unwrap();
    assert!(page.contains("runtime") && page.contains(".TH"), "{page}");
    for shell in ["bash", "zsh", "fish"] {
        let output = run(&["completions", shell]);
        assert!(
            String::from_utf8(output.stdout).unwrap().contains("scratch-dir"),
            "{shell}"
        );
    }
}

#[test]
fn service_unit_is_sound() {
    let unit = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/pbgi-server.service");
    let text = std::fs::read_to_string(unit).unwrap();
    for line in [
        "Type=notify",
        "WatchdogSec=30",
        "ProtectSystem=strict",
        "NoNewPrivileges=yes",
        "UMask=0077",
        "LimitCORE=0",
    ] {
        assert!(text.lines().any(|found| found == line), "{line}");
    }
    let analyze = |arguments: &[&str]| Command::new("systemd-analyze").args(arguments).arg(unit).output();
    let Ok(output) = analyze(&["security", "--offline=true", "--threshold=30", "--no-pager"]) else {
        eprintln!("SKIPPED: no systemd-analyze here, the unit's exposure is not checked");
        return;
    };
    let told = String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "exposure above 3.0: {told}");
}

#[test]
fn oom_killer_is_told_to_take_workers_before_the_daemon() {
    let daemon = Daemon::start(sleeper, |_| {});
    let score = |pid: u32| {
        let text = std::fs::read_to_string(format!("/proc/{pid}/oom_score_adj")).unwrap();
        text.trim().parse::<i32>().unwrap()
    };
    let own = score(daemon.child.id());
    // The daemon tells the kernel once the worker is there.
    let mut workers = Vec::new();
    wait_until("both workers before the daemon", || {
        workers = children(daemon.child.id()).into_iter().map(score).collect();
        workers == [500, 500]
    });
    // Only the privileged may lower their own score.
    assert!(own == -500 || own == 0, "{own}");
    println!("RELIABILITY O5: oom_score_adj of the daemon {own}, of its workers {workers:?}");
    daemon.stop();
}
