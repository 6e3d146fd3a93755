//! The miss channel: how a worker asks for pages that it did not find. Fixed-size messages over a Unix stream socket; the
//! daemon has one thread for each worker.
//!
//! What a miss waits for is not the page but threads that wake up: 30 to 100 us each on a virtual machine whose processors
//! sleep. So that thread stays on the processor of its worker ([`serve`]), which stays awake while it waits ([`ask`]): nothing
//! is woken, one thread gives way to the other, and the page is in the processor's own caches.
//!
//! ```text
//! daemon -> worker   Welcome        once, first
//! worker -> daemon   PageRequest    1 to 16 pages
//! daemon -> worker   PageReply      an outcome for each, in the same order; the pages are pinned by then
//! ```
//!
//! All numbers are little-endian. Every message begins with its magic, and every field is checked: the peer may be
//! another build.

use crate::error::{CacheError, LoadErrorKind};
use crate::frame::FrameId;
use crate::owner::{Fetched, Origin, Seat};
use crate::wire::malformed;
pub use crate::wire::{Reader, Writer};
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sched::{CpuSet, sched_getcpu, sched_setaffinity};
use nix::unistd::Pid;
use pbgi_core::limits::MOUNTS_MAX;
use pbgi_core::{MountId, PageKey, PageKind, PageNo};
use std::io::{ErrorKind, Read, Write};
use std::os::fd::AsFd;
use std::os::unix::net::UnixStream;
use std::time::{Duration, Instant};

/// Most pages in one request: a sibling group's children and a few more, never a burden on a small local cache.
pub const REQUEST_PAGES_MAX: usize = 16;

/// How long [`ask`] stays awake: several times what a page takes that the operating system holds.
const AWAKE: Duration = Duration::from_micros(60);

const NAME_BYTES: usize = 64;
const TEXT_BYTES: usize = 464;

/// A message of the miss channel.
pub trait Message: Sized {
    /// Its name, for errors.
    const NAME: &'static str;
    /// Its magic: the first four bytes.
    const MAGIC: [u8; 4];
    /// Its size, magic included.
    const BYTES: usize;

    /// Writes the fields behind the magic.
    #[doc(hidden)]
    fn put(&self, out: &mut Writer<'_>) -> Result<(), CacheError>;
    /// Reads the fields behind the magic.
    #[doc(hidden)]
    fn take(from: &mut Reader<'_>) -> Result<Self, CacheError>;

    /// The message as bytes, `BYTES` of them.
    fn encode(&self) -> Result<Vec<u8>, CacheError> {
        let mut bytes = vec![0; Self::BYTES];
        let (magic, fields) = bytes.split_at_mut(Self::MAGIC.len());
        magic.copy_from_slice(&Self::MAGIC);
        self.put(&mut Writer::new(fields, Self::NAME))?;
        Ok(bytes)
    }

    /// The message in these bytes.
    fn decode(bytes: &[u8]) -> Result<Self, CacheError> {
        if bytes.len() != Self::BYTES || !bytes.starts_with(&Self::MAGIC) {
            return Err(malformed(
                Self::NAME,
                format!("{} bytes that do not begin with its magic", bytes.len()),
            ));
        }
        Self::take(&mut Reader::new(&bytes[Self::MAGIC.len()..], Self::NAME))
    }
}

/// Sends a message; blocks until the socket took it.
pub fn send<M: Message>(mut socket: impl Write, message: &M) -> Result<(), CacheError> {
    let bytes = message.encode()?;
    socket.write_all(&bytes).map_err(|error| CacheError::Channel {
        reason: error.to_string(),
    })
}

/// Receives a message; `None` if the peer closed the channel between two messages, as it does when it ends.
pub fn receive<M: Message>(mut socket: impl Read) -> Result<Option<M>, CacheError> {
    let mut bytes = vec![0; M::BYTES];
    let mut filled = 0;
    while filled < bytes.len() {
        match socket.read(&mut bytes[filled..]) {
            Ok(0) if filled == 0 => return Ok(None),
            Ok(0) => {
                return Err(CacheError::Channel {
                    reason: format!("{} cut off after {filled} bytes", M::NAME),
                });
            }
            Ok(count) => filled += count,
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            // A peer that was killed with unread input resets instead of closing.
            Err(error) if filled == 0 && error.kind() == ErrorKind::ConnectionReset => return Ok(None),
            Err(error) => {
                return Err(CacheError::Channel {
                    reason: error.to_string(),
                });
            }
        }
    }
    M::decode(&bytes).map(Some)
}

/// Asks for pages: the worker's side. `None` if the daemon closed the channel.
pub fn ask(socket: &UnixStream, request: &PageRequest) -> Result<Option<PageReply>, CacheError> {
    send(socket, request)?;
    let start = Instant::now();
    // An error of `poll` is met again, and told, by the read.
    while poll(&mut [PollFd::new(socket.as_fd(), PollFlags::POLLIN)], PollTimeout::ZERO) == Ok(0)
        && start.elapsed() < AWAKE
    {
        std::thread::yield_now();
    }
    receive(socket)
}

/// Answers a worker until it closes the channel: the daemon's side, on a thread of its own.
pub fn serve(socket: &UnixStream, mut answer: impl FnMut(&PageRequest) -> PageReply) -> Result<(), CacheError> {
    let mut processor = PageRequest::NOWHERE;
    while let Some(request) = receive::<PageRequest>(socket)? {
        send(socket, &answer(&request))?;
        if request.processor != processor {
            processor = request.processor;
            stay_on(processor);
        }
    }
    Ok(())
}

/// Keeps this thread on a processor, if the system allows it: it is faster there, and right anywhere.
fn stay_on(processor: u16) {
    let mut set = CpuSet::new();
    if set.set(usize::from(processor)).is_ok() {
        let this_thread = Pid::from_raw(0);
        let _ = sched_setaffinity(this_thread, &set);
    }
}

/// What a worker needs to know to attach.
#[derive(Clone, PartialEq, Eq)]
pub struct Welcome {
    /// Name of the segment.
    pub segment: String,
    /// Hash of its layout.
    pub layout_hash: u64,
    /// The worker's seat.
    pub seat: Seat,
    /// Secret that proves to the queue service who this worker is.
    pub token: [u8; 16],
    /// Process id of the daemon, for the worker to check that its parent has not died meanwhile.
    pub daemon_pid: u32,
    /// Capacity of the local cache of node pages, in frames.
    pub local_node_frames: u32,
    /// Capacity of the local cache of point pages, in frames.
    pub local_point_frames: u32,
}

impl std::fmt::Debug for Welcome {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        // The token stays out of logs.
        f.debug_struct("Welcome")
            .field("segment", &self.segment)
            .field("seat", &self.seat)
            .finish_non_exhaustive()
    }
}

impl Message for Welcome {
    const NAME: &'static str = "welcome";
    const MAGIC: [u8; 4] = *b"pgW1";
    const BYTES: usize = 4 + 8 + 4 + 1 + 16 + 4 + 4 + 4 + 1 + NAME_BYTES;

    fn put(&self, out: &mut Writer<'_>) -> Result<(), CacheError> {
        out.bytes(&self.layout_hash.to_le_bytes())?;
        out.bytes(&self.seat.epoch.to_le_bytes())?;
        out.bytes(&[self.seat.slot])?;
        out.bytes(&self.token)?;
        out.bytes(&self.daemon_pid.to_le_bytes())?;
        out.bytes(&self.local_node_frames.to_le_bytes())?;
        out.bytes(&self.local_point_frames.to_le_bytes())?;
        if self.segment.len() > NAME_BYTES {
            return Err(malformed(Self::NAME, format!("a name of {} bytes", self.segment.len())));
        }
        out.bytes(&[self.segment.len() as u8])?;
        out.bytes(self.segment.as_bytes())
    }

    fn take(from: &mut Reader<'_>) -> Result<Self, CacheError> {
        let layout_hash = u64::from_le_bytes(from.bytes()?);
        let epoch = u32::from_le_bytes(from.bytes()?);
        let [slot] = from.bytes()?;
        let token = from.bytes()?;
        let [daemon_pid, local_node_frames, local_point_frames] =
            [from.bytes()?, from.bytes()?, from.bytes()?].map(u32::from_le_bytes);
        let [length] = from.bytes()?;
        let segment = from.text(usize::from(length))?;
        Ok(Self {
            segment,
            layout_hash,
            seat: Seat { slot, epoch },
            token,
            daemon_pid,
            local_node_frames,
            local_point_frames,
        })
    }
}

/// A worker asks for pages. It made room for them in its local cache before.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PageRequest {
    /// Number of the request; its reply has the same.
    pub id: u64,
    /// Number of the job that the pages are for.
    pub job: u64,
    /// The processor that the worker runs on, or [`Self::NOWHERE`].
    pub processor: u16,
    /// The pages, 1 to [`REQUEST_PAGES_MAX`].
    pub keys: Vec<PageKey>,
}

impl PageRequest {
    /// A processor that is none.
    pub const NOWHERE: u16 = u16::MAX;

    /// From the worker's own thread.
    pub fn new(id: u64, job: u64, keys: Vec<PageKey>) -> Self {
        let processor = sched_getcpu().ok().and_then(|number| number.try_into().ok());
        Self {
            id,
            job,
            processor: processor.unwrap_or(Self::NOWHERE),
            keys,
        }
    }
}

const KEY_BYTES: usize = 8;

impl Message for PageRequest {
    const NAME: &'static str = "page request";
    const MAGIC: [u8; 4] = *b"pgQ2";
    const BYTES: usize = 4 + 8 + 8 + 2 + 1 + REQUEST_PAGES_MAX * KEY_BYTES;

    fn put(&self, out: &mut Writer<'_>) -> Result<(), CacheError> {
        out.bytes(&self.id.to_le_bytes())?;
        out.bytes(&self.job.to_le_bytes())?;
        out.bytes(&self.processor.to_le_bytes())?;
        out.bytes(&[page_count(Self::NAME, self.keys.len())?])?;
        for key in &self.keys {
            out.bytes(&[key.mount.slot, key.kind as u8])?;
            out.bytes(&key.mount.generation.to_le_bytes())?;
            out.bytes(&key.page.0.to_le_bytes())?;
        }
        Ok(())
    }

    fn take(from: &mut Reader<'_>) -> Result<Self, CacheError> {
        let id = u64::from_le_bytes(from.bytes()?);
        let job = u64::from_le_bytes(from.bytes()?);
        let processor = u16::from_le_bytes(from.bytes()?);
        let [count] = from.bytes()?;
        page_count(Self::NAME, usize::from(count))?;
        let keys = (0..count).map(|_| take_key(from)).collect::<Result<_, _>>()?;
        Ok(Self {
            id,
            job,
            processor,
            keys,
        })
    }
}

fn take_key(from: &mut Reader<'_>) -> Result<PageKey, CacheError> {
    let [slot, kind] = from.bytes()?;
    let generation = u16::from_le_bytes(from.bytes()?);
    let page = PageNo(u32::from_le_bytes(from.bytes()?));
    let kind = match kind {
        0 => PageKind::Node,
        1 => PageKind::Point,
        other => return Err(malformed(PageRequest::NAME, format!("page kind {other}"))),
    };
    if usize::from(slot) >= MOUNTS_MAX {
        return Err(malformed(PageRequest::NAME, format!("mount slot {slot}")));
    }
    Ok(PageKey {
        mount: MountId { slot, generation },
        kind,
        page,
    })
}

/// What became of one page of a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PageOutcome {
    /// Resident, and pinned in the worker's name.
    Pinned(Fetched),
    /// Not to be had; [`PageReply::error`] says why for the first such page.
    Failed(LoadErrorKind),
}

/// The daemon's answer. Every page that it calls pinned has to be adopted, also when another one failed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PageReply {
    /// Number of the request.
    pub id: u64,
    /// One for each key of the request, in its order.
    pub outcomes: Vec<PageOutcome>,
    /// What the first failed page failed of; empty if none did. Cut to what fits.
    pub error: String,
}

impl PageReply {
    /// The answer that these results of [`crate::CacheOwner::fetch`] make.
    pub fn new(id: u64, results: impl IntoIterator<Item = Result<Fetched, CacheError>>) -> Self {
        let mut error = String::new();
        let outcomes = results.into_iter().map(|result| match result {
            Ok(fetched) => PageOutcome::Pinned(fetched),
            Err(failure) => {
                if error.is_empty() {
                    error = failure.to_string();
                }
                PageOutcome::Failed(failure.kind())
            }
        });
        let outcomes = outcomes.collect();
        Self { id, outcomes, error }
    }
}

const OUTCOME_BYTES: usize = 5;
const FAILED: u8 = 0x80;

impl Message for PageReply {
    const NAME: &'static str = "page reply";
    const MAGIC: [u8; 4] = *b"pgR1";
    const BYTES: usize = 4 + 8 + 1 + REQUEST_PAGES_MAX * OUTCOME_BYTES + 2 + TEXT_BYTES;

    fn put(&self, out: &mut Writer<'_>) -> Result<(), CacheError> {
        out.bytes(&self.id.to_le_bytes())?;
        out.bytes(&[page_count(Self::NAME, self.outcomes.len())?])?;
        let length = self.error.floor_char_boundary(TEXT_BYTES.min(self.error.len()));
        out.bytes(&(length as u16).to_le_bytes())?;
        out.bytes(&self.error.as_bytes()[..length])?;
        for outcome in &self.outcomes {
            let (code, frame) = match outcome {
                PageOutcome::Pinned(fetched) => (fetched.origin as u8, fetched.frame.0),
                PageOutcome::Failed(kind) => (FAILED | *kind as u8, 0),
            };
            out.bytes(&[code])?;
            out.bytes(&frame.to_le_bytes())?;
        }
        Ok(())
    }

    fn take(from: &mut Reader<'_>) -> Result<Self, CacheError> {
        let id = u64::from_le_bytes(from.bytes()?);
        let [count] = from.bytes()?;
        page_count(Self::NAME, usize::from(count))?;
        let length = usize::from(u16::from_le_bytes(from.bytes()?));
        if length > TEXT_BYTES {
            return Err(malformed(Self::NAME, format!("a text of {length} bytes")));
        }
        let error = from.text(length)?;
        let outcomes = (0..count).map(|_| take_outcome(from)).collect::<Result<_, _>>()?;
        Ok(Self { id, outcomes, error })
    }
}

fn take_outcome(from: &mut Reader<'_>) -> Result<PageOutcome, CacheError> {
    let [code] = from.bytes()?;
    let frame = FrameId(u32::from_le_bytes(from.bytes()?));
    let pinned = |origin| Ok(PageOutcome::Pinned(Fetched { frame, origin }));
    match code {
        0 => pinned(Origin::Loaded),
        1 => pinned(Origin::Resident),
        2 => pinned(Origin::ResidentOtherJob),
        _ => match (code & FAILED != 0).then(|| LoadErrorKind::try_from(code & !FAILED)) {
            Some(Ok(kind)) => Ok(PageOutcome::Failed(kind)),
            _ => Err(malformed(PageReply::NAME, format!("outcome {code}"))),
        },
    }
}

fn page_count(message: &'static str, count: usize) -> Result<u8, CacheError> {
    match count {
        1..=REQUEST_PAGES_MAX => Ok(count as u8),
        _ => Err(malformed(
            message,
            format!("{count} pages, 1 to {REQUEST_PAGES_MAX} allowed"),
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::collection::vec;
    use proptest::prelude::*;
    use std::os::unix::net::UnixStream;

    fn key(page: u32) -> PageKey {
        PageKey {
            mount: MountId {
                slot: 63,
                generation: 65_535,
            },
            kind: PageKind::Point,
            page: PageNo(page),
        }
    }

    fn welcome() -> Welcome {
        Welcome {
            segment: format!("/pbgi-{:032x}", 7),
            layout_hash: u64::MAX - 1,
            seat: Seat {
                slot: 63,
                epoch: u32::MAX,
            },
            token: *b"0123456789abcdef",
            daemon_pid: 12,
            local_node_frames: 4,
            local_point_frames: 5,
        }
    }

    fn reply() -> PageReply {
        let fetched = |origin| {
            Ok(Fetched {
                frame: FrameId(u32::MAX),
                origin,
            })
        };
        let corrupt = CacheError::Load(crate::LoadError::new(
            LoadErrorKind::Corrupt,
            "checksum \u{fc}".repeat(99),
        ));
        let mut results = vec![fetched(Origin::Loaded), fetched(Origin::Resident), Err(corrupt)];
        results.extend((3..REQUEST_PAGES_MAX).map(|_| fetched(Origin::ResidentOtherJob)));
        PageReply::new(9, results)
    }

    #[test]
    fn messages_arrive_as_sent_and_a_closed_channel_is_its_end() {
        let (mut left, mut right) = UnixStream::pair().unwrap();
        let request = PageRequest::new(1, 2, (0..16).map(key).collect());
        send(&mut left, &welcome()).unwrap();
        send(&mut left, &request).unwrap();
        send(&mut left, &reply()).unwrap();
        drop(left);
        assert_eq!(receive::<Welcome>(&mut right).unwrap().unwrap(), welcome());
        assert_eq!(receive::<PageRequest>(&mut right).unwrap().unwrap(), request);
        let received: PageReply = receive(&mut right).unwrap().unwrap();
        assert_eq!(received.outcomes, reply().outcomes);
        assert!(reply().error.starts_with(&received.error) && received.error.len() > TEXT_BYTES - 4);
        assert_eq!(receive::<PageReply>(&mut right).unwrap(), None);
    }

    #[test]
    fn message_cut_off_at_any_byte_is_an_error() {
        let bytes = welcome().encode().unwrap();
        for length in 1..bytes.len() {
            assert!(receive::<Welcome>(&bytes[..length]).is_err(), "{length}");
        }
    }

    #[test]
    fn requests_out_of_bounds_are_refused_on_both_sides() {
        for count in [0, 17, 300] {
            assert!(PageRequest::new(0, 0, vec![key(0); count]).encode().is_err());
        }
        let good = PageRequest::new(0, 0, vec![key(0)]).encode().unwrap();
        for (at, value) in [(0, b'x'), (22, 0), (22, 17), (23, 64), (24, 2)] {
            let mut bytes = good.clone();
            bytes[at] = value;
            assert!(PageRequest::decode(&bytes).is_err(), "byte {at} = {value}");
        }
    }

    proptest! {
        #[test]
        fn any_bytes_decode_to_a_message_that_encodes_or_to_an_error(bytes in vec(any::<u8>(), PageReply::BYTES)) {
            let mut reply = bytes.clone();
            reply[..4].copy_from_slice(&PageReply::MAGIC);
            reply[12] = bytes[0] % 20;
            reply[14] = 0;
            for outcome in 0..16 {
                reply[15 + outcome * 5] %= 5;
            }
            if let Ok(message) = PageReply::decode(&reply) {
                prop_assert_eq!(PageReply::decode(&message.encode().unwrap()).unwrap(), message);
            }
            let mut request = bytes[..PageRequest::BYTES].to_vec();
            request[..4].copy_from_slice(&PageRequest::MAGIC);
            if let Ok(message) = PageRequest::decode(&request) {
                prop_assert_eq!(PageRequest::decode(&message.encode().unwrap()).unwrap(), message);
            }
        }
    }
}
