//! The words of the scheduler: what happens, and what is to be done.

/// Number of a job, given in order of arrival.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, serde::Serialize, serde::Deserialize)]
pub struct JobNo(pub u64);

/// Number of a lease, never used twice.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct LeaseId(pub u64);

/// A worker's seat and how often it was taken; a process is known by this, never by its pid.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Seat {
    /// Below the number of workers.
    pub slot: u8,
    /// Changes whenever the seat is taken anew.
    pub epoch: u32,
}

/// What a job needs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// A build child.
    Build,
    /// Workers.
    Shade {
        /// Most workers at once.
        workers_max: usize,
    },
    /// Workers, for tiles that come with [`Event::Feed`] until [`Event::Close`]. It starts at once, outside the lanes.
    Live,
}

/// Number of a user, for fair shares.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct UserNo(pub u32);

/// What a submitter wants beside the job itself.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Order {
    /// Higher ones go first.
    pub priority: i32,
    /// Whose job it is: users of equal priority share the workers.
    pub user: UserNo,
    /// Jobs that must succeed first; those that have ended are not named.
    pub after: Vec<JobNo>,
    /// Whether it waits for [`Event::Resume`].
    pub paused: bool,
}

/// How a job ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum End {
    /// Its output is in place.
    Succeeded,
    /// It will not be; why.
    Failed(String),
    /// Somebody asked.
    Cancelled,
    /// A job that it comes after did not succeed.
    Unmet(JobNo),
    /// The daemon stops; the next one goes on with it.
    Suspended,
}

/// Something that happened.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// A job arrived.
    Submit {
        /// Its number.
        job: JobNo,
        /// Its needs.
        kind: Kind,
        /// Its place among others.
        order: Order,
    },
    /// A shading job's picture is cut into tiles.
    Prepared {
        /// The job.
        job: JobNo,
        /// Tiles with receivers, in the order of handing out.
        tiles: Vec<u32>,
    },
    /// A live job has another tile.
    Feed {
        /// The job.
        job: JobNo,
        /// The tile; each comes once.
        tile: u32,
    },
    /// A live job has no more tiles.
    Close {
        /// The job.
        job: JobNo,
    },
    /// What [`Effect::Start`] or [`Effect::Write`] began has ended (preparing ends with [`Event::Prepared`] if it went well).
    Finished {
        /// The job.
        job: JobNo,
        /// How.
        outcome: Result<(), String>,
    },
    /// Somebody asked to stop a job.
    Cancel {
        /// The job.
        job: JobNo,
    },
    /// A job may not run.
    Fail {
        /// The job.
        job: JobNo,
        /// Why.
        reason: String,
    },
    /// A job is to rest: its leased tiles are finished, and nothing else.
    Pause {
        /// The job.
        job: JobNo,
    },
    /// A paused job is to go on.
    Resume {
        /// The job.
        job: JobNo,
    },
    /// A worker asks for a tile.
    Ask {
        /// The worker.
        seat: Seat,
    },
    /// A worker shows that it lives.
    Heartbeat {
        /// The worker.
        seat: Seat,
        /// What it works on.
        lease: LeaseId,
    },
    /// A worker is done with a tile.
    Complete {
        /// The worker.
        seat: Seat,
        /// The lease of that tile.
        lease: LeaseId,
        /// Why the tile cannot be shaded.
        failure: Option<String>,
    },
    /// A worker is dead: waited for, not suspected.
    WorkerGone {
        /// The worker.
        seat: Seat,
        /// Whether it died of itself.
        death: Death,
    },
    /// No worker can be had, or one can again.
    Workless {
        /// Why not.
        reason: Option<String>,
    },
    /// Time passed.
    Tick,
    /// The daemon stops: nothing new, only leased tiles and pictures that are being written are finished.
    Drain,
}

/// Whose doing a worker's death was.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Death {
    /// Its own, or that of the kernel when memory ran out.
    Own,
    /// The daemon's.
    Killed,
    /// Somebody else's, by a signal: it says nothing about the tile.
    Outside,
}

/// Something to do.
#[derive(Clone, Debug, PartialEq)]
pub enum Effect {
    /// Begin a build, or prepare a picture.
    Start(JobNo),
    /// Stop what was started; [`Event::Finished`] is still awaited.
    Abort(JobNo),
    /// Give a tile to a worker.
    Grant {
        /// The worker.
        seat: Seat,
        /// The lease.
        lease: LeaseId,
        /// The job.
        job: JobNo,
        /// The tile.
        tile: u32,
    },
    /// Keep the result.
    Accept {
        /// The job.
        job: JobNo,
        /// The tile.
        tile: u32,
    },
    /// Throw the result away: its lease had ended.
    Drop,
    /// The lease lives.
    Alive,
    /// Kill a worker whose lease ran out, and report its death.
    Kill(Seat),
    /// A paused job's last lease ended: let go of its picture. [`Effect::Start`] brings it back.
    Park(JobNo),
    /// All tiles are there: write the picture.
    Write(JobNo),
    /// The job ended.
    Ended {
        /// The job.
        job: JobNo,
        /// How.
        end: End,
    },
    /// There may be a tile for a worker that found none.
    Wake,
}
