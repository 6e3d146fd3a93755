//! Fewer receivers shaded: where a group's receivers lie on one smooth surface, some of them (probes) are, and a plane through what
//! they got tells what all get, as long as it tells the probes right. Otherwise the surface is halved, down to receivers that
//! are all shaded. A surface ends at an edge: nothing is interpolated across.

use crate::shader::{Receiver, Shaded};
use crate::simd::LANES;
use glam::{Vec2, Vec3};

/// Cosine of the largest angle between the normals of receivers on one surface: 10 degrees.
const SURFACE_COSINE_MIN: f32 = 0.985;
/// How steeply another receiver of the same surface may lie above or below the tangent plane: sine of 6 degrees.
const SURFACE_SLOPE_MAX: f32 = 0.1;
/// Surfaces of no more receivers are shaded whole: probes and halves would be as many.
const WHOLE_MAX: usize = 12;
/// Receivers of a surface that are shaded to know the others; they fill a pack.
const PROBES: usize = LANES;
/// Numbers of a result that are interpolated.
const VALUES: usize = 7;

/// Receivers on one surface, and how it lies.
#[derive(Clone, Debug)]
pub(crate) struct Patch {
    members: Vec<Member>,
}

/// A receiver of a patch.
#[derive(Clone, Copy, Debug)]
struct Member {
    /// Its number in the group.
    index: u32,
    /// Where it lies in the tangent plane.
    place: Vec2,
}

/// Cuts a group's receivers, given by their numbers, into surfaces.
pub(crate) fn patches(receivers: &[Receiver], order: &[(u64, u32)]) -> Vec<Patch> {
    let mut left: Vec<u32> = order.iter().map(|(_, index)| *index).collect();
    let mut patches = Vec::new();
    while let Some(first) = left.first() {
        let seed = receivers[*first as usize];
        let normal = seed.normal.normalize();
        let (u, v) = normal.any_orthonormal_pair();
        let mut members = Vec::new();
        left.retain(|&index| {
            let receiver = receivers[index as usize];
            let apart = receiver.position - seed.position;
            let belongs = receiver.normal.normalize().dot(normal) >= SURFACE_COSINE_MIN
                && apart.dot(normal).abs() <= SURFACE_SLOPE_MAX * apart.length();
            if belongs {
                let place = Vec2::new(apart.dot(u), apart.dot(v));
                members.push(Member { index, place });
            }
            !belongs
        });
        // The seed belongs to its own surface, unless a number of it is beyond all measure.
        if members.is_empty() {
            let index = left.remove(0);
            members.push(Member {
                index,
                place: Vec2::ZERO,
            });
        }
        patches.push(Patch { members });
    }
    patches
}

impl Patch {
    /// The receivers that have to be shaded before [`Self::fill`], beside those that are.
    pub(crate) fn wanted(&self, shaded: &[bool], wanted: &mut Vec<u32>) {
        if self.members.len() <= WHOLE_MAX {
            let all = self.members.iter().map(|member| member.index);
            wanted.extend(all.filter(|&index| !shaded[index as usize]));
            return;
        }
        // Each next one is as far as possible from those that are known.
        let mut chosen: Vec<Vec2> = self
            .members
            .iter()
            .filter(|member| shaded[member.index as usize])
            .map(|member| member.place)
            .collect();
        if chosen.is_empty() {
            let middle = self.members.iter().map(|member| member.place).sum::<Vec2>() / self.members.len() as f32;
            let farthest = self.farthest(|member| member.place.distance_squared(middle));
            wanted.push(farthest.index);
            chosen.push(farthest.place);
        }
        while chosen.len() < PROBES {
            let distance = |place: Vec2| {
                let distances = chosen.iter().map(|known| known.distance_squared(place));
                distances.fold(f32::INFINITY, f32::min)
            };
            let farthest = self.farthest(|member| distance(member.place));
            if distance(farthest.place) <= 0.0 {
                // All others lie where a known one does.
                return;
            }
            wanted.push(farthest.index);
            chosen.push(farthest.place);
        }
    }

    fn farthest(&self, distance: impl Fn(&Member) -> f32) -> Member {
        let mut best = (self.members[0], f32::NEG_INFINITY);
        for member in &self.members {
            let distance = distance(member);
            if distance > best.1 {
                best = (*member, distance);
            }
        }
        best.0
    }

    /// Gives all receivers their results from those that are shaded, if that can be done within `error`; otherwise the two
    /// halves, if the patch was not shaded whole.
    pub(crate) fn fill(
        self,
        receivers: &[Receiver],
        shaded: &[bool],
        error: f32,
        results: &mut [Shaded],
    ) -> Option<[Self; 2]> {
        if self.members.len() <= WHOLE_MAX {
            return None;
        }
        let probes: Vec<(Vec2, [f32; VALUES])> = self
            .members
            .iter()
            .filter(|member| shaded[member.index as usize])
            .map(|member| (member.place, numbers(&results[member.index as usize])))
            .collect();
        let plane = Plane::fit(&probes);
        let mean = plane.middle[..3].iter().fold(0.0f32, |most, value| most.max(*value));
        let bounds = [error * mean, error * mean, error * mean, error, error, error, error];
        let tells = |(place, values): &(Vec2, [f32; VALUES])| {
            let told = plane.at(*place);
            (0..VALUES).all(|value| (told[value] - values[value]).abs() <= bounds[value])
        };
        if probes.iter().all(tells) {
            for member in &self.members {
                let normal = receivers[member.index as usize].normal;
                results[member.index as usize] = result(plane.at(member.place), normal);
            }
            return None;
        }
        Some(self.halves())
    }

    /// Cut across its longer side.
    fn halves(self) -> [Self; 2] {
        let (mut low, mut high) = (Vec2::INFINITY, Vec2::NEG_INFINITY);
        for member in &self.members {
            low = low.min(member.place);
            high = high.max(member.place);
        }
        let axis = usize::from(high.y - low.y > high.x - low.x);
        let mut members = self.members;
        members.sort_by(|a, b| a.place[axis].total_cmp(&b.place[axis]).then(a.index.cmp(&b.index)));
        let upper = members.split_off(members.len() / 2);
        [Self { members }, Self { members: upper }]
    }
}

/// A direction counts by how much is open: where next to nothing is, it may be any.
fn numbers(shaded: &Shaded) -> [f32; VALUES] {
    let [r, g, b] = shaded.irradiance;
    let [x, y, z] = shaded.bent_normal.map(|value| value * (1.0 - shaded.occlusion));
    [r, g, b, shaded.occlusion, x, y, z]
}

fn result([r, g, b, occlusion, x, y, z]: [f32; VALUES], normal: Vec3) -> Shaded {
    Shaded {
        irradiance: [r, g, b].map(|value| value.max(0.0)),
        occlusion: occlusion.clamp(0.0, 1.0),
        bent_normal: Vec3::new(x, y, z).normalize_or(normal.normalize()).to_array(),
    }
}

/// Values that are linear in the tangent plane.
struct Plane {
    center: Vec2,
    middle: [f32; VALUES],
    slope: [Vec2; VALUES],
}

impl Plane {
    /// The one with the least squared distances from values at places.
    fn fit(probes: &[(Vec2, [f32; VALUES])]) -> Self {
        /// Share of the spread that is added to it along both axes: places on one line tell nothing of the other.
        const RIDGE: f32 = 1e-4;
        let share = 1.0 / probes.len().max(1) as f32;
        let center = probes.iter().map(|(place, _)| *place).sum::<Vec2>() * share;
        let mut middle = [0.0; VALUES];
        for (_, values) in probes {
            for (sum, value) in middle.iter_mut().zip(values) {
                *sum += value * share;
            }
        }
        let (mut uu, mut uv, mut vv) = (0.0, 0.0, 0.0);
        let mut moment = [Vec2::ZERO; VALUES];
        for (place, values) in probes {
            let apart = *place - center;
            uu += apart.x * apart.x;
            uv += apart.x * apart.y;
            vv += apart.y * apart.y;
            for ((moment, value), middle) in moment.iter_mut().zip(values).zip(middle) {
                *moment += apart * (value - middle);
            }
        }
        let ridge = RIDGE * (uu + vv);
        let (uu, vv) = (uu + ridge, vv + ridge);
        let determinant = uu * vv - uv * uv;
        let slope = moment.map(|moment| {
            if determinant > 0.0 {
                Vec2::new(vv * moment.x - uv * moment.y, uu * moment.y - uv * moment.x) / determinant
            } else {
                Vec2::ZERO
            }
        });
        Self { center, middle, slope }
    }

    fn at(&self, place: Vec2) -> [f32; VALUES] {
        let apart = place - self.center;
        std::array::from_fn(|value| self.middle[value] + self.slope[value].dot(apart))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn floor_and_wall() -> Vec<Receiver> {
        let place = |i: usize| ((i % 8) as f32, (i / 8) as f32);
        (0..64)
            .map(|i| match place(i) {
                (x, y) if x < 4.0 => (Vec3::new(x, 0.0, y), Vec3::Y),
                (x, y) => (Vec3::new(4.0, x - 4.0, y), Vec3::NEG_X),
            })
            .map(|(position, normal)| Receiver { position, normal })
            .collect()
    }

    fn order(receivers: &[Receiver]) -> Vec<(u64, u32)> {
        (0..receivers.len() as u32).map(|index| (0, index)).collect()
    }

    /// Interpolates what `value` gives; the results, and how many were shaded.
    fn run(receivers: &[Receiver], error: f32, value: impl Fn(&Receiver) -> f32) -> (Vec<Shaded>, usize) {
        let mut level = patches(receivers, &order(receivers));
        let mut shaded = vec![false; receivers.len()];
        let mut results = vec![Shaded::default(); receivers.len()];
        while !level.is_empty() {
            let mut wanted = Vec::new();
            level.iter().for_each(|patch| patch.wanted(&shaded, &mut wanted));
            for index in wanted {
                let value = value(&receivers[index as usize]);
                results[index as usize] = Shaded {
                    irradiance: [value; 3],
                    occlusion: value.min(1.0),
                    bent_normal: [0.0, 1.0, 0.0],
                };
                assert!(!std::mem::replace(&mut shaded[index as usize], true), "shaded twice");
            }
            let halves = level
                .drain(..)
                .filter_map(|patch| patch.fill(receivers, &shaded, error, &mut results));
            level = halves.flatten().collect();
        }
        (results, shaded.into_iter().filter(|shaded| *shaded).count())
    }

    #[test]
    fn smooth_light_on_two_walls_takes_a_pack_each_and_does_not_cross_their_edge() {
        let receivers = floor_and_wall();
        let light = |receiver: &Receiver| match receiver.normal == Vec3::Y {
            true => 0.2 + 0.01 * receiver.position.x + 0.02 * receiver.position.z,
            false => 0.9 - 0.01 * receiver.position.z,
        };
        let (results, shaded) = run(&receivers, 0.01, light);
        assert_eq!(shaded, 2 * PROBES);
        for (receiver, result) in receivers.iter().zip(results) {
            assert!((result.occlusion - light(receiver)).abs() < 1e-3);
        }
    }

    #[test]
    fn shadow_edge_is_followed_down_to_its_receivers() {
        let receivers: Vec<Receiver> = (0..64)
            .map(|i| Receiver {
                position: Vec3::new((i % 8) as f32, 0.0, (i / 8) as f32),
                normal: Vec3::Y,
            })
            .collect();
        let light = |receiver: &Receiver| f32::from(receiver.position.x > 2.5);
        let (results, shaded) = run(&receivers, 0.02, light);
        assert!(shaded < 64, "{shaded}");
        for (receiver, result) in receivers.iter().zip(results) {
            assert!((result.occlusion - light(receiver)).abs() <= 0.02);
        }
    }

    #[test]
    fn receivers_at_one_place_or_on_one_line_are_no_trouble() {
        for step in [0.0, 1e-20, 1.0, 1e20] {
            let receivers: Vec<Receiver> = (0..64)
                .map(|i| Receiver {
                    position: Vec3::X * (step * i as f32),
                    normal: Vec3::Y,
                })
                .collect();
            let (results, _) = run(&receivers, 0.02, |_| 0.5);
            assert!(results.iter().all(|result| (result.occlusion - 0.5).abs() < 1e-5));
        }
    }
}
