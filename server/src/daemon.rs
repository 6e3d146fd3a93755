//! The daemon from its first breath to its last: takes its sockets, its orders and its end of life as arguments.

use crate::config::{Changes, Config, Options};
use crate::dispatcher::Dispatcher;
use crate::error::ServerError;
use crate::http;
use crate::limits;
use crate::loader::{Loader, cache_seat};
use crate::mounts::Mounts;
use crate::roots::Roots;
use crate::rpc;
use crate::scheduler::{Death, Seat};
use crate::state::StateDir;
use crate::supervisor::{Handle, Nursery, Plan, Supervisor, WorkerBirth};
use crate::table::JobTable;
use nix::unistd::Gid;
use pbgi_cache::{CacheOwner, Segment};
use pbgi_store::{OsVolume, sweep_scratch};
use std::fs;
use std::io;
use std::net::SocketAddr;
use std::os::unix::fs::{PermissionsExt, chown as std_chown};
use std::os::unix::net::{UnixListener as StdUnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;
use tokio::net::{TcpListener, UnixListener};
use tokio::sync::watch;
use tokio::task::JoinHandle;

/// The sockets, bound.
#[derive(Debug)]
pub struct Listeners {
    jobs: UnixListener,
    queue: UnixListener,
    http: UnixListener,
    tcp: Option<TcpListener>,
    http_tcp: Option<TcpListener>,
    /// Names to remove in the end: those that we made.
    made: Vec<PathBuf>,
}

impl Listeners {
    /// Binds the sockets of a configuration; `activated` is the clients' one if a service manager has bound it. Needs a
    /// runtime.
    ///
    /// # Errors
    /// A name that is taken by a living daemon, or the system refuses.
    pub fn bind(config: &Config, activated: Option<StdUnixListener>) -> Result<Self, ServerError> {
        let (jobs_path, queue_path) = (config.options.jobs_socket(), config.options.queue_socket());
        let (jobs, mut made) = match activated {
            Some(listener) => {
                let taken = listener
                    .set_nonblocking(true)
                    .and_then(|()| UnixListener::from_std(listener));
                (
                    taken.map_err(ServerError::setup("take the service manager's socket"))?,
                    Vec::new(),
                )
            }
            None => {
                let group = config.options.access.group;
                (bind(&jobs_path, group)?, vec![jobs_path])
            }
        };
        let queue = bind(&queue_path, None)?;
        made.push(queue_path);
        let http_path = config.options.http_socket();
        let http = bind(&http_path, config.options.access.group)?;
        made.push(http_path);
        let http_tcp = config.options.access.http.map(bind_tcp).transpose()?;
        let tcp = match &config.options.access.tcp {
            Some(tcp) => Some(bind_tcp(tcp.address)?),
            None => None,
        };
        Ok(Self {
            jobs,
            queue,
            http,
            http_tcp,
            tcp,
            made,
        })
    }
}

fn bind(path: &Path, group: Option<Gid>) -> Result<UnixListener, ServerError> {
    match UnixStream::connect(path) {
        Ok(_) => {
            return Err(ServerError::Setup {
                action: "bind a socket",
                reason: format!("another daemon listens there, at {}", path.display()),
            });
        }
        // Left behind by a daemon that died.
        Err(error) if error.kind() == io::ErrorKind::ConnectionRefused => {
            fs::remove_file(path).map_err(ServerError::io("remove a stale socket", path))?;
        }
        Err(_) => {}
    }
    let listener = UnixListener::bind(path).map_err(ServerError::io("bind a socket", path))?;
    let protect = |mode, path: &Path| {
        std_chown(path, None, group.map(Gid::as_raw))?;
        fs::set_permissions(path, fs::Permissions::from_mode(mode))
    };
    let protected = match (group, path.parent()) {
        (Some(_), Some(folder)) => protect(0o660, path).and_then(|()| protect(0o750, folder)),
        _ => protect(0o600, path),
    };
    protected.map_err(ServerError::io("protect a socket", path))?;
    Ok(listener)
}

fn bind_tcp(address: SocketAddr) -> Result<TcpListener, ServerError> {
    let bound = std::net::TcpListener::bind(address).and_then(|listener| {
        listener.set_nonblocking(true)?;
        TcpListener::from_std(listener)
    });
    bound.map_err(|error| ServerError::Setup {
        action: "listen on TCP",
        reason: format!("{error}, at {address}"),
    })
}

/// How far the daemon is told to stop.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum Stop {
    /// Not at all.
    #[default]
    Run,
    /// Finish what is leased, then end.
    Drain,
    /// End at once.
    Now,
}

/// Turns in the daemon's life that a service manager wants to hear of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Life {
    /// The sockets are served and the segment is reserved.
    Ready,
    /// A few times a second: it can still take its own lock.
    Alive,
    /// It drains.
    Stopping,
}

/// What the daemon is told while it runs.
#[derive(Clone, Debug)]
pub struct Orders {
    /// How far it is to stop.
    pub stop: watch::Receiver<Stop>,
    /// Options that were read again: what can change takes them over.
    pub reload: watch::Receiver<Option<Options>>,
}

/// Runs until told to stop, idle for too long, or broken. `tell` is called at every turn of [`Life`].
///
/// # Errors
/// What kept it from starting.
pub async fn run(
    config: Config,
    state: StateDir,
    listeners: Listeners,
    tell: impl Fn(Life),
    mut orders: Orders,
) -> Result<(), ServerError> {
    let paths = listeners.made.clone();
    let outcome = run_daemon(&config, &state, listeners, tell, &mut orders).await;
    for path in paths {
        // A stale socket is removed by the next start as well.
        let _ = fs::remove_file(path);
    }
    outcome
}

async fn run_daemon(
    config: &Config,
    state: &StateDir,
    listeners: Listeners,
    tell: impl Fn(Life),
    orders: &mut Orders,
) -> Result<(), ServerError> {
    sweep(config, state)?;
    let remote = config
        .options
        .access
        .tcp
        .as_ref()
        .map(|tcp| rpc::Remote::new(&tcp.auth))
        .transpose()?;
    let name = Segment::unique_name()?;
    state.note_segment(&name)?;
    let segment = Segment::create(&name, &config.layout).inspect_err(|_| state.forget_segment())?;
    let cache = Arc::new(CacheOwner::new(segment));
    let (table, rows) = JobTable::open(state.path()).inspect_err(|_| unlink(&name, state))?;
    let (dispatcher, supervisor) = start(config, cache, Arc::new(table)).inspect_err(|_| unlink(&name, state))?;
    dispatcher.restore(rows, rpc::stored_request);
    let (ending, ended) = watch::channel(false);
    let users = rpc::Gate::users(&config.options.access);
    let mut changing = Changing {
        options: config.options.clone(),
        users: users.clone(),
        remote: remote.as_ref().map(rpc::Remote::gate),
    };
    let mut servers = vec![
        tokio::spawn(rpc::serve_jobs(
            listeners.jobs,
            users,
            dispatcher.clone(),
            ended.clone(),
        )),
        tokio::spawn(rpc::serve_queue(listeners.queue, dispatcher.clone(), ended.clone())),
    ];
    servers.push(tokio::spawn(http::serve_unix(
        listeners.http,
        dispatcher.clone(),
        ended.clone(),
    )));
    if let Some(listener) = listeners.http_tcp {
        servers.push(tokio::spawn(http::serve_tcp(
            listener,
            dispatcher.clone(),
            ended.clone(),
        )));
    }
    if let (Some(listener), Some(remote)) = (listeners.tcp, remote) {
        servers.push(tokio::spawn(rpc::serve_tcp(
            listener,
            remote,
            dispatcher.clone(),
            ended,
        )));
    }
    tracing::info!(
        version = env!("CARGO_PKG_VERSION"),
        pid = std::process::id(),
        memory_bytes = config.memory.total_bytes,
        segment_bytes = config.layout.total_bytes(),
        workers = config.options.workers,
        "ready"
    );
    for line in config.explain() {
        tracing::info!("{line}");
    }
    tell(Life::Ready);
    serve(&mut changing, &dispatcher, &tell, orders).await;
    tell(Life::Stopping);
    tracing::info!("stopping");
    drain(&dispatcher, &orders.stop).await;
    ending.send_replace(true);
    let reaped = tokio::task::spawn_blocking(move || supervisor.stop()).await;
    if let Err(error) = reaped {
        tracing::error!(%error, "stopping the children panicked");
    }
    let patience = match *orders.stop.borrow() {
        Stop::Now => limits::DISCONNECT_NOW_MAX,
        _ => limits::DISCONNECT_MAX,
    };
    let deadline = tokio::time::Instant::now() + patience;
    for server in servers {
        disconnect(server, deadline).await;
    }
    // Others may still hold the segment's owner for a moment: its name goes now.
    unlink(&name, state);
    if let Ok(Err(error)) = dispatcher.table.ticket().await {
        tracing::error!(error, "the last changes of jobs are lost");
    }
    tracing::info!("stopped");
    Ok(())
}

fn unlink(name: &str, state: &StateDir) {
    if let Err(error) = Segment::unlink(name) {
        tracing::error!(%error, "cannot remove the segment");
    }
    state.forget_segment();
}

/// Cleans up after a daemon that died.
fn sweep(config: &Config, state: &StateDir) -> Result<(), ServerError> {
    if let Some(name) = state.sweep_segment()? {
        tracing::warn!(name, "removed the segment of a daemon that died");
    }
    let scratch = &config.options.scratch_dir;
    match sweep_scratch(&OsVolume, scratch) {
        Ok(swept) if swept.folders > 0 => tracing::warn!(?swept, "removed scratch of a daemon that died"),
        Ok(_) => {}
        Err(error) => tracing::warn!(%error, "cannot sweep scratch"),
    }
    crate::bounce::sweep(scratch);
    if let Err(error) = crate::output::sweep(scratch) {
        tracing::warn!(%error, "cannot sweep scratch");
    }
    Ok(())
}

/// Starts the supervisor and, through it, the workers.
fn start(
    config: &Config,
    cache: Arc<CacheOwner>,
    table: Arc<JobTable>,
) -> Result<(Arc<Dispatcher>, Handle), ServerError> {
    let options = &config.options;
    let plan = Plan {
        workers: options.workers as u8,
        worker_binary: options.worker_binary.clone(),
        queue_socket: options.queue_socket(),
        server_binary: options.server_binary.clone(),
        spawn: std::process::Command::spawn,
    };
    let roots = Roots::open(&options.access.roots)?;
    let mut made = None;
    let runtime = tokio::runtime::Handle::current();
    let (handle, _) = Supervisor::start(plan, |supervisor| {
        let mounts = Arc::new(Mounts::new(cache.clone()));
        let dispatcher = Dispatcher::new(
            config.clone(),
            cache.clone(),
            mounts.clone(),
            supervisor.clone(),
            table,
            roots,
            runtime,
        );
        let dispatcher = made.insert(Arc::new(dispatcher)).clone();
        Nurse(Loader {
            cache,
            mounts,
            supervisor,
            dispatcher,
        })
    })?;
    match made {
        Some(dispatcher) => Ok((dispatcher, handle)),
        None => Err(ServerError::Setup {
            action: "start the supervisor",
            reason: "it was not asked for its nursery".into(),
        }),
    }
}

async fn serve(changing: &mut Changing, dispatcher: &Arc<Dispatcher>, tell: &impl Fn(Life), orders: &mut Orders) {
    /// Ticks between two looks at the segment's name.
    const SEGMENT_TICKS: u32 = 5;
    let mut requested = dispatcher.stop_requested();
    let mut clock = tokio::time::interval(limits::TICK);
    clock.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    let mut ticks = 0_u32;
    loop {
        tokio::select! {
            _ = clock.tick() => {}
            _ = orders.stop.wait_for(|stop| *stop >= Stop::Drain) => return,
            _ = requested.wait_for(|stop| *stop) => return,
            Ok(()) = orders.reload.changed() => {
                let options = orders.reload.borrow_and_update().clone();
                options.into_iter().for_each(|options| changing.reload(&options, dispatcher));
            }
        }
        dispatcher.tick();
        tell(Life::Alive);
        ticks = ticks.wrapping_add(1);
        if ticks.is_multiple_of(SEGMENT_TICKS) {
            dispatcher.check_segment();
        }
        if let (Some(limit), Some(idle)) = (changing.options.idle, dispatcher.idle_time())
            && idle >= limit
        {
            tracing::info!(seconds = idle.as_secs(), "idle for long enough");
            return;
        }
    }
}

/// What may change while the daemon runs, and who must hear of it.
struct Changing {
    options: Options,
    users: rpc::Gate,
    remote: Option<rpc::Gate>,
}

impl Changing {
    /// Takes over what can change, or nothing if there is something wrong with it.
    fn reload(&mut self, new: &Options, dispatcher: &Dispatcher) {
        match self.try_reload(new, dispatcher) {
            Ok(Changes { taken, left }) => {
                let list = |keys: &[&str]| match keys {
                    [] => "nothing".to_owned(),
                    keys => keys.join(", "),
                };
                tracing::info!(
                    "the configuration was read again: {} changed, {} changes at the next start",
                    list(&taken),
                    list(&left)
                );
            }
            Err(error) => tracing::error!(%error, "the configuration stays as it was"),
        }
    }

    fn try_reload(&mut self, new: &Options, dispatcher: &Dispatcher) -> Result<Changes, ServerError> {
        let mut options = self.options.clone();
        let mut changes = options.take_over(new);
        options.check_roots()?;
        let roots = Roots::open(&options.access.roots)?;
        // A secret may change while the names of its files do not.
        let remote = match (&self.remote, &options.access.tcp) {
            (Some(gate), Some(tcp)) => Some((gate, rpc::Gate::remote(&tcp.auth)?)),
            _ => None,
        };
        if remote.is_some_and(|(gate, new)| gate.change(&new)) {
            changes.taken.push("tokens");
        }
        self.users.change(&rpc::Gate::users(&options.access));
        dispatcher.change_roots(roots);
        self.options = options;
        Ok(changes)
    }
}

/// Lets leased tiles end, but not for ever.
async fn drain(dispatcher: &Arc<Dispatcher>, stop: &watch::Receiver<Stop>) {
    dispatcher.drain();
    let deadline = Instant::now() + limits::DRAIN_MAX;
    let mut clock = tokio::time::interval(limits::TICK / 4);
    while !dispatcher.is_idle() && Instant::now() < deadline && *stop.borrow() < Stop::Now {
        clock.tick().await;
        dispatcher.tick();
    }
}

async fn disconnect(mut server: JoinHandle<Result<(), ServerError>>, deadline: tokio::time::Instant) {
    match tokio::time::timeout_at(deadline, &mut server).await {
        Ok(Ok(Ok(()))) => {}
        Ok(Ok(Err(error))) => tracing::error!(%error, "server failed"),
        Ok(Err(error)) => tracing::error!(%error, "server panicked"),
        // Clients that keep their connections are cut off.
        Err(_) => server.abort(),
    }
}

/// What the supervisor tells, passed on to those concerned.
struct Nurse(Loader);

impl Nursery for Nurse {
    fn seat(&mut self, slot: u8) -> Seat {
        // The slots are the cache's own, so there is always a seat.
        let epoch = self.0.cache.seat(slot).map_or(0, |seat| seat.epoch);
        Seat { slot, epoch }
    }

    fn born(&mut self, birth: WorkerBirth, channel: UnixStream) -> Result<(), ServerError> {
        self.0.dispatcher.worker_born(birth);
        self.0.serve(&birth, channel)
    }

    fn dead(&mut self, seat: Seat, death: Death) {
        // First the pins: a tile that goes out again must find frames to evict.
        match self.0.cache.seat(seat.slot) {
            Ok(current) if current == cache_seat(seat) => match self.0.cache.reap(seat.slot) {
                Ok(pins) => tracing::debug!(slot = seat.slot, epoch = seat.epoch, pins, "seat reaped"),
                Err(error) => tracing::error!(%error, "cannot reap a seat"),
            },
            _ => tracing::error!(slot = seat.slot, epoch = seat.epoch, "a dead worker had no seat"),
        }
        self.0.dispatcher.worker_dead(seat, death);
    }

    fn parked(&mut self, slots: usize, reason: &str) {
        self.0.dispatcher.workers_parked(slots, reason);
    }
}
