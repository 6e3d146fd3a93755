//! Page faults: one thread a worker answers what its local and the shared cache did not have.
//!
//! The cache makes it single flight; the page is read from the scene's file straight into its frame, and its checksum is
//! verified there before anybody can find it.

use crate::dispatcher::Dispatcher;
use crate::error::ServerError;
use crate::mounts::{Mounted, Mounts, store_error};
use crate::scheduler::Seat;
use crate::supervisor::{Handle, WorkerBirth};
use pbgi_cache::channel::{self, PageReply, PageRequest, Welcome};
use pbgi_cache::{CacheError, CacheOwner, Fetched, LoadError, LoadErrorKind};
use pbgi_core::{PageKey, PageKind};
use std::os::unix::net::UnixStream;
use std::sync::Arc;

/// What a loader thread needs.
#[derive(Clone)]
pub struct Loader {
    /// Where pages go.
    pub cache: Arc<CacheOwner>,
    /// Where they come from.
    pub mounts: Arc<Mounts>,
    /// Who is told when a worker hangs up.
    pub supervisor: Handle,
    /// Who knows which tile a worker shades, for the trace.
    pub dispatcher: Arc<Dispatcher>,
}

impl Loader {
    /// Welcomes a worker and serves its page channel on a thread of its own.
    ///
    /// # Errors
    /// No thread to be had.
    pub fn serve(&self, birth: &WorkerBirth, socket: UnixStream) -> Result<(), ServerError> {
        let layout = self.cache.layout();
        let welcome = Welcome {
            segment: self.cache.segment().name().to_owned(),
            layout_hash: layout.hash(),
            seat: cache_seat(birth.seat),
            token: birth.token,
            daemon_pid: std::process::id(),
            local_node_frames: layout.pool(PageKind::Node).local_frames,
            local_point_frames: layout.pool(PageKind::Point).local_frames,
        };
        if let Err(error) = channel::send(&socket, &welcome) {
            // It is dead already: how it died says more than this error.
            tracing::debug!(slot = birth.seat.slot, %error, "worker cannot be welcomed");
            self.supervisor.hangup(birth.seat);
            return Ok(());
        }
        let loader = self.clone();
        let seat = birth.seat;
        std::thread::Builder::new()
            .name(format!("loader-{}", seat.slot))
            .spawn(move || loader.run(seat, &socket))
            .map_err(ServerError::setup("start a loader thread"))?;
        Ok(())
    }

    fn run(&self, seat: Seat, socket: &UnixStream) {
        let outcome = channel::serve(socket, |request| self.answer(seat, request));
        if let Err(error) = outcome {
            tracing::debug!(slot = seat.slot, epoch = seat.epoch, %error, "page channel failed");
        }
        self.supervisor.hangup(seat);
    }

    fn answer(&self, seat: Seat, request: &PageRequest) -> PageReply {
        let tile = self.dispatcher.tile_span(seat);
        // The disk reads what comes after the first page meanwhile.
        for key in request.keys.iter().skip(1) {
            if let Some(mount) = self.mounts.get(key.mount) {
                mount.scene().will_need(key.kind, key.page);
            }
        }
        let fetch = |&key: &PageKey| {
            let span = tracing::debug_span!(
                parent: &tile,
                "page",
                mount = key.mount.slot,
                generation = key.mount.generation,
                kind = %key.kind,
                page = key.page.0,
                origin = tracing::field::Empty,
            );
            let _entered = span.enter();
            let fetched = self.fetch(seat, key, request.job);
            match &fetched {
                Ok(fetched) => {
                    span.record("origin", tracing::field::debug(fetched.origin));
                }
                Err(error) => tracing::debug!(%error, "page not to be had"),
            }
            fetched
        };
        PageReply::new(request.id, request.keys.iter().map(fetch))
    }

    fn fetch(&self, seat: Seat, key: PageKey, job: u64) -> Result<Fetched, CacheError> {
        let mount = self.mounts.get(key.mount).ok_or(CacheError::NotMounted(key.mount))?;
        self.cache
            .fetch(cache_seat(seat), key, job, |page| read(&mount, key, page))
    }
}

fn read(mount: &Mounted, key: PageKey, page: &mut [u8]) -> Result<(), LoadError> {
    let read = mount.scene().read_page(key.kind, key.page, page);
    mount.count_page();
    read.map_err(|error| {
        let kind = match store_error(&error).kind {
            crate::error::JobErrorKind::Corrupt => LoadErrorKind::Corrupt,
            _ => LoadErrorKind::Io,
        };
        LoadError::new(kind, error.to_string())
    })
}

/// The cache's word for a seat.
pub fn cache_seat(seat: Seat) -> pbgi_cache::Seat {
    pbgi_cache::Seat {
        slot: seat.slot,
        epoch: seat.epoch,
    }
}
