//! Real processes of the system's own programs in place of workers.

use super::*;
use std::collections::HashMap;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

#[derive(Default)]
struct Log {
    epochs: HashMap<u8, u32>,
    births: Vec<(WorkerBirth, UnixStream)>,
    deaths: Vec<(Seat, Death)>,
    parked: Option<(usize, String)>,
}

#[derive(Clone, Default)]
struct Witness(Arc<Mutex<Log>>);

impl Nursery for Witness {
    fn seat(&mut self, slot: u8) -> Seat {
        let epoch = *self.0.lock().unwrap().epochs.entry(slot).or_insert(1);
        Seat { slot, epoch }
    }

    fn born(&mut self, birth: WorkerBirth, channel: UnixStream) -> Result<(), ServerError> {
        self.0.lock().unwrap().births.push((birth, channel));
        Ok(())
    }

    fn dead(&mut self, seat: Seat, death: Death) {
        let mut log = self.0.lock().unwrap();
        *log.epochs.entry(seat.slot).or_insert(1) += 1;
        log.deaths.push((seat, death));
    }

    fn parked(&mut self, slots: usize, reason: &str) {
        self.0.lock().unwrap().parked = Some((slots, reason.to_owned()));
    }
}

fn start(worker: &Path, workers: u8) -> (Handle, Witness) {
    start_with(worker, workers, process::Command::spawn)
}

fn start_with(
    worker: &Path,
    workers: u8,
    spawn: fn(&mut process::Command) -> io::Result<process::Child>,
) -> (Handle, Witness) {
    let plan = Plan {
        workers,
        worker_binary: worker.to_owned(),
        queue_socket: "/nowhere".into(),
        server_binary: "/bin/cat".into(),
        spawn,
    };
    let witness = Witness::default();
    let (handle, _) = Supervisor::start(plan, |_| witness.clone()).unwrap();
    (handle, witness)
}

/// A program that sleeps whatever its arguments are.
fn sleeper(folder: &Path) -> PathBuf {
    script(folder, "sleeper", "exec sleep 1000")
}

/// A shell script that ignores its arguments.
fn script(folder: &Path, name: &str, text: &str) -> PathBuf {
    let path = folder.join(name);
    std::fs::write(&path, format!("#!/bin/sh\n{text}\n")).unwrap();
    std::fs::set_permissions(&path, PermissionsExt::from_mode(0o755)).unwrap();
    path
}

fn wait<T>(witness: &Witness, what: &str, mut found: impl FnMut(&mut Log) -> Option<T>) -> T {
    let deadline = Instant::now() + Duration::from_secs(60);
    loop {
        if let Some(value) = found(&mut witness.0.lock().unwrap()) {
            return value;
        }
        assert!(Instant::now() < deadline, "no {what} within 60 s");
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn dead_worker_is_reaped_and_its_slot_filled_with_a_new_epoch() {
    let folder = tempfile::tempdir().unwrap();
    let (handle, witness) = start(&sleeper(folder.path()), 2);
    let births = wait(&witness, "births", |log| {
        (log.births.len() == 2).then(|| log.births[0].0)
    });
    handle.ready(births.seat);
    handle.kill(births.seat);
    let (seat, death) = wait(&witness, "death", |log| log.deaths.first().copied());
    assert_eq!((seat, death), (births.seat, Death::Killed));
    let third = wait(&witness, "third birth", |log| log.births.get(2).map(|birth| birth.0));
    assert_eq!(
        third.seat,
        Seat {
            slot: seat.slot,
            epoch: 2
        }
    );
    assert_ne!(third.token, births.token);
    // A kill meant for the old worker does not hit the new one.
    handle.kill(births.seat);
    handle.stop();
    let deaths = wait(&witness, "deaths", |log| {
        (log.deaths.len() == 3).then(|| log.deaths.clone())
    });
    assert!(deaths.contains(&(third.seat, Death::Killed)), "{deaths:?}");
    let pids: Vec<u32> = witness
        .0
        .lock()
        .unwrap()
        .births
        .iter()
        .map(|birth| birth.0.pid)
        .collect();
    assert!(
        pids.iter().all(|pid| crate::memory::anonymous_bytes(*pid).is_none()),
        "a child is left"
    );
}

#[test]
fn workers_that_never_get_ready_park_their_slot_after_five_deaths() {
    let (handle, witness) = start(Path::new("/bin/false"), 1);
    let (slots, reason) = wait(&witness, "parking", |log| log.parked.clone());
    assert_eq!(slots, 1);
    assert!(reason.contains("before it was ready: exit status: 1"), "{reason}");
    assert_eq!(witness.0.lock().unwrap().deaths.len(), limits::PARK_DEATHS);
    handle.stop();
}

/// Attempts to make a process while there are too many, and whether there are.
static ATTEMPTS: AtomicUsize = AtomicUsize::new(0);
static CROWDED: AtomicBool = AtomicBool::new(true);

fn spawn_when_there_is_room(command: &mut process::Command) -> io::Result<process::Child> {
    if CROWDED.load(Ordering::SeqCst) {
        ATTEMPTS.fetch_add(1, Ordering::SeqCst);
        return Err(nix::errno::Errno::EAGAIN.into());
    }
    command.spawn()
}

#[test]
fn processes_that_cannot_be_made_park_their_slots_until_there_is_room_again() {
    let folder = tempfile::tempdir().unwrap();
    let (handle, witness) = start_with(&sleeper(folder.path()), 2, spawn_when_there_is_room);
    let (slots, reason) = wait(&witness, "parking", |log| {
        log.parked.clone().filter(|parked| parked.0 == 2)
    });
    assert!(reason.contains("sleeper: Resource temporarily unavailable"), "{reason}");
    assert_eq!(ATTEMPTS.load(Ordering::SeqCst), slots * limits::PARK_DEATHS);
    // Neither builds nor anything else ends the daemon.
    let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
    let refused = runtime.block_on(handle.build(1)).unwrap_err();
    assert_eq!(refused.raw_os_error(), Some(nix::libc::EAGAIN));
    CROWDED.store(false, Ordering::SeqCst);
    // As every job that comes in does.
    let births = wait(&witness, "births", |log| {
        handle.unpark();
        (log.births.len() == slots).then_some(log.births.len())
    });
    println!(
        "RELIABILITY O4: EAGAIN for {slots} workers: parked after {} attempts each, a build refused with it; \
         {births} workers as soon as there was room",
        limits::PARK_DEATHS
    );
    handle.stop();
}

#[test]
fn missing_worker_program_is_named() {
    let (handle, witness) = start(Path::new("/nowhere/worker"), 1);
    let (_, reason) = wait(&witness, "parking", |log| log.parked.clone());
    assert!(
        reason.contains("cannot start /nowhere/worker: No such file"),
        "{reason}"
    );
    handle.stop();
}

#[test]
fn kill_from_outside_is_told_from_a_death_of_its_own() {
    let folder = tempfile::tempdir().unwrap();
    let death_of = |program: &Path, signal: Option<Signal>| {
        let (handle, witness) = start(program, 1);
        let birth = wait(&witness, "birth", |log| log.births.first().map(|birth| birth.0));
        if let Some(signal) = signal {
            kill(birth.pid, signal);
        }
        let (_, death) = wait(&witness, "death", |log| log.deaths.first().copied());
        handle.stop();
        death
    };
    let sleeper = sleeper(folder.path());
    for signal in [Signal::SIGKILL, Signal::SIGTERM] {
        assert_eq!(death_of(&sleeper, Some(signal)), Death::Outside, "{signal}");
    }
    for signal in [Signal::SIGSEGV, Signal::SIGABRT, Signal::SIGBUS] {
        assert_eq!(death_of(&sleeper, Some(signal)), Death::Own, "{signal}");
    }
    assert_eq!(death_of(&script(folder.path(), "quitter", "exit 3"), None), Death::Own);
}

#[test]
fn worker_that_hangs_up_and_stays_is_killed_for_it() {
    let folder = tempfile::tempdir().unwrap();
    let (handle, witness) = start(&sleeper(folder.path()), 1);
    let birth = wait(&witness, "birth", |log| log.births.first().map(|birth| birth.0));
    handle.hangup(birth.seat);
    let (seat, death) = wait(&witness, "death", |log| log.deaths.first().copied());
    assert_eq!((seat, death), (birth.seat, Death::Own));
    handle.stop();
}
