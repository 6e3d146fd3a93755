//! Areas in which planes cut voxels: how much of its plane a flat cluster could fill.

use glam::DVec3;

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

/// The half-spaces of a voxel as they cut a plane with unit `normal`. A plane along a face is not cut by that face: rounding
/// and a slight tilt would decide how much is left.
pub fn voxel_half_spaces(center: DVec3, half: f64, normal: DVec3) -> [HalfSpace; 6] {
    std::array::from_fn(|i| {
        let axis = DVec3::AXES[i / 2];
        let reach = if normal.dot(axis).abs() > ALONG_FACE {
            half * (1.0 + 2.0 * FACE_SLACK)
        } else {
            half
        };
        let sign = if i % 2 == 0 { 1.0 } else { -1.0 };
        HalfSpace {
            normal: axis * sign,
            offset: reach - sign * center.dot(axis),
        }
    })
}

/// Area of the part of a plane (through a point, unit normal) that lies in all half-spaces and within `reach` of the point
/// along both of the plane's axes. At most [`CLIPS_MAX`] half-spaces count.
pub fn section_area(through: DVec3, normal: DVec3, reach: f64, clips: &[HalfSpace]) -> f64 {
    let (u, v) = normal.any_orthonormal_pair();
    let (u, v) = (u * reach, v * reach);
    let mut polygon = [DVec3::ZERO; CORNERS_MAX];
    polygon[..4].copy_from_slice(&[through - u - v, through + u - v, through + u + v, through - u + v]);
    let mut corners = 4;
    for clip in clips.iter().take(CLIPS_MAX) {
        let inside = |p: DVec3| clip.normal.dot(p) + clip.offset;
        let mut clipped = [DVec3::ZERO; CORNERS_MAX];
        let mut kept = 0;
        let mut keep = |corner| {
            if kept < CORNERS_MAX {
                clipped[kept] = corner;
                kept += 1;
            }
        };
        for i in 0..corners {
            let (a, b) = (polygon[i], polygon[(i + 1) % corners]);
            let (da, db) = (inside(a), inside(b));
            if da >= 0.0 {
                keep(a);
            }
            if (da >= 0.0) != (db >= 0.0) {
                keep(a + (b - a) * (da / (da - db)));
            }
        }
        (polygon, corners) = (clipped, kept);
    }
    let doubled: DVec3 = (0..corners).map(|i| polygon[i].cross(polygon[(i + 1) % corners])).sum();
    doubled.dot(normal).abs() / 2.0
}

#[cfg(test)]
mod tests {
    use super::*;

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
