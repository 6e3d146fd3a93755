//! The scheduler against seeded histories of arrivals, deaths, hangs, cancels and late answers.

use super::*;
use std::collections::BTreeSet;

const SHADE: Kind = Kind::Shade {
    workers_max: usize::MAX,
};

fn seat(slot: u8, epoch: u32) -> Seat {
    Seat { slot, epoch }
}

fn submit(job: JobNo, kind: Kind) -> Event {
    let order = Order::default();
    Event::Submit { job, kind, order }
}

/// A picture of so many tiles, ready to be handed out.
fn add(scheduler: &mut Scheduler, number: u64, order: Order, tiles: u32, now: Instant) -> Vec<Effect> {
    let (job, kind) = (JobNo(number), SHADE);
    let effects = scheduler.on(Event::Submit { job, kind, order }, now);
    if effects.contains(&Effect::Start(job)) {
        let tiles = (0..tiles).collect();
        scheduler.on(Event::Prepared { job, tiles }, now);
    }
    effects
}

fn next(scheduler: &mut Scheduler, seat: Seat, now: Instant) -> Option<u64> {
    match scheduler.on(Event::Ask { seat }, now).as_slice() {
        [Effect::Grant { job, .. }] => Some(job.0),
        _ => None,
    }
}

fn order(priority: i32, user: u32) -> Order {
    Order {
        priority,
        user: UserNo(user),
        ..Order::default()
    }
}

fn shading(tiles: u32) -> (Scheduler, Instant) {
    let now = Instant::now();
    let mut scheduler = Scheduler::default();
    let job = JobNo(1);
    assert_eq!(scheduler.on(submit(job, SHADE), now), [Effect::Start(job)]);
    let tiles = (0..tiles).collect();
    assert_eq!(scheduler.on(Event::Prepared { job, tiles }, now), [Effect::Wake]);
    (scheduler, now)
}

fn grant(scheduler: &mut Scheduler, seat: Seat, now: Instant) -> Option<(LeaseId, u32)> {
    match scheduler.on(Event::Ask { seat }, now).as_slice() {
        [] => None,
        [Effect::Grant { lease, tile, .. }] => Some((*lease, *tile)),
        other => panic!("unexpected {other:?}"),
    }
}

#[test]
fn silent_worker_is_killed_before_its_tile_goes_out_again() {
    let (mut scheduler, start) = shading(1);
    let (lease, tile) = grant(&mut scheduler, seat(0, 1), start).unwrap();
    let later = start + HEARTBEAT_EXPIRY;
    assert_eq!(scheduler.on(Event::Tick, later), [Effect::Kill(seat(0, 1))]);
    assert_eq!(scheduler.on(Event::Tick, later), []);
    assert_eq!(grant(&mut scheduler, seat(1, 1), later), None);
    let late = Event::Complete {
        seat: seat(0, 1),
        lease,
        failure: None,
    };
    assert_eq!(scheduler.on(late, later), [Effect::Drop]);
    assert_eq!(grant(&mut scheduler, seat(0, 1), later), None);
    let gone = Event::WorkerGone {
        seat: seat(0, 1),
        death: Death::Killed,
    };
    assert_eq!(scheduler.on(gone, later), [Effect::Wake]);
    assert_eq!(
        grant(&mut scheduler, seat(1, 1), later).map(|(_, tile)| tile),
        Some(tile)
    );
}

#[test]
fn heartbeats_do_not_outlast_the_total_time() {
    let (mut scheduler, start) = shading(1);
    let (lease, _) = grant(&mut scheduler, seat(0, 1), start).unwrap();
    let mut now = start;
    while now < start + LEASE_EXPIRY - Duration::from_secs(1) {
        now += Duration::from_secs(1);
        assert_eq!(
            scheduler.on(
                Event::Heartbeat {
                    seat: seat(0, 1),
                    lease
                },
                now
            ),
            [Effect::Alive]
        );
        assert_eq!(scheduler.on(Event::Tick, now), []);
    }
    assert_eq!(
        scheduler.on(Event::Tick, start + LEASE_EXPIRY),
        [Effect::Kill(seat(0, 1))]
    );
    assert_eq!(
        scheduler.on(
            Event::Heartbeat {
                seat: seat(0, 1),
                lease
            },
            now
        ),
        []
    );
}

#[test]
fn poison_tile_fails_its_job_at_the_third_death() {
    let (mut scheduler, now) = shading(4);
    for epoch in 1..=TILE_DEATHS_MAX {
        let (_, tile) = grant(&mut scheduler, seat(0, epoch), now).unwrap();
        assert_eq!(tile, 0);
        let gone = Event::WorkerGone {
            seat: seat(0, epoch),
            death: Death::Own,
        };
        let effects = scheduler.on(gone, now);
        let failed = effects.iter().any(|effect| {
            matches!(
                effect,
                Effect::Ended {
                    end: End::Failed(_),
                    ..
                }
            )
        });
        assert_eq!(failed, epoch == TILE_DEATHS_MAX, "{effects:?}");
    }
    assert!(scheduler.is_idle());
}

#[test]
fn kills_by_others_do_not_poison_a_tile() {
    let (mut scheduler, now) = shading(1);
    for epoch in 1..20 {
        grant(&mut scheduler, seat(0, epoch), now).unwrap();
        let gone = Event::WorkerGone {
            seat: seat(0, epoch),
            death: if epoch % 2 == 0 { Death::Killed } else { Death::Outside },
        };
        assert_eq!(scheduler.on(gone, now), [Effect::Wake]);
    }
}

#[test]
fn late_message_of_a_recycled_seat_is_refused() {
    let (mut scheduler, now) = shading(1000);
    for epoch in 1..=1000 {
        let (lease, _) = grant(&mut scheduler, seat(0, epoch), now).unwrap();
        let stale = Event::Complete {
            seat: seat(0, epoch - 1),
            lease,
            failure: None,
        };
        assert_eq!(scheduler.on(stale, now), [Effect::Drop]);
        let stale = Event::Heartbeat {
            seat: seat(0, epoch - 1),
            lease,
        };
        assert_eq!(scheduler.on(stale, now), []);
        let gone = Event::WorkerGone {
            seat: seat(0, epoch),
            death: Death::Killed,
        };
        scheduler.on(gone, now);
    }
    println!("RELIABILITY P13: 1,000 recycled seats, 0 of 2,000 stale messages taken");
}

#[test]
fn builds_and_pictures_start_in_order_of_arrival_in_their_lanes() {
    let now = Instant::now();
    let mut scheduler = Scheduler::default();
    let mut started = Vec::new();
    for number in 0..10 {
        let kind = if number % 2 == 0 { Kind::Build } else { SHADE };
        let job = JobNo(number);
        started.extend(scheduler.on(submit(job, kind), now));
    }
    let expected: Vec<Effect> = [0, 1, 3, 5, 7]
        .into_iter()
        .map(|number| Effect::Start(JobNo(number)))
        .collect();
    assert_eq!(started, expected);
    let outcome = Ok(());
    let effects = scheduler.on(Event::Finished { job: JobNo(0), outcome }, now);
    let end = End::Succeeded;
    assert_eq!(effects, [Effect::Ended { job: JobNo(0), end }, Effect::Start(JobNo(2))]);
}

#[test]
fn drain_finishes_leased_tiles_and_leaves_the_rest_to_the_next_daemon() {
    let (mut scheduler, now) = shading(2);
    let (lease, _) = grant(&mut scheduler, seat(0, 1), now).unwrap();
    assert_eq!(scheduler.on(Event::Drain, now), []);
    assert_eq!(grant(&mut scheduler, seat(1, 1), now), None);
    let done = Event::Complete {
        seat: seat(0, 1),
        lease,
        failure: None,
    };
    let effects = scheduler.on(done, now);
    assert!(
        matches!(
            effects.last(),
            Some(Effect::Ended {
                end: End::Suspended,
                ..
            })
        ),
        "{effects:?}"
    );
    assert!(scheduler.is_idle());
}

#[test]
fn failed_tile_is_tried_three_times() {
    let (mut scheduler, now) = shading(2);
    for attempt in 1..=TILE_FAILURES_MAX {
        let tile = loop {
            let (lease, tile) = grant(&mut scheduler, seat(0, 1), now).unwrap();
            if tile == 0 {
                break lease;
            }
            // The other one is fine, and tile 0 comes after it.
            let done = (seat(0, 1), lease, None);
            let (seat, lease, failure) = done;
            scheduler.on(Event::Complete { seat, lease, failure }, now);
        };
        let failure = Some("io: no luck".to_owned());
        let event = Event::Complete {
            seat: seat(0, 1),
            lease: tile,
            failure,
        };
        let effects = scheduler.on(event, now);
        let failed = |effect: &Effect| {
            matches!(
                effect,
                Effect::Ended {
                    end: End::Failed(_),
                    ..
                }
            )
        };
        assert_eq!(effects.iter().any(failed), attempt == TILE_FAILURES_MAX, "{effects:?}");
    }
    assert!(scheduler.is_idle());
}

#[test]
fn higher_priority_goes_first_and_may_overtake_a_full_lane() {
    let now = Instant::now();
    let mut scheduler = Scheduler::default();
    for number in 0..SHADES_ACTIVE_MAX as u64 {
        add(&mut scheduler, number, order(0, 0), 9, now);
    }
    assert_eq!(add(&mut scheduler, 10, order(0, 0), 9, now), []);
    assert_eq!(add(&mut scheduler, 11, order(5, 0), 9, now), [Effect::Start(JobNo(11))]);
    assert_eq!(add(&mut scheduler, 12, order(9, 0), 9, now), []);
    assert_eq!(next(&mut scheduler, seat(0, 1), now), Some(11));
    let job = JobNo(0);
    let effects = scheduler.on(Event::Cancel { job }, now);
    assert_eq!(effects[1..], [Effect::Start(JobNo(12))]);
}

#[test]
fn users_of_equal_priority_share_the_workers_equally() {
    let now = Instant::now();
    let mut scheduler = Scheduler::default();
    // One user came first, with three jobs; the other has one.
    for number in 0..3 {
        add(&mut scheduler, number, order(0, 1), 100, now);
    }
    add(&mut scheduler, 3, order(0, 2), 100, now);
    let granted: Vec<u64> = (0..8)
        .filter_map(|slot| next(&mut scheduler, seat(slot, 1), now))
        .collect();
    assert_eq!(granted.iter().filter(|&&job| job == 3).count(), 4, "{granted:?}");
    // One worker: turns.
    let mut scheduler = Scheduler::default();
    add(&mut scheduler, 0, order(0, 1), 100, now);
    add(&mut scheduler, 1, order(0, 2), 100, now);
    let mut turns = Vec::new();
    for _ in 0..6 {
        let effects = scheduler.on(Event::Ask { seat: seat(0, 1) }, now);
        let [Effect::Grant { lease, job, .. }] = effects[..] else {
            panic!("{effects:?}")
        };
        turns.push(job.0);
        let (seat, failure) = (seat(0, 1), None);
        scheduler.on(Event::Complete { seat, lease, failure }, now);
    }
    assert_eq!(turns, [0, 1, 0, 1, 0, 1]);
}

#[test]
fn job_starts_after_those_it_comes_after_and_ends_with_them() {
    let now = Instant::now();
    let mut scheduler = Scheduler::default();
    let (build, shade, last) = (JobNo(0), JobNo(1), JobNo(2));
    scheduler.on(submit(build, Kind::Build), now);
    let after = |job| Order {
        after: vec![job],
        ..Order::default()
    };
    assert_eq!(add(&mut scheduler, 1, after(build), 1, now), []);
    assert_eq!(add(&mut scheduler, 2, after(shade), 1, now), []);
    let outcome = Ok(());
    let effects = scheduler.on(Event::Finished { job: build, outcome }, now);
    let end = End::Succeeded;
    assert_eq!(effects, [Effect::Ended { job: build, end }, Effect::Start(shade)]);
    let outcome = Err("no G-buffer".to_owned());
    let effects = scheduler.on(Event::Finished { job: shade, outcome }, now);
    assert_eq!(
        effects[1],
        Effect::Ended {
            job: last,
            end: End::Unmet(shade)
        }
    );
    assert!(scheduler.is_idle());
}

#[test]
fn paused_picture_finishes_its_leases_then_makes_room_and_comes_back() {
    let (mut scheduler, now) = shading(3);
    let job = JobNo(1);
    let (lease, _) = grant(&mut scheduler, seat(0, 1), now).unwrap();
    assert_eq!(scheduler.on(Event::Pause { job }, now), []);
    assert_eq!(grant(&mut scheduler, seat(1, 1), now), None);
    let (seat_, failure) = (seat(0, 1), None);
    let effects = scheduler.on(
        Event::Complete {
            seat: seat_,
            lease,
            failure,
        },
        now,
    );
    assert_eq!(effects.last(), Some(&Effect::Park(job)));
    assert_eq!(scheduler.counts(), (1, 0));
    assert_eq!(scheduler.on(Event::Resume { job }, now), [Effect::Start(job)]);
    let tiles = vec![1, 2];
    assert_eq!(scheduler.on(Event::Prepared { job, tiles }, now), [Effect::Wake]);
    assert_eq!(grant(&mut scheduler, seat(0, 1), now).map(|(_, tile)| tile), Some(1));
}

#[test]
fn lease_of_a_former_life_does_not_touch_the_job_that_is_tried_again() {
    let (mut scheduler, now) = shading(1);
    let job = JobNo(1);
    let (lease, _) = grant(&mut scheduler, seat(0, 1), now).unwrap();
    scheduler.on(Event::Cancel { job }, now);
    add(&mut scheduler, 1, Order::default(), 1, now);
    let (old, failure) = (seat(0, 1), None);
    let late = Event::Complete {
        seat: old,
        lease,
        failure,
    };
    assert_eq!(scheduler.on(late, now), [Effect::Drop]);
    assert_eq!(grant(&mut scheduler, seat(1, 1), now).map(|(_, tile)| tile), Some(0));
}

#[test]
fn without_workers_pictures_fail_with_the_reason_until_one_asks() {
    let (mut scheduler, now) = shading(2);
    let reason = Some("no program".to_owned());
    let effects = scheduler.on(Event::Workless { reason }, now);
    let end = End::Failed("no program".into());
    assert_eq!(
        effects,
        [Effect::Ended {
            job: JobNo(1),
            end: end.clone()
        }]
    );
    let job = JobNo(2);
    scheduler.on(submit(job, SHADE), now);
    let tiles = vec![0];
    assert_eq!(
        scheduler.on(Event::Prepared { job, tiles }, now),
        [Effect::Ended { job, end }]
    );
    grant(&mut scheduler, seat(0, 1), now);
    let job = JobNo(3);
    scheduler.on(submit(job, SHADE), now);
    let tiles = vec![0];
    assert_eq!(scheduler.on(Event::Prepared { job, tiles }, now), [Effect::Wake]);
}

#[test]
fn live_job_takes_tiles_as_they_come_and_ends_when_closed() {
    let now = Instant::now();
    let mut scheduler = Scheduler::default();
    let (job, kind, order) = (JobNo(1), Kind::Live, Order::default());
    assert_eq!(scheduler.on(Event::Submit { job, kind, order }, now), []);
    assert_eq!(grant(&mut scheduler, seat(0, 1), now), None);
    assert_eq!(scheduler.on(Event::Feed { job, tile: 7 }, now), [Effect::Wake]);
    let (lease, tile) = grant(&mut scheduler, seat(0, 1), now).unwrap();
    assert_eq!(tile, 7);
    assert_eq!(scheduler.on(Event::Close { job }, now), []);
    assert_eq!(scheduler.on(Event::Feed { job, tile: 8 }, now), []);
    let (seat, failure) = (seat(0, 1), None);
    let effects = scheduler.on(Event::Complete { seat, lease, failure }, now);
    let end = End::Succeeded;
    assert_eq!(effects, [Effect::Accept { job, tile: 7 }, Effect::Ended { job, end }]);
}

#[test]
fn gap_of_an_hour_between_ticks_kills_each_worker_once_and_loses_nothing() {
    let (mut scheduler, start) = shading(2);
    let first = grant(&mut scheduler, seat(0, 1), start).unwrap();
    let second = grant(&mut scheduler, seat(1, 1), start).unwrap();
    let later = start + Duration::from_secs(3_600);
    let kills = scheduler.on(Event::Tick, later);
    assert_eq!(kills, [Effect::Kill(seat(0, 1)), Effect::Kill(seat(1, 1))]);
    assert_eq!(scheduler.on(Event::Tick, later), []);
    for slot in [0, 1] {
        let (seat, death) = (seat(slot, 1), Death::Killed);
        scheduler.on(Event::WorkerGone { seat, death }, later);
    }
    let mut again: Vec<u32> = (0..2)
        .filter_map(|slot| grant(&mut scheduler, seat(slot, 2), later))
        .map(|(_, tile)| tile)
        .collect();
    again.sort_unstable();
    assert_eq!(again, [first.1.min(second.1), first.1.max(second.1)]);
    assert_eq!(scheduler.on(Event::Tick, later), []);
    println!("RELIABILITY O2: 1 h between two ticks, 2 leases expired once, both tiles handed out again");
}

mod simulation;
