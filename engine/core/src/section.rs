//! Areas in which planes cut voxels: how much of its plane a flat cluster could fill.

use glam::{DVec2, DVec3};

/// The half-space `normal.x + offset >= 0`.
#[derive(Clone, Copy, Debug)]
pub struct HalfSpace {
    /// Points inward; need not be unit.
    pub normal: DVec3,
    /// See above.
    pub offset: f64,
}

/// Corners of a square cut by at most [`CLIPS_MAX`] half-spaces.
const CORNERS_MAX: usize = 4 + CLIPS_MAX;
/// Half-spaces that [`section_area`] takes: a voxel's six and a few of its neighbours' planes.
pub const CLIPS_MAX: usize = 12;
/// Cosine between a plane's normal and an axis from which the plane runs along the voxel's faces across that axis.
const ALONG_FACE: f64 = 0.9;
/// How far such a plane may lie outside, as a share of the voxel's edge.
const FACE_SLACK: f64 = 0.025;

/// How far a voxel reaches from its centre along each axis where a plane with unit `normal` cuts it. A plane along a face is
/// not cut by that face: rounding and a slight tilt would decide how much is left.
fn voxel_reach(half: f64, normal: DVec3) -> DVec3 {
    let stretch = |cosine: f64| {
        if cosine > ALONG_FACE {
            1.0 + 2.0 * FACE_SLACK
        } else {
            1.0
        }
    };
    let DVec3 { x, y, z } = normal.abs();
    DVec3::new(stretch(x), stretch(y), stretch(z)) * half
}

/// The half-spaces of a voxel as they cut a plane with unit `normal`.
pub fn voxel_half_spaces(center: DVec3, half: f64, normal: DVec3) -> [HalfSpace; 6] {
    let reach = voxel_reach(half, normal);
    std::array::from_fn(|i| {
        let axis = DVec3::AXES[i / 2];
        let sign = if i % 2 == 0 { 1.0 } else { -1.0 };
        HalfSpace {
            normal: axis * sign,
            offset: reach.dot(axis) - sign * center.dot(axis),
        }
    })
}

/// Area of the part of a plane (through a point, unit normal) that lies in a voxel: what [`section_area`] finds for
/// [`voxel_half_spaces`], without following corners.
pub fn voxel_section_area(through: DVec3, normal: DVec3, center: DVec3, half: f64) -> f64 {
    let reach = voxel_reach(half, normal);
    let distance = normal.dot(center - through);
    // Seen along the axis that it faces most, the section is the part of the voxel's rectangle between two parallel lines.
    let mut axes = [0, 1, 2].map(|axis| (normal[axis].abs(), reach[axis]));
    axes.sort_unstable_by(|a, b| b.0.total_cmp(&a.0));
    let [(cosine, depth), along, across] = axes;
    let strip = [cosine * depth - distance, -cosine * depth - distance];
    let [upper, lower] = strip.map(|line| rectangle_below(line, along, across));
    (upper - lower) / cosine
}

/// Area of the part of a rectangle around the origin where `a x + b y <= line`: `along` is (a, half the side along x), `across`
/// is that for y, and `a >= b >= 0`.
fn rectangle_below(line: f64, (a, half_x): (f64, f64), (b, half_y): (f64, f64)) -> f64 {
    // Below this slope the rounding of the differences is larger than what they make of the area.
    const SLOPE_MIN: f64 = 1e-6;
    let a = a.max(f64::MIN_POSITIVE);
    if b < SLOPE_MIN * a {
        return 2.0 * half_y * (line / a + half_x).clamp(0.0, 2.0 * half_x);
    }
    // Beyond the last corner nothing is added but digits, which the differences would lose.
    let line = line.min(a * half_x + b * half_y);
    let corner = |x: f64, y: f64| (line + x * a * half_x + y * b * half_y).max(0.0).powi(2);
    (corner(1.0, 1.0) - corner(-1.0, 1.0) - corner(1.0, -1.0) + corner(-1.0, -1.0)) / (2.0 * a * b)
}

/// Area of the part of a plane (through a point, unit normal) that lies in all half-spaces and within `reach` of the point
/// along both of the plane's axes. At most [`CLIPS_MAX`] half-spaces count.
pub fn section_area(through: DVec3, normal: DVec3, reach: f64, clips: &[HalfSpace]) -> f64 {
    let (u, v) = normal.any_orthonormal_pair();
    let mut polygon = Polygon::square(reach);
    for clip in clips.iter().take(CLIPS_MAX) {
        let inward = DVec2::new(clip.normal.dot(u), clip.normal.dot(v));
        polygon.clip(inward, clip.normal.dot(through) + clip.offset);
    }
    polygon.area()
}

/// A convex polygon in a plane, counter-clockwise.
struct Polygon {
    corners: [DVec2; CORNERS_MAX],
    count: usize,
}

impl Polygon {
    /// Around the origin, from `-reach` to `reach` along both axes.
    fn square(reach: f64) -> Self {
        let mut corners = [DVec2::ZERO; CORNERS_MAX];
        corners[..4].copy_from_slice(&[
            DVec2::new(-reach, -reach),
            DVec2::new(reach, -reach),
            DVec2::new(reach, reach),
            DVec2::new(-reach, reach),
        ]);
        Self { corners, count: 4 }
    }

    /// Keeps what lies where `inward.x + offset >= 0` (Sutherland and Hodgman 1974).
    fn clip(&mut self, inward: DVec2, offset: f64) {
        let mut clipped = Self {
            corners: [DVec2::ZERO; CORNERS_MAX],
            count: 0,
        };
        let inside = |corner: DVec2| inward.dot(corner) + offset;
        let Some(&last) = self.corners[..self.count].last() else {
            return;
        };
        let mut before = (last, inside(last));
        for &corner in &self.corners[..self.count] {
            let now = (corner, inside(corner));
            if (now.1 >= 0.0) != (before.1 >= 0.0) {
                clipped.push(before.0 + (now.0 - before.0) * (before.1 / (before.1 - now.1)));
            }
            if now.1 >= 0.0 {
                clipped.push(corner);
            }
            before = now;
        }
        *self = clipped;
    }

    fn push(&mut self, corner: DVec2) {
        if let Some(free) = self.corners.get_mut(self.count) {
            *free = corner;
            self.count += 1;
        }
    }

    fn area(&self) -> f64 {
        let corners = &self.corners[..self.count];
        let next = corners.iter().cycle().skip(1);
        let doubled: f64 = corners.iter().zip(next).map(|(a, b)| a.perp_dot(*b)).sum();
        doubled.abs() / 2.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn unit_cube_section(through: DVec3, normal: DVec3) -> f64 {
        section_area(through, normal, 2.0, &voxel_half_spaces(DVec3::splat(0.5), 0.5, normal))
    }

    #[test]
    fn sections_of_a_cube_have_their_known_areas() {
        let center = DVec3::splat(0.5);
        assert!((unit_cube_section(center, DVec3::Z) - 1.0).abs() < 1e-12);
        assert!((unit_cube_section(center, DVec3::new(1.0, 1.0, 0.0).normalize()) - 2f64.sqrt()).abs() < 1e-12);
        // The regular hexagon with edges of half a face diagonal.
        assert!((unit_cube_section(center, DVec3::ONE.normalize()) - 1.299_038).abs() < 1e-6);
    }

    proptest! {
        #[test]
        fn closed_form_is_the_area_of_the_polygon(
            normal in [-1.0f64..1.0, -1.0f64..1.0, -1.0f64..1.0],
            small in prop::sample::select(vec![1.0, 1e-3, 1e-5, 1e-6, 1e-7, 1e-9, 1e-14, 0.0]),
            shrunk in 0u8..7,
            place in [0.0f64..1.0, 0.0f64..1.0, 0.0f64..1.0],
        ) {
            // Every kind of plane: along faces, along edges, nearly so, and any other.
            let normal = DVec3::from_array(std::array::from_fn(|axis| {
                if shrunk >> axis & 1 == 1 { normal[axis] * small } else { normal[axis] }
            }));
            prop_assume!(normal.length() > 1e-20);
            let normal = (normal / normal.abs().max_element()).normalize();
            let (through, center) = (DVec3::from_array(place), DVec3::splat(0.5));
            let area = voxel_section_area(through, normal, center, 0.5);
            let expected = section_area(through, normal, 2.0, &voxel_half_spaces(center, 0.5, normal));
            prop_assert!((area - expected).abs() < 3e-6, "{area} for {expected}");
        }
    }

    #[test]
    fn a_plane_along_a_face_is_whole() {
        let tilted = DVec3::new(1e-4, 0.0, 1.0).normalize();
        assert!((unit_cube_section(DVec3::new(0.5, 0.5, 1.0), tilted) - 1.0).abs() < 1e-3);
    }

    #[test]
    fn a_further_plane_cuts_the_section() {
        let mut clips = voxel_half_spaces(DVec3::splat(0.5), 0.5, DVec3::Z).to_vec();
        clips.push(HalfSpace {
            normal: DVec3::X,
            offset: -0.25,
        });
        assert!((section_area(DVec3::splat(0.5), DVec3::Z, 2.0, &clips) - 0.75).abs() < 1e-12);
    }
}
