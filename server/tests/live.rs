//! Streams of receivers: answered in order, at the reader's pace, beside pictures.
#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod harness;

use harness::PATIENCE;
use harness::site::{Site, work_in_disguise};
use pbgi_proto::v1;
use pbgi_proto::v1::scene_service_client::SceneServiceClient;
use pbgi_proto::v1::shade_service_client::ShadeServiceClient;
use std::time::Duration;
use tokio::sync::mpsc;
use tokio_stream::StreamExt;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Status, Streaming};

#[test]
#[ignore = "the worker's part, run by the daemon of the other tests"]
fn disguised_worker() {
    work_in_disguise();
}

/// Receivers whose positions count up from `first`.
fn receivers(first: u32, count: u32) -> Vec<u8> {
    let floats = (first..first + count).flat_map(|number| [number as f32, 1.0, 2.0, 0.0, 0.0, 1.0]);
    floats.flat_map(f32::to_le_bytes).collect()
}

fn start(scene: String) -> v1::ShadePointsRequest {
    v1::ShadePointsRequest {
        start: Some(v1::ShadePointsStart {
            scene,
            ..Default::default()
        }),
        receivers: Vec::new(),
    }
}

fn more(receivers: Vec<u8>) -> v1::ShadePointsRequest {
    v1::ShadePointsRequest { start: None, receivers }
}

type Answers = Streaming<v1::ShadePointsResponse>;

async fn open(site: &Site) -> (mpsc::Sender<v1::ShadePointsRequest>, Result<Answers, Status>) {
    let (sender, receiver) = mpsc::channel(1);
    sender.send(start(site.path("s.pbgi"))).await.unwrap();
    let mut client = ShadeServiceClient::new(site.daemon.channel("jobs.sock").await);
    let answer = client.shade_points(ReceiverStream::new(receiver)).await;
    (sender, answer.map(tonic::Response::into_inner))
}

/// The numbers that the answers were made from.
fn numbers(answer: &v1::ShadePointsResponse) -> Vec<u32> {
    let first = |values: &[u8]| f32::from_le_bytes(values[..4].try_into().unwrap()) as u32;
    answer.values.chunks(28).map(first).collect()
}

#[tokio::test]
async fn receivers_are_answered_in_order_and_the_stream_ends_with_them() {
    let site = Site::new(64, 64);
    site.succeed("build", site.build("s.pbgi")).await;
    let (sender, answers) = open(&site).await;
    let mut answers = answers.unwrap();
    let feeder = tokio::spawn(async move {
        let mut first = 0;
        for count in [1, 3_000, 0, 64, 1_024, 5_000, 7] {
            sender.send(more(receivers(first, count))).await.unwrap();
            first += count;
        }
        first
    });
    let mut seen = Vec::new();
    while let Some(answer) = answers.next().await {
        seen.extend(numbers(&answer.unwrap()));
    }
    assert_eq!(seen, (0..feeder.await.unwrap()).collect::<Vec<u32>>());
    // The session is over: the scene can be dropped.
    let mut scenes = SceneServiceClient::new(site.daemon.channel("jobs.sock").await);
    let scene = || site.path("s.pbgi");
    let warmed = scenes
        .warm_scene(v1::WarmSceneRequest { scene: scene() })
        .await
        .unwrap()
        .into_inner();
    assert!(warmed.pages > 1 && warmed.bytes > 20_000 * 32, "{warmed:?}");
    let deadline = tokio::time::Instant::now() + PATIENCE;
    loop {
        match scenes.drop_scene(v1::DropSceneRequest { scene: scene() }).await {
            Ok(answer) => break assert!(answer.into_inner().dropped),
            Err(status) => assert_eq!(status.code(), Code::FailedPrecondition),
        }
        assert!(tokio::time::Instant::now() < deadline);
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    assert!(site.daemon.status().await.mounts.is_empty());
    site.daemon.stop();
}

#[tokio::test]
async fn stream_that_is_not_read_is_not_read_from_either_and_holds_up_nobody() {
    let site = Site::new(64, 64);
    site.succeed("build", site.build("s.pbgi")).await;
    let (sender, answers) = open(&site).await;
    let mut answers = answers.unwrap();
    // 200 MiB of receivers: the daemon must not take them in.
    let block = receivers(0, 100_000);
    let mut taken = 0;
    while taken < 100 {
        let send = tokio::time::timeout(Duration::from_millis(1_500), sender.send(more(block.clone()))).await;
        if send.is_err() {
            break;
        }
        taken += 1;
    }
    assert!(taken < 20, "{taken} messages of 2.3 MiB were taken in");
    site.succeed("picture", site.shade("a.exr")).await;
    assert!(answers.next().await.unwrap().is_ok());
    println!(
        "RELIABILITY R3: a stream that is not read was left after {taken} messages of 2.3 MiB; a picture beside it was shaded"
    );
    site.daemon.stop();
}

#[tokio::test]
async fn mistakes_are_told_and_end_the_stream() {
    let site = Site::new(64, 64);
    let (_sender, refused) = open(&site).await;
    assert_eq!(refused.unwrap_err().code(), Code::NotFound);
    site.succeed("build", site.build("s.pbgi")).await;
    for (message, part) in [
        (more(vec![0; 25]), "multiple of 24"),
        (start(site.path("s.pbgi")), "starts once"),
    ] {
        let (sender, answers) = open(&site).await;
        sender.send(message).await.unwrap();
        let told = answers.unwrap().next().await.unwrap().unwrap_err();
        assert_eq!(told.code(), Code::InvalidArgument);
        assert!(told.message().contains(part), "{told}");
    }
    let mut client = ShadeServiceClient::new(site.daemon.channel("jobs.sock").await);
    let refused = client
        .shade_points(tokio_stream::once(more(Vec::new())))
        .await
        .unwrap_err();
    assert_eq!(refused.code(), Code::InvalidArgument);
    site.daemon.stop();
}
