//! The raster: for each of eight receivers a hemisphere of bits around its normal that all have the same cosine weight.
//!
//! Rows are half great circles through the poles on the frame's x axis: at row angle `phi` a direction is
//! `(tan a, sin phi, cos phi)` up to length, with `a` running along the row. The cosine-weighted measure is
//! `cos^2 a da * cos phi dphi`, a product, so rows even in `sin phi` and columns even in `(a + sin a cos a) / pi` cut the
//! hemisphere into cells of equal weight: irradiance and occlusion are bit counts. A convex cone meets a row in one
//! interval of `tan a`, found from its bounding half-spaces by one multiplication each.

use crate::footprint::{Footprint, RowSpan};
use crate::simd::{Floats, Words};
use crate::vector::Vector;
use glam::Vec3;
use std::ops::Range;

/// Tangents beyond this are the poles.
const FAR: f32 = 1e6;
/// Bits of a word.
const WORD_BITS: usize = 32;
/// Largest number of rows and of columns.
pub(crate) const RESOLUTION_MAX: usize = 64;
/// 2^23: floats from here on are integers, so that the last bits of a sum with a small number are that number, rounded ...
pub(crate) const INTEGER_SHIFT: f32 = 8_388_608.0;
/// ... and these hold the largest that a raster needs.
pub(crate) const INTEGER_MASK: u32 = 0x7f;

/// Share of covered bits from which it pays to ask whether a voxel is hidden.
const HIDDEN_TEST_SHARE: f32 = 0.1;

/// Directions of rows and columns of one resolution.
#[derive(Clone, Debug)]
pub(crate) struct RasterTables {
    pub(crate) resolution: usize,
    /// The same as a float.
    size: f32,
    /// Sine of the elevation of the lowest bits.
    pub(crate) lowest: f32,
    /// Covered bits from which it pays to ask whether a voxel is hidden.
    pub(crate) crowded: u32,
    row_sin: [f32; RESOLUTION_MAX],
    row_cos: [f32; RESOLUTION_MAX],
    /// sin and cos of `a` at the middle of each column.
    column_sin: [f32; RESOLUTION_MAX],
    column_cos: [f32; RESOLUTION_MAX],
}

impl RasterTables {
    pub(crate) fn new(resolution: usize) -> Self {
        let mut tables = Self {
            resolution,
            size: resolution as f32,
            lowest: 0.0,
            crowded: (HIDDEN_TEST_SHARE * (resolution * resolution) as f32) as u32,
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
        tables.lowest = tables.row_cos[0] * tables.column_cos[0];
        tables
    }

    /// Bits of one receiver.
    pub(crate) fn bits(&self) -> u32 {
        (self.resolution * self.resolution) as u32
    }

    fn full_row(&self) -> u64 {
        u64::MAX >> (64 - self.resolution)
    }

    /// Direction of a bit in the receiver's frame, unit.
    #[inline(always)]
    pub(crate) fn direction(&self, row: usize, column: usize) -> Vec3 {
        let (sin, cos) = (self.column_sin[column], self.column_cos[column]);
        Vec3::new(sin, cos * self.row_sin[row], cos * self.row_cos[row])
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

/// Bits of eight receivers: what is covered, and what of that counts as occluded. A row has `WORDS` words.
#[derive(Clone, Debug)]
pub(crate) struct Raster<F: Floats, const WORDS: usize> {
    covered: [[F::Words; WORDS]; RESOLUTION_MAX],
    /// Bits whose first surface is near enough to occlude; kept where surfaces occlude in part.
    occluded: [[F::Words; WORDS]; RESOLUTION_MAX],
    covered_count: F::Words,
}

/// How a footprint is drawn. What is left out follows a pattern that depends on `seed` alone.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Ink<F> {
    /// Share of the footprint that is covered; all if `None`.
    pub(crate) density: Option<F>,
    /// Share of the newly covered bits that count as occluded; all if `None`.
    pub(crate) weight: Option<F>,
    /// Names the element.
    pub(crate) seed: u64,
}

/// What a footprint added to the raster.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Covered<F> {
    /// Bits that were open before.
    pub(crate) bits: F,
    /// The same as an area, free of the steps of the columns: the share of the footprint that was open times its length
    /// along all rows, in columns. A bright light then fades smoothly where its edge crosses bits.
    pub(crate) light: F,
}

impl<F: Floats> Covered<F> {
    /// The lanes in which something was open.
    #[inline(always)]
    pub(crate) fn bits_set(&self) -> F::Words {
        F::splat(0.0).less(self.bits)
    }
}

/// Bits from which a footprint's length along the rows is a better measure than its bits; below, those that happen to be hit
/// stand for those that are not.
const EXACT_BITS: f32 = 64.0;

impl<F: Floats, const WORDS: usize> Raster<F, WORDS> {
    #[inline(always)]
    pub(crate) fn new() -> Self {
        let zero = F::Words::splat(0);
        Self {
            covered: [[zero; WORDS]; RESOLUTION_MAX],
            occluded: [[zero; WORDS]; RESOLUTION_MAX],
            covered_count: zero,
        }
    }

    #[inline(always)]
    pub(crate) fn clear(&mut self) {
        *self = Self::new();
    }

    /// Bits covered so far.
    #[inline(always)]
    pub(crate) fn covered_count(&self) -> F::Words {
        self.covered_count
    }

    /// Covers a footprint's bits for some lanes and counts those that were open. Without `PATTERN` it covers and occludes in full,
    /// and has no use for `ink`.
    #[inline(always)]
    pub(crate) fn cover<const N: usize, const PATTERN: bool>(
        &mut self,
        tables: &RasterTables,
        footprint: &Footprint<F, N>,
        lanes: u8,
        ink: &Ink<F>,
    ) -> Covered<F> {
        let zero = F::Words::splat(0);
        let rows = footprint.rows(tables.size, lanes);
        let lanes = F::Words::from_lanes(lanes);
        let resolution = F::splat(tables.size);
        let (far, near) = (F::splat(FAR), F::splat(-FAR));
        let (mut count, mut drawn, mut length) = (zero, zero, F::splat(0.0));
        for row in rows {
            let (sin, cos) = (F::splat(tables.row_sin[row]), F::splat(tables.row_cos[row]));
            let (mut low, mut high) = (near, far);
            for half_space in &footprint.half_spaces {
                let bound = half_space.y.mul_add(sin, half_space.z * cos).to_bits();
                // All ones are no number, and lose every comparison.
                low = (bound | half_space.upper).to_floats().max(low);
                high = (bound | half_space.lower).to_floats().min(high);
            }
            let met = low.less(high) & lanes;
            if met.lanes() == 0 {
                continue;
            }
            let (first, end) = (column_of_tangent(low, resolution), column_of_tangent(high, resolution));
            length = length + met.select(end - first, F::splat(0.0));
            let (first, end) = (rounded(first), rounded(end));
            drawn = drawn.wrapping_add(met & end.wrapping_sub(first).max_signed(zero));
            for (word, mask) in word_masks::<F, WORDS>(first, end).into_iter().enumerate() {
                let mut mask = mask & met;
                if let (true, Some(density)) = (PATTERN, ink.density) {
                    mask = mask & sparse_bits(ink.seed ^ (row * WORDS + word) as u64, density);
                }
                let covered = &mut self.covered[row][word];
                let newly = mask & !*covered;
                *covered = *covered | mask;
                count = count.wrapping_add(newly.count_ones());
                if let (true, Some(weight)) = (PATTERN, ink.weight) {
                    let kept = newly & sparse_bits(!ink.seed ^ (row * WORDS + word) as u64, weight);
                    self.occluded[row][word] = self.occluded[row][word] | kept;
                }
            }
        }
        self.covered_count = self.covered_count.wrapping_add(count);
        let (bits, drawn) = (count.as_floats(), drawn.as_floats());
        let light = if PATTERN && ink.density.is_some() {
            bits
        } else {
            drawn.less(F::splat(EXACT_BITS)).select(bits, bits * (length / drawn))
        };
        Covered { bits, light }
    }

    /// The lanes in which every bit of a window is covered already.
    #[inline(always)]
    pub(crate) fn hides(&self, tables: &RasterTables, window: &Window<F, WORDS>, lanes: u8) -> u8 {
        let mut open = F::Words::splat(0);
        for row in window.rows.clone() {
            let sin = F::splat(tables.row_sin[row]);
            let shown = window.low.less(sin) & sin.less(window.high);
            for (mask, covered) in window.columns.iter().zip(&self.covered[row]) {
                open = open | (shown & *mask & !*covered);
            }
        }
        lanes & !F::Words::splat(0).not_equal(open).lanes()
    }

    /// What is covered for one receiver, a word a row.
    #[inline(always)]
    pub(crate) fn covered(&self, lane: usize) -> [u64; RESOLUTION_MAX] {
        lane_of(&self.covered, lane)
    }

    /// What is occluded for one receiver, where surfaces occlude in part.
    #[inline(always)]
    pub(crate) fn occluded(&self, lane: usize) -> [u64; RESOLUTION_MAX] {
        lane_of(&self.occluded, lane)
    }
}

#[inline(always)]
fn lane_of<W: Words, const WORDS: usize>(rows: &[[W; WORDS]; RESOLUTION_MAX], lane: usize) -> [u64; RESOLUTION_MAX] {
    std::array::from_fn(|row| {
        let words = rows[row].iter().enumerate();
        words.fold(0, |sum, (word, bits)| {
            sum | u64::from(bits.to_array()[lane]) << (word * WORD_BITS)
        })
    })
}

/// Mean direction of the bits that are not set, unit, in the receiver's frame; z where all are.
pub(crate) fn bent_normal(bits: &[u64; RESOLUTION_MAX], tables: &RasterTables) -> Vec3 {
    let mut sum = Vec3::ZERO;
    for (row, bits) in bits.iter().enumerate().take(tables.resolution) {
        let mut open = !bits & tables.full_row();
        let (mut sin, mut cos) = (0.0, 0.0);
        while open != 0 {
            let column = open.trailing_zeros() as usize;
            sin += tables.column_sin[column];
            cos += tables.column_cos[column];
            open &= open - 1;
        }
        sum += Vec3::new(sin, cos * tables.row_sin[row], cos * tables.row_cos[row]);
    }
    sum.normalize_or(Vec3::Z)
}

/// Calls `visit` with row and column of every bit that is not set.
pub(crate) fn for_each_open(bits: &[u64; RESOLUTION_MAX], tables: &RasterTables, mut visit: impl FnMut(usize, usize)) {
    for (row, bits) in bits.iter().enumerate().take(tables.resolution) {
        let mut open = !bits & tables.full_row();
        while open != 0 {
            visit(row, open.trailing_zeros() as usize);
            open &= open - 1;
        }
    }
}

/// The box of rows and columns around spheres: it costs far less than their outlines, and is hidden nearly as often.
#[derive(Debug)]
pub(crate) struct Window<F: Floats, const WORDS: usize> {
    columns: [F::Words; WORDS],
    /// Sines of row angles.
    low: F,
    high: F,
    /// Rows of all lanes.
    rows: Range<usize>,
}

impl<F: Floats, const WORDS: usize> Window<F, WORDS> {
    /// Around spheres whose centres, in the receivers' frames, are farther than `radius`; where one is not, it means nothing.
    #[inline(always)]
    pub(crate) fn of_spheres(tables: &RasterTables, center: &Vector<F>, radius: f32, lanes: u8) -> Self {
        /// Sine of an angle that no rounding exceeds.
        const SLACK: f32 = 1e-4;
        let resolution = F::splat(tables.size);
        let radius = F::splat(radius);
        // Along the rows a sphere spans the angle to its middle plus and minus its angular radius. Lengths are times the
        // squared distance.
        let across = (center.y * center.y + center.z * center.z).sqrt();
        let tangent = (center.length_squared() - radius * radius).max(F::splat(0.0)).sqrt();
        let (x_tangent, x_radius) = (center.x * tangent, center.x * radius);
        let (across_tangent, across_radius) = (across * tangent, across * radius);
        let first = column_of_angle(x_tangent - across_radius, across_tangent + x_radius, resolution);
        let end = column_of_angle(x_tangent + across_radius, across_tangent - x_radius, resolution);
        let span = RowSpan::of_spheres(center, radius);
        Self {
            columns: word_masks::<F, WORDS>(rounded(first), rounded(end)),
            low: span.low - F::splat(SLACK),
            high: span.high + F::splat(SLACK),
            rows: span.rows(tables.size, lanes),
        }
    }
}

/// All bits of the lanes whose sign is set.
#[inline(always)]
fn met_mask<W: Words>(signs: W) -> W {
    W::splat(0).greater_signed(signs)
}

/// A run of columns as the words of a row.
#[inline(always)]
fn word_masks<F: Floats, const WORDS: usize>(first: F::Words, end: F::Words) -> [F::Words; WORDS] {
    let mut masks = [first; WORDS];
    for (word, mask) in masks.iter_mut().enumerate() {
        *mask = run_mask::<F>(first, end, word);
    }
    masks
}

/// The part of a run of columns, from `first` up to, not including, `end`, that lies in a word.
#[inline(always)]
fn run_mask<F: Floats>(first: F::Words, end: F::Words, word: usize) -> F::Words {
    let (zero, one) = (F::Words::splat(0), F::Words::splat(1));
    let base = F::Words::splat((word * WORD_BITS) as u32);
    // From 32 on the shift gives 0, and below it everything.
    let first = one
        .shift_left(first.wrapping_sub(base).max_signed(zero))
        .wrapping_sub(one);
    let end = one
        .shift_left(end.wrapping_sub(base).max_signed(zero))
        .wrapping_sub(one);
    end & !first
}

/// Where a tangent lies along a row, in columns.
#[inline(always)]
fn column_of_tangent<F: Floats>(tangent: F, resolution: F) -> F {
    let one = F::splat(1.0);
    column(tangent, one / (one + tangent.abs()), resolution)
}

/// Where an angle lies along a row, in columns, from its sine and cosine in any scale; the pole behind the horizon.
#[inline(always)]
fn column_of_angle<F: Floats>(sin: F, cos: F, resolution: F) -> F {
    let cos = cos.max(F::splat(0.0));
    column(sin, cos / (cos + sin.abs()), resolution)
}

/// Where a direction along a row lies, in columns: `resolution ((a + sin a cos a) / pi + 1/2)`, from the sign of `a` and
/// `y = cos |a| / (cos |a| + sin |a|)`. The rest to the pole begins with the cube of `y`; fitted to 2e-4, a hundredth of a column.
#[inline(always)]
fn column<F: Floats>(sign: F, y: F, resolution: F) -> F {
    const FIT: [f32; 6] = [0.807_386_2, -5.911_842_5, 27.192_5, -45.278_4, 31.945_1, -8.254_766];
    let mut sum = F::splat(FIT[5]);
    for factor in FIT[..5].iter().rev() {
        sum = sum.mul_add(y, F::splat(*factor));
    }
    let half_share = (-(y * y * y)).mul_add(sum, F::splat(0.5));
    (F::splat(0.5) + half_share.copysign(sign)) * resolution
}

/// Number of column middles below a place along a row.
#[inline(always)]
fn rounded<F: Floats>(column: F) -> F::Words {
    // The sum's last bits are the rounded integer. Not a number (a row through a sphere's own axis) becomes any column; its
    // row is known to be missed.
    (column + F::splat(INTEGER_SHIFT)).to_bits() & F::Words::splat(INTEGER_MASK)
}

/// Words whose bits are set with probability `density` (in steps of 1/16), always the same for a seed.
#[inline(always)]
fn sparse_bits<F: Floats>(seed: u64, density: F) -> F::Words {
    let steps = rounded(density * F::splat(16.0));
    let all = met_mask(F::Words::splat(15).wrapping_sub(steps));
    let mut state = seed;
    let mut bits = F::Words::splat(0);
    // Binary fraction, least digit first: OR raises the probability to (1 + p) / 2, AND halves it.
    for digit in 0..4 {
        state = splitmix(state);
        let random = F::Words::splat(state as u32);
        let digit = F::Words::splat(31 - digit);
        let set = met_mask(steps.shift_left(digit));
        bits = (set & (bits | random)) | (!set & bits & random);
    }
    bits | all
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
    use crate::footprint::{OF_RECTANGLE, Plane};
    use crate::simd::ScalarFloats;
    use std::f32::consts::PI;

    type Scalar64 = Raster<ScalarFloats, 2>;

    const SOLID: Ink<ScalarFloats> = Ink {
        density: None,
        weight: None,
        seed: 1,
    };

    fn splat(v: Vec3) -> Vector<ScalarFloats> {
        Vector::splat(v)
    }

    /// A square across z at height 1.
    fn square(center: Vec3, turn: (f32, f32), half: f32) -> Footprint<ScalarFloats, OF_RECTANGLE> {
        let plane = Plane {
            normal: splat(Vec3::Z),
            distance: ScalarFloats::splat(1.0),
        };
        let half = ScalarFloats::splat(half);
        let sides = [Vec3::new(turn.0, turn.1, 0.0), Vec3::new(-turn.1, turn.0, 0.0)].map(|axis| (splat(axis), half));
        Footprint::rectangle(splat(center), &plane, sides)
    }

    /// Form factors of parallel squares above the receiver, from tables of heat transfer.
    #[test]
    fn a_coaxial_square_covers_its_form_factor() {
        let tables = RasterTables::new(64);
        for half in [0.2f32, 0.5, 1.0, 3.0] {
            let mut raster = Scalar64::new();
            let square = square(Vec3::Z, (0.893_96, 0.448_14), half);
            let count = raster.cover::<_, false>(&tables, &square, 1, &SOLID).bits.to_array()[0];
            // Form factor of a parallel square from a point below its centre: four times that of a quarter.
            let x = half / (1.0 + half * half).sqrt();
            let quarter = x * (half / (1.0 + half * half).sqrt()).atan() / PI;
            let covered = count / tables.bits() as f32;
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
        for_each_open(&Scalar64::new().covered(0), &tables, |row, column| {
            let d = tables.direction(row, column);
            assert!((d.length() - 1.0).abs() < 1e-5);
            sum += d;
        });
        // The mean of z over the cosine-weighted hemisphere is 2/3.
        assert!((sum / tables.bits() as f32).distance(Vec3::Z * (2.0 / 3.0)) < 1e-3);
    }

    #[test]
    fn the_fitted_column_is_the_share_of_the_row() {
        for step in -100..=100 {
            let tangent = (step as f32 * 0.015).tan();
            let angle = f64::from(tangent).atan();
            let exact = 64.0 * ((angle + angle.sin() * angle.cos()) / std::f64::consts::PI + 0.5);
            let fitted = column_of_tangent(ScalarFloats::splat(tangent), ScalarFloats::splat(64.0)).to_array()[0];
            assert!(
                (f64::from(fitted) - exact).abs() < 0.02,
                "{tangent}: {fitted} for {exact}"
            );
        }
    }

    #[test]
    fn sparse_bits_have_their_density() {
        for density in [0.25f32, 0.5, 0.8125] {
            let count = |seed| sparse_bits(seed, ScalarFloats::splat(density)).to_array()[3].count_ones();
            let ones: u32 = (0..2000).map(count).sum();
            assert!((ones as f32 / 64_000.0 - density).abs() < 0.01);
        }
        assert_eq!(sparse_bits(7, ScalarFloats::splat(1.0)).to_array()[0], u32::MAX);
    }

    #[test]
    fn a_footprint_covered_twice_counts_once_and_is_hidden() {
        let tables = RasterTables::new(32);
        let mut raster = Raster::<ScalarFloats, 1>::new();
        let place = Vec3::new(0.3, 0.2, 1.0);
        let square = square(place, (1.0, 0.0), 0.4);
        let small = Window::of_spheres(&tables, &splat(place), 0.2, 3);
        let large = Window::of_spheres(&tables, &splat(place), 0.7, 3);
        assert_eq!(raster.hides(&tables, &small, 1), 0);
        assert!(raster.cover::<_, false>(&tables, &square, 1, &SOLID).bits.to_array()[0] > 0.0);
        assert_eq!(
            raster.cover::<_, false>(&tables, &square, 1, &SOLID).bits.to_array()[0],
            0.0
        );
        assert_eq!(raster.hides(&tables, &small, 3), 1, "the other lane is open");
        assert_eq!(raster.hides(&tables, &large, 1), 0);
    }
}
