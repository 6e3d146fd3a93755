//! The protocols in every interleaving that the memory model allows (up to a bound of preemptions):
//!
//!     RUSTFLAGS="--cfg loom" cargo test -p pbgi-cache --release --test loom --target-dir target/loom
//!
//! The code under test is the code in use; only the atomics and locks are loom's. `LOOM_MAX_PREEMPTIONS` changes the
//! bound.
#![cfg(loom)]
#![allow(clippy::unwrap_used, reason = "a failed step of a test is a failed test")]

use loom::cell::UnsafeCell;
use loom::sync::atomic::AtomicU64;
use loom::sync::{Arc, Mutex};
use loom::thread;
use pbgi_cache::protocol::{Barrier, FullFence, load_tag, owner_pin, publish, reap, try_claim, try_pin, unpin};
use pbgi_cache::{Flights, Role, Tag, TagState};
use pbgi_core::{MountId, PageKey, PageKind, PageNo};

const MASK: u64 = 1 << 5;
const PREEMPTIONS: usize = 3;

fn model(check: impl Fn() + Sync + Send + 'static) {
    let mut builder = loom::model::Builder::new();
    builder.preemption_bound = builder.preemption_bound.or(Some(PREEMPTIONS));
    builder.check(check);
}

fn page(page: u32) -> Tag {
    let mount = MountId { slot: 1, generation: 2 };
    Tag::resident(PageKey {
        mount,
        kind: PageKind::Node,
        page: PageNo(page),
    })
}

/// One frame, and the ledger words of two workers. The bytes of the frame are the number of its page; loom reports
/// any access to them that is not ordered with a write.
struct Frame {
    tag: AtomicU64,
    ledgers: [AtomicU64; 2],
    bytes: UnsafeCell<u32>,
}

impl Frame {
    fn holding(tag: Tag) -> Arc<Self> {
        Arc::new(Self {
            tag: AtomicU64::new(tag.0),
            ledgers: [AtomicU64::new(0), AtomicU64::new(0)],
            bytes: UnsafeCell::new(tag.page().0),
        })
    }

    fn read(&self) -> u32 {
        // SAFETY: loom's cell checks the access; by Rule 4 the caller holds a pin.
        #[expect(unsafe_code, reason = "the cell under test")]
        self.bytes.with(|bytes| unsafe { *bytes })
    }

    fn pin_and_check<B: Barrier>(&self, worker: usize, tag: Tag) -> bool {
        let pinned = try_pin::<B>(&self.tag, &self.ledgers[worker], MASK, tag);
        if pinned {
            assert_eq!(self.read(), tag.page().0, "a pinned frame changed");
        }
        pinned
    }

    fn visit<B: Barrier>(&self, worker: usize, tag: Tag) {
        if self.pin_and_check::<B>(worker, tag) {
            unpin(&self.ledgers[worker], MASK);
        }
    }

    fn replace<B: Barrier>(&self, old: Tag, new: Tag) -> bool {
        let claimed = try_claim::<B>(&self.tag, old, new.with_state(TagState::Loading), &self.ledgers, MASK);
        if claimed {
            // SAFETY: loom's cell checks the access; by Rule 6 it is exclusive.
            #[expect(unsafe_code, reason = "the cell under test")]
            self.bytes.with_mut(|bytes| unsafe { *bytes = new.page().0 });
            publish(&self.tag, new);
        }
        claimed
    }
}

fn two_workers_and_an_evictor<B: Barrier + 'static>() {
    let frame = Frame::holding(page(1));
    let workers = [0, 1].map(|worker| {
        let frame = Arc::clone(&frame);
        thread::spawn(move || {
            frame.visit::<B>(worker, page(1));
            frame.visit::<B>(worker, page(2));
        })
    });
    frame.replace::<B>(page(1), page(2));
    for worker in workers {
        worker.join().unwrap();
    }
    let tag = load_tag(&frame.tag);
    assert_eq!(frame.read(), tag.page().0);
    assert!(frame.replace::<B>(tag, page(3)), "a pin leaked");
}

#[test]
fn pinned_frame_never_changes() {
    model(two_workers_and_an_evictor::<FullFence>);
}

struct NoFence;

impl Barrier for NoFence {
    fn full() {}
}

#[test]
fn without_the_fence_the_model_finds_a_pinned_frame_that_changes() {
    let outcome = std::panic::catch_unwind(|| model(two_workers_and_an_evictor::<NoFence>));
    assert!(outcome.is_err(), "Rule 3 would be needless");
}

#[test]
fn evictor_that_returns_to_the_same_page_deceives_nobody() {
    model(|| {
        let frame = Frame::holding(page(1));
        let worker = {
            let frame = Arc::clone(&frame);
            thread::spawn(move || frame.visit::<FullFence>(0, page(1)))
        };
        if frame.replace::<FullFence>(page(1), page(2)) {
            frame.replace::<FullFence>(page(2), page(1));
        }
        worker.join().unwrap();
    });
}

#[test]
fn worker_that_dies_at_any_step_leaves_nothing_after_its_reaping() {
    for step in 0..4 {
        model(move || {
            let frame = Frame::holding(page(1));
            let dying = {
                let frame = Arc::clone(&frame);
                // The steps of `try_pin`, up to the one after which the worker is no more.
                thread::spawn(move || match step {
                    0 => drop(load_tag(&frame.tag)),
                    1 => owner_pin(&frame.ledgers[0], MASK),
                    2 => {
                        owner_pin(&frame.ledgers[0], MASK);
                        FullFence::full();
                    }
                    _ => drop(frame.pin_and_check::<FullFence>(0, page(1))),
                })
            };
            let living = {
                let frame = Arc::clone(&frame);
                thread::spawn(move || frame.visit::<FullFence>(1, page(1)))
            };
            // The owner goes on while the worker dies, is told of its end (`wait`), and repairs.
            let early = frame.replace::<FullFence>(page(1), page(2));
            dying.join().unwrap();
            reap(&frame.ledgers[..1]);
            living.join().unwrap();
            assert!(
                early || frame.replace::<FullFence>(page(1), page(2)),
                "a dead worker's pin is left after step {step}"
            );
        });
    }
}

#[test]
fn frame_that_is_tried_keeps_the_pin_its_owner_set() {
    model(|| {
        let frame = Frame::holding(page(1));
        owner_pin(&frame.ledgers[0], MASK);
        let worker = {
            let frame = Arc::clone(&frame);
            // Finds by itself what the owner pinned in its name, while the owner tries the frame.
            thread::spawn(move || {
                frame.pin_and_check::<FullFence>(0, page(1));
                assert_eq!(frame.read(), 1);
            })
        };
        assert!(!frame.replace::<FullFence>(page(1), page(2)), "an owner's pin went");
        worker.join().unwrap();
    });
}

struct Cache {
    state: Mutex<(Option<u32>, Flights<Result<u32, ()>, usize>)>,
    loads: AtomicU64,
    pins: [AtomicU64; 2],
}

/// `CacheOwner::fetch` in small: find, join or load outside the lock, land.
fn fetch(cache: &Cache, seat: usize, loaded: Result<u32, ()>) -> Result<u32, ()> {
    let mut state = cache.state.lock().unwrap();
    if let Some(page) = state.0 {
        owner_pin(&cache.pins[seat], MASK);
        return Ok(page);
    }
    if let Role::Follow(flight) = state.1.join(7, seat) {
        drop(state);
        return flight.wait();
    }
    drop(state);
    cache.loads.fetch_add(1, loom::sync::atomic::Ordering::Relaxed);
    let mut state = cache.state.lock().unwrap();
    state.0 = loaded.ok();
    if loaded.is_ok() {
        owner_pin(&cache.pins[seat], MASK);
    }
    state.1.land(7, loaded, |follower| {
        if loaded.is_ok() {
            owner_pin(&cache.pins[follower], MASK);
        }
    });
    loaded
}

fn fetch_twice(loaded: Result<u32, ()>) -> (Arc<Cache>, [Result<u32, ()>; 2]) {
    let cache = Arc::new(Cache {
        state: Mutex::new((None, Flights::default())),
        loads: AtomicU64::new(0),
        pins: [AtomicU64::new(0), AtomicU64::new(0)],
    });
    let other = {
        let cache = Arc::clone(&cache);
        thread::spawn(move || fetch(&cache, 0, loaded))
    };
    let own = fetch(&cache, 1, loaded);
    let outcomes = [other.join().unwrap(), own];
    assert!(cache.state.lock().unwrap().1.is_empty(), "a flight never landed");
    (cache, outcomes)
}

#[test]
fn of_two_who_want_a_page_one_loads_and_both_are_pinned() {
    model(|| {
        let (cache, outcomes) = fetch_twice(Ok(42));
        assert_eq!(outcomes, [Ok(42); 2]);
        assert_eq!(cache.loads.load(loom::sync::atomic::Ordering::Relaxed), 1);
        assert!(
            cache
                .pins
                .iter()
                .all(|pins| pins.load(loom::sync::atomic::Ordering::Relaxed) == MASK)
        );
    });
}

#[test]
fn of_two_who_want_a_page_that_fails_both_are_told() {
    model(|| {
        let (cache, outcomes) = fetch_twice(Err(()));
        assert_eq!(outcomes, [Err(()); 2]);
        assert!(
            cache
                .pins
                .iter()
                .all(|pins| pins.load(loom::sync::atomic::Ordering::Relaxed) == 0)
        );
    });
}
