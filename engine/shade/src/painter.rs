//! Draws the elements of a cut into the raster and sums what they add.

use crate::cluster::{Cluster, SECTION_FILL, is_aligned, is_own_surface, rectangle_of};
use crate::cut::{Seen, Visit, Walk};
use crate::facet::{Facet, facets};
use crate::footprint::{Footprint, Plane};
use crate::frame::Frame;
use crate::raster::{Covered, Ink, Raster};
use crate::shader::Receiver;
use glam::Vec3;
use pbgi_core::PointRecord;
use pbgi_core::cluster::separate_sides;

/// Above this the voxel holds two sheets, of which the receiver sees one.
const TWO_SHEETS_FILL: f32 = 1.6;
/// Discs are drawn this much wider than their area says, because round ones of equal area leave gaps on a surface.
const DISC_SCALE: f32 = 1.4;
const NEAR_RADII: f32 = 6.0;
/// Width of what a disc or facet stands for, in radii, when asked whether a receiver lies on it.
const DISC_WIDTH: f32 = 4.0;
/// Distance from a plane, as a share of half a voxel's edge or of a disc's radius, that is no distance.
const TOUCH: f32 = 1e-3;
/// Share of covered bits from which it pays to ask whether a voxel is hidden.
const HIDDEN_TEST_SHARE: f32 = 0.1;
/// Share of its section that a facet's points must cover to be drawn as the section. A leaf holds few points, so the share is
/// uncertain by a third.
const FACET_FILL: f32 = 0.35;
/// Share of its rectangle that a round cluster must show to be drawn opaque; thinner ones are drawn with holes.
const OPAQUE_SHARE: f32 = 0.4;
/// Area by which an opaque round cluster is drawn larger: a rectangle never meets its neighbours exactly, and a closed wall
/// must not leak.
const ROUND_SCALE: f32 = 1.2;

/// Draws elements into the raster and sums what they add.
pub(crate) struct Painter<'a> {
    pub(crate) walk: &'a Walk<'a>,
    pub(crate) frame: &'a Frame,
    pub(crate) raster: &'a mut Raster,
    pub(crate) seen: Seen,
}

impl Painter<'_> {
    /// Whether nothing of a voxel can be seen: below the horizon, or behind what is drawn already.
    #[inline(always)]
    pub(crate) fn culls(&self, visit: &Visit) -> bool {
        let reach = visit.half * 1.732_051 + visit.radius;
        if self.frame.normal().dot(visit.center) < -reach {
            return true;
        }
        let bits = self.walk.tables.bits();
        if self.raster.covered_count() == bits {
            return true;
        }
        let far = visit.center.length_squared() > 1.1 * reach * reach;
        let local = self.frame.local_from_world(visit.center);
        far && self.raster.covered_count() as f32 > HIDDEN_TEST_SHARE * bits as f32
            && self.walk.simd.hides_sphere(self.raster, self.walk.tables, local, reach)
    }

    #[inline(always)]
    pub(crate) fn draw_cluster(&mut self, cluster: &Cluster, visit: &Visit) {
        if cluster.own_surface {
            return;
        }
        if cluster.flat {
            self.draw_flat(cluster, visit)
        } else {
            self.draw_round(cluster, visit)
        }
    }

    /// A piece of a plane: the section of its voxel if it fills that, else the rectangle of its covariance.
    #[inline(never)]
    fn draw_flat(&mut self, cluster: &Cluster, visit: &Visit) {
        let plane = Plane::through(cluster.centroid, cluster.axis, TOUCH * visit.half);
        let toward = cluster.axis.dot(cluster.centroid) < 0.0;
        let (footprint, drawn_area) = if cluster.fill >= SECTION_FILL {
            let section = Footprint::section(self.frame, cluster.section_box(visit), plane);
            (section, cluster.area / cluster.fill)
        } else {
            self.rectangle(cluster, plane)
        };
        let distance = cluster.distance_squared.sqrt();
        let weight = self.weight(distance, cluster.depth);
        let covered = self.cover(&footprint, 1.0, weight, visit);
        if covered.bits > 0 {
            let (even, odd) = cluster.evaluate(cluster.axis);
            let power = |sign: f32| {
                Vec3::new(
                    even[1] + sign * odd[1],
                    even[2] + sign * odd[2],
                    even[3] + sign * odd[3],
                )
            };
            let (front, back) = separate_sides(power(1.0), power(-1.0));
            let power = if toward { front } else { back };
            // One sheet shows all its area; of two the receiver sees the nearer.
            let area = if cluster.fill > TWO_SHEETS_FILL {
                drawn_area
            } else {
                cluster.area
            };
            self.seen.radiance += power * (cluster.normaliser / area) * covered.light;
        }
    }

    #[inline(always)]
    fn rectangle(&self, cluster: &Cluster, plane: Plane) -> (Footprint, f32) {
        let [(u, mut a), (v, mut b)] = rectangle_of(&cluster.covariance, plane.normal);
        // Shrunk where the points cover less than the rectangle; it is never made larger.
        let scale = (cluster.area / (4.0 * a * b).max(1e-30)).min(1.0).sqrt();
        a *= scale;
        b *= scale;
        let local = |v| self.frame.local_from_world(v);
        let sides = [(local(u), a), (local(v), b)];
        let footprint = Footprint::rectangle(local(cluster.centroid), local(plane.normal), plane.distance, sides);
        (footprint, 4.0 * a * b)
    }

    /// A cluster without a plane: the rectangle of its covariance seen from the receiver, as wide as its projected area.
    #[inline(never)]
    fn draw_round(&mut self, cluster: &Cluster, visit: &Visit) {
        let distance = cluster.distance_squared.sqrt();
        if distance < 1e-6 * visit.half {
            return;
        }
        let direction = cluster.centroid / distance;
        let (even, odd) = cluster.evaluate(-direction);
        // Both sides of every disc: twice the even bands.
        let shown = (2.0 * even[0]).max(0.0) * cluster.normaliser;
        let plane = Plane {
            normal: direction,
            distance,
        };
        let [(u, mut a), (v, mut b)] = rectangle_of(&cluster.covariance, direction);
        let whole = (4.0 * a * b).max(1e-30);
        let share = shown / whole;
        let mut density = 1.0;
        if share < OPAQUE_SHARE {
            density = share / OPAQUE_SHARE;
        }
        let scale = (share.clamp(OPAQUE_SHARE, 1.0) * ROUND_SCALE).sqrt();
        a *= scale;
        b *= scale;
        let local = |v| self.frame.local_from_world(v);
        let sides = [(local(u), a), (local(v), b)];
        let footprint = Footprint::rectangle(local(cluster.centroid), local(plane.normal), distance, sides);
        let weight = self.weight(distance, cluster.depth);
        let covered = self.cover(&footprint, density, weight, visit);
        if covered.bits > 0 {
            let power = Vec3::new(even[1] + odd[1], even[2] + odd[2], even[3] + odd[3]).max(Vec3::ZERO);
            let drawn = (4.0 * a * b * density).min(shown).max(1e-30);
            self.seen.radiance += power * (cluster.normaliser / drawn) * covered.light;
        }
    }

    /// A leaf that is opened: the planes its points lie on, or else their discs. Points come nearest first.
    #[inline(never)]
    pub(crate) fn draw_leaf(&mut self, points: &[(f32, PointRecord)], visit: &Visit, receiver: &Receiver) {
        let Some((facets, len)) = facets(points, receiver.position) else {
            for (_, point) in points {
                self.draw_disc(point, receiver);
            }
            return;
        };
        let facets = &facets[..len];
        for facet in facets {
            let (cuts, cut_count) = facet.cuts(facets, points, receiver.position);
            let cuts = &cuts[..cut_count];
            // Without a neighbour to end at, a section would reach over the edge of its surface.
            let needed = if cuts.is_empty() { SECTION_FILL } else { FACET_FILL };
            if facet.fill(visit.center, visit.half, cuts) >= needed {
                self.draw_facet(facet, cuts, visit, receiver);
            } else {
                let members = points
                    .iter()
                    .enumerate()
                    .filter(|(index, _)| facet.members >> index & 1 == 1);
                for (_, (_, point)) in members {
                    self.draw_disc(point, receiver);
                }
            }
        }
    }

    #[inline(always)]
    fn draw_facet(&mut self, facet: &Facet, cuts: &[(Vec3, f32)], visit: &Visit, receiver: &Receiver) {
        let plane = Plane::through(facet.centroid, facet.normal, TOUCH * visit.half);
        let touched =
            is_aligned(receiver.normal, facet.normal) && plane.distance < self.walk.settings.bias * facet.radius;
        if touched || is_own_surface(receiver.normal, facet.normal, facet.centroid, DISC_WIDTH * facet.radius) {
            return;
        }
        let mut footprint = Footprint::section(self.frame, facet.section_box(visit), plane);
        for (normal, distance) in cuts {
            footprint.cut(self.frame, plane, *normal, *distance);
        }
        let weight = self.weight(facet.centroid.length(), facet.radius);
        let covered = self.cover(&footprint, 1.0, weight, visit);
        if covered.bits > 0 {
            let side = usize::from(facet.normal.dot(facet.centroid) > 0.0);
            self.seen.radiance += facet.power[side] / facet.area * covered.light;
        }
    }

    #[inline(always)]
    fn draw_disc(&mut self, point: &PointRecord, receiver: &Receiver) {
        let center = Vec3::from(point.position) - receiver.position;
        let normal = point.normal();
        let plane = Plane::through(center, normal, TOUCH * point.radius);
        let distance = center.length();
        if distance < NEAR_RADII * point.radius {
            let touched =
                is_aligned(receiver.normal, normal) && plane.distance < self.walk.settings.bias * point.radius;
            if touched || is_own_surface(receiver.normal, normal, center, DISC_WIDTH * point.radius) {
                return;
            }
        }
        let footprint = Footprint::disc(self.frame, center, plane, point.radius * DISC_SCALE);
        let weight = self.weight(distance, point.radius);
        let covered = self.walk.simd.cover(
            self.raster,
            self.walk.tables,
            &footprint,
            Ink {
                density: 1.0,
                weight,
                seed: 0,
            },
        );
        if covered.bits > 0 {
            let sides = point.sides();
            let radiance = if normal.dot(center) < 0.0 {
                sides.front
            } else {
                sides.back
            };
            self.seen.radiance += Vec3::from(radiance) * covered.light;
            self.seen.occlusion += weight * covered.bits as f32;
        }
    }

    #[inline(always)]
    fn cover(&mut self, footprint: &Footprint, density: f32, weight: f32, visit: &Visit) -> Covered {
        let ink = Ink {
            density,
            weight,
            seed: visit.path,
        };
        let covered = self.walk.simd.cover(self.raster, self.walk.tables, footprint, ink);
        self.seen.occlusion += weight * covered.bits as f32;
        covered
    }

    /// How much a surface at `distance`, reaching `extent` to both sides, counts as an occluder.
    #[inline(always)]
    fn weight(&self, distance: f32, extent: f32) -> f32 {
        let settings = self.walk.settings;
        let within = ((settings.max_dist - distance + extent) / (2.0 * extent).max(f32::MIN_POSITIVE)).clamp(0.0, 1.0);
        if settings.falloff > 0.0 {
            within * (-settings.falloff * distance).exp()
        } else {
            within
        }
    }
}
