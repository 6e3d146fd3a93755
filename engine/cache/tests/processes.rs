//! Owner and workers in processes of their own: what a killed, hung or scribbling worker does to everybody else.
//!
//! A worker is this very test binary, started again with [`worker_process`] as its only test and the miss channel as
//! its stdin.
#![cfg(not(loom))]
#![allow(clippy::unwrap_used, reason = "a failed step of a test is a failed test")]

mod support;

use pbgi_cache::channel::{PageOutcome, PageReply, PageRequest, Welcome, ask, receive, send};
use pbgi_cache::{CacheError, CacheOwner, CacheView, LocalCache, Seat};
use pbgi_core::{PageKey, PageKind};
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::net::UnixStream;
use std::os::unix::process::ExitStatusExt;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Barrier, mpsc};
use std::thread;
use std::time::{Duration, Instant};
use support::*;

const ROLE: &str = "PBGI_CACHE_TEST_ROLE";
const SEED: &str = "PBGI_SEED";
const SIGKILL: i32 = 9;
const SIGSEGV: i32 = 11;
/// Exit codes of a worker.
const WRONG_PAGE: i32 = 3;
const REFUSED: i32 = 4;
/// Far longer than anything here takes.
const PATIENCE: Duration = Duration::from_secs(60);

// The worker

/// Does nothing unless a test of this file started it.
#[test]
fn worker_process() {
    let Ok(role) = std::env::var(ROLE) else { return };
    let channel = UnixStream::from(std::io::stdin().as_fd().try_clone_to_owned().unwrap());
    let welcome: Welcome = receive(&channel).unwrap().unwrap();
    let view = match CacheView::attach(&welcome.segment, welcome.layout_hash, welcome.seat.slot) {
        Ok(view) => view,
        Err(error) => {
            eprintln!("{error}");
            std::process::exit(REFUSED);
        }
    };
    let mut worker = Worker {
        cache: LocalCache::new(view),
        channel,
        verified: 0,
    };
    match role.as_str() {
        "visit" => worker.visit(),
        "hold" => worker.hold(),
        "scribble frame" => worker.scribble_frame(),
        "scribble ledger" => worker.scribble_ledger(),
        other => panic!("{other}"),
    }
}

struct Worker {
    cache: LocalCache,
    channel: UnixStream,
    verified: u64,
}

impl Worker {
    /// Looks at pages until the channel ends: mostly some that almost fit the shared cache, so that what is evicted
    /// is wanted.
    fn visit(&mut self) {
        let seed: u64 = std::env::var(SEED).unwrap().parse().unwrap();
        let mut random = StdRng::seed_from_u64(seed);
        loop {
            let kind = if random.random_bool(0.25) { point } else { node };
            let page = if random.random_bool(0.002) {
                random.random_range(0..PAGES)
            } else {
                random.random_range(0..68)
            };
            let key = kind(page);
            let pins = self.cache.counters().shared_hits;
            if self.cache.get(key).is_none() && !self.ask(key) {
                return;
            }
            if !matches(self.cache.get(key).unwrap(), key) {
                eprintln!("a wrong page for {key:?}");
                std::process::exit(WRONG_PAGE);
            }
            self.verified += self.cache.counters().shared_hits - pins;
        }
    }

    /// Asks the owner for a page; false if the owner is gone. The request's number is the count of verified pins.
    fn ask(&mut self, key: PageKey) -> bool {
        self.cache.reserve(key.kind, 1);
        let job = u64::from(self.cache.view().slot());
        let Ok(Some(reply)) = ask(&self.channel, &PageRequest::new(self.verified, job, vec![key])) else {
            return false;
        };
        match reply.outcomes[..] {
            [PageOutcome::Pinned(fetched)] => self.cache.adopt(key, fetched.frame).unwrap(),
            _ => panic!("{}", reply.error),
        }
        true
    }

    /// Takes one page and keeps it until the channel ends.
    fn hold(&mut self) {
        assert!(self.ask(node(1)));
        assert!(matches(self.cache.get(node(1)).unwrap(), node(1)));
        let _ = receive::<PageReply>(&self.channel);
    }

    fn scribble_frame(&mut self) {
        assert!(self.ask(node(1)));
        let page = self.cache.get(node(1)).unwrap();
        // SAFETY: none: this store is the fault that the read-only mapping has to stop.
        #[expect(unsafe_code, reason = "a stray store, on purpose")]
        unsafe {
            page.as_ptr().cast_mut().write_volatile(0xff);
        }
    }

    /// Sets every bit that this process can write to: the one writable mapping of the segment.
    fn scribble_ledger(&mut self) {
        let maps = std::fs::read_to_string("/proc/self/maps").unwrap();
        let writable: Vec<_> = maps
            .lines()
            .filter(|line| line.contains("/pbgi-") && line.contains(" rw-s "))
            .collect();
        let [window] = writable[..] else { panic!("{writable:?}") };
        let (start, end) = window.split_once(' ').unwrap().0.split_once('-').unwrap();
        let [start, end] = [start, end].map(|address| usize::from_str_radix(address, 16).unwrap());
        assert_eq!(end - start, 4096, "more than the own ledger is writable");
        // SAFETY: within a writable mapping of this process; that the cache's words lie there is the point.
        #[expect(unsafe_code, reason = "stray stores, on purpose")]
        unsafe {
            std::ptr::with_exposed_provenance_mut::<u8>(start).write_bytes(0xff, end - start);
        }
        let _ = receive::<PageReply>(&self.channel);
    }
}

// The daemon

struct Started {
    seat: Seat,
    child: Child,
    channel: UnixStream,
}

fn start(owner: &CacheOwner, slot: u8, role: &str, seed: u64, layout_hash: u64) -> Started {
    // Taken before the worker lives: a request that it leaves behind must not find its successor's.
    let seat = owner.seat(slot).unwrap();
    let (ours, theirs) = UnixStream::pair().unwrap();
    let mut command = Command::new(std::env::current_exe().unwrap());
    command
        .args(["--exact", "worker_process", "--nocapture"])
        .env(ROLE, role)
        .env(SEED, seed.to_string());
    command.stdin(OwnedFd::from(theirs)).stdout(Stdio::null());
    let child = command.spawn().unwrap();
    let welcome = Welcome {
        segment: owner.segment().name().into(),
        layout_hash,
        seat,
        token: [7; 16],
        daemon_pid: std::process::id(),
        local_node_frames: owner.layout().pool(PageKind::Node).local_frames,
        local_point_frames: owner.layout().pool(PageKind::Point).local_frames,
    };
    send(&ours, &welcome).unwrap();
    Started {
        seat,
        child,
        channel: ours,
    }
}

fn start_good(owner: &CacheOwner, slot: u8, role: &str, seed: u64) -> Started {
    start(owner, slot, role, seed, owner.layout().hash())
}

/// Answers a worker until it is gone or `over`; returns the verified pins it told of.
fn serve(owner: &CacheOwner, seat: Seat, channel: &UnixStream, over: &AtomicBool, verified: &AtomicU64) {
    let mut told = 0;
    while let Ok(Some(request)) = receive::<PageRequest>(channel) {
        verified.fetch_add(request.id - told, Ordering::Relaxed);
        told = request.id;
        if over.load(Ordering::Relaxed) {
            return;
        }
        let results = request
            .keys
            .iter()
            .map(|&key| owner.fetch(seat, key, request.job, |page| fill(page, key)));
        if send(channel, &PageReply::new(request.id, results)).is_err() {
            return;
        }
    }
}

fn wait_until(what: &str, mut done: impl FnMut() -> bool) {
    let start = Instant::now();
    while !done() {
        assert!(start.elapsed() < PATIENCE, "waited in vain: {what}");
        thread::sleep(Duration::from_micros(200));
    }
}

fn seed() -> u64 {
    let seed = std::env::var(SEED).map_or_else(|_| u64::from(rand::random::<u32>()), |seed| seed.parse().unwrap());
    println!("{SEED}={seed}");
    seed
}

fn loaded_pages_are_whole(owner: &CacheOwner, slot: u8) -> u64 {
    let mut view = view(owner, slot);
    let mut resident = 0;
    for kind in [node, point] {
        for page in 0..PAGES {
            if let Some(pin) = view.pin(kind(page)) {
                check(&pin, kind(page));
                resident += 1;
            }
        }
    }
    resident
}

/// Lets the workers end, also when a test fails.
struct Over<'a>(&'a AtomicBool);

impl Drop for Over<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

// What is promised

/// One worker is killed again and again, always with a full local cache; the others go on.
fn chaos(kills: u64, pins: u64) {
    let seed = seed();
    let owner = owner(3, 64, 8, 4);
    let (over, verified) = (AtomicBool::new(false), AtomicU64::new(0));
    let mut killed = 0;
    thread::scope(|scope| {
        let (owner, over, verified) = (&owner, &over, &verified);
        let end = Over(over);
        let others = [1, 2].map(|slot| {
            scope.spawn(move || {
                let mut worker = start_good(owner, slot, "visit", seed + u64::from(slot));
                serve(owner, worker.seat, &worker.channel, over, verified);
                drop(worker.channel);
                (slot, worker.child.wait().unwrap())
            })
        });
        while killed < kills || verified.load(Ordering::Relaxed) < pins {
            let mut worker = start_good(owner, 0, "visit", seed + 3 + killed);
            let (seat, channel) = (worker.seat, worker.channel);
            let service = scope.spawn(move || serve(owner, seat, &channel, over, verified));
            wait_until("a full local cache", || owner.pins(0, PageKind::Node) == 8);
            assert_eq!(owner.overrun(), None, "a worker pins more than its share");
            worker.child.kill().unwrap();
            assert_eq!(worker.child.wait().unwrap().signal(), Some(SIGKILL), "PBGI_SEED={seed}");
            assert!(owner.reap(0).unwrap() > 0, "was killed without pins");
            service.join().unwrap();
            assert_eq!(
                owner.pins(0, PageKind::Node) + owner.pins(0, PageKind::Point),
                0,
                "a pin leaked"
            );
            killed += 1;
        }
        drop(end);
        for other in others {
            let (slot, status) = other.join().unwrap();
            assert!(status.success(), "{status}, PBGI_SEED={seed}");
            owner.reap(slot).unwrap();
        }
    });
    let before = owner.counters().node;
    assert_eq!(before.redundant_reads, 0);
    assert_eq!(before.loading, 0);
    // Every frame can be evicted: as many new pages as frames find room, and push out every old one.
    for page in 0..64 {
        load(&owner, 0, node(PAGES - 1 - page), 9);
        owner.reap(0).unwrap();
    }
    assert!(owner.counters().node.evictions >= before.evictions + 63);
    loaded_pages_are_whole(&owner, 0);
    println!(
        "RELIABILITY P1: {killed} kills, 0 pins left\nRELIABILITY P2: {killed} kills, {0} verified pins, 0 wrong pages\nRELIABILITY S10: {0} verified pins, 0 wrong pages",
        verified.load(Ordering::Relaxed)
    );
}

#[test]
fn hundred_killed_workers_leak_no_pin_and_a_million_pins_see_no_wrong_page() {
    chaos(100, 1_000_000);
}

#[test]
#[ignore = "minutes: cargo test --release -- --ignored"]
fn ten_thousand_killed_workers_leak_no_pin_and_a_hundred_million_pins_see_no_wrong_page() {
    chaos(10_000, 100_000_000);
}

#[test]
fn worker_that_dies_while_its_page_loads_disturbs_nobody() {
    let owner = owner(2, 16, 4, 2);
    for round in 0..50 {
        let key = node(1 + round);
        let mut dying = start_good(&owner, 0, "hold", 0);
        let (seat, waiting) = (owner.seat(0).unwrap(), owner.seat(1).unwrap());
        let _request: PageRequest = receive(&dying.channel).unwrap().unwrap();
        let (begun, dead) = (Barrier::new(2), Barrier::new(2));
        thread::scope(|scope| {
            let service = scope.spawn(|| {
                owner.fetch(seat, key, 1, |page| {
                    begun.wait();
                    dead.wait();
                    fill(page, key)
                })
            });
            begun.wait();
            let (owner, follower) = (&owner, waiting);
            let follower = scope.spawn(move || owner.fetch(follower, key, 1, |_| panic!("loaded twice")));
            assert_eq!(owner.counters().node.loading, 1);
            dying.child.kill().unwrap();
            dying.child.wait().unwrap();
            owner.reap(0).unwrap();
            dead.wait();
            assert!(matches!(
                service.join().unwrap(),
                Err(CacheError::StaleSeat { slot: 0, .. })
            ));
            assert!(follower.join().unwrap().is_ok());
        });
        assert_eq!((owner.pins(0, PageKind::Node), owner.pins(1, PageKind::Node)), (0, 1));
        assert_eq!(owner.counters().node.loading, 0);
        assert_eq!(owner.reap(1).unwrap(), 1);
    }
    assert_eq!(owner.counters().node.loads, 50);
    println!("RELIABILITY P3: 50 workers killed while their page was loading: 50 loads landed, 0 frames left loading");
}

fn end(mut worker: Started) -> ExitStatus {
    drop(worker.channel);
    worker.child.wait().unwrap()
}

fn serve_one(owner: &CacheOwner, slot: u8, channel: &UnixStream) {
    let request: PageRequest = receive(channel).unwrap().unwrap();
    let seat = owner.seat(slot).unwrap();
    let results = request
        .keys
        .iter()
        .map(|&key| owner.fetch(seat, key, request.job, |page| fill(page, key)));
    send(channel, &PageReply::new(request.id, results)).unwrap();
}

#[test]
fn worker_that_writes_to_a_page_dies_of_it_alone() {
    let owner = owner(2, 16, 4, 2);
    let holder = start_good(&owner, 1, "hold", 0);
    serve_one(&owner, 1, &holder.channel);
    let mut scribbler = start_good(&owner, 0, "scribble frame", 0);
    serve_one(&owner, 0, &scribbler.channel);
    assert_eq!(scribbler.child.wait().unwrap().signal(), Some(SIGSEGV));
    assert_eq!(owner.reap(0).unwrap(), 1);
    println!("RELIABILITY S5: signal {SIGSEGV} for the scribbler, every page as it was");
    assert_eq!(loaded_pages_are_whole(&owner, 0), 1);
    assert_eq!(owner.pins(1, PageKind::Node), 1);
    assert!(end(holder).success());
}

#[test]
fn worker_that_scribbles_on_its_ledger_is_named_and_evictions_resume_after_it() {
    let owner = owner(2, 16, 4, 2);
    for page in 0..16 {
        load(&owner, 1, node(page), 1);
        owner.reap(1).unwrap();
    }
    let mut scribbler = start_good(&owner, 0, "scribble ledger", 0);
    wait_until("the scribbler is named", || owner.overrun() == owner.seat(0).ok());
    let (sender, receiver) = mpsc::channel();
    thread::scope(|scope| {
        scope.spawn(|| {
            sender
                .send(owner.fetch(owner.seat(1).unwrap(), node(100), 1, |page| fill(page, node(100))))
                .unwrap()
        });
        assert!(
            receiver.recv_timeout(Duration::from_millis(50)).is_err(),
            "evicted a frame that a ledger has"
        );
        scribbler.child.kill().unwrap();
        scribbler.child.wait().unwrap();
        owner.reap(0).unwrap();
        assert!(receiver.recv_timeout(PATIENCE).unwrap().is_ok());
    });
    assert_eq!(owner.overrun(), None);
    assert_eq!(owner.counters().node.evictions, 1);
    println!("RELIABILITY S6: all bits set: the worker named, the next eviction done once it was reaped");
}

#[test]
fn worker_of_another_build_is_refused() {
    let owner = owner(1, 16, 4, 2);
    let worker = start(&owner, 0, "hold", 0, owner.layout().hash() ^ 2);
    assert_eq!(end(worker).code(), Some(REFUSED));
    println!("RELIABILITY S7: a layout of another build refused, exit code {REFUSED}");
}
