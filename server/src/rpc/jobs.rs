//! What clients may ask: jobs, scenes, the daemon.

use super::convert;
use super::status::status;
use crate::dispatcher::Dispatcher;
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
}

#[tonic::async_trait]
impl JobService for Jobs {
    type WatchJobStream = ReceiverStream<Result<v1::Job, Status>>;

    async fn submit_job(&self, request: Request<v1::SubmitJobRequest>) -> Result<Response<v1::Job>, Status> {
        let request = request.into_inner();
        let task = convert::request(request.task).map_err(status)?;
        let job = self.dispatcher.submit(&request.job_id, task).map_err(status)?;
        Ok(Response::new(convert::job(job)))
    }

    async fn get_job(&self, request: Request<v1::GetJobRequest>) -> Result<Response<v1::Job>, Status> {
        let job = self.dispatcher.job(&request.into_inner().job_id).map_err(status)?;
        Ok(Response::new(convert::job(job)))
    }

    async fn list_jobs(&self, _: Request<v1::ListJobsRequest>) -> Result<Response<v1::ListJobsResponse>, Status> {
        let jobs = self.dispatcher.jobs().into_iter().map(convert::job).collect();
        Ok(Response::new(v1::ListJobsResponse { jobs }))
    }

    async fn watch_job(&self, request: Request<v1::WatchJobRequest>) -> Result<Response<Self::WatchJobStream>, Status> {
        let job = self.dispatcher.watch(&request.into_inner().job_id).map_err(status)?;
        let (sender, receiver) = mpsc::channel(1);
        tokio::spawn(forward(job, sender));
        Ok(Response::new(ReceiverStream::new(receiver)))
    }

    async fn cancel_job(&self, request: Request<v1::CancelJobRequest>) -> Result<Response<v1::Job>, Status> {
        let job = self.dispatcher.cancel(&request.into_inner().job_id).map_err(status)?;
        Ok(Response::new(convert::job(job)))
    }
}

/// Sends a job's latest state until it ends, or until nobody reads.
async fn forward(mut job: watch::Receiver<JobStatus>, sender: mpsc::Sender<Result<v1::Job, Status>>) {
    loop {
        let now = job.borrow_and_update().clone();
        let ended = now.state.ended();
        let sent = tokio::time::timeout(STALL_MAX, sender.send(Ok(convert::job(now)))).await;
        if ended || !matches!(sent, Ok(Ok(()))) {
            return;
        }
        tokio::time::sleep(WATCH_INTERVAL).await;
        tokio::select! {
            changed = job.changed() => if changed.is_err() { return },
            () = sender.closed() => return,
        }
    }
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
}

#[tonic::async_trait]
impl DaemonService for Jobs {
    async fn get_status(&self, _: Request<v1::GetStatusRequest>) -> Result<Response<v1::DaemonStatus>, Status> {
        Ok(Response::new(convert::daemon(self.dispatcher.status())))
    }

    async fn shutdown(&self, _: Request<v1::ShutdownRequest>) -> Result<Response<v1::ShutdownResponse>, Status> {
        tracing::info!("a client asked to stop");
        self.dispatcher.request_stop();
        Ok(Response::new(v1::ShutdownResponse {}))
    }
}
