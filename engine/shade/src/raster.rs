//! The raster: a hemisphere of bits around the receiver's normal that all have the same cosine weight.
//!
//! Rows are half great circles through the poles on the frame's x axis: at row angle `phi` a direction is
//! `(tan a, sin phi, cos phi)` up to length, with `a` running along the row. The cosine-weighted measure is
//! `cos^2 a da * cos phi dphi`, a product, so rows even in `sin phi` and columns even in `(a + sin a cos a) / pi` cut the
//! hemisphere into cells of equal weight: irradiance and occlusion are bit counts. A convex cone meets a row in one
//! interval of `tan a`, found from its bounding half-spaces by one division each.

use crate::footprint::{Footprint, row_blocks};
use std::f32::consts::{FRAC_1_PI, PI};

/// Tangents beyond this are the poles.
const FAR: f32 = 1e6;
/// Rows handled together, one vector register of floats.
pub(crate) const LANES: usize = 8;
/// Largest number of rows and of columns: one machine word a row.
pub(crate) const RESOLUTION_MAX: usize = 64;

/// Directions of rows and columns of one resolution.
#[derive(Clone, Debug)]
pub(crate) struct RasterTables {
    pub(crate) resolution: usize,
    row_sin: [f32; RESOLUTION_MAX],
    row_cos: [f32; RESOLUTION_MAX],
    /// sin and cos of `a` at the middle of each column.
    column_sin: [f32; RESOLUTION_MAX],
    column_cos: [f32; RESOLUTION_MAX],
}

/// Bits of one receiver: what is covered, and what of that counts as occluded.
#[derive(Clone, Debug)]
pub(crate) struct Raster {
    covered: [u64; RESOLUTION_MAX],
    /// Bits whose first surface is near enough to occlude; differs from `covered` only under `max_dist` and `falloff`.
    occluded: [u64; RESOLUTION_MAX],
    covered_count: u32,
}

impl RasterTables {
    pub(crate) fn new(resolution: usize) -> Self {
        let mut tables = Self {
            resolution,
            row_sin: [0.0; RESOLUTION_MAX],
            row_cos: [0.0; RESOLUTION_MAX],
            column_sin: [0.0; RESOLUTION_MAX],
            column_cos: [0.0; RESOLUTION_MAX],
        };
        for i in 0..resolution {
            let middle = (i as f64 + 0.5) / resolution as f64;
            let sin = 2.0 * middle - 1.0;
            tables.row_sin[i] = sin as f32;
            tables.row_cos[i] = (1.0 - sin * sin).sqrt() as f32;
            let a = column_angle(middle);
            tables.column_sin[i] = a.sin() as f32;
            tables.column_cos[i] = a.cos() as f32;
        }
        tables
    }

    /// Bits of the whole raster.
    pub(crate) fn bits(&self) -> u32 {
        (self.resolution * self.resolution) as u32
    }

    fn full_row(&self) -> u64 {
        u64::MAX >> (64 - self.resolution)
    }

    /// Direction of a bit in the receiver's frame, unit.
    #[inline(always)]
    pub(crate) fn direction(&self, row: usize, column: usize) -> glam::Vec3 {
        let (sin, cos) = (self.column_sin[column], self.column_cos[column]);
        glam::Vec3::new(sin, cos * self.row_sin[row], cos * self.row_cos[row])
    }
}

/// Angle at which the share `middle` of a row's weight lies behind: solves `(a + sin a cos a) / pi + 1/2 = middle`.
fn column_angle(middle: f64) -> f64 {
    let share = |a: f64| (a + a.sin() * a.cos()) / std::f64::consts::PI + 0.5;
    let (mut low, mut high) = (-std::f64::consts::FRAC_PI_2, std::f64::consts::FRAC_PI_2);
    for _ in 0..60 {
        let a = (low + high) / 2.0;
        if share(a) < middle { low = a } else { high = a }
    }
    (low + high) / 2.0
}

/// How a footprint is drawn. What is left out follows a pattern that depends on `seed` alone.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Ink {
    /// Share of the footprint that is covered.
    pub(crate) density: f32,
    /// Share of the newly covered bits that count as occluded.
    pub(crate) weight: f32,
    /// Names the element.
    pub(crate) seed: u64,
}

/// What a footprint added to the raster.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Covered {
    /// Bits that were open before.
    pub(crate) bits: u32,
    /// The same as an area, free of the steps of the columns: the share of the footprint that was open times its length
    /// along all rows, in columns. A bright light then fades smoothly where its edge crosses bits.
    pub(crate) light: f32,
}

/// Bits from which a footprint's length along the rows is a better measure than its bits; below, those that happen to be hit
/// stand for those that are not.
const EXACT_BITS: u32 = 64;

impl Raster {
    pub(crate) fn new() -> Self {
        Self {
            covered: [0; RESOLUTION_MAX],
            occluded: [0; RESOLUTION_MAX],
            covered_count: 0,
        }
    }

    pub(crate) fn clear(&mut self) {
        *self = Self::new();
    }

    /// Bits covered so far.
    #[inline(always)]
    pub(crate) fn covered_count(&self) -> u32 {
        self.covered_count
    }

    /// Covers a footprint's bits and counts those that were open.
    #[inline(always)]
    pub(crate) fn cover(&mut self, tables: &RasterTables, footprint: &Footprint, ink: Ink) -> Covered {
        let Ink { density, weight, seed } = ink;
        let (mut count, mut drawn, mut length) = (0, 0, 0.0);
        let blocks = footprint.rows(tables.resolution);
        for block in blocks {
            let (masks, block_length) = footprint_masks(tables, footprint, block);
            length += block_length;
            for (lane, mut mask) in masks.into_iter().enumerate() {
                let row = block * LANES + lane;
                if density < 1.0 {
                    mask &= sparse_bits(seed ^ row as u64, density);
                }
                drawn += mask.count_ones();
                let newly = mask & !self.covered[row];
                count += newly.count_ones();
                self.covered[row] |= mask;
                if weight >= 1.0 {
                    self.occluded[row] |= newly;
                } else if weight > 0.0 && newly != 0 {
                    self.occluded[row] |= newly & sparse_bits(!seed ^ row as u64, weight);
                }
            }
        }
        self.covered_count += count;
        let exact = drawn >= EXACT_BITS && density >= 1.0;
        let light = if exact {
            count as f32 * (length / drawn as f32)
        } else {
            count as f32
        };
        Covered { bits: count, light }
    }

    /// Whether every bit in which a sphere shows is covered already; `center` in the receiver's frame, farther than `radius`.
    #[inline(always)]
    pub(crate) fn hides_sphere(&self, tables: &RasterTables, center: glam::Vec3, radius: f32) -> bool {
        for block in row_blocks(center, radius, tables.resolution) {
            let masks = sphere_masks(tables, center, radius, block);
            let open = masks
                .into_iter()
                .zip(&self.covered[block * LANES..])
                .fold(0, |open, (m, c)| open | (m & !c));
            if open != 0 {
                return false;
            }
        }
        true
    }

    /// Mean direction of what is not occluded, unit, in the receiver's frame; z where nothing is open.
    #[inline(always)]
    pub(crate) fn bent_normal(&self, tables: &RasterTables) -> glam::Vec3 {
        let mut sum = glam::Vec3::ZERO;
        for row in 0..tables.resolution {
            let mut open = !self.occluded[row] & tables.full_row();
            let (mut sin, mut cos) = (0.0, 0.0);
            while open != 0 {
                let column = open.trailing_zeros() as usize;
                sin += tables.column_sin[column];
                cos += tables.column_cos[column];
                open &= open - 1;
            }
            sum += glam::Vec3::new(sin, cos * tables.row_sin[row], cos * tables.row_cos[row]);
        }
        sum.normalize_or(glam::Vec3::Z)
    }

    /// Calls `visit` with row and column of every bit that nothing covers.
    #[inline(always)]
    pub(crate) fn for_each_open(&self, tables: &RasterTables, mut visit: impl FnMut(usize, usize)) {
        for row in 0..tables.resolution {
            let mut open = !self.covered[row] & tables.full_row();
            while open != 0 {
                visit(row, open.trailing_zeros() as usize);
                open &= open - 1;
            }
        }
    }
}

/// Bits of eight rows that lie inside a footprint.
#[inline(always)]
fn footprint_masks(tables: &RasterTables, footprint: &Footprint, block: usize) -> ([u64; LANES], f32) {
    let start = block * LANES;
    let (mut low, mut high) = ([-FAR; LANES], [FAR; LANES]);
    for plane in footprint.half_spaces() {
        let bound: [f32; LANES] = std::array::from_fn(|lane| {
            let (sin, cos) = (tables.row_sin[start + lane], tables.row_cos[start + lane]);
            -(plane.y * sin + plane.z * cos) * plane.inverse_x
        });
        if plane.inverse_x > 0.0 {
            for lane in 0..LANES {
                low[lane] = if bound[lane] > low[lane] {
                    bound[lane]
                } else {
                    low[lane]
                };
            }
        } else {
            for lane in 0..LANES {
                high[lane] = if bound[lane] < high[lane] {
                    bound[lane]
                } else {
                    high[lane]
                };
            }
        }
    }
    let (first, end) = (columns(&low, tables.resolution), columns(&high, tables.resolution));
    let mut masks = [0; LANES];
    let mut lengths = [0.0; LANES];
    for lane in 0..LANES {
        masks[lane] = run_mask(rounded(first[lane]), rounded(end[lane]));
        lengths[lane] = (end[lane] - first[lane]).max(0.0);
    }
    (masks, lengths.iter().sum())
}

/// Bits from `first` up to, not including, `end`; both at most 64.
#[inline(always)]
fn run_mask(first: u32, end: u32) -> u64 {
    // A shift by 64 is out of range, hence the halves.
    let below = |column: u32| ((1u64 << (column / 2)) << (column - column / 2)).wrapping_sub(1);
    below(end) & !below(first)
}

/// Where each tangent lies along a row, in columns.
#[inline(always)]
fn columns(tangent: &[f32; LANES], resolution: usize) -> [f32; LANES] {
    let mut result = [0.0; LANES];
    for lane in 0..LANES {
        let tangent = tangent[lane].clamp(-FAR, FAR);
        let cos = 1.0 / (1.0 + tangent * tangent).sqrt();
        result[lane] = column(tangent * cos, cos, resolution as f32);
    }
    result
}

/// Bits of eight rows in which a sphere shows. In a row's plane the sphere lies around the angle of its centre's projection
/// `(x, p)`, at distance `q`; it spans the angles whose cosine with that is `m / q`, `m` being the length of the tangents.
#[inline(always)]
fn sphere_masks(tables: &RasterTables, center: glam::Vec3, radius: f32, block: usize) -> [u64; LANES] {
    let start = block * LANES;
    let resolution = tables.resolution as f32;
    let tangent_squared = center.length_squared() - radius * radius;
    let tangent = tangent_squared.max(0.0).sqrt();
    let x = center.x;
    let (mut low, mut low_cos, mut high, mut high_cos, mut seen) =
        ([0.0; LANES], [0.0; LANES], [0.0; LANES], [0.0; LANES], [0u32; LANES]);
    for lane in 0..LANES {
        let p = center.y * tables.row_sin[start + lane] + center.z * tables.row_cos[start + lane];
        let q_squared = x * x + p * p;
        let reach_squared = q_squared - tangent_squared;
        let reach = reach_squared.max(0.0).sqrt();
        let inverse = 1.0 / q_squared;
        low_cos[lane] = (p * tangent + x * reach) * inverse;
        high_cos[lane] = (p * tangent - x * reach) * inverse;
        low[lane] = (x * tangent - p * reach) * inverse;
        high[lane] = (x * tangent + p * reach) * inverse;
        // Signs as masks: a branch would keep the loop from becoming one of vectors.
        seen[lane] = !sign_mask(reach_squared) & !(sign_mask(low_cos[lane]) & sign_mask(high_cos[lane]) & sign_mask(p));
    }
    let (mut first, mut end) = ([0; LANES], [0; LANES]);
    for lane in 0..LANES {
        let low = select(sign_mask(low_cos[lane]), -1.0, low[lane]);
        let high = select(sign_mask(high_cos[lane]), 1.0, high[lane]);
        first[lane] = rounded(column(low, low_cos[lane], resolution));
        end[lane] = rounded(column(high, high_cos[lane], resolution)) & seen[lane];
    }
    let mut masks = [0; LANES];
    for lane in 0..LANES {
        masks[lane] = run_mask(first[lane], end[lane]);
    }
    masks
}

/// All ones for a negative number.
#[inline(always)]
fn sign_mask(value: f32) -> u32 {
    ((value.to_bits() as i32) >> 31) as u32
}

#[inline(always)]
fn select(mask: u32, set: f32, clear: f32) -> f32 {
    f32::from_bits((set.to_bits() & mask) | (clear.to_bits() & !mask))
}

/// Where an angle lies along a row, in columns: `resolution ((a + sin a cos a) / pi + 1/2)`. The arcsine is the polynomial
/// 4.4.45 of Abramowitz and Stegun, whose error (7e-5) is a thousandth of a column.
#[inline(always)]
fn column(sin: f32, cos: f32, resolution: f32) -> f32 {
    let s = sin.abs().min(1.0);
    let polynomial = 1.570_728_8 + s * (-0.212_114_4 + s * (0.074_261 - s * 0.018_729_3));
    let arcsine = PI / 2.0 - (1.0 - s).sqrt() * polynomial;
    let half_share = (arcsine + s * cos.max(0.0)) * FRAC_1_PI;
    (0.5 + half_share.copysign(sin)) * resolution
}

/// Number of column middles below a place along a row.
#[inline(always)]
fn rounded(column: f32) -> u32 {
    /// 2^23: floats from here on are integers.
    const INTEGER_SHIFT: f32 = 8_388_608.0;
    const COLUMN_MASK: u32 = 0x7f;
    // The sum's last bits are the rounded integer; a cast would check for what cannot be. Not a number (a row through the
    // sphere's own axis) becomes any column; its row is known to be missed.
    ((column + INTEGER_SHIFT).to_bits() & COLUMN_MASK).min(RESOLUTION_MAX as u32)
}

/// A word whose bits are set with probability `density` (in steps of 1/16), always the same for a seed.
#[inline(always)]
fn sparse_bits(seed: u64, density: f32) -> u64 {
    let steps = (density * 16.0 + 0.5) as u32;
    if steps >= 16 {
        return u64::MAX;
    }
    let mut state = seed;
    let mut bits = 0;
    // Binary fraction, least digit first: OR raises the probability to (1 + p) / 2, AND halves it.
    for digit in 0..4 {
        state = splitmix(state);
        bits = if steps >> digit & 1 == 1 {
            bits | state
        } else {
            bits & state
        };
    }
    bits
}

#[inline(always)]
fn splitmix(state: u64) -> u64 {
    let mut z = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ z >> 31
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::footprint::Footprint;
    use glam::Vec3;

    const SOLID: Ink = Ink {
        density: 1.0,
        weight: 1.0,
        seed: 1,
    };

    /// Form factors of parallel squares above the receiver, from tables of heat transfer.
    #[test]
    fn a_coaxial_square_covers_its_form_factor() {
        let tables = RasterTables::new(64);
        for half in [0.2f32, 0.5, 1.0, 3.0] {
            let mut raster = Raster::new();
            let turned = |x, y| (Vec3::new(x, y, 0.0), half);
            let sides = [turned(0.893_96, 0.448_14), turned(-0.448_14, 0.893_96)];
            let square = Footprint::rectangle(Vec3::Z, Vec3::Z, 1.0, sides);
            let count = raster.cover(&tables, &square, SOLID).bits;
            // Form factor of a parallel square from a point below its centre: four times that of a quarter.
            let x = half / (1.0 + half * half).sqrt();
            let quarter = x * (half / (1.0 + half * half).sqrt()).atan() / PI;
            let covered = count as f32 / tables.bits() as f32;
            assert!(
                (covered - 4.0 * quarter).abs() < 0.006,
                "half {half}: {covered} for {}",
                4.0 * quarter
            );
        }
    }

    #[test]
    fn directions_are_unit_and_average_to_the_cosine_mean() {
        let tables = RasterTables::new(64);
        let mut sum = Vec3::ZERO;
        Raster::new().for_each_open(&tables, |row, column| {
            let d = tables.direction(row, column);
            assert!((d.length() - 1.0).abs() < 1e-5);
            sum += d;
        });
        // The mean of z over the cosine-weighted hemisphere is 2/3.
        assert!((sum / tables.bits() as f32).distance(Vec3::Z * (2.0 / 3.0)) < 1e-3);
    }

    #[test]
    fn sparse_bits_have_their_density() {
        for density in [0.25f32, 0.5, 0.8125] {
            let ones: u32 = (0..1000).map(|seed| sparse_bits(seed, density).count_ones()).sum();
            assert!((ones as f32 / 64_000.0 - density).abs() < 0.01);
        }
        assert_eq!(sparse_bits(7, 1.0), u64::MAX);
    }

    #[test]
    fn a_footprint_covered_twice_counts_once_and_is_hidden() {
        let tables = RasterTables::new(32);
        let mut raster = Raster::new();
        let square = Footprint::rectangle(Vec3::new(0.3, 0.2, 1.0), Vec3::Z, 1.0, [(Vec3::X, 0.4), (Vec3::Y, 0.4)]);
        assert!(!raster.hides_sphere(&tables, Vec3::new(0.3, 0.2, 1.0), 0.2));
        assert!(raster.cover(&tables, &square, SOLID).bits > 0);
        assert_eq!(raster.cover(&tables, &square, SOLID).bits, 0);
        assert!(raster.hides_sphere(&tables, Vec3::new(0.3, 0.2, 1.0), 0.2));
        assert!(!raster.hides_sphere(&tables, Vec3::new(0.3, 0.2, 1.0), 0.7));
    }
}
