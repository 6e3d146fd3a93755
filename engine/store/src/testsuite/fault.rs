//! [`FaultVolume`]: any volume, with one operation, or all from one on, failing.

use crate::volume::{Entry, EntryKind, IoMode, Lock, RenameMode, Storage, Volume};
use nix::errno::Errno;
use std::io;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

/// Which operations are counted and may fail.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FaultScope {
    /// Every one.
    All,
    /// Those that take room on the disk: create, write, set length, sync.
    Space,
    /// Reads of file content.
    Reads,
}

/// What fails, when and how.
#[derive(Clone, Copy, Debug)]
pub struct FaultPlan {
    /// The operation that fails, counted from 1 within the scope.
    pub at: u64,
    /// Whether all later ones fail too.
    pub persistent: bool,
    /// How it fails.
    pub errno: Errno,
    /// What is counted.
    pub scope: FaultScope,
}

/// Counts operations and fails them as planned. A write that fails has written half of its bytes.
pub struct FaultVolume {
    inner: Arc<dyn Volume>,
    state: Arc<FaultState>,
}

struct FaultState {
    plan: FaultPlan,
    counted: AtomicU64,
    injected: AtomicU64,
    healed: AtomicBool,
}

impl FaultVolume {
    /// Wraps `inner`.
    pub fn new(inner: Arc<dyn Volume>, plan: FaultPlan) -> Self {
        let state = FaultState {
            plan,
            counted: AtomicU64::new(0),
            injected: AtomicU64::new(0),
            healed: AtomicBool::new(false),
        };
        Self {
            inner,
            state: Arc::new(state),
        }
    }

    /// Operations failed so far.
    pub fn injected(&self) -> u64 {
        self.state.injected.load(Ordering::Relaxed)
    }

    /// Nothing fails from now on.
    pub fn heal(&self) {
        self.state.healed.store(true, Ordering::Relaxed);
    }

    fn check(&self, scope: FaultScope) -> io::Result<()> {
        self.state.check(scope)
    }
}

impl FaultState {
    fn check(&self, scope: FaultScope) -> io::Result<()> {
        let plan = &self.plan;
        let counts = plan.scope == FaultScope::All || plan.scope == scope;
        if !counts || self.healed.load(Ordering::Relaxed) {
            return Ok(());
        }
        let number = self.counted.fetch_add(1, Ordering::Relaxed) + 1;
        if number == plan.at || (plan.persistent && number > plan.at) {
            self.injected.fetch_add(1, Ordering::Relaxed);
            return Err(plan.errno.into());
        }
        Ok(())
    }
}

struct FaultFile {
    inner: Box<dyn Storage>,
    state: Arc<FaultState>,
}

impl Storage for FaultFile {
    fn byte_len(&self) -> io::Result<u64> {
        self.state.check(FaultScope::All)?;
        self.inner.byte_len()
    }

    fn read_at(&self, offset: u64, out: &mut [u8]) -> io::Result<()> {
        self.state.check(FaultScope::Reads)?;
        self.inner.read_at(offset, out)
    }

    fn write_at(&self, offset: u64, data: &[u8]) -> io::Result<()> {
        let fault = self.state.check(FaultScope::Space);
        let written = if fault.is_ok() { data } else { &data[..data.len() / 2] };
        self.inner.write_at(offset, written)?;
        fault
    }

    fn set_len(&self, len: u64) -> io::Result<()> {
        self.state.check(FaultScope::Space)?;
        self.inner.set_len(len)
    }

    fn sync(&self) -> io::Result<()> {
        self.state.check(FaultScope::Space)?;
        self.inner.sync()
    }
}

impl Volume for FaultVolume {
    fn create_new(&self, path: &Path, mode: IoMode) -> io::Result<Box<dyn Storage>> {
        self.check(FaultScope::Space)?;
        Ok(Box::new(FaultFile {
            inner: self.inner.create_new(path, mode)?,
            state: self.state.clone(),
        }))
    }

    fn open(&self, path: &Path) -> io::Result<Box<dyn Storage>> {
        self.check(FaultScope::All)?;
        Ok(Box::new(FaultFile {
            inner: self.inner.open(path)?,
            state: self.state.clone(),
        }))
    }

    fn create_dir(&self, path: &Path, mode: u32) -> io::Result<()> {
        self.check(FaultScope::Space)?;
        self.inner.create_dir(path, mode)
    }

    fn kind(&self, path: &Path) -> io::Result<Option<EntryKind>> {
        self.check(FaultScope::All)?;
        self.inner.kind(path)
    }

    fn rename(&self, from: &Path, to: &Path, mode: RenameMode) -> io::Result<()> {
        self.check(FaultScope::All)?;
        self.inner.rename(from, to, mode)
    }

    fn remove_file(&self, path: &Path) -> io::Result<()> {
        self.check(FaultScope::All)?;
        self.inner.remove_file(path)
    }

    fn remove_dir(&self, path: &Path) -> io::Result<()> {
        self.check(FaultScope::All)?;
        self.inner.remove_dir(path)
    }

    fn list(&self, dir: &Path) -> io::Result<Vec<Entry>> {
        self.check(FaultScope::All)?;
        self.inner.list(dir)
    }

    fn sync_dir(&self, dir: &Path) -> io::Result<()> {
        self.check(FaultScope::Space)?;
        self.inner.sync_dir(dir)
    }

    fn free_bytes(&self, dir: &Path) -> io::Result<u64> {
        self.check(FaultScope::All)?;
        self.inner.free_bytes(dir)
    }

    fn age(&self, dir: &Path) -> io::Result<Duration> {
        self.check(FaultScope::All)?;
        self.inner.age(dir)
    }

    fn try_lock(&self, path: &Path) -> io::Result<Option<Lock>> {
        self.check(FaultScope::All)?;
        self.inner.try_lock(path)
    }
}
