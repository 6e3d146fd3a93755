//! The segment's life: create, reserve, check, unlink. The only file besides `attach` that makes shared memory calls.

use crate::error::CacheError;
use crate::layout::{ALIGN, SegmentLayout};
use crate::map::SegmentMap;
use nix::errno::Errno;
use nix::fcntl::{OFlag, posix_fallocate};
use nix::sys::mman::{shm_open, shm_unlink};
use nix::sys::stat::{Mode, fstat};
use nix::unistd::{SysconfVar, sysconf};
use shared_memory::{Shmem, ShmemConf, ShmemError};
use std::fs::File;
use std::io::Read;
use std::os::fd::OwnedFd;
use std::ptr::NonNull;

/// Every segment of this program is called this and 32 hexadecimal digits.
const NAME_PREFIX: &str = "/pbgi-";
const NAME_DIGITS: usize = 32;
/// Where the system keeps shared memory objects; asked only for how much room is left.
const SHM_DIRECTORY: &str = "/dev/shm";

/// The daemon's hold on the segment: made and reserved by [`Segment::create`], unlinked on drop.
///
/// `shared_memory` creates, maps and unlinks it. It leaves the memory unreserved, where a touch may end in SIGBUS, so
/// it is reserved here before the first touch.
pub struct Segment {
    map: SegmentMap,
    name: String,
    inode: (u64, u64),
    // Unmapped last (fields drop in order), and unlinked by `Drop`, which does not rely on a descriptor being non-zero.
    _memory: Mapping,
}

struct Mapping(Shmem);

// SAFETY: Rule 9: the mapping is process-wide, used through `SegmentMap` only, and unmapped once, by whichever thread
// drops it.
unsafe impl Send for Mapping {}
// SAFETY: as above; `Mapping` has no methods.
unsafe impl Sync for Mapping {}

impl Segment {
    /// A name that nobody can guess (128 random bits). Write it to the state file before [`Segment::create`], so that
    /// whatever happens the next start can [`Segment::unlink`] it.
    pub fn unique_name() -> Result<String, CacheError> {
        let mut random = [0; NAME_DIGITS / 2];
        File::open("/dev/urandom")
            .and_then(|mut source| source.read_exact(&mut random))
            .map_err(|error| os("name", NAME_PREFIX, error))?;
        Ok(format!("{NAME_PREFIX}{:032x}", u128::from_le_bytes(random)))
    }

    /// Creates the segment, with mode 0600, and reserves all of it. A segment of that name must not exist. On error
    /// nothing is left behind.
    pub fn create(name: &str, layout: &SegmentLayout) -> Result<Self, CacheError> {
        let needed = layout.total_bytes();
        // Asked first, because an attempt to reserve takes what there is before it fails; the attempt itself is what
        // counts.
        match available() {
            Some(available) if available < needed => Err(CacheError::NoSpace { needed, available }),
            _ => Self::create_unasked(name, layout),
        }
    }

    fn create_unasked(name: &str, layout: &SegmentLayout) -> Result<Self, CacheError> {
        check_name(name)?;
        check_page_size(name)?;
        let needed = layout.total_bytes();
        let bytes = usize::try_from(needed).map_err(|error| os("size", name, error))?;
        let created = ShmemConf::new().os_id(name).size(bytes).create();
        let memory = Mapping(created.map_err(|error| match error {
            ShmemError::MappingIdExists => CacheError::Exists { name: name.into() },
            other => {
                // `shared_memory` leaves the name behind if its descriptor happens to be 0.
                let _ = shm_unlink(name);
                os("create", name, other)
            }
        })?);
        // From here on dropping `guard` unlinks the name on every way out.
        let guard = Unlink(name);
        let descriptor = open(name, OFlag::O_RDWR)?;
        reserve(name, &descriptor, needed)?;
        let status = fstat(&descriptor).map_err(|error| os("inspect", name, error))?;
        let base = NonNull::new(memory.0.as_ptr()).ok_or_else(|| os("map", name, "null address"))?;
        // SAFETY: Rules 1 and 9: freshly mapped with that many bytes, reserved above, kept in `_memory` beside the
        // map, and written through the map alone.
        let map = unsafe { SegmentMap::new(base, *layout) };
        // SAFETY: Rule 9: the segment is new and its name known to nobody who would attach before it is handed out.
        unsafe { map.write_header(&layout.header()) };
        std::mem::forget(guard);
        Ok(Self {
            map,
            name: name.into(),
            inode: (status.st_dev, status.st_ino),
            _memory: memory,
        })
    }

    /// Removes a segment that an earlier daemon left behind, by the name in the state file. Returns whether there was
    /// one.
    ///
    /// Only names of this program's making are accepted. Processes that still map the segment keep it until they end.
    pub fn unlink(name: &str) -> Result<bool, CacheError> {
        check_name(name)?;
        match shm_unlink(name) {
            Ok(()) => Ok(true),
            Err(Errno::ENOENT) => Ok(false),
            Err(error) => Err(os("unlink", name, error)),
        }
    }

    /// The name, for the worker's welcome.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The layout.
    pub fn layout(&self) -> &SegmentLayout {
        self.map.layout()
    }

    /// Whether the name still leads to this segment. If somebody removed it, running workers go on, new ones cannot
    /// attach.
    pub fn linked(&self) -> Result<bool, CacheError> {
        let descriptor = match shm_open(self.name.as_str(), OFlag::O_RDONLY, Mode::empty()) {
            Ok(descriptor) => descriptor,
            Err(Errno::ENOENT) => return Ok(false),
            Err(error) => return Err(os("open", &self.name, error)),
        };
        let status = fstat(&descriptor).map_err(|error| os("inspect", &self.name, error))?;
        Ok((status.st_dev, status.st_ino) == self.inode)
    }

    pub(crate) fn map(&self) -> &SegmentMap {
        &self.map
    }
}

impl Drop for Segment {
    fn drop(&mut self) {
        // A name that somebody else took meanwhile is theirs; `shared_memory` would unlink it unseen.
        if !self.linked().unwrap_or(true) {
            self._memory.0.set_owner(false);
        } else {
            let _ = shm_unlink(self.name.as_str());
        }
    }
}

impl std::fmt::Debug for Segment {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Segment")
            .field("name", &self.name)
            .field("layout", self.layout())
            .finish_non_exhaustive()
    }
}

struct Unlink<'a>(&'a str);

impl Drop for Unlink<'_> {
    fn drop(&mut self) {
        let _ = shm_unlink(self.0);
    }
}

/// Opens a segment by name.
pub(crate) fn open(name: &str, access: OFlag) -> Result<OwnedFd, CacheError> {
    shm_open(name, access | OFlag::O_CLOEXEC, Mode::empty()).map_err(|error| os("open", name, error))
}

pub(crate) fn check_name(name: &str) -> Result<(), CacheError> {
    let digits = name.strip_prefix(NAME_PREFIX).unwrap_or_default();
    if digits.len() == NAME_DIGITS && digits.bytes().all(|byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f')) {
        return Ok(());
    }
    Err(CacheError::Name { name: name.into() })
}

/// Windows of a ledger are mapped one by one: a larger system page would let a worker write to its neighbour's.
pub(crate) fn check_page_size(name: &str) -> Result<(), CacheError> {
    match sysconf(SysconfVar::PAGE_SIZE) {
        Ok(Some(bytes)) if bytes == ALIGN as i64 => Ok(()),
        found => Err(os(
            "map",
            name,
            format!("memory pages of {ALIGN} bytes are needed, the system has {found:?}"),
        )),
    }
}

pub(crate) fn os(action: &'static str, name: &str, reason: impl std::fmt::Display) -> CacheError {
    CacheError::Os {
        action,
        name: name.into(),
        reason: reason.to_string(),
    }
}

/// Makes the file system set every byte aside, or say now that it cannot.
fn reserve(name: &str, descriptor: &OwnedFd, needed: u64) -> Result<(), CacheError> {
    let length = i64::try_from(needed).map_err(|error| os("reserve", name, error))?;
    loop {
        match posix_fallocate(descriptor, 0, length) {
            Ok(()) => return Ok(()),
            Err(Errno::EINTR) => {}
            // EFBIG: beyond what the file system can ever hold.
            Err(Errno::ENOSPC | Errno::EFBIG) => {
                return Err(CacheError::NoSpace {
                    needed,
                    available: available().unwrap_or(0),
                });
            }
            Err(error) => return Err(os("reserve", name, error)),
        }
    }
}

/// Bytes left for shared memory, if that can be told.
fn available() -> Option<u64> {
    let status = nix::sys::statvfs::statvfs(SHM_DIRECTORY).ok()?;
    Some(status.blocks_available() * status.fragment_size())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layout::PoolLayout;

    #[test]
    fn reservation_that_fails_leaves_no_segment_and_no_signal() {
        let status = nix::sys::statvfs::statvfs(SHM_DIRECTORY).unwrap();
        let size = status.blocks() * status.fragment_size();
        let frames = size / (16 << 20) + 2;
        if frames > 1 << 24 {
            eprintln!("SKIPPED: {SHM_DIRECTORY} of {size} bytes is too large to exceed");
            return;
        }
        let point = PoolLayout {
            frame_bytes: 4096,
            frames: 8,
            local_frames: 1,
        };
        let node = PoolLayout {
            frame_bytes: 16 << 20,
            frames: frames as u32,
            local_frames: 1,
        };
        let layout = SegmentLayout::new(1, 1, node, point).unwrap();
        let name = Segment::unique_name().unwrap();
        match Segment::create_unasked(&name, &layout) {
            Err(CacheError::NoSpace { needed, available }) => assert!(needed > size && available <= size),
            other => panic!("{other:?}"),
        }
        assert!(!Segment::unlink(&name).unwrap(), "a segment was left");
    }
}
