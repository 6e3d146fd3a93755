//! Shading of receivers that a client streams: cut into tiles of groups, handed out beside those of pictures, answered in order.
//!
//! A session holds at most `limits::LIVE_TILES_MAX` tiles between the stream and the answers; it does not read on before there
//! is room. That bounds its memory and is all the back-pressure there is.

use crate::framebuffer::TileReceivers;
use crate::mounts::Mounted;
use crate::shade_job::Counters;
use pbgi_core::limits::{GROUP_EDGE, TILE_EDGE};
use pbgi_core::{Environment, ShadeSettings};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;
use tokio::sync::mpsc;

/// Bytes of a receiver: position and normal.
pub const RECEIVER_BYTES: usize = 24;
/// Bytes of its values.
pub const VALUE_BYTES: usize = 28;
/// Bytes of what a ray meets.
pub const HIT_BYTES: usize = 40;
/// Receivers of a tile.
pub const TILE_RECEIVERS: usize = (TILE_EDGE * TILE_EDGE) as usize;
/// Receivers of a group.
const GROUP_RECEIVERS: usize = (GROUP_EDGE * GROUP_EDGE) as usize;

/// What a session is about.
#[derive(Clone, Debug)]
pub struct LiveTask {
    /// The scene, as the client names it.
    pub scene: PathBuf,
    /// How to shade.
    pub settings: ShadeSettings,
    /// The environment map, as the client names it.
    pub environment: Option<PathBuf>,
    /// For whom.
    pub user: String,
    /// Higher ones go first.
    pub priority: i32,
    /// Angle between neighbouring rays, radians, where rays are traced instead.
    pub pixel_angle: Option<f32>,
    /// Most workers at once; `None` for all.
    pub workers: Option<usize>,
}

/// What a session shades with.
pub(crate) struct Session {
    /// The scene.
    pub(crate) mounted: Mounted,
    /// How to shade.
    pub(crate) settings: ShadeSettings,
    /// Light from far away.
    pub(crate) environment: Option<Arc<Environment>>,
    /// For whom.
    pub(crate) user: String,
    /// Higher ones go first.
    pub(crate) priority: i32,
    /// See [`LiveTask::pixel_angle`].
    pub(crate) pixel_angle: Option<f32>,
}

/// A tile's values, or why there will be no more.
pub type LiveResult = Result<(u32, Vec<u8>), String>;

/// A session, as the dispatcher holds it.
pub struct Live {
    /// The scene.
    pub mounted: Mounted,
    /// How to shade.
    pub settings: ShadeSettings,
    /// Light from far away.
    pub environment: Option<Arc<Environment>>,
    /// See [`LiveTask::pixel_angle`].
    pub pixel_angle: Option<f32>,
    /// Tiles that are not done.
    pub tiles: BTreeMap<u32, TileReceivers>,
    /// What its tiles took so far.
    pub counters: Counters,
    /// Receivers given so far, holes among them.
    pub receivers: u64,
    /// Since when.
    pub started: Instant,
    /// Most memory of all processes since then, and most of the cache.
    pub peaks: (u64, u64),
    /// Where values go; it has room for every tile that may be out.
    pub results: mpsc::Sender<LiveResult>,
}

impl Live {
    /// Checks the values of a tile.
    ///
    /// # Errors
    /// What is wrong with them.
    pub fn check(&self, tile: u32, values: &[u8]) -> Result<(), String> {
        let receivers = self
            .tiles
            .get(&tile)
            .map_or(0, |tile| tile.bytes.len() / RECEIVER_BYTES);
        let expected = receivers
            * if self.pixel_angle.is_some() {
                HIT_BYTES
            } else {
                VALUE_BYTES
            };
        if values.len() != expected {
            return Err(format!(
                "{expected} bytes of values expected, {} received",
                values.len()
            ));
        }
        let finite = |bytes: &[u8; 4]| f32::from_le_bytes(*bytes).is_finite();
        if values.as_chunks::<4>().0.iter().all(finite) {
            Ok(())
        } else {
            Err("a value is not finite".to_owned())
        }
    }
}

/// Cuts receivers into tiles of groups, in order of arrival. What is not finite becomes a hole.
///
/// # Errors
/// Bytes that are no whole number of receivers.
pub fn tiles(receivers: &[u8]) -> Result<Vec<TileReceivers>, String> {
    if !receivers.len().is_multiple_of(RECEIVER_BYTES) {
        return Err(format!(
            "{} bytes of receivers, must be a multiple of {RECEIVER_BYTES}",
            receivers.len()
        ));
    }
    let tile = |bytes: &[u8]| TileReceivers {
        group_lengths: bytes
            .chunks(GROUP_RECEIVERS * RECEIVER_BYTES)
            .map(|group| (group.len() / RECEIVER_BYTES) as u32)
            .collect(),
        bytes: bytes
            .as_chunks::<RECEIVER_BYTES>()
            .0
            .iter()
            .flat_map(receiver)
            .collect(),
    };
    Ok(receivers.chunks(TILE_RECEIVERS * RECEIVER_BYTES).map(tile).collect())
}

fn receiver(bytes: &[u8; RECEIVER_BYTES]) -> [u8; RECEIVER_BYTES] {
    let finite = |float: &[u8; 4]| f32::from_le_bytes(*float).is_finite();
    if bytes.as_chunks::<4>().0.iter().all(finite) {
        *bytes
    } else {
        [0; RECEIVER_BYTES]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bytes(count: usize) -> Vec<u8> {
        (0..count * 6).flat_map(|index| (index as f32).to_le_bytes()).collect()
    }

    #[test]
    fn receivers_keep_their_order_in_tiles_and_groups() {
        for count in [0, 1, 63, 64, 65, 1_024, 1_025, 5_000] {
            let tiles = tiles(&bytes(count)).unwrap();
            assert_eq!(tiles.len(), count.div_ceil(TILE_RECEIVERS));
            let joined: Vec<u8> = tiles.iter().flat_map(|tile| tile.bytes.clone()).collect();
            assert!(joined == bytes(count));
            for tile in &tiles {
                let receivers: u32 = tile.group_lengths.iter().sum();
                assert_eq!(receivers as usize * RECEIVER_BYTES, tile.bytes.len());
                assert!(
                    tile.group_lengths
                        .iter()
                        .all(|&length| length <= GROUP_RECEIVERS as u32)
                );
            }
        }
        assert!(tiles(&[0; 25]).is_err());
    }

    #[test]
    fn receiver_that_is_not_finite_is_a_hole_and_spreads_no_further() {
        let mut given = bytes(3);
        given[28..32].copy_from_slice(&f32::NAN.to_le_bytes());
        let tiles = tiles(&given).unwrap();
        assert_eq!(tiles[0].bytes[24..48], [0; 24]);
        assert_eq!(tiles[0].bytes[48..], bytes(3)[48..]);
    }
}
