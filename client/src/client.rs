//! The connection to a daemon.

use crate::cache::CacheStatus;
use crate::convert;
use crate::error::{ClientError, Refusal};
use crate::job::{BuildJob, DaemonStatus, Job, JobOptions, ShadeJob};
use crate::shape::SceneShape;
use hyper_util::rt::TokioIo;
use pbgi_core::SceneInfo;
use pbgi_proto::v1;
use pbgi_proto::v1::daemon_service_client::DaemonServiceClient;
use pbgi_proto::v1::job_service_client::JobServiceClient;
use pbgi_proto::v1::scene_service_client::SceneServiceClient;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::Duration;
use tokio::net::UnixStream;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Identity};
use tonic::{Code, Request, Status};

/// Until the daemon accepts a connection.
const CONNECT_SECS: u64 = 5;
/// Until an ordinary request is answered.
pub(crate) const REQUEST_SECS: u64 = 30;
/// Until a scene is opened and verified.
const SCENE_SECS: u64 = 120;
/// Until a daemon has finished what is leased.
const SHUTDOWN_SECS: u64 = 60;
/// A list of ten thousand jobs stays below this.
pub(crate) const RESPONSE_BYTES_MAX: usize = 32 << 20;

/// Connects to a socket. One whose queue is full, because many connect at once, is asked again for a while.
async fn reach(socket: &Path) -> std::io::Result<UnixStream> {
    const PAUSE: Duration = Duration::from_millis(10);
    let deadline = tokio::time::Instant::now() + Duration::from_secs(CONNECT_SECS);
    loop {
        match UnixStream::connect(socket).await {
            Err(error) if error.kind() == ErrorKind::WouldBlock && tokio::time::Instant::now() < deadline => {
                tokio::time::sleep(PAUSE).await;
            }
            outcome => return outcome,
        }
    }
}

/// A connection to one daemon. Cheap to clone; clones share the connection.
#[derive(Clone, Debug)]
pub struct Client {
    pub(crate) channel: Channel,
    address: String,
    token: Option<MetadataValue<Ascii>>,
}

impl Client {
    /// Connects to the daemon at `uri`: `unix:/path/to/jobs.sock`, or the path alone.
    ///
    /// # Errors
    /// An address of another form; nobody listens there.
    pub async fn connect(uri: &str) -> Result<Self, ClientError> {
        Self::connect_path(&socket_path(uri)?).await
    }

    /// Connects to the daemon whose jobs socket is `socket`.
    ///
    /// # Errors
    /// Nobody listens there.
    pub async fn connect_path(socket: &Path) -> Result<Self, ClientError> {
        let unreachable = |reason: String| ClientError::Connect {
            path: socket.to_owned(),
            reason,
        };
        // The transport's own error says "transport error" only: ask the socket first.
        reach(socket).await.map_err(|error| unreachable(error.to_string()))?;
        let path = socket.to_owned();
        let connector = tower::service_fn(move |_| {
            let path = path.clone();
            async move { reach(&path).await.map(TokioIo::new) }
        });
        // The authority is a formality: the connector knows where to go.
        let channel = Endpoint::from_static("http://localhost")
            .connect_timeout(Duration::from_secs(CONNECT_SECS))
            .connect_with_connector(connector)
            .await
            .map_err(|error| unreachable(chain(&error)))?;
        Ok(Self {
            channel,
            address: format!("unix:{}", socket.display()),
            token: None,
        })
    }

    /// Connects to a daemon on another machine, `https://host:port`, by mutual TLS. `identity` is a folder with `ca.pem`, who
    /// signed the daemon's certificate; `cert.pem` and `key.pem`, who we are; and `token`, if the daemon wants one.
    ///
    /// # Errors
    /// A file that is missing or unusable, another address, or nobody who listens there and knows us.
    pub async fn connect_remote(uri: &str, identity: &Path) -> Result<Self, ClientError> {
        let read = |name: &str| {
            let path = identity.join(name);
            std::fs::read_to_string(&path).map_err(|source| ClientError::Io {
                action: "read",
                path,
                source,
            })
        };
        let unreachable = |reason: String| ClientError::Connect {
            path: PathBuf::from(uri),
            reason,
        };
        let tls = ClientTlsConfig::new()
            .ca_certificate(Certificate::from_pem(read("ca.pem")?))
            .identity(Identity::from_pem(read("cert.pem")?, read("key.pem")?));
        let token = match read("token") {
            Ok(token) => {
                let header = format!("Bearer {}", token.trim()).parse::<MetadataValue<Ascii>>();
                Some(header.map_err(|_| unreachable("the token is no plain text".to_owned()))?)
            }
            Err(ClientError::Io { source, .. }) if source.kind() == ErrorKind::NotFound => None,
            Err(error) => return Err(error),
        };
        let endpoint = Endpoint::from_shared(uri.to_owned()).map_err(|_| ClientError::Address(uri.to_owned()))?;
        let channel = endpoint
            .connect_timeout(Duration::from_secs(CONNECT_SECS))
            .tls_config(tls)
            .map_err(|error| unreachable(chain(&error)))?
            .connect()
            .await
            .map_err(|error| unreachable(chain(&error)))?;
        Ok(Self {
            channel,
            address: uri.to_owned(),
            token,
        })
    }

    /// Where this client is connected to.
    pub fn address(&self) -> &str {
        &self.address
    }

    fn request<T>(&self, wish: &Wish, message: T) -> Request<T> {
        self.sign(wish.request(message))
    }

    pub(crate) fn sign<T>(&self, mut request: Request<T>) -> Request<T> {
        if let Some(token) = &self.token {
            request.metadata_mut().insert("authorization", token.clone());
        }
        request
    }

    /// Submits a build under the caller's `id`; the same id with the same request is the same job.
    ///
    /// # Errors
    /// The daemon's refusal, or a lost connection.
    pub async fn submit_build(&self, id: &str, job: &BuildJob, options: &JobOptions) -> Result<Job, ClientError> {
        let task = convert::build_task(job).map(v1::submit_job_request::Task::Build);
        self.submit(id, task, options).await
    }

    /// Submits a shading job, as [`Self::submit_build`].
    ///
    /// # Errors
    /// The daemon's refusal, or a lost connection.
    pub async fn submit_shade(&self, id: &str, job: &ShadeJob, options: &JobOptions) -> Result<Job, ClientError> {
        let task = convert::shade_task(job).map(v1::submit_job_request::Task::Shade);
        self.submit(id, task, options).await
    }

    async fn submit(
        &self,
        id: &str,
        task: Result<v1::submit_job_request::Task, String>,
        options: &JobOptions,
    ) -> Result<Job, ClientError> {
        let wish = Wish::new(format!("submit job {id:?}"), REQUEST_SECS);
        let task = task.map_err(|message| ClientError::Refused {
            action: wish.action.clone(),
            refusal: Refusal::Invalid,
            message,
        })?;
        let request = v1::SubmitJobRequest {
            job_id: id.to_owned(),
            task: Some(task),
            options: Some(convert::job_options(options)),
            attach: options.attach,
        };
        let answer = self.jobs().submit_job(self.request(&wish, request)).await;
        wish.job(answer)
    }

    /// The job as it stands.
    ///
    /// # Errors
    /// No such job, or a lost connection.
    pub async fn job(&self, id: &str) -> Result<Job, ClientError> {
        let wish = Wish::new(format!("look up job {id:?}"), REQUEST_SECS);
        let request = v1::GetJobRequest { job_id: id.to_owned() };
        let answer = self.jobs().get_job(self.request(&wish, request)).await;
        wish.job(answer)
    }

    /// Follows a job to its end: `observe` is told now and at every change. Returns the ended job.
    ///
    /// # Errors
    /// No such job, or a lost connection.
    pub async fn watch(&self, id: &str, mut observe: impl FnMut(&Job)) -> Result<Job, ClientError> {
        let wish = Wish::new(format!("watch job {id:?}"), REQUEST_SECS);
        let request = v1::WatchJobRequest {
            job_id: id.to_owned(),
            cancel_on_disconnect: false,
        };
        // No deadline: a job may take days.
        let answer = self.jobs().watch_job(self.sign(Request::new(request))).await;
        let mut stream = answer.map_err(|status| wish.failed(&status))?.into_inner();
        loop {
            let message = stream.message().await.map_err(|status| wish.failed(&status))?;
            let Some(message) = message else {
                return Err(wish.malformed("no end".to_owned()));
            };
            let job = convert::job(message).map_err(|fault| wish.malformed(fault))?;
            observe(&job);
            if job.state.ended() {
                return Ok(job);
            }
        }
    }

    /// Cancels a job; one that has ended stays as it is.
    ///
    /// # Errors
    /// No such job, or a lost connection.
    pub async fn cancel(&self, id: &str, reason: &str) -> Result<Job, ClientError> {
        let wish = Wish::new(format!("cancel job {id:?}"), REQUEST_SECS);
        let (job_id, reason) = (id.to_owned(), reason.to_owned());
        let request = v1::CancelJobRequest { job_id, reason };
        let answer = self.jobs().cancel_job(self.request(&wish, request)).await;
        wish.job(answer)
    }

    /// Lets a job rest: its leased tiles are finished, and no more.
    ///
    /// # Errors
    /// No such job, one that cannot rest any more, or a lost connection.
    pub async fn pause(&self, id: &str, reason: &str) -> Result<Job, ClientError> {
        let wish = Wish::new(format!("pause job {id:?}"), REQUEST_SECS);
        let (job_id, reason) = (id.to_owned(), reason.to_owned());
        let request = v1::PauseJobRequest { job_id, reason };
        let answer = self.jobs().pause_job(self.request(&wish, request)).await;
        wish.job(answer)
    }

    /// Lets a paused job go on.
    ///
    /// # Errors
    /// No such job, or a lost connection.
    pub async fn resume(&self, id: &str) -> Result<Job, ClientError> {
        let wish = Wish::new(format!("resume job {id:?}"), REQUEST_SECS);
        let request = v1::ResumeJobRequest { job_id: id.to_owned() };
        let answer = self.jobs().resume_job(self.request(&wish, request)).await;
        wish.job(answer)
    }

    /// Puts a job that failed or was cancelled back in line.
    ///
    /// # Errors
    /// No such job, one whose output another job makes, or a lost connection.
    pub async fn retry(&self, id: &str) -> Result<Job, ClientError> {
        let wish = Wish::new(format!("retry job {id:?}"), REQUEST_SECS);
        let request = v1::RetryJobRequest { job_id: id.to_owned() };
        let answer = self.jobs().retry_job(self.request(&wish, request)).await;
        wish.job(answer)
    }

    /// All jobs the daemon remembers, newest first.
    ///
    /// # Errors
    /// A lost connection.
    pub async fn list(&self) -> Result<Vec<Job>, ClientError> {
        let wish = Wish::new("list the jobs", REQUEST_SECS);
        let answer = self
            .jobs()
            .list_jobs(self.request(&wish, v1::ListJobsRequest::default()))
            .await;
        let list = answer.map_err(|status| wish.failed(&status))?.into_inner();
        let jobs = list.jobs.into_iter().map(convert::job).collect::<Result<_, _>>();
        jobs.map_err(|fault| wish.malformed(fault))
    }

    /// Opens, verifies and describes the scene at `path` (absolute).
    ///
    /// # Errors
    /// No such scene, a damaged one, or a lost connection.
    pub async fn scene(&self, path: &Path) -> Result<SceneInfo, ClientError> {
        let wish = Wish::new(format!("open scene {path:?}"), SCENE_SECS);
        let scene = convert::text(path).map_err(|message| ClientError::Refused {
            action: wish.action.clone(),
            refusal: Refusal::Invalid,
            message,
        })?;
        let answer = SceneServiceClient::new(self.channel.clone())
            .get_scene(self.request(&wish, v1::GetSceneRequest { scene }))
            .await;
        let info = answer.map_err(|status| wish.failed(&status))?.into_inner();
        convert::scene_info(&info).map_err(|fault| wish.malformed(fault))
    }

    /// Counts the nodes of a scene by level.
    ///
    /// # Errors
    /// As [`Self::scene`].
    pub async fn scene_shape(&self, path: &Path) -> Result<SceneShape, ClientError> {
        let wish = Wish::new(format!("look at the nodes of {path:?}"), SCENE_SECS);
        let scene = convert::text(path).map_err(|message| ClientError::Refused {
            action: wish.action.clone(),
            refusal: Refusal::Invalid,
            message,
        })?;
        let answer = SceneServiceClient::new(self.channel.clone())
            .get_scene_shape(self.request(&wish, v1::GetSceneRequest { scene }))
            .await;
        Ok(answer.map_err(|status| wish.failed(&status))?.into_inner().into())
    }

    /// What the daemon's page cache holds.
    ///
    /// # Errors
    /// A lost connection.
    pub async fn cache(&self) -> Result<CacheStatus, ClientError> {
        let wish = Wish::new("ask for the state of the page cache", REQUEST_SECS);
        let answer = self
            .daemon()
            .get_cache(self.request(&wish, v1::GetCacheRequest {}))
            .await;
        Ok(answer.map_err(|status| wish.failed(&status))?.into_inner().into())
    }

    /// The daemon's own account of itself.
    ///
    /// # Errors
    /// A lost connection.
    pub async fn status(&self) -> Result<DaemonStatus, ClientError> {
        let wish = Wish::new("ask for the daemon's status", REQUEST_SECS);
        let answer = self
            .daemon()
            .get_status(self.request(&wish, v1::GetStatusRequest {}))
            .await;
        let status = answer.map_err(|status| wish.failed(&status))?.into_inner();
        Ok(convert::daemon_status(status))
    }

    /// Asks the daemon to finish what is leased and to exit.
    ///
    /// # Errors
    /// A refusal, or a lost connection.
    pub async fn shutdown(&self) -> Result<(), ClientError> {
        let wish = Wish::new("shut the daemon down", SHUTDOWN_SECS);
        let answer = self
            .daemon()
            .shutdown(self.request(&wish, v1::ShutdownRequest {}))
            .await;
        answer.map_err(|status| wish.failed(&status))?;
        Ok(())
    }

    fn jobs(&self) -> JobServiceClient<Channel> {
        JobServiceClient::new(self.channel.clone()).max_decoding_message_size(RESPONSE_BYTES_MAX)
    }

    fn daemon(&self) -> DaemonServiceClient<Channel> {
        DaemonServiceClient::new(self.channel.clone())
    }
}

/// What is wanted and how long it may take: the context of its errors.
pub(crate) struct Wish {
    pub(crate) action: String,
    seconds: u64,
}

impl Wish {
    pub(crate) fn new(action: impl Into<String>, seconds: u64) -> Self {
        Self {
            action: action.into(),
            seconds,
        }
    }

    fn request<T>(&self, message: T) -> Request<T> {
        let mut request = Request::new(message);
        request.set_timeout(Duration::from_secs(self.seconds));
        request
    }

    fn job(&self, answer: Result<tonic::Response<v1::Job>, Status>) -> Result<Job, ClientError> {
        let job = answer.map_err(|status| self.failed(&status))?.into_inner();
        convert::job(job).map_err(|fault| self.malformed(fault))
    }

    pub(crate) fn malformed(&self, fault: String) -> ClientError {
        ClientError::Malformed {
            action: self.action.clone(),
            fault,
        }
    }

    /// The one place where gRPC codes become ours.
    pub(crate) fn failed(&self, status: &Status) -> ClientError {
        let action = self.action.clone();
        let message = status.message().to_owned();
        // A connection that breaks in mid-request is reported as an unknown or internal error of the transport.
        let broken = std::error::Error::source(status).is_some();
        let refusal = match status.code() {
            Code::Unavailable => return ClientError::Lost { action, message },
            Code::Cancelled | Code::DeadlineExceeded => {
                let seconds = self.seconds;
                return ClientError::Deadline { action, seconds };
            }
            Code::Unknown | Code::Internal if broken => return ClientError::Lost { action, message },
            Code::InvalidArgument | Code::OutOfRange => Refusal::Invalid,
            Code::NotFound => Refusal::NotFound,
            Code::AlreadyExists => Refusal::Exists,
            Code::FailedPrecondition => Refusal::Precondition,
            Code::ResourceExhausted => Refusal::Limit,
            Code::Aborted => Refusal::Conflict,
            Code::PermissionDenied | Code::Unauthenticated => Refusal::Denied,
            Code::DataLoss => Refusal::Corrupt,
            Code::Ok | Code::Unknown | Code::Unimplemented | Code::Internal => Refusal::Internal,
        };
        ClientError::Refused {
            action,
            refusal,
            message,
        }
    }
}

/// The path in a server address.
fn socket_path(uri: &str) -> Result<PathBuf, ClientError> {
    let path = match uri.split_once(':') {
        Some(("unix", path)) => path.strip_prefix("//").unwrap_or(path),
        _ => uri,
    };
    if path.starts_with('/') || path.starts_with("./") || path.starts_with("../") {
        Ok(PathBuf::from(path))
    } else {
        Err(ClientError::Address(uri.to_owned()))
    }
}

/// An error and its causes in one line.
fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        text = format!("{text}: {error}");
        cause = error.source();
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_read() {
        for uri in ["unix:/run/jobs.sock", "unix:///run/jobs.sock", "/run/jobs.sock"] {
            assert_eq!(socket_path(uri).unwrap(), PathBuf::from("/run/jobs.sock"), "{uri}");
        }
        for uri in ["", "localhost:50051", "http://localhost:1", "unix:", "jobs.sock"] {
            let text = socket_path(uri).unwrap_err().to_string();
            assert!(text.contains("unix:/path/to/jobs.sock"), "{text}");
        }
    }

    #[tokio::test]
    async fn a_missing_daemon_is_named() {
        let error = Client::connect("unix:/nonexistent/jobs.sock").await.unwrap_err();
        let text = error.to_string();
        assert!(text.contains("/nonexistent/jobs.sock"), "{text}");
    }

    #[test]
    fn refusals_keep_their_kind() {
        let wish = Wish::new("do it", 1);
        let kind = |code| match wish.failed(&Status::new(code, "because")) {
            ClientError::Refused { refusal, message, .. } => {
                assert_eq!(message, "because");
                Some(refusal)
            }
            _ => None,
        };
        assert_eq!(kind(Code::AlreadyExists), Some(Refusal::Exists));
        assert_eq!(kind(Code::DataLoss), Some(Refusal::Corrupt));
        assert_eq!(kind(Code::Unavailable), None);
        assert_eq!(kind(Code::DeadlineExceeded), None);
    }
}
