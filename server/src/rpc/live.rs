//! The stream of receivers: reads as fast as tiles are shaded, answers in order.

use super::convert;
use super::gate::Caller;
use super::status::status;
use crate::dispatcher::Dispatcher;
use crate::error::{JobError, JobErrorKind};
use crate::framebuffer::TileReceivers;
use crate::limits;
use crate::live::{LiveResult, LiveTask, tiles};
use crate::scheduler::JobNo;
use pbgi_proto::v1;
use pbgi_proto::v1::shade_service_server::ShadeService;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status, Streaming};

/// How long answers may be left unread before the stream is dropped.
const STALL_MAX: Duration = Duration::from_secs(30);
/// How long the first message may take.
const START_MAX: Duration = Duration::from_secs(30);
/// Answers that wait for the transport.
const ANSWERS_MAX: usize = 4;

pub(super) struct LiveShading {
    dispatcher: Arc<Dispatcher>,
}

impl LiveShading {
    pub(super) fn new(dispatcher: Arc<Dispatcher>) -> Self {
        Self { dispatcher }
    }
}

#[tonic::async_trait]
impl ShadeService for LiveShading {
    type ShadePointsStream = ReceiverStream<Result<v1::ShadePointsResponse, Status>>;

    async fn shade_points(
        &self,
        request: Request<Streaming<v1::ShadePointsRequest>>,
    ) -> Result<Response<Self::ShadePointsStream>, Status> {
        let user = Caller::of(request.extensions()).name();
        let mut requests = request.into_inner();
        let first = tokio::time::timeout(START_MAX, requests.message()).await;
        let first = first.map_err(|_| status(JobError::invalid("no first message came")))??;
        let Some((start, receivers)) = first.and_then(|first| Some((first.start?, first.receivers))) else {
            return Err(status(JobError::invalid(
                "the first message does not say which scene to shade with",
            )));
        };
        let task = LiveTask {
            scene: start.scene.into(),
            settings: convert::shade_settings(start.settings),
            environment: (!start.environment.is_empty()).then(|| start.environment.into()),
            user,
            priority: start.priority.unwrap_or(limits::PRIORITY_MAX),
            pixel_angle: start.rays.map(|rays| rays.pixel_angle),
            workers: (start.workers > 0).then_some(start.workers as usize),
        };
        let workers = task.workers.unwrap_or(limits::LIVE_TILES_MAX);
        let tiles_max = workers.min(limits::LIVE_TILES_MAX);
        let (job, values) = self.dispatcher.open_live(task).await.map_err(status)?;
        let (answers, stream) = mpsc::channel(ANSWERS_MAX);
        let session = Session {
            dispatcher: self.dispatcher.clone(),
            job,
            values,
            answers,
            waiting: VecDeque::new(),
            done: BTreeMap::new(),
            tile_next: 0,
            answer_next: 0,
            tiles_max,
            reports: start.report,
        };
        tokio::spawn(session.run(requests, receivers));
        Ok(Response::new(ReceiverStream::new(stream)))
    }
}

struct Session {
    dispatcher: Arc<Dispatcher>,
    job: JobNo,
    values: mpsc::Receiver<LiveResult>,
    answers: mpsc::Sender<Result<v1::ShadePointsResponse, Status>>,
    /// Tiles of the message that was read last, not handed out yet.
    waiting: VecDeque<TileReceivers>,
    /// Tiles that are done before an earlier one.
    done: BTreeMap<u32, Vec<u8>>,
    tile_next: u32,
    answer_next: u32,
    /// Tiles out at once: no more workers than this can have one.
    tiles_max: usize,
    reports: bool,
}

impl Drop for Session {
    fn drop(&mut self) {
        self.dispatcher.close_live(self.job);
    }
}

impl Session {
    async fn run(mut self, mut requests: Streaming<v1::ShadePointsRequest>, receivers: Vec<u8>) {
        let served = self.serve(&mut requests, receivers).await;
        if let Err(Some(error)) = served {
            // A client that left does not listen.
            let _ = tokio::time::timeout(STALL_MAX, self.answers.send(Err(error))).await;
        }
    }

    /// Ends with an error for the client, or with none if it left.
    async fn serve(
        &mut self,
        requests: &mut Streaming<v1::ShadePointsRequest>,
        receivers: Vec<u8>,
    ) -> Result<(), Option<Status>> {
        self.take(&receivers)?;
        let mut more = true;
        loop {
            self.hand_out();
            let out = self.tile_next - self.answer_next;
            if !more && out == 0 {
                return self.report().await;
            }
            tokio::select! {
                value = self.values.recv() => match value {
                    Some(Ok((tile, values))) => {
                        self.done.insert(tile, values);
                        self.answer().await?;
                    }
                    Some(Err(text)) => return Err(Some(status(JobError::new(JobErrorKind::Unavailable, text)))),
                    None => return Err(None),
                },
                message = requests.message(), if more && self.waiting.is_empty() && (out as usize) < self.tiles_max => {
                    match message.map_err(|_| None)? {
                        None => more = false,
                        Some(message) if message.start.is_some() => {
                            return Err(Some(status(JobError::invalid("a stream starts once"))));
                        }
                        Some(message) => self.take(&message.receivers)?,
                    }
                }
                () = self.answers.closed() => return Err(None),
            }
        }
    }

    fn take(&mut self, receivers: &[u8]) -> Result<(), Option<Status>> {
        let tiles = tiles(receivers).map_err(|text| Some(status(JobError::invalid(text))))?;
        self.waiting.extend(tiles);
        Ok(())
    }

    fn hand_out(&mut self) {
        while ((self.tile_next - self.answer_next) as usize) < self.tiles_max
            && let Some(tile) = self.waiting.pop_front()
        {
            self.dispatcher.feed(self.job, self.tile_next, tile);
            self.tile_next += 1;
        }
    }

    /// Sends what is next in order.
    async fn answer(&mut self) -> Result<(), Option<Status>> {
        while let Some(values) = self.done.remove(&self.answer_next) {
            self.answer_next += 1;
            let statistics = None;
            self.send(v1::ShadePointsResponse { values, statistics }).await?;
        }
        Ok(())
    }

    /// Tells at the end what it took, where that is wanted.
    async fn report(&mut self) -> Result<(), Option<Status>> {
        if !self.reports {
            return Ok(());
        }
        let statistics = self.dispatcher.live_statistics(self.job);
        let statistics = statistics.as_ref().map(convert::statistics);
        let values = Vec::new();
        self.send(v1::ShadePointsResponse { values, statistics }).await
    }

    async fn send(&mut self, answer: v1::ShadePointsResponse) -> Result<(), Option<Status>> {
        match tokio::time::timeout(STALL_MAX, self.answers.send(Ok(answer))).await {
            Ok(Ok(())) => Ok(()),
            _ => Err(None),
        }
    }
}
