//! [`CrashVolume`]: a disk in memory that knows what a power loss would leave of it.

use crate::volume::{Entry, EntryKind, IoMode, Lock, RenameMode, Storage, Volume};
use nix::errno::Errno;
use std::collections::{BTreeMap, HashMap};
use std::ffi::{OsStr, OsString};
use std::io;
use std::path::{Component, Path};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// Granularity at which an unsynced write may be lost.
const SECTOR: usize = 4096;

/// How much of what was never synced survives.
#[derive(Clone, Copy, Debug)]
pub enum CrashImage {
    /// Nothing.
    Durable,
    /// Any mixture, by this seed: sectors of files one by one, names of a folder up to some change.
    Torn(u64),
}

/// Files and folders with a live and a durable state. Power is lost at a chosen event: every operation fails from then
/// on, and [`Self::after_crash`] shows what is left. An event is the moment before and the moment after each sync, and
/// the moment before each rename.
#[derive(Clone)]
pub struct CrashVolume(Arc<Mutex<Disk>>);

struct Disk {
    inodes: HashMap<u64, Inode>,
    next_inode: u64,
    events: u64,
    crash_at: Option<u64>,
    crashed: bool,
}

enum Inode {
    File { live: Vec<u8>, durable: Vec<u8> },
    Folder(Folder),
}

#[derive(Default)]
struct Folder {
    live: BTreeMap<OsString, u64>,
    durable: BTreeMap<OsString, u64>,
    /// Changes since the last sync.
    journal: Vec<Change>,
}

enum Change {
    Insert(OsString, u64),
    Remove(OsString),
    Rename(OsString, OsString),
    Exchange(OsString, OsString),
}

const ROOT: u64 = 0;

impl Default for CrashVolume {
    fn default() -> Self {
        Self::new(None)
    }
}

impl CrashVolume {
    /// An empty disk that loses power at event number `crash_at`, counted from 1.
    pub fn new(crash_at: Option<u64>) -> Self {
        let disk = Disk {
            inodes: HashMap::from([(ROOT, Inode::Folder(Folder::default()))]),
            next_inode: ROOT + 1,
            events: 0,
            crash_at,
            crashed: false,
        };
        Self(Arc::new(Mutex::new(disk)))
    }

    /// Whether the event was reached.
    pub fn crashed(&self) -> bool {
        self.disk().crashed
    }

    /// Counts events from zero again and loses power at `crash_at`.
    pub fn arm(&self, crash_at: Option<u64>) {
        let mut disk = self.disk();
        (disk.events, disk.crash_at) = (0, crash_at);
    }

    /// The disk as the next start finds it.
    pub fn after_crash(&self, image: CrashImage) -> Self {
        let old = self.disk();
        let mut random = match image {
            CrashImage::Durable => None,
            CrashImage::Torn(seed) => Some(Random(seed)),
        };
        let fresh = Self::new(None);
        let mut new = fresh.disk();
        for (&number, inode) in &old.inodes_by_number() {
            new.inodes.insert(number, inode.survivor(random.as_mut()));
        }
        new.next_inode = old.next_inode;
        drop(new);
        fresh
    }

    fn disk(&self) -> MutexGuard<'_, Disk> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Inode {
    fn survivor(&self, random: Option<&mut Random>) -> Self {
        match self {
            Self::File { live, durable } => {
                let content = random.map_or_else(|| durable.clone(), |random| torn(live, durable, random));
                Self::File {
                    live: content.clone(),
                    durable: content,
                }
            }
            Self::Folder(folder) => {
                let kept = random.map_or(0, |random| random.below(folder.journal.len() as u64 + 1) as usize);
                let mut names = folder.durable.clone();
                for change in &folder.journal[..kept] {
                    change.apply(&mut names);
                }
                Self::Folder(Folder {
                    live: names.clone(),
                    durable: names,
                    journal: Vec::new(),
                })
            }
        }
    }
}

/// Each sector, and the length, from one of the two.
fn torn(live: &[u8], durable: &[u8], random: &mut Random) -> Vec<u8> {
    let len = if random.below(2) == 0 {
        live.len()
    } else {
        durable.len()
    };
    let mut content = vec![0; len];
    for (index, sector) in content.chunks_mut(SECTOR).enumerate() {
        let source = if random.below(2) == 0 { live } else { durable };
        let source = source.get(index * SECTOR..).unwrap_or(&[]);
        let count = sector.len().min(source.len());
        sector[..count].copy_from_slice(&source[..count]);
    }
    content
}

impl Change {
    fn apply(&self, names: &mut BTreeMap<OsString, u64>) {
        match self {
            Self::Insert(name, inode) => {
                names.insert(name.clone(), *inode);
            }
            Self::Remove(name) => {
                names.remove(name);
            }
            Self::Rename(from, to) => {
                if let Some(inode) = names.remove(from) {
                    names.insert(to.clone(), inode);
                }
            }
            Self::Exchange(a, b) => {
                if let (Some(inode_a), Some(inode_b)) = (names.get(a).copied(), names.get(b).copied()) {
                    names.insert(a.clone(), inode_b);
                    names.insert(b.clone(), inode_a);
                }
            }
        }
    }
}

impl Folder {
    fn change(&mut self, change: Change) {
        change.apply(&mut self.live);
        self.journal.push(change);
    }
}

impl Disk {
    fn inodes_by_number(&self) -> BTreeMap<u64, &Inode> {
        self.inodes.iter().map(|(&number, inode)| (number, inode)).collect()
    }

    fn powered(&self) -> io::Result<()> {
        if self.crashed { Err(Errno::EIO.into()) } else { Ok(()) }
    }

    fn event(&mut self) -> io::Result<()> {
        self.events += 1;
        self.crashed |= Some(self.events) == self.crash_at;
        self.powered()
    }

    fn find(&self, path: &Path) -> io::Result<u64> {
        self.powered()?;
        let mut inode = ROOT;
        for component in path.components() {
            if let Component::Normal(name) = component {
                let next = self.folder(inode)?.live.get(name);
                inode = *next.ok_or(io::ErrorKind::NotFound)?;
            }
        }
        Ok(inode)
    }

    fn folder(&self, inode: u64) -> io::Result<&Folder> {
        match self.inodes.get(&inode) {
            Some(Inode::Folder(folder)) => Ok(folder),
            _ => Err(io::ErrorKind::NotADirectory.into()),
        }
    }

    fn folder_mut(&mut self, inode: u64) -> io::Result<&mut Folder> {
        match self.inodes.get_mut(&inode) {
            Some(Inode::Folder(folder)) => Ok(folder),
            _ => Err(io::ErrorKind::NotADirectory.into()),
        }
    }

    fn parent_of(&self, path: &Path) -> io::Result<(u64, OsString)> {
        let name = path
            .file_name()
            .map(OsStr::to_owned)
            .ok_or(io::ErrorKind::InvalidInput)?;
        Ok((self.find(path.parent().unwrap_or(Path::new("")))?, name))
    }

    fn insert(&mut self, path: &Path, inode: Inode) -> io::Result<u64> {
        let (parent, name) = self.parent_of(path)?;
        let number = self.next_inode;
        let folder = self.folder_mut(parent)?;
        if folder.live.contains_key(&name) {
            return Err(io::ErrorKind::AlreadyExists.into());
        }
        folder.change(Change::Insert(name, number));
        self.inodes.insert(number, inode);
        self.next_inode += 1;
        Ok(number)
    }

    fn remove(&mut self, path: &Path) -> io::Result<()> {
        self.find(path)?;
        let (parent, name) = self.parent_of(path)?;
        self.folder_mut(parent)?.change(Change::Remove(name));
        Ok(())
    }
}

struct CrashFile {
    volume: CrashVolume,
    inode: u64,
}

impl CrashFile {
    fn with<T>(&self, act: impl FnOnce(&mut Vec<u8>, &mut Vec<u8>) -> io::Result<T>) -> io::Result<T> {
        let mut disk = self.volume.disk();
        disk.powered()?;
        match disk.inodes.get_mut(&self.inode) {
            Some(Inode::File { live, durable }) => act(live, durable),
            _ => Err(io::ErrorKind::IsADirectory.into()),
        }
    }
}

impl Storage for CrashFile {
    fn byte_len(&self) -> io::Result<u64> {
        self.with(|live, _| Ok(live.len() as u64))
    }

    fn read_at(&self, offset: u64, out: &mut [u8]) -> io::Result<()> {
        self.with(|live, _| {
            let start = offset as usize;
            let source = live.get(start..start + out.len()).ok_or(io::ErrorKind::UnexpectedEof)?;
            out.copy_from_slice(source);
            Ok(())
        })
    }

    fn write_at(&self, offset: u64, data: &[u8]) -> io::Result<()> {
        self.with(|live, _| {
            let end = offset as usize + data.len();
            live.resize(live.len().max(end), 0);
            live[offset as usize..end].copy_from_slice(data);
            Ok(())
        })
    }

    fn set_len(&self, len: u64) -> io::Result<()> {
        self.with(|live, _| {
            live.resize(len as usize, 0);
            Ok(())
        })
    }

    fn sync(&self) -> io::Result<()> {
        self.volume.disk().event()?;
        self.with(|live, durable| {
            durable.clone_from(live);
            Ok(())
        })?;
        self.volume.disk().event()
    }
}

impl Volume for CrashVolume {
    fn create_new(&self, path: &Path, _mode: IoMode) -> io::Result<Box<dyn Storage>> {
        let file = Inode::File {
            live: Vec::new(),
            durable: Vec::new(),
        };
        let inode = self.disk().insert(path, file)?;
        Ok(Box::new(CrashFile {
            volume: self.clone(),
            inode,
        }))
    }

    fn open(&self, path: &Path) -> io::Result<Box<dyn Storage>> {
        let inode = self.disk().find(path)?;
        Ok(Box::new(CrashFile {
            volume: self.clone(),
            inode,
        }))
    }

    fn create_dir(&self, path: &Path, _mode: u32) -> io::Result<()> {
        self.disk().insert(path, Inode::Folder(Folder::default())).map(drop)
    }

    fn kind(&self, path: &Path) -> io::Result<Option<EntryKind>> {
        let disk = self.disk();
        match disk.find(path) {
            Ok(inode) if disk.folder(inode).is_ok() => Ok(Some(EntryKind::Folder)),
            Ok(_) => Ok(Some(EntryKind::File)),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        }
    }

    fn rename(&self, from: &Path, to: &Path, mode: RenameMode) -> io::Result<()> {
        let mut disk = self.disk();
        disk.event()?;
        let ((from_parent, from), (to_parent, to)) = (disk.parent_of(from)?, disk.parent_of(to)?);
        if from_parent != to_parent {
            return Err(io::ErrorKind::CrossesDevices.into());
        }
        let folder = disk.folder_mut(from_parent)?;
        let taken = folder.live.contains_key(&to);
        match mode {
            _ if !folder.live.contains_key(&from) => Err(io::ErrorKind::NotFound.into()),
            RenameMode::NoReplace if taken => Err(io::ErrorKind::AlreadyExists.into()),
            RenameMode::Exchange if !taken => Err(io::ErrorKind::NotFound.into()),
            RenameMode::NoReplace => {
                folder.change(Change::Rename(from, to));
                Ok(())
            }
            RenameMode::Exchange => {
                folder.change(Change::Exchange(from, to));
                Ok(())
            }
        }
    }

    fn remove_file(&self, path: &Path) -> io::Result<()> {
        self.disk().remove(path)
    }

    fn remove_dir(&self, path: &Path) -> io::Result<()> {
        let mut disk = self.disk();
        let inode = disk.find(path)?;
        if !disk.folder(inode)?.live.is_empty() {
            return Err(io::ErrorKind::DirectoryNotEmpty.into());
        }
        disk.remove(path)
    }

    fn list(&self, dir: &Path) -> io::Result<Vec<Entry>> {
        let disk = self.disk();
        let folder = disk.folder(disk.find(dir)?)?;
        let entry = |(name, &inode): (&OsString, &u64)| Entry {
            name: name.clone(),
            kind: if disk.folder(inode).is_ok() {
                EntryKind::Folder
            } else {
                EntryKind::File
            },
        };
        Ok(folder.live.iter().map(entry).collect())
    }

    fn sync_dir(&self, dir: &Path) -> io::Result<()> {
        let mut disk = self.disk();
        disk.event()?;
        let inode = disk.find(dir)?;
        let folder = disk.folder_mut(inode)?;
        folder.durable.clone_from(&folder.live);
        folder.journal.clear();
        disk.event()
    }

    fn free_bytes(&self, _dir: &Path) -> io::Result<u64> {
        Ok(u64::MAX)
    }

    fn age(&self, _dir: &Path) -> io::Result<Duration> {
        Ok(Duration::ZERO)
    }

    fn try_lock(&self, path: &Path) -> io::Result<Option<Lock>> {
        // One process, and every path in it is used by one owner.
        self.disk().find(path)?;
        Ok(Some(Box::new(())))
    }
}

/// SplitMix64: enough to pick survivors, and the same on every machine.
struct Random(u64);

impl Random {
    fn below(&mut self, bound: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ (z >> 31)) % bound
    }
}
