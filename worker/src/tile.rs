//! A tile on the wire: receivers in, shaded values out.

use pbgi_proto::v1;
use pbgi_shade::{Ray, Receiver};
use std::ops::Range;

// Records cross the wire as they lie in memory.
const _: () = assert!(cfg!(target_endian = "little"));
const _: () = assert!(size_of::<Receiver>() == size_of::<Ray>());

/// A lease's work.
#[derive(Debug)]
pub(crate) struct Tile {
    pub(crate) lease_id: u64,
    pub(crate) task_id: u64,
    pub(crate) number: u32,
    pub(crate) receivers: Vec<Receiver>,
    /// Ranges of receivers that are shaded together, in order, without gaps.
    pub(crate) groups: Vec<Range<usize>>,
}

impl Tile {
    /// Some of its receivers, which are rays.
    pub(crate) fn rays(&self, group: Range<usize>) -> &[Ray] {
        bytemuck::cast_slice(&self.receivers[group])
    }

    pub(crate) fn from_wire(lease: &v1::Lease) -> Result<Self, String> {
        if !lease.receivers.len().is_multiple_of(size_of::<Receiver>()) {
            return Err(format!("a tile of {} bytes", lease.receivers.len()));
        }
        let records = lease.receivers.chunks_exact(size_of::<Receiver>());
        let receivers: Vec<Receiver> = records.map(bytemuck::pod_read_unaligned).collect();
        let mut groups = Vec::with_capacity(lease.group_lengths.len());
        let mut start = 0;
        for &length in &lease.group_lengths {
            let end = start + length as usize;
            groups.push(start..end);
            start = end;
        }
        if start != receivers.len() {
            return Err(format!("groups of {start} receivers, {} given", receivers.len()));
        }
        Ok(Self {
            lease_id: lease.lease_id,
            task_id: lease.task_id,
            number: lease.tile,
            receivers,
            groups,
        })
    }
}

/// Results as the queue takes them.
pub(crate) fn values<T: bytemuck::NoUninit>(shaded: &[T]) -> Vec<u8> {
    bytemuck::cast_slice(shaded).to_vec()
}

#[cfg(test)]
mod tests {
    use super::*;
    use pbgi_shade::Shaded;

    fn lease(receivers: usize, group_lengths: Vec<u32>) -> v1::Lease {
        let numbers = (0..receivers * 6).flat_map(|i| (i as f32).to_le_bytes());
        v1::Lease {
            receivers: numbers.collect(),
            group_lengths,
            ..Default::default()
        }
    }

    #[test]
    fn receivers_are_read_in_order_and_grouped() {
        let tile = Tile::from_wire(&lease(3, vec![2, 1])).unwrap();
        assert_eq!(tile.groups, vec![0..2, 2..3]);
        assert_eq!(tile.receivers[1].position.to_array(), [6.0, 7.0, 8.0]);
        assert_eq!(tile.receivers[2].normal.to_array(), [15.0, 16.0, 17.0]);
    }

    #[test]
    fn lengths_that_do_not_fit_are_refused() {
        assert!(Tile::from_wire(&lease(3, vec![2])).is_err());
        assert!(Tile::from_wire(&lease(3, vec![4])).is_err());
        let mut odd = lease(1, vec![1]);
        odd.receivers.push(0);
        assert!(Tile::from_wire(&odd).is_err());
    }

    #[test]
    fn results_are_seven_little_endian_floats() {
        let shaded = Shaded {
            irradiance: [1.0, 2.0, 3.0],
            occlusion: 0.5,
            bent_normal: [0.0, 1.0, 0.0],
        };
        let bytes = values(&[shaded]);
        assert_eq!(bytes.len(), 28);
        assert_eq!(bytes[12..16], 0.5f32.to_le_bytes());
    }
}
