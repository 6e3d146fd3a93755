//! [`ContentHash`]: the 128-bit identity of an octree, from the points in their order and everything else that decides
//! its bytes. [`UnorderedHash`]: whether two sets of points are the same.

use pbgi_core::{BuildId, BuildSettings, PointRecord, Quantizer};

/// Counts changes of the construction that change the bytes for the same input.
const CONSTRUCTION_VERSION: u64 = 6;

/// Odd constants without pattern: the fractions of square roots of primes.
const KEYS: [u64; 8] = [
    0x6a09_e667_f3bc_c909,
    0xbb67_ae85_84ca_a73b,
    0x3c6e_f372_fe94_f82b,
    0xa54f_f53a_5f1d_36f1,
    0x510e_527f_ade6_82d1,
    0x9b05_688c_2b3e_6c1f,
    0x1f83_d9ab_fb41_bd6b,
    0x5be0_cd19_137e_2179,
];

/// Two lanes of folded multiplication, a few nanoseconds a point. Against accident, not against forgery.
#[derive(Clone, Debug)]
pub struct ContentHash {
    lanes: [u64; 2],
}

impl Default for ContentHash {
    fn default() -> Self {
        Self {
            lanes: [KEYS[0] ^ CONSTRUCTION_VERSION, KEYS[1]],
        }
    }
}

impl ContentHash {
    /// Takes the next point.
    #[inline]
    pub fn add(&mut self, point: &PointRecord) {
        self.add_words(bytemuck::cast(*point));
    }

    #[inline]
    fn add_words(&mut self, [a, b, c, d]: [u64; 4]) {
        let [first, second] = self.lanes;
        self.lanes = [
            fold(first ^ a, b ^ KEYS[2]).rotate_left(29) ^ fold(c ^ KEYS[3], d ^ KEYS[4] ^ first),
            fold(second ^ d, a ^ KEYS[5]).rotate_left(31) ^ fold(b ^ KEYS[6], c ^ KEYS[7] ^ second),
        ];
    }

    /// Adds what else decides the bytes of the scene, and ends.
    pub fn finish(mut self, point_count: u64, quantizer: Option<&Quantizer>, settings: &BuildSettings) -> BuildId {
        let lattice = quantizer.map_or([0; 4], |q| {
            [q.origin[0], q.origin[1], q.origin[2], q.edge].map(f64::to_bits)
        });
        self.add_words(lattice);
        self.add_words([
            u64::from(settings.leaf_max),
            u64::from(settings.chunk_levels),
            u64::from(settings.nodes_per_page),
            u64::from(settings.points_per_page),
        ]);
        self.add_words([point_count, KEYS[5], KEYS[6], KEYS[7]]);
        let [first, second] = self.lanes;
        BuildId(u128::from(first) << 64 | u128::from(second))
    }
}

/// The same for the same points in any order. Against accident, not against forgery.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct UnorderedHash(pub u64);

impl UnorderedHash {
    /// Takes another point.
    #[inline]
    pub fn add(&mut self, point: &PointRecord) {
        let [a, b, c, d]: [u64; 4] = bytemuck::cast(*point);
        let mixed = fold(a ^ KEYS[0], b ^ KEYS[1]) ^ fold(c ^ KEYS[2], d ^ KEYS[3]).rotate_left(31);
        self.0 = self.0.wrapping_add(fold(mixed ^ KEYS[4], KEYS[5]));
    }

    /// Takes the points of another.
    pub fn merge(&mut self, other: Self) {
        self.0 = self.0.wrapping_add(other.0);
    }
}

/// Both halves of the product, folded.
#[inline]
fn fold(a: u64, b: u64) -> u64 {
    let product = u128::from(a) * u128::from(b);
    product as u64 ^ (product >> 64) as u64
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytemuck::Zeroable;
    use std::collections::HashSet;

    #[test]
    fn every_bit_counts_and_the_order_does_not() {
        let hash = |points: &[PointRecord]| {
            let mut hash = UnorderedHash::default();
            points.iter().for_each(|point| hash.add(point));
            hash
        };
        let mut points = [PointRecord::zeroed(); 3];
        points[0].radius = 1.0;
        let mut seen = HashSet::from([hash(&points).0, hash(&points[..2]).0]);
        for bit in 0..3 * 256 {
            let mut flipped = points;
            bytemuck::bytes_of_mut(&mut flipped)[bit / 8] ^= 1 << (bit % 8);
            // The last two points are equal: what flips in one flips in the other to the same set.
            assert!(seen.insert(hash(&flipped).0) != (bit >= 2 * 256), "bit {bit}");
        }
        assert_eq!(hash(&points), hash(&[points[1], points[2], points[0]]));
        let mut parts = hash(&points[..1]);
        parts.merge(hash(&points[1..]));
        assert_eq!(hash(&points), parts);
    }

    #[test]
    fn every_bit_the_order_and_the_settings_count() {
        let settings = BuildSettings::default();
        let hash = |points: &[PointRecord], settings: &BuildSettings| {
            let mut hash = ContentHash::default();
            points.iter().for_each(|point| hash.add(point));
            hash.finish(points.len() as u64, None, settings)
        };
        let mut points = [PointRecord::zeroed(); 3];
        let mut ids = HashSet::from([hash(&points, &settings), hash(&points[..2], &settings)]);
        for bit in 0..3 * 256 {
            let mut flipped = points;
            bytemuck::bytes_of_mut(&mut flipped)[bit / 8] ^= 1 << (bit % 8);
            assert!(ids.insert(hash(&flipped, &settings)), "bit {bit}");
        }
        points[0].radius = 1.0;
        let swapped = [points[1], points[0], points[2]];
        assert!(hash(&points, &settings) != hash(&swapped, &settings));
        let other = BuildSettings {
            leaf_max: 17,
            ..settings
        };
        assert!(hash(&points, &settings) != hash(&points, &other));
    }
}
