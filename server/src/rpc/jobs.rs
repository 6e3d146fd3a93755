//! What clients may ask: jobs, scenes, the daemon.

use super::gate::{Caller, Grants};
use super::status::status;
use super::{cache, convert};
use crate::access::Call;
use crate::dispatcher::{Dispatcher, Submission};
use crate::error::{JobError, JobErrorKind};
use crate::job::JobStatus;
use pbgi_proto::v1;
use pbgi_proto::v1::daemon_service_server::DaemonService;
use pbgi_proto::v1::job_service_server::JobService;
use pbgi_proto::v1::scene_service_server::SceneService;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::{mpsc, watch};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status};

/// How long a watcher may leave a message unread before it is dropped.
const STALL_MAX: Duration = Duration::from_secs(30);
/// Least time between two messages to a watcher; it gets the latest state each time.
const WATCH_INTERVAL: Duration = Duration::from_millis(20);

#[derive(Clone)]
pub(super) struct Jobs {
    dispatcher: Arc<Dispatcher>,
}

impl Jobs {
    pub(super) fn new(dispatcher: Arc<Dispatcher>) -> Self {
        Self { dispatcher }
    }

    /// Answers with a job that somebody changed, once the change is on the disk.
    async fn changed(&self, job: JobStatus) -> Result<Response<v1::Job>, Status> {
        self.dispatcher.stored().await.map_err(status)?;
        Ok(Response::new(convert::job(job)))
    }
}

#[tonic::async_trait]
impl JobService for Jobs {
    type WatchJobStream = ReceiverStream<Result<v1::Job, Status>>;

    async fn submit_job(&self, request: Request<v1::SubmitJobRequest>) -> Result<Response<v1::Job>, Status> {
        let caller = Caller::of(request.extensions()).name();
        let request = request.into_inner();
        let submission = Submission {
            wire: prost::Message::encode_to_vec(&request),
            id: request.job_id,
            request: convert::request(request.task).map_err(status)?,
            options: convert::options(request.options, &caller),
            attach: request.attach,
        };
        let job = self.dispatcher.submit(submission).await.map_err(status)?;
        Ok(Response::new(convert::job(job)))
    }

    async fn get_job(&self, request: Request<v1::GetJobRequest>) -> Result<Response<v1::Job>, Status> {
        let job = self.dispatcher.job(&request.into_inner().job_id).map_err(status)?;
        Ok(Response::new(convert::job(job)))
    }

    async fn list_jobs(&self, request: Request<v1::ListJobsRequest>) -> Result<Response<v1::ListJobsResponse>, Status> {
        let limit = match request.into_inner().limit {
            0 => usize::MAX,
            limit => limit as usize,
        };
        let jobs = self.dispatcher.jobs(limit).into_iter().map(convert::job).collect();
        Ok(Response::new(v1::ListJobsResponse { jobs }))
    }

    async fn watch_job(&self, request: Request<v1::WatchJobRequest>) -> Result<Response<Self::WatchJobStream>, Status> {
        if request.get_ref().cancel_on_disconnect {
            Grants::ask(request.extensions(), Call::Work)?;
        }
        let request = request.into_inner();
        let job = self.dispatcher.watch(&request.job_id).map_err(status)?;
        let (sender, receiver) = mpsc::channel(1);
        let dispatcher = self.dispatcher.clone();
        tokio::spawn(async move {
            let seen_to_its_end = forward(job, sender).await;
            if request.cancel_on_disconnect && !seen_to_its_end {
                // A job that is forgotten has ended.
                let _ = dispatcher.cancel(&request.job_id, "its watcher left");
            }
        });
        Ok(Response::new(ReceiverStream::new(receiver)))
    }

    async fn cancel_job(&self, request: Request<v1::CancelJobRequest>) -> Result<Response<v1::Job>, Status> {
        let request = request.into_inner();
        let job = self
            .dispatcher
            .cancel(&request.job_id, &request.reason)
            .map_err(status)?;
        self.changed(job).await
    }

    async fn pause_job(&self, request: Request<v1::PauseJobRequest>) -> Result<Response<v1::Job>, Status> {
        let request = request.into_inner();
        let job = self
            .dispatcher
            .pause(&request.job_id, &request.reason)
            .map_err(status)?;
        self.changed(job).await
    }

    async fn resume_job(&self, request: Request<v1::ResumeJobRequest>) -> Result<Response<v1::Job>, Status> {
        let job = self.dispatcher.resume(&request.into_inner().job_id).map_err(status)?;
        self.changed(job).await
    }

    async fn retry_job(&self, request: Request<v1::RetryJobRequest>) -> Result<Response<v1::Job>, Status> {
        let job = self.dispatcher.retry(&request.into_inner().job_id).map_err(status)?;
        self.changed(job).await
    }
}

/// Sends a job's latest state until it ends, or until nobody reads. Returns whether it ended.
async fn forward(mut job: watch::Receiver<JobStatus>, sender: mpsc::Sender<Result<v1::Job, Status>>) -> bool {
    loop {
        let now = job.borrow_and_update().clone();
        let (ended, suspended) = (now.state.ended(), now.suspended);
        let message = if suspended {
            let text = "the daemon is shutting down; the next one goes on with the job";
            Err(status(JobError::new(JobErrorKind::Unavailable, text)))
        } else {
            Ok(convert::job(now))
        };
        let sent = tokio::time::timeout(STALL_MAX, sender.send(message)).await;
        if ended || suspended || !matches!(sent, Ok(Ok(()))) {
            return ended || suspended;
        }
        tokio::time::sleep(WATCH_INTERVAL).await;
        tokio::select! {
            changed = job.changed() => if changed.is_err() { return true },
            () = sender.closed() => return false,
        }
    }
}

/// Keeps work on the disk off the threads that serve.
async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, JobError> + Send + 'static,
) -> Result<T, JobError> {
    let done = tokio::task::spawn_blocking(work).await;
    done.unwrap_or_else(|error| Err(JobError::new(JobErrorKind::Internal, error.to_string())))
}

#[tonic::async_trait]
impl SceneService for Jobs {
    async fn get_scene(&self, request: Request<v1::GetSceneRequest>) -> Result<Response<v1::SceneInfo>, Status> {
        let info = self
            .dispatcher
            .scene(request.into_inner().scene.into())
            .await
            .map_err(status)?;
        Ok(Response::new(convert::scene(&info)))
    }

    async fn get_scene_shape(&self, request: Request<v1::GetSceneRequest>) -> Result<Response<v1::SceneShape>, Status> {
        let (this, path) = (self.dispatcher.clone(), request.into_inner().scene);
        let shape = blocking(move || this.scene_shape(path.as_ref()))
            .await
            .map_err(status)?;
        Ok(Response::new(convert::shape(&shape)))
    }

    async fn warm_scene(
        &self,
        request: Request<v1::WarmSceneRequest>,
    ) -> Result<Response<v1::WarmSceneResponse>, Status> {
        let (this, path) = (self.dispatcher.clone(), request.into_inner().scene);
        let warmed = blocking(move || this.warm_scene(path.as_ref())).await;
        let (pages, bytes) = warmed.map_err(status)?;
        Ok(Response::new(v1::WarmSceneResponse { pages, bytes }))
    }

    async fn drop_scene(
        &self,
        request: Request<v1::DropSceneRequest>,
    ) -> Result<Response<v1::DropSceneResponse>, Status> {
        let (this, path) = (self.dispatcher.clone(), request.into_inner().scene);
        let dropped = blocking(move || this.drop_scene(path.as_ref())).await.map_err(status)?;
        Ok(Response::new(v1::DropSceneResponse { dropped }))
    }
}

#[tonic::async_trait]
impl DaemonService for Jobs {
    async fn get_status(&self, _: Request<v1::GetStatusRequest>) -> Result<Response<v1::DaemonStatus>, Status> {
        Ok(Response::new(convert::daemon(self.dispatcher.status())))
    }

    async fn get_cache(&self, _: Request<v1::GetCacheRequest>) -> Result<Response<v1::CacheStatus>, Status> {
        Ok(Response::new(cache::status(self.dispatcher.cache_report())))
    }

    async fn shutdown(&self, _: Request<v1::ShutdownRequest>) -> Result<Response<v1::ShutdownResponse>, Status> {
        tracing::info!("a client asked to stop");
        self.dispatcher.request_stop();
        Ok(Response::new(v1::ShutdownResponse {}))
    }
}
