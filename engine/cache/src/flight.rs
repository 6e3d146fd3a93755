//! Single flight: of all who want the same page at once, one loads it and the others wait for the outcome.
//!
//! [`Flights`] lives inside its user's lock; [`Flight`] is what the others wait on outside it.

use crate::sync::{Condvar, Mutex, MutexGuard};
use std::collections::HashMap;
use std::sync::Arc;

/// One load in progress, with outcome `T`.
#[derive(Debug)]
pub struct Flight<T> {
    outcome: Mutex<Option<T>>,
    landed: Condvar,
}

impl<T: Clone> Flight<T> {
    fn new() -> Self {
        Self {
            outcome: Mutex::new(None),
            landed: Condvar::new(),
        }
    }

    /// Blocks until the load ended, and returns its outcome.
    pub fn wait(&self) -> T {
        let mut outcome = lock(&self.outcome);
        loop {
            if let Some(outcome) = &*outcome {
                return outcome.clone();
            }
            outcome = match self.landed.wait(outcome) {
                Ok(guard) => guard,
                Err(poisoned) => poisoned.into_inner(),
            };
        }
    }

    fn land(&self, outcome: T) {
        *lock(&self.outcome) = Some(outcome);
        self.landed.notify_all();
    }
}

/// What a caller of [`Flights::join`] has to do.
#[derive(Debug)]
pub enum Role<T> {
    /// Load, then call [`Flights::land`], whatever happened.
    Lead,
    /// Release the lock, then [`Flight::wait`].
    Follow(Arc<Flight<T>>),
}

/// The loads in progress, and on whose behalf: `S` is what the leader must know of each follower.
#[derive(Debug)]
pub struct Flights<T, S> {
    aloft: HashMap<u64, (Arc<Flight<T>>, Vec<S>)>,
}

impl<T: Clone, S> Default for Flights<T, S> {
    fn default() -> Self {
        Self { aloft: HashMap::new() }
    }
}

impl<T: Clone, S> Flights<T, S> {
    /// Loads in progress.
    pub fn len(&self) -> usize {
        self.aloft.len()
    }

    /// Whether nothing is being loaded.
    pub fn is_empty(&self) -> bool {
        self.aloft.is_empty()
    }

    /// Whether this page is being loaded.
    pub fn contains(&self, key: u64) -> bool {
        self.aloft.contains_key(&key)
    }

    /// How many of the loads in progress are for a key that `which` accepts.
    pub fn count(&self, which: impl Fn(u64) -> bool) -> usize {
        self.aloft.keys().filter(|&&key| which(key)).count()
    }

    /// Joins the load of `key`, or opens it.
    pub fn join(&mut self, key: u64, follower: S) -> Role<T> {
        if let Some((flight, followers)) = self.aloft.get_mut(&key) {
            followers.push(follower);
            return Role::Follow(Arc::clone(flight));
        }
        self.aloft.insert(key, (Arc::new(Flight::new()), Vec::new()));
        Role::Lead
    }

    /// Ends the load of `key`: `each` sees every follower, then all of them wake with the outcome.
    pub fn land(&mut self, key: u64, outcome: T, each: impl FnMut(S)) {
        if let Some((flight, followers)) = self.aloft.remove(&key) {
            followers.into_iter().for_each(each);
            flight.land(outcome);
        }
    }
}

/// A poisoned lock is entered all the same: every section under it leaves whole values behind.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    match mutex.lock() {
        Ok(guard) => guard,
        Err(poisoned) => poisoned.into_inner(),
    }
}
