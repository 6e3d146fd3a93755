//! The wall clock, for records, logs and time stamps of files only: no job's fate is decided by it.

use std::time::{SystemTime, UNIX_EPOCH};

/// The time to stamp a file with.
#[expect(clippy::disallowed_methods, reason = "the one place that tells people the time")]
pub fn now() -> SystemTime {
    SystemTime::now()
}

/// Milliseconds since the Unix epoch.
pub fn unix_millis() -> i64 {
    let since = now().duration_since(UNIX_EPOCH);
    let millis = since.map_or(0, |since| i64::try_from(since.as_millis()).unwrap_or(i64::MAX));
    #[cfg(test)]
    let millis = millis + SHIFT_MILLIS.get();
    millis
}

#[cfg(test)]
thread_local! {
    /// How far a test has moved this thread's wall clock.
    pub(crate) static SHIFT_MILLIS: std::cell::Cell<i64> = const { std::cell::Cell::new(0) };
}
