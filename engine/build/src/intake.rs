//! The first stage: every point is taken from the input, looked at once, and given to the sorter. Looking is
//! done by several threads beside reading; the order is that of the input.

use crate::error::BuildError;
use crate::report::{BuildProgress, Stage, StageSeconds};
use crate::sort::sorter::Sorter;
use pbgi_core::{Bounds, InvalidPoint, PointRecord, PointStream, Quantizer};
use std::collections::VecDeque;
use std::ops::ControlFlow;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Mutex, PoisonError};
use std::thread::Builder;
use std::time::Instant;

/// Carries progress to the observer, and its wish to stop back.
pub(crate) struct Watcher<'a>(pub(crate) &'a mut dyn FnMut(BuildProgress) -> ControlFlow<()>);

impl Watcher<'_> {
    pub(crate) fn tell(&mut self, stage: Stage, done: u64, total: Option<u64>) -> Result<(), BuildError> {
        match (self.0)(BuildProgress { stage, done, total }) {
            ControlFlow::Continue(()) => Ok(()),
            ControlFlow::Break(()) => Err(BuildError::Cancelled),
        }
    }
}

/// What one look at every point tells.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Tally {
    pub(crate) points: u64,
    /// Tight box around the valid points.
    pub(crate) bounds: Bounds,
    pub(crate) radius_max: f32,
    pub(crate) radiance_clamped: u64,
    outside: Option<Misfits<[f32; 3]>>,
    invalid: Option<Misfits<InvalidPoint>>,
}

/// Points that cannot be used: how many, and what the first one is like.
#[derive(Clone, Copy, Debug)]
struct Misfits<T> {
    count: u64,
    first: u64,
    example: T,
}

impl<T> Misfits<T> {
    #[cold]
    fn count(misfits: &mut Option<Self>, index: u64, example: T) {
        let entry = misfits.get_or_insert(Self {
            count: 0,
            first: index,
            example,
        });
        entry.count += 1;
    }

    /// Adds those of a later part of the input, which starts at point `offset`.
    fn merge(misfits: &mut Option<Self>, later: Option<Self>, offset: u64) {
        let Some(later) = later else { return };
        let entry = misfits.get_or_insert(Self {
            count: 0,
            first: later.first + offset,
            ..later
        });
        entry.count += later.count;
    }
}

impl Default for Tally {
    fn default() -> Self {
        Self {
            points: 0,
            bounds: Bounds::EMPTY,
            radius_max: 0.0,
            radiance_clamped: 0,
            outside: None,
            invalid: None,
        }
    }
}

impl Tally {
    /// Looks at the next point; whether it may be used.
    #[inline]
    fn add(&mut self, point: &PointRecord, declared: Option<&Bounds>) -> bool {
        let index = self.points;
        self.points += 1;
        if let Err(reason) = point.validate() {
            Misfits::count(&mut self.invalid, index, reason);
            return false;
        }
        if declared.is_some_and(|bounds| !bounds.contains(point.position)) {
            Misfits::count(&mut self.outside, index, point.position);
            return false;
        }
        self.bounds.include(point.position);
        self.radius_max = self.radius_max.max(point.radius);
        self.radiance_clamped += u64::from(point.is_clamped());
        true
    }

    /// Adds the tally of the points that follow.
    fn merge(&mut self, later: &Self) {
        Misfits::merge(&mut self.invalid, later.invalid, self.points);
        Misfits::merge(&mut self.outside, later.outside, self.points);
        self.points += later.points;
        self.bounds.merge(&later.bounds);
        self.radius_max = self.radius_max.max(later.radius_max);
        self.radiance_clamped += later.radiance_clamped;
    }

    fn check(&self) -> Result<(), BuildError> {
        if let Some(Misfits { count, first, example }) = self.invalid {
            return Err(BuildError::InvalidPoints {
                count,
                first,
                reason: example,
            });
        }
        if let Some(Misfits { count, first, example }) = self.outside {
            return Err(BuildError::OutsideBounds {
                count,
                first,
                position: example,
            });
        }
        Ok(())
    }
}

/// All points, in the sorter.
pub(crate) struct Intake {
    pub(crate) tally: Tally,
    /// `None` if there are no points.
    pub(crate) quantizer: Option<Quantizer>,
    /// See [`PointStream::origin`].
    pub(crate) origin: [f64; 3],
    /// Reading and sorting so far.
    pub(crate) seconds: StageSeconds,
}

/// Takes everything from `stream`. Where it does not know its bounds and the points do not fit the memory, it is read
/// twice: runs need the lattice.
pub(crate) fn take_in<S: PointStream + ?Sized>(
    stream: &mut S,
    sorter: &mut Sorter,
    records_max: u64,
    watcher: &mut Watcher<'_>,
) -> Result<Intake, BuildError<S::Error>> {
    let declared = stream.bounds();
    if let Some(Bounds { min, max }) = declared.filter(|bounds| !bounds.is_empty() && lattice(bounds).is_none()) {
        return Err(BuildError::Bounds { min, max });
    }
    let mut pass = Pass {
        declared,
        quantizer: declared.as_ref().and_then(lattice),
        keeps: declared.is_some() || sorter.fits_core(),
        tally: Tally::default(),
        seconds: StageSeconds::default(),
        records_max,
    };
    pass.read(stream, sorter, watcher)?;
    if !pass.keeps {
        let measured = pass.tally.bounds;
        pass = Pass {
            declared: Some(measured),
            quantizer: lattice(&measured),
            keeps: true,
            tally: Tally::default(),
            ..pass
        };
        stream.rewind().map_err(BuildError::Input)?;
        pass.read(stream, sorter, watcher)?;
    }
    Ok(Intake {
        quantizer: pass.quantizer.or_else(|| lattice(&pass.tally.bounds)),
        origin: stream.origin(),
        tally: pass.tally,
        seconds: pass.seconds,
    })
}

fn lattice(bounds: &Bounds) -> Option<Quantizer> {
    Quantizer::from_bounds(bounds)
}

/// One reading of the input from its start.
struct Pass {
    declared: Option<Bounds>,
    quantizer: Option<Quantizer>,
    /// Whether points are kept: no longer, once they do not fit and there is no lattice to sort them by.
    keeps: bool,
    tally: Tally,
    seconds: StageSeconds,
    records_max: u64,
}

/// A batch that has been looked at.
struct Looked {
    points: Vec<PointRecord>,
    tally: Tally,
}

type Question = (Vec<PointRecord>, SyncSender<Looked>);

/// Looks at batches until there are none any more.
fn look(questions: &Mutex<Receiver<Question>>, declared: Option<&Bounds>) {
    loop {
        let next = questions.lock().unwrap_or_else(PoisonError::into_inner).recv();
        let Ok((mut points, answer)) = next else { return };
        let mut tally = Tally::default();
        let mut usable = true;
        for point in &points {
            usable &= tally.add(point, declared);
        }
        if !usable {
            // The build ends in an error: no need to keep the good ones among them.
            points.clear();
        }
        // Nobody waits for it when the build has failed.
        let _ = answer.send(Looked { points, tally });
    }
}

impl Pass {
    /// Reads to the end of the input; once more from its start, should runs that were left be those of another.
    fn read<S: PointStream + ?Sized>(
        &mut self,
        stream: &mut S,
        sorter: &mut Sorter,
        watcher: &mut Watcher<'_>,
    ) -> Result<(), BuildError<S::Error>> {
        if let Some(quantizer) = &self.quantizer
            && !sorter.fits_core()
        {
            sorter.resume(quantizer)?;
        }
        while self.run(stream, sorter, watcher)?.is_break() {
            sorter.forget().map_err(BuildError::widen)?;
            self.tally = Tally::default();
            stream.rewind().map_err(BuildError::Input)?;
        }
        Ok(())
    }

    /// Reads to the end of the input, or breaks off where its points are not those of the runs that were left.
    fn run<S: PointStream + ?Sized>(
        &mut self,
        stream: &mut S,
        sorter: &mut Sorter,
        watcher: &mut Watcher<'_>,
    ) -> Result<ControlFlow<()>, BuildError<S::Error>> {
        let total = stream.len_hint();
        let threads = sorter.threads();
        let declared = self.declared;
        let (ask, questions) = sync_channel(threads);
        let questions = Mutex::new(questions);
        std::thread::scope(|scope| {
            for _ in 0..threads {
                let questions = &questions;
                let started = Builder::new()
                    .name("pbgi-look".to_owned())
                    .spawn_scoped(scope, move || look(questions, declared.as_ref()));
                started.map_err(BuildError::Thread)?;
            }
            // Moved in, so that the threads end when this does.
            let ask: SyncSender<Question> = ask;
            let (mut asked, mut spare) = (VecDeque::new(), Vec::new());
            let mut end: Option<Result<(), S::Error>> = None;
            loop {
                let started = Instant::now();
                while end.is_none() && asked.len() < 2 * threads {
                    let mut batch: Vec<PointRecord> = spare.pop().unwrap_or_default();
                    match stream.next_batch(&mut batch) {
                        Ok(true) => {
                            let (answer, looked) = sync_channel(1);
                            asked.push_back(looked);
                            // Fails only when every thread has panicked, which the scope tells.
                            let _ = ask.send((batch, answer));
                        }
                        Ok(false) => end = Some(Ok(())),
                        Err(error) => end = Some(Err(error)),
                    }
                }
                // What was read before the end is told first.
                let Some(next) = asked.pop_front() else {
                    end.unwrap_or(Ok(())).map_err(BuildError::Input)?;
                    self.tally.check().map_err(BuildError::widen)?;
                    return Ok(match sorter.knows_no_more() {
                        true => ControlFlow::Continue(()),
                        false => ControlFlow::Break(()),
                    });
                };
                if let Ok(Looked { mut points, tally }) = next.recv() {
                    let taken = self.take(&points, &tally, total, sorter, watcher);
                    if taken.map_err(BuildError::widen)?.is_break() {
                        return Ok(ControlFlow::Break(()));
                    }
                    points.clear();
                    spare.push(points);
                }
                self.seconds.reading += started.elapsed().as_secs_f64();
                let told = watcher.tell(Stage::Reading, self.tally.points, total);
                told.map_err(BuildError::widen)?;
            }
        })
    }

    fn take(
        &mut self,
        points: &[PointRecord],
        tally: &Tally,
        total: Option<u64>,
        sorter: &mut Sorter,
        watcher: &mut Watcher<'_>,
    ) -> Result<ControlFlow<()>, BuildError> {
        self.tally.merge(tally);
        if self.tally.points > self.records_max {
            return Err(BuildError::Limit {
                what: "points",
                max: self.records_max,
            });
        }
        let Some(mut points) = sorter.skip_known(points) else {
            return Ok(ControlFlow::Break(()));
        };
        while self.keeps && !points.is_empty() {
            if sorter.buffer().room() == 0 {
                self.make_room(total, sorter, watcher)?;
                continue;
            }
            let (head, tail) = points.split_at(sorter.buffer().room().min(points.len()));
            sorter.buffer().extend(head);
            points = tail;
        }
        Ok(ControlFlow::Continue(()))
    }

    #[cold]
    fn make_room(
        &mut self,
        total: Option<u64>,
        sorter: &mut Sorter,
        watcher: &mut Watcher<'_>,
    ) -> Result<(), BuildError> {
        let Some(quantizer) = &self.quantizer else {
            sorter.buffer().clear();
            self.keeps = false;
            return Ok(());
        };
        let started = Instant::now();
        watcher.tell(Stage::Sorting, self.tally.points, total)?;
        sorter.spill(quantizer)?;
        let seconds = started.elapsed().as_secs_f64();
        self.seconds.sorting += seconds;
        // The caller's clock runs on.
        self.seconds.reading -= seconds;
        Ok(())
    }
}
