//! Ctrl-C and SIGTERM: the first asks the command to stop, the second stops the process.

use super::failure::Failure;
use std::future::Future;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::watch;

const EXIT_INTERRUPTED: i32 = 130;

/// Whether the user wants to stop. Cheap to clone.
#[derive(Clone, Debug)]
pub(crate) struct Interrupt {
    asked: Arc<AtomicBool>,
    changed: watch::Receiver<bool>,
}

impl Interrupt {
    /// Takes over the signals; needs a runtime.
    pub(crate) fn listen() -> Result<Self, Failure> {
        let failed = |error| Failure::failed(format!("cannot listen to signals: {error}"));
        let mut interrupted = signal(SignalKind::interrupt()).map_err(failed)?;
        let mut terminated = signal(SignalKind::terminate()).map_err(failed)?;
        let (sender, changed) = watch::channel(false);
        let asked = Arc::new(AtomicBool::new(false));
        let flag = Arc::clone(&asked);
        tokio::spawn(async move {
            loop {
                tokio::select! {
                    _ = interrupted.recv() => {}
                    _ = terminated.recv() => {}
                }
                if flag.swap(true, Ordering::Relaxed) {
                    std::process::exit(EXIT_INTERRUPTED);
                }
                // Nobody listens when nothing can be stopped.
                let _ = sender.send(true);
            }
        });
        Ok(Self { asked, changed })
    }

    /// Whether a signal came; for loops that block.
    pub(crate) fn asked(&self) -> bool {
        self.asked.load(Ordering::Relaxed)
    }

    /// Returns when a signal comes.
    pub(crate) async fn wait(&self) {
        let mut changed = self.changed.clone();
        if changed.wait_for(|asked| *asked).await.is_err() {
            // The listener lives as long as the runtime.
            std::future::pending::<()>().await;
        }
    }

    /// The result of `work`, unless a signal comes first.
    pub(crate) async fn guard<T>(&self, work: impl Future<Output = Result<T, Failure>>) -> Result<T, Failure> {
        tokio::select! {
            result = work => result,
            () = self.wait() => Err(Failure::Interrupted("nothing was written".to_owned())),
        }
    }

    /// Runs blocking `work` aside and waits for it, unless a signal comes first.
    pub(crate) async fn blocking<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> Result<T, Failure> + Send + 'static,
    ) -> Result<T, Failure> {
        self.guard(async {
            let joined = tokio::task::spawn_blocking(work).await;
            joined.unwrap_or_else(|error| Err(Failure::failed(format!("defect: {error}"))))
        })
        .await
    }
}
