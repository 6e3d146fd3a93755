//! Open scenes: which are mounted in the cache, under which id, and when they are let go.
//!
//! A scene is known by its real path and its build id. It stays mounted, and its pages warm, after the last job that used it,
//! until its path leads to another build or too many others came after it.

use crate::error::{JobError, JobErrorKind};
use crate::limits;
use pbgi_cache::{CacheError, CacheOwner};
use pbgi_core::limits::MOUNTS_MAX;
use pbgi_core::{BuildId, MountId};
use pbgi_store::{Scene, StoreError};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// A scene in use; it stays mounted while one of these exists.
#[derive(Clone)]
pub struct Mounted(Arc<Mount>);

struct Mount {
    id: MountId,
    scene: Scene,
    path: PathBuf,
    pages_loaded: AtomicU64,
}

impl Mounted {
    /// Its id in page keys.
    pub fn id(&self) -> MountId {
        self.0.id
    }

    /// The scene.
    pub fn scene(&self) -> &Scene {
        &self.0.scene
    }

    /// Counts a page read from disk.
    pub fn count_page(&self) {
        self.0.pages_loaded.fetch_add(1, Ordering::Relaxed);
    }
}

/// A mount, for people.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MountStatus {
    /// Its id in page keys.
    pub id: MountId,
    /// The real path.
    pub path: PathBuf,
    /// What is mounted.
    pub build_id: BuildId,
    /// Pages read since.
    pub pages_loaded: u64,
}

/// All mounts.
pub struct Mounts {
    cache: Arc<CacheOwner>,
    state: Mutex<Seats>,
}

struct Seats {
    seats: Vec<Option<Entry>>,
    generations: [u16; MOUNTS_MAX],
    clock: u64,
}

struct Entry {
    mount: Arc<Mount>,
    /// When it was last asked for, by the count of such requests.
    used: u64,
}

impl Mounts {
    /// None yet.
    pub fn new(cache: Arc<CacheOwner>) -> Self {
        let seats = Seats {
            seats: (0..MOUNTS_MAX).map(|_| None).collect(),
            generations: [0; MOUNTS_MAX],
            clock: 0,
        };
        Self {
            cache,
            state: Mutex::new(seats),
        }
    }

    fn lock(&self) -> MutexGuard<'_, Seats> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Opens and verifies a scene, or finds it mounted. Blocks on the disk.
    ///
    /// # Errors
    /// No scene, a damaged one, one whose pages do not fit the cache, or too many in use.
    pub fn open(&self, path: &Path) -> Result<Mounted, JobError> {
        let path = std::fs::canonicalize(path).map_err(|error| {
            let kind = match error.kind() {
                std::io::ErrorKind::NotFound => JobErrorKind::NotFound,
                _ => JobErrorKind::Precondition,
            };
            JobError::new(kind, format!("cannot open scene: {error}, at {}", path.display()))
        })?;
        let scene = Scene::open(&path).map_err(|error| store_error(&error))?;
        let build_id = scene.info().build_id;
        let mut state = self.lock();
        state.clock += 1;
        let now = state.clock;
        let same_path = |entry: &&mut Entry| entry.mount.path == path;
        if let Some(entry) = state
            .seats
            .iter_mut()
            .flatten()
            .filter(same_path)
            .find(|entry| entry.mount.scene.info().build_id == build_id)
        {
            entry.used = now;
            return Ok(Mounted(entry.mount.clone()));
        }
        self.let_go(&mut state, Some(&path));
        let Some(slot) = state.seats.iter().position(Option::is_none) else {
            let text = format!("{MOUNTS_MAX} scenes are in use; try again when a job has ended");
            return Err(JobError::new(JobErrorKind::Exhausted, text));
        };
        state.generations[slot] = state.generations[slot].wrapping_add(1);
        let id = MountId {
            slot: slot as u8,
            generation: state.generations[slot],
        };
        self.cache
            .mount(id, scene.info())
            .map_err(|error| cannot_mount(&error, &path))?;
        tracing::info!(slot, generation = id.generation, %build_id, path = %path.display(), "scene mounted");
        let pages_loaded = AtomicU64::new(0);
        let mount = Arc::new(Mount {
            id,
            scene,
            path,
            pages_loaded,
        });
        let entry = Entry {
            mount: mount.clone(),
            used: now,
        };
        state.seats[slot] = Some(entry);
        Ok(Mounted(mount))
    }

    /// The mount that a page key names.
    pub fn get(&self, id: MountId) -> Option<Mounted> {
        let state = self.lock();
        let entry = state.seats.get(usize::from(id.slot))?.as_ref()?;
        (entry.mount.id == id).then(|| Mounted(entry.mount.clone()))
    }

    /// What is mounted, in order of seats.
    pub fn list(&self) -> Vec<MountStatus> {
        let state = self.lock();
        let status = |entry: &Entry| MountStatus {
            id: entry.mount.id,
            path: entry.mount.path.clone(),
            build_id: entry.mount.scene.info().build_id,
            pages_loaded: entry.mount.pages_loaded.load(Ordering::Relaxed),
        };
        state.seats.iter().flatten().map(status).collect()
    }

    /// Unmounts a scene; whether it was mounted.
    ///
    /// # Errors
    /// A job uses it.
    pub fn close(&self, path: &Path) -> Result<bool, JobError> {
        // A scene that is gone from the disk may still be mounted under the name it had.
        let path = std::fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
        let mut state = self.lock();
        let named = |seat: &Option<Entry>| seat.as_ref().is_some_and(|entry| entry.mount.path == path);
        let Some(slot) = state.seats.iter().position(named) else {
            return Ok(false);
        };
        // As in `let_go`: one owner means that nobody else has it or can get it.
        if state.seats[slot]
            .as_ref()
            .is_some_and(|entry| Arc::strong_count(&entry.mount) > 1)
        {
            let text = "the scene is in use; try again when its jobs have ended";
            return Err(JobError::new(JobErrorKind::Precondition, text));
        }
        if let Some(entry) = state.seats[slot].take() {
            self.cache.unmount(entry.mount.id);
            tracing::info!(slot, path = %path.display(), "scene dropped");
        }
        Ok(true)
    }

    /// Unmounts what nobody uses: other builds of the path that is being opened, and the longest unused of too many.
    fn let_go(&self, state: &mut Seats, replaced: Option<&Path>) {
        // `get` hands out clones under this very lock, so one owner means that nobody else has it or can get it.
        let unused = |entry: &Entry| Arc::strong_count(&entry.mount) == 1;
        let mut idle: Vec<(u64, usize)> = Vec::new();
        for (slot, seat) in state.seats.iter().enumerate() {
            if let Some(entry) = seat.as_ref().filter(|entry| unused(entry)) {
                let stale = replaced == Some(entry.mount.path.as_path());
                idle.push((if stale { 0 } else { entry.used }, slot));
            }
        }
        idle.sort_unstable();
        let excess = (idle.len() + 1).saturating_sub(limits::MOUNTS_IDLE_MAX);
        for (index, (used, slot)) in idle.into_iter().enumerate() {
            if (index < excess || used == 0)
                && let Some(entry) = state.seats[slot].take()
            {
                self.cache.unmount(entry.mount.id);
                tracing::info!(slot, path = %entry.mount.path.display(), "scene unmounted");
            }
        }
    }
}

/// A store's error as a client's.
pub fn store_error(error: &StoreError) -> JobError {
    let kind = match error {
        StoreError::Corrupt { .. } => JobErrorKind::Corrupt,
        StoreError::Missing { .. } => JobErrorKind::NotFound,
        StoreError::Exists { .. } => JobErrorKind::Exists,
        StoreError::NoSpace { .. } | StoreError::Limit { .. } => JobErrorKind::Exhausted,
        _ => JobErrorKind::Precondition,
    };
    JobError::new(kind, error.to_string())
}

fn cannot_mount(error: &CacheError, path: &Path) -> JobError {
    let remedy = match error {
        CacheError::PageTooLarge { .. } => {
            "; build the scene with smaller pages, or start the daemon with --nodes-per-page and --points-per-page"
        }
        _ => "",
    };
    JobError::new(
        JobErrorKind::Precondition,
        format!("{error}{remedy}, at {}", path.display()),
    )
}
