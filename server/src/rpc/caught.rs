//! A panic in a handler is an error of its caller and of nobody else: [`CatchPanics`] answers INTERNAL for it.

use super::status::status;
use crate::error::{JobError, JobErrorKind};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::pin::Pin;
use std::task::{Context, Poll};
use tonic::body::Body;
use tonic::codegen::http::Response;
use tower::{Layer, Service};

/// Puts [`Caught`] around a service.
#[derive(Clone, Copy, Debug)]
pub(super) struct CatchPanics;

/// A service whose handlers may panic.
#[derive(Clone, Debug)]
pub(super) struct Caught<S>(S);

impl<S> Layer<S> for CatchPanics {
    type Service = Caught<S>;

    fn layer(&self, inner: S) -> Self::Service {
        Caught(inner)
    }
}

impl<S, R> Service<R> for Caught<S>
where
    S: Service<R, Response = Response<Body>>,
    S::Future: Send + 'static,
{
    type Response = Response<Body>;
    type Error = S::Error;
    type Future = Answer<S::Future>;

    fn poll_ready(&mut self, cx: &mut Context<'_>) -> Poll<Result<(), S::Error>> {
        self.0.poll_ready(cx)
    }

    fn call(&mut self, request: R) -> Self::Future {
        // The service is a handle on what is shared, which stands a panic: the dispatcher's lock ends the process if one left it
        // in the middle of a change.
        Answer(catch_unwind(AssertUnwindSafe(|| Box::pin(self.0.call(request)))).ok())
    }
}

/// The handler at work; `None` once it panicked.
pub(super) struct Answer<F>(Option<Pin<Box<F>>>);

impl<F, E> Future for Answer<F>
where
    F: Future<Output = Result<Response<Body>, E>>,
{
    type Output = F::Output;

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Self::Output> {
        let polled = self
            .0
            .as_mut()
            .and_then(|handler| catch_unwind(AssertUnwindSafe(|| handler.as_mut().poll(cx))).ok());
        polled.unwrap_or_else(|| {
            self.0 = None;
            let text = "the daemon made a mistake with this request; its log says where";
            Poll::Ready(Ok(status(JobError::new(JobErrorKind::Internal, text)).into_http()))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ServerError;
    use crate::scheduler::{Death, Seat};
    use crate::supervisor::{Nursery, Plan, Supervisor, WorkerBirth, abort_on_core_panic};
    use pbgi_proto::v1;
    use pbgi_proto::v1::daemon_service_server::{DaemonService, DaemonServiceServer};
    use std::os::unix::net::UnixStream;
    use std::os::unix::process::ExitStatusExt;
    use std::process::{Command, Stdio};
    use std::time::Instant;
    use tokio_stream::wrappers::UnixListenerStream;
    use tonic::{Code, Request, Status};

    struct Clumsy;

    #[tonic::async_trait]
    impl DaemonService for Clumsy {
        async fn get_status(
            &self,
            _: Request<v1::GetStatusRequest>,
        ) -> Result<tonic::Response<v1::DaemonStatus>, Status> {
            tokio::task::yield_now().await;
            panic!("injected")
        }

        async fn get_cache(&self, _: Request<v1::GetCacheRequest>) -> Result<tonic::Response<v1::CacheStatus>, Status> {
            Ok(tonic::Response::new(v1::CacheStatus::default()))
        }

        async fn shutdown(
            &self,
            _: Request<v1::ShutdownRequest>,
        ) -> Result<tonic::Response<v1::ShutdownResponse>, Status> {
            panic!("injected")
        }
    }

    /// A nursery that panics on the supervisor's thread, or on one that bears a loader's name.
    struct Panicking {
        loader: bool,
    }

    impl Nursery for Panicking {
        fn seat(&mut self, slot: u8) -> Seat {
            let thread = std::thread::Builder::new().name("loader-0".into());
            if self.loader {
                thread.spawn(|| panic!("injected")).unwrap().join().unwrap_err();
                return Seat { slot, epoch: 1 };
            }
            panic!("injected")
        }

        fn born(&mut self, _: WorkerBirth, _: UnixStream) -> Result<(), ServerError> {
            Ok(())
        }

        fn dead(&mut self, _: Seat, _: Death) {}

        fn parked(&mut self, _: usize, _: &str) {}
    }

    const CORE_VARIABLE: &str = "PBGI_TEST_CORE";

    #[test]
    #[ignore = "ends its process; run by the test of panics"]
    fn core_thread_in_disguise() {
        let Some(which) = std::env::var_os(CORE_VARIABLE) else {
            return;
        };
        abort_on_core_panic();
        let plan = Plan {
            workers: 1,
            worker_binary: "/bin/false".into(),
            queue_socket: "/nowhere".into(),
            server_binary: "/bin/false".into(),
            spawn: Command::spawn,
        };
        let loader = which == "loader";
        let (_handle, thread) = Supervisor::start(plan, |_| Panicking { loader }).unwrap();
        // The process does not get beyond this.
        let _ = thread.join();
    }

    #[tokio::test]
    async fn panic_in_a_handler_harms_its_caller_only_and_one_in_the_core_ends_the_process() {
        const PANICS: u32 = 20;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("socket");
        let listener = tokio::net::UnixListener::bind(&path).unwrap();
        let server = super::super::server()
            .layer(CatchPanics)
            .add_service(DaemonServiceServer::new(Clumsy))
            .serve_with_incoming(UnixListenerStream::new(listener));
        let server = tokio::spawn(server);
        let connector = tower::service_fn(move |_| {
            let path = path.clone();
            async move {
                let stream = tokio::net::UnixStream::connect(path).await;
                stream.map(hyper_util::rt::TokioIo::new)
            }
        });
        let endpoint = tonic::transport::Endpoint::from_static("http://localhost");
        let channel = endpoint.connect_with_connector(connector).await.unwrap();
        let mut client = v1::daemon_service_client::DaemonServiceClient::new(channel);
        let mut slowest = std::time::Duration::ZERO;
        for number in 0..PANICS {
            // In the first step of a handler, and in a later one.
            let told = match number % 2 {
                0 => client.get_status(v1::GetStatusRequest {}).await.err(),
                _ => client.shutdown(v1::ShutdownRequest {}).await.err(),
            };
            let told = told.unwrap();
            assert!(
                told.code() == Code::Internal && told.message().contains("its log"),
                "{told}"
            );
            let begun = Instant::now();
            client.get_cache(v1::GetCacheRequest {}).await.unwrap();
            slowest = slowest.max(begun.elapsed());
        }
        server.abort();
        for core in ["supervisor", "loader"] {
            let status = Command::new(std::env::current_exe().unwrap())
                .args(["--ignored", "--exact", "rpc::caught::tests::core_thread_in_disguise"])
                .env(CORE_VARIABLE, core)
                .stdout(Stdio::null())
                .stderr(Stdio::null())
                .status()
                .unwrap();
            assert_eq!(status.signal(), Some(nix::libc::SIGABRT), "{core}: {status}");
        }
        println!(
            "RELIABILITY P14: {PANICS} panics in handlers, {PANICS} times INTERNAL, the next call on the same connection \
             answered within {slowest:.1?}; a panic of supervisor or loader ends the process by SIGABRT"
        );
    }
}
