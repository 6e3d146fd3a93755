//! Shading of receivers that are streamed: [`Client::shade_points`]; and of rays, [`Client::trace_rays`].

use crate::client::{Client, REQUEST_SECS, RESPONSE_BYTES_MAX, Wish};
use crate::convert;
use crate::error::{ClientError, Refusal};
use pbgi_core::{ShadeSettings, Statistics};
use pbgi_proto::v1;
use pbgi_proto::v1::shade_service_client::ShadeServiceClient;
use std::path::PathBuf;
use tokio::sync::mpsc;
use tokio_stream::StreamExt;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Request;

/// Receivers in one message at most: 4 MiB.
pub const LIVE_RECEIVERS_MAX: usize = 170_000;

/// Receivers to come, and how they are shaded.
#[derive(Clone, Debug)]
pub struct LiveJob {
    /// The scene directory, absolute.
    pub scene: PathBuf,
    /// How receivers are shaded.
    pub settings: ShadeSettings,
    /// Environment map, absolute; `None` for black.
    pub environment: Option<PathBuf>,
    /// Higher ones go first; `None` for the highest, for somebody who sits and waits.
    pub priority: Option<i32>,
    /// Most workers; `None` for all.
    pub workers: Option<u32>,
}

impl Client {
    /// Shades receivers as they come: position x y z and normal x y z, world space, at most [`LIVE_RECEIVERS_MAX`] at a
    /// time; a zero normal is a hole. `take` is given their values in their order, some at a time: irradiance R G B,
    /// occlusion, bent normal x y z; what it returns as an error ends the stream. The receivers are asked for only as fast
    /// as they are shaded and taken. Returns what it took.
    ///
    /// # Errors
    /// The daemon's refusal, a lost connection, or that of `take`.
    pub async fn shade_points<E: From<ClientError>>(
        &self,
        job: &LiveJob,
        receivers: mpsc::Receiver<Vec<[f32; 6]>>,
        mut take: impl FnMut(&[[f32; 7]]) -> Result<(), E>,
    ) -> Result<Statistics, E> {
        let action = format!("shade receivers with {:?}", job.scene);
        self.stream(action, convert::live_start(job), receivers, &mut take)
            .await
    }

    /// Finds what rays meet in a scene: origin x y z and direction x y z, world space, `pixel_angle` radians between
    /// neighbours; 64 that follow each other are traced together. `take` is given position x y z, normal x y z on the side
    /// of the ray, radiance R G B and coverage, all 0 where there is nothing; otherwise as [`Self::shade_points`].
    ///
    /// # Errors
    /// The daemon's refusal, a lost connection, or that of `take`.
    pub async fn trace_rays<E: From<ClientError>>(
        &self,
        job: &LiveJob,
        pixel_angle: f32,
        rays: mpsc::Receiver<Vec<[f32; 6]>>,
        mut take: impl FnMut(&[[f32; 10]]) -> Result<(), E>,
    ) -> Result<Statistics, E> {
        let action = format!("find what a camera sees of {:?}", job.scene);
        let start = convert::live_start(job).map(|start| v1::ShadePointsStart {
            rays: Some(v1::RayTracing { pixel_angle }),
            ..start
        });
        self.stream(action, start, rays, &mut take).await
    }

    async fn stream<E: From<ClientError>, const N: usize>(
        &self,
        action: String,
        start: Result<v1::ShadePointsStart, String>,
        receivers: mpsc::Receiver<Vec<[f32; 6]>>,
        take: &mut impl FnMut(&[[f32; N]]) -> Result<(), E>,
    ) -> Result<Statistics, E> {
        let wish = Wish::new(action, REQUEST_SECS);
        let start = start.map_err(|message| ClientError::Refused {
            action: wish.action.clone(),
            refusal: Refusal::Invalid,
            message,
        })?;
        let first = v1::ShadePointsRequest {
            start: Some(start),
            receivers: Vec::new(),
        };
        let others = ReceiverStream::new(receivers).map(|block| v1::ShadePointsRequest {
            start: None,
            receivers: bytes(&block),
        });
        // No deadline: a cloud may take days.
        let request = self.sign(Request::new(tokio_stream::once(first).chain(others)));
        let mut service = ShadeServiceClient::new(self.channel.clone())
            .max_decoding_message_size(RESPONSE_BYTES_MAX)
            .max_encoding_message_size(RESPONSE_BYTES_MAX);
        let answer = service.shade_points(request).await;
        let mut answers = answer.map_err(|status| wish.failed(&status))?.into_inner();
        loop {
            let answer = answers.message().await.map_err(|status| wish.failed(&status))?;
            let Some(answer) = answer else {
                return Err(wish.malformed("no statistics at its end".to_owned()).into());
            };
            if let Some(statistics) = answer.statistics {
                return Ok(convert::statistics(statistics));
            }
            let values = values(&answer.values);
            take(&values.ok_or_else(|| wish.malformed(format!("{} bytes of values", answer.values.len())))?)?;
        }
    }
}

fn bytes(receivers: &[[f32; 6]]) -> Vec<u8> {
    receivers
        .iter()
        .flatten()
        .flat_map(|number| number.to_le_bytes())
        .collect()
}

/// Numbers of what was asked for, `N` for each; `None` if they do not come out even.
fn values<const N: usize>(bytes: &[u8]) -> Option<Vec<[f32; N]>> {
    let (words, rest) = bytes.as_chunks::<4>();
    let numbers: Vec<f32> = words.iter().map(|word| f32::from_le_bytes(*word)).collect();
    let (values, left) = numbers.as_chunks::<N>();
    (rest.is_empty() && left.is_empty()).then(|| values.to_vec())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_cross_the_wire_in_order() {
        let sent = bytes(&[[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]]);
        assert_eq!(sent.len(), 24);
        assert_eq!(sent[20..], 6.0f32.to_le_bytes());
        let received: Vec<u8> = (0..14).flat_map(|number| (number as f32).to_le_bytes()).collect();
        let read = values::<7>(&received).unwrap();
        assert_eq!(read[1], [7.0, 8.0, 9.0, 10.0, 11.0, 12.0, 13.0]);
        assert!(values::<7>(&received[1..]).is_none() && values::<7>(&received[4..]).is_none());
    }
}
