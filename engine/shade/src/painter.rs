//! Draws the elements of a cut into the raster and sums what they add, for eight receivers at a time.

use crate::cluster::{Cluster, SAME_SHEET, Sheet, is_aligned, is_own_surface, orthonormal_pair, rectangle_of};
use crate::cut::{Pack, Sight, Visit, Walk};
use crate::footprint::{Footprint, Plane};
use crate::leaf::{Disc, Facet, Part};
use crate::raster::{Covered, Ink, Raster};
use crate::simd::{Floats, LANES, Words};
use crate::vector::Vector;
use glam::Vec3;
use pbgi_core::HitSides;

/// Above this the voxel holds two sheets, of which the receiver sees one.
const TWO_SHEETS_FILL: f32 = 1.6;
/// Distance in radii within which a disc may be the receiver's own surface.
const NEAR_RADII: f32 = 6.0;
/// Width of what a disc or facet stands for, in radii, when asked whether a receiver lies on it.
const DISC_WIDTH: f32 = 4.0;
/// A receiver under a disc is on it within this many radii ...
const UNDER_DEPTH: f32 = 0.5;
/// ... if its middle is no higher above the receiver's horizon: what reaches over an edge starts below it ...
const OVERHANG: f32 = 0.3;
/// ... and within this many behind one that faces as it does.
const BEHIND_DEPTH: f32 = 1.25;
/// Distance from a plane, as a share of half a voxel's edge or of a disc's radius, that is no distance.
const TOUCH: f32 = 1e-3;
/// Share of its rectangle that a round cluster must cover to be drawn opaque; thinner ones are drawn with holes.
const OPAQUE_SHARE: f32 = 0.4;
/// Area by which a dense piece of a sheet is drawn larger: a rectangle never meets its neighbours exactly, and a closed wall
/// must not leak ...
const WALL_SCALE: f32 = 1.2;
/// ... if it covers this share of its rectangle.
const WALL_SHARE: f32 = 0.7;
/// Share of its rectangle that what is before a sheet covers at least.
const LEAST_SHARE: f32 = 0.01;

/// How much larger a round cluster is drawn than what it covers.
#[inline(always)]
fn wall_scale<F: Floats>(covered: F, scattered: f32) -> F {
    let dense = ((covered - F::splat(OPAQUE_SHARE)) * F::splat(1.0 / (WALL_SHARE - OPAQUE_SHARE))).clamp(0.0, 1.0);
    dense.mul_add(F::splat((WALL_SCALE - 1.0) * (1.0 - scattered)), F::splat(1.0))
}

/// Draws elements into the rasters and sums what they add.
pub(crate) struct Painter<'a, F: Floats, const WORDS: usize> {
    pub(crate) walk: &'a Walk<'a>,
    pub(crate) pack: &'a Pack<F>,
    pub(crate) raster: &'a mut Raster<F, WORDS>,
    /// Radiance, bit by bit.
    pub(crate) radiance: Vector<F>,
    /// Occlusion weight, bit by bit.
    pub(crate) occlusion: F,
}

impl<'a, F: Floats, const WORDS: usize> Painter<'a, F, WORDS> {
    #[inline(always)]
    pub(crate) fn new(walk: &'a Walk<'a>, pack: &'a Pack<F>, raster: &'a mut Raster<F, WORDS>) -> Self {
        raster.clear();
        Self {
            walk,
            pack,
            raster,
            radiance: Vector::splat(Vec3::ZERO),
            occlusion: F::splat(0.0),
        }
    }

    /// The lanes that may still see something of a voxel: it is not behind what is drawn already.
    #[inline(always)]
    pub(crate) fn seen_by(&self, sight: &Sight<F, WORDS>) -> u8 {
        let tables = self.walk.tables;
        let covered = self.raster.covered_count();
        let open = F::Words::splat(tables.bits()).greater_signed(covered);
        let lanes = sight.visit.lanes & open.lanes();
        let crowded = covered.greater_signed(F::Words::splat(tables.crowded));
        let asked = lanes & sight.far & crowded.lanes();
        if asked == 0 {
            return lanes;
        }
        lanes & !self.raster.hides(tables, &sight.window, asked)
    }

    /// Draws a cluster for some lanes; `center` is its voxel's, `centroid` its own, relative to the receivers.
    #[inline(always)]
    pub(crate) fn draw_cluster(
        &mut self,
        cluster: &Cluster<'_>,
        visit: &Visit,
        center: Vector<F>,
        centroid: Vector<F>,
        lanes: u8,
    ) {
        let sheet = if cluster.flat {
            None
        } else {
            match self.draw_round(cluster, visit, centroid, lanes) {
                None => return,
                sheet => sheet,
            }
        };
        let axis = Vector::splat(sheet.as_ref().map_or(cluster.axis, |sheet| sheet.axis));
        let lanes = lanes & !cluster.own_surface(self.pack.frames.z, centroid, center);
        let lanes = self.hit(lanes, axis, centroid, || match sheet {
            Some(_) => [1.0, 0.0],
            None => cluster.facing(),
        });
        if lanes != 0 {
            self.draw_flat(cluster, sheet.as_ref(), visit, center, centroid, lanes);
        }
    }

    /// A piece of a plane: the section of its voxel if it fills that, as a `sheet` behind other things does, else the rectangle of its
    /// covariance.
    #[inline(always)]
    fn draw_flat(
        &mut self,
        cluster: &Cluster<'_>,
        sheet: Option<&Sheet>,
        visit: &Visit,
        center: Vector<F>,
        centroid: Vector<F>,
        lanes: u8,
    ) {
        let frames = &self.pack.frames;
        let (axis, height) = sheet.map_or((cluster.axis, 0.0), |sheet| (sheet.axis, sheet.height));
        let middle = centroid + Vector::splat(axis * height);
        let axis = Vector::splat(axis);
        let plane = Plane::through(frames, middle, axis, TOUCH * visit.half);
        let weight = self.weight(
            middle,
            #[inline(always)]
            |direction| cluster.depth(direction),
        );
        let (covered, drawn_area) = if sheet.is_some() || cluster.fills_section() {
            let (of_voxel, of_points) = cluster.section_reach();
            let (of_voxel, of_points) = (Vector::splat(of_voxel), Vector::splat(of_points));
            let low = (center - of_voxel).max(centroid - of_points);
            let high = (center + of_voxel).min(centroid + of_points);
            let section = Footprint::section(frames, low, high, &plane);
            let covered = self.cover(&section, lanes, None, weight, visit.path);
            (covered, F::splat(cluster.area / cluster.fill))
        } else {
            let [(u, a), (v, b)] = rectangle_of(&cluster.covariance, axis);
            // Shrunk where the points cover less than the rectangle; it is never made larger.
            let four = F::splat(4.0);
            let scale = F::splat(cluster.area) / (four * a * b).max(F::splat(1e-30));
            let scale = scale.min(F::splat(1.0)).sqrt();
            let (a, b) = (a * scale, b * scale);
            let sides = [(frames.local_from_world(u), a), (frames.local_from_world(v), b)];
            let rectangle = Footprint::rectangle(frames.local_from_world(centroid), &plane, sides);
            (self.cover(&rectangle, lanes, None, weight, visit.path), four * a * b)
        };
        let Some(covered) = covered else {
            return;
        };
        match sheet {
            Some(sheet) => self.add_light([sheet.radiance, Vec3::ZERO], axis, middle, covered.light),
            None => {
                let powers = cluster.side_powers::<F>();
                // One sheet shows all its area; of two the receiver sees the nearer.
                let area = if cluster.fill > TWO_SHEETS_FILL {
                    drawn_area
                } else {
                    F::splat(cluster.area)
                };
                self.add_light(powers, axis, centroid, covered.light / area);
            }
        }
    }

    /// A cluster without a plane: the rectangle of its covariance seen from the receiver, as wide as what it covers. Where it is a
    /// sheet with other things before it, that is drawn of these, and the sheet returned.
    #[inline(always)]
    fn draw_round(&mut self, cluster: &Cluster<'_>, visit: &Visit, centroid: Vector<F>, lanes: u8) -> Option<Sheet> {
        let frames = &self.pack.frames;
        let distance = centroid.length_squared().sqrt();
        let apart = F::splat(1e-6 * visit.half).less(distance);
        let lanes = lanes & apart.lanes();
        let direction = centroid * (F::splat(1.0) / distance);
        let shown = cluster.toward(-direction);
        let sides = self.walk.settings.hit_sides;
        let plane = Plane {
            normal: frames.local_from_world(direction),
            distance,
        };
        let [(u, a), (v, b)] = rectangle_of(&cluster.covariance, direction);
        let tiny = F::splat(1e-30);
        let rectangle = (F::splat(4.0) * a * b).max(tiny);
        let scattered = shown.scattered();
        let sheet = shown.sheet();
        let (area, middle) = match &sheet {
            Some(sheet) => {
                // A difference of roundings is no area.
                let area = shown.area_without(sheet, sides).max(rectangle * F::splat(LEAST_SHARE));
                (area, centroid + Vector::splat(sheet.axis * sheet.others_height()))
            }
            // Of leaves, chance says which are seen, not which way they face.
            None if scattered < 1.0 => (shown.area(sides), centroid + shown.shift() * F::splat(1.0 - scattered)),
            None => (shown.area(sides), centroid),
        };
        let visible = area.min(rectangle).max(tiny);
        let covered = visible / rectangle;
        let density = (covered * F::splat(1.0 / OPAQUE_SHARE)).min(F::splat(1.0));
        let scale = wall_scale(covered, scattered) * covered.max(F::splat(OPAQUE_SHARE));
        let scale = scale.sqrt();
        let (a, b) = (a * scale, b * scale);
        let axes = [(frames.local_from_world(u), a), (frames.local_from_world(v), b)];
        let footprint = Footprint::rectangle(frames.local_from_world(middle), &plane, axes);
        let weight = self.weight(
            centroid,
            #[inline(always)]
            |direction| cluster.depth(direction),
        );
        let thin = density.less(F::splat(1.0)).lanes() & lanes != 0;
        let covered = self.cover(&footprint, lanes, thin.then_some(density), weight, visit.path);
        if let Some(covered) = covered {
            // What hides is taken to be as unlit as the insides of a body.
            let lit = covered.bits_set().select(covered.light / visible, F::splat(0.0));
            let power = match &sheet {
                Some(sheet) => shown.power_without(sheet),
                None => shown.power(),
            };
            self.radiance = self.radiance + power * lit;
        }
        sheet
    }

    /// The parts of an opened leaf, in the order in which the walk would meet them had it gone on: by distance along the
    /// diagonal of the octant in which the receivers stand.
    #[inline(always)]
    pub(crate) fn draw_parts(
        &mut self,
        parts: &[Part],
        order: &mut Vec<(f32, u32)>,
        visit: &Visit,
        octant: u32,
        lanes: u8,
    ) {
        // Away from the receivers.
        let side = |bit: u32| if octant >> bit & 1 == 1 { -1.0f32 } else { 1.0 };
        let diagonal = Vec3::new(side(0), side(1), side(2));
        order.clear();
        order.extend(
            parts
                .iter()
                .enumerate()
                .map(|(index, part)| (diagonal.dot(part.center()), index as u32)),
        );
        order.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        for (_, index) in order.iter() {
            match &parts[*index as usize] {
                Part::Disc(disc) => self.draw_disc(disc, lanes),
                Part::Facet(facet) => self.draw_facet(facet, visit, lanes),
            }
        }
    }

    #[inline(always)]
    fn draw_facet(&mut self, facet: &Facet, visit: &Visit, lanes: u8) {
        let frames = &self.pack.frames;
        let (centroid, normal) = (self.pack.relative(facet.centroid), Vector::splat(facet.normal));
        let plane = Plane::through(frames, centroid, normal, TOUCH * visit.half);
        let touched =
            is_aligned(frames.z, normal) & plane.distance.less(F::splat(self.walk.settings.bias * facet.radius));
        let own = touched | is_own_surface(frames.z, normal, centroid, DISC_WIDTH * facet.radius);
        let lanes = self.hit(lanes & !own.lanes(), normal, centroid, || facet.facing);
        if lanes == 0 {
            return;
        }
        let (low, high) = (self.pack.relative(facet.low), self.pack.relative(facet.high));
        let cuts = facet.cuts().iter().map(
            #[inline(always)]
            |cut| {
                let normal = Vector::splat(cut.normal);
                let distance = normal.dot(self.pack.relative(cut.point));
                (frames.local_from_world(normal), distance)
            },
        );
        let footprint = Footprint::section(frames, low, high, &plane).cut(&plane, cuts);
        let weight = self.weight(
            centroid,
            #[inline(always)]
            |_| F::splat(facet.radius),
        );
        if let Some(covered) = self.cover(&footprint, lanes, None, weight, visit.path) {
            self.add_light(facet.radiance, normal, centroid, covered.light);
        }
    }

    #[inline(always)]
    fn draw_disc(&mut self, disc: &Disc, lanes: u8) {
        let frames = &self.pack.frames;
        let (center, normal) = (self.pack.relative(disc.center), Vector::splat(disc.normal));
        let plane = Plane::through(frames, center, normal, TOUCH * disc.radius);
        let own = self.is_own_disc(disc, center, normal, plane.distance);
        let lanes = self.hit(lanes & !own.lanes(), normal, center, || [1.0, 0.0]);
        if lanes == 0 {
            return;
        }
        let [u, v] = orthonormal_pair(normal);
        let axes = [frames.local_from_world(u), frames.local_from_world(v)];
        let footprint = Footprint::disc(frames.local_from_world(center), &plane, axes, disc.drawn_radius);
        let weight = self.weight(
            center,
            #[inline(always)]
            |_| F::splat(disc.radius),
        );
        if let Some(covered) = self.cover(&footprint, lanes, None, weight, 0) {
            self.add_light(disc.radiance, normal, center, covered.light);
        }
    }

    /// The lanes in which a disc is the receiver's own surface, or so near that points cannot tell: below the distance between
    /// points nothing is known of a surface, and a disc reaches over its edge.
    #[inline(always)]
    fn is_own_disc(&self, disc: &Disc, center: Vector<F>, normal: Vector<F>, distance: F) -> F::Words {
        let receiver_normal = self.pack.frames.z;
        let squared = center.length_squared();
        let near = squared.less(F::splat((NEAR_RADII * disc.radius).powi(2)));
        let touched =
            is_aligned(receiver_normal, normal) & distance.less(F::splat(self.walk.settings.bias * disc.radius));
        let own = touched | is_own_surface(receiver_normal, normal, center, DISC_WIDTH * disc.radius);
        let beside = squared - distance * distance;
        let overhangs = receiver_normal.dot(center).less(F::splat(OVERHANG * disc.radius));
        let under = overhangs
            & beside.less(F::splat(disc.drawn_radius.powi(2)))
            & distance.less(F::splat(UNDER_DEPTH * disc.radius));
        let facing = F::splat(SAME_SHEET).less(normal.dot(receiver_normal));
        let behind =
            facing & F::splat(0.0).less(normal.dot(center)) & distance.less(F::splat(BEHIND_DEPTH * disc.radius));
        near & (own | under | behind)
    }

    /// The lanes that see sides which count of a flat element at `center`. `facing` gives the area that faces along its normal,
    /// and against it.
    #[inline(always)]
    fn hit(&self, lanes: u8, normal: Vector<F>, center: Vector<F>, facing: impl Fn() -> [f32; 2]) -> u8 {
        /// Share of an element's area that is enough: of a sheet with two sides, half is.
        const SHARE_MIN: f32 = 0.25;
        let sides = self.walk.settings.hit_sides;
        if sides == HitSides::Both {
            return lanes;
        }
        let [along, against] = facing();
        // Who stands where the normal points to sees the fronts of what faces along it, and the backs of the rest.
        let (before, behind) = match sides {
            HitSides::Back => (against, along),
            _ => (along, against),
        };
        let enough = SHARE_MIN * (along + against);
        let stands_before = normal.dot(center).less(F::splat(0.0)).lanes();
        let mut hit = 0;
        if before > enough {
            hit |= stands_before;
        }
        if behind > enough {
            hit |= !stands_before;
        }
        lanes & hit
    }

    /// Adds what a two-sided element at `center` shows: the first of `sides` where the receiver is on the side of `normal`.
    #[inline(always)]
    fn add_light(&mut self, sides: [Vec3; 2], normal: Vector<F>, center: Vector<F>, light: F) {
        let toward = normal.dot(center).less(F::splat(0.0));
        let (front, back) = (Vector::splat(sides[0]), Vector::splat(sides[1]));
        let seen = Vector {
            x: toward.select(front.x, back.x),
            y: toward.select(front.y, back.y),
            z: toward.select(front.z, back.z),
        };
        self.radiance = self.radiance + seen * light;
    }

    /// Covers a footprint; `None` if nothing of it was open.
    #[inline(always)]
    fn cover<const N: usize>(
        &mut self,
        footprint: &Footprint<F, N>,
        lanes: u8,
        density: Option<F>,
        weight: Option<F>,
        seed: u64,
    ) -> Option<Covered<F>> {
        let ink = Ink { density, weight, seed };
        let tables = self.walk.tables;
        let covered = if density.is_some() || weight.is_some() {
            F::cover::<WORDS, N, true>(self.raster, tables, footprint, lanes, &ink)
        } else {
            F::cover::<WORDS, N, false>(self.raster, tables, footprint, lanes, &ink)
        };
        if covered.bits_set().lanes() == 0 {
            return None;
        }
        let occluded = match weight {
            None => covered.bits,
            Some(weight) => covered.bits * weight,
        };
        self.occlusion = self.occlusion + occluded;
        Some(covered)
    }

    /// How much surfaces at `center`, reaching `extent` to both sides, count as occluders; all if `None`.
    #[inline(always)]
    fn weight(&self, center: Vector<F>, extent: impl Fn(Vector<F>) -> F) -> Option<F> {
        let settings = self.walk.settings;
        if !settings.weighs_distance() {
            return None;
        }
        let distance = center.length_squared().sqrt();
        let extent = extent(center * (F::splat(1.0) / distance.max(F::splat(f32::MIN_POSITIVE))));
        let width = (extent + extent).max(F::splat(f32::MIN_POSITIVE));
        let within = ((F::splat(settings.max_dist) - distance + extent) / width).clamp(0.0, 1.0);
        let fade: [f32; LANES] = distance.to_array().map(|distance| (-settings.falloff * distance).exp());
        Some(within * F::from_array(fade))
    }
}
