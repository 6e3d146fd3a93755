//! Where the USD library works: in a thread of its own, so that a panic in it, or work that has no end, is an error of the file and
//! nothing else.

use crate::error::PointsError;
use crate::limits;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{RecvTimeoutError, sync_channel};
use std::sync::{Arc, Once};
use std::thread;
use std::time::{Duration, Instant};

/// Its thread.
const THREAD: &str = "usd";
/// Room for the parser's recursion, which [`limits::USD_DEPTH_MAX`] bounds; taken as it is used.
const STACK_BYTES: usize = 64 << 20;
/// Time between two looks at the pulse.
const LOOK: Duration = Duration::from_millis(200);

/// Told by the work whenever it gets on.
#[derive(Clone, Default)]
pub(super) struct Pulse(Arc<AtomicU64>);

impl Pulse {
    pub(super) fn beat(&self) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }
}

/// Does the work and waits for it, as long as its pulse beats.
pub(super) fn contained<T: Send + 'static>(
    path: &Path,
    work: impl FnOnce(&Pulse) -> Result<T, PointsError> + Send + 'static,
) -> Result<T, PointsError> {
    keep_panics_quiet();
    let pulse = Pulse::default();
    let (answer, result) = sync_channel(1);
    let beats = pulse.clone();
    let thread = thread::Builder::new().name(THREAD.to_owned()).stack_size(STACK_BYTES);
    let thread = thread.spawn(move || {
        // Nobody listens any more to work that was given up.
        let _ = answer.send(work(&beats));
    });
    let thread = thread.map_err(PointsError::io("start a thread for", path))?;
    let stall = Duration::from_secs(limits::USD_STALL_SECS);
    let mut last = (0, Instant::now());
    loop {
        match result.recv_timeout(LOOK) {
            Ok(done) => return done,
            Err(RecvTimeoutError::Timeout) => {
                let beats = pulse.0.load(Ordering::Relaxed);
                if beats != last.0 {
                    last = (beats, Instant::now());
                } else if last.1.elapsed() > stall {
                    // The thread cannot be ended; it goes with the process.
                    let what = format!("one prim of the stage takes longer than {stall:?}: flatten it with usdcat");
                    return Err(PointsError::invalid(path, what));
                }
            }
            Err(RecvTimeoutError::Disconnected) => {
                let cause = thread.join().err();
                let text = cause.as_ref().and_then(|cause| {
                    let text = cause.downcast_ref::<&str>().copied();
                    text.or_else(|| cause.downcast_ref::<String>().map(String::as_str))
                });
                let what = format!(
                    "not a usable USD file: its reader gave up ({}): save it anew with usdcat",
                    text.unwrap_or("without a word")
                );
                return Err(PointsError::invalid(path, what));
            }
        }
    }
}

/// What a panic of that thread says is in our error; of all others it is reported as before.
fn keep_panics_quiet() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let report = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |info| {
            if thread::current().name() != Some(THREAD) {
                report(info);
            }
        }));
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panic_is_an_error_of_the_file() {
        let error = contained::<()>(Path::new("a.usda"), |_| panic!("index {} out of range", 7)).unwrap_err();
        let text = error.to_string();
        assert!(
            text.contains("index 7 out of range") && text.contains("a.usda"),
            "{text}"
        );
    }
}
