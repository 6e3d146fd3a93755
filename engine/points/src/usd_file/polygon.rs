//! Polygons to triangles: a fan where it is right, ears where corners point inwards.

use glam::Vec3;

/// Most corners of a polygon whose ears are looked for, which takes the square of their number; larger ones become fans.
const EARS_CORNERS_MAX: usize = 1024;

/// Triangles of a polygon by the numbers of its corners, in its order.
pub(super) fn triangles(corners: &[Vec3]) -> Vec<[usize; 3]> {
    let count = corners.len();
    if count == 3 {
        return vec![[0, 1, 2]];
    }
    // Twice the area, along the normal, of any polygon that is nearly flat.
    let fan = |at: usize| (corners[at] - corners[0]).cross(corners[at + 1] - corners[0]);
    let normal: Vec3 = (1..count.saturating_sub(1)).map(fan).sum();
    let turn = |a: usize, b: usize, c: usize| (corners[b] - corners[a]).cross(corners[c] - corners[b]).dot(normal);
    let convex = (0..count).all(|at| turn((at + count - 1) % count, at, (at + 1) % count) >= 0.0);
    if convex || count > EARS_CORNERS_MAX {
        return (1..count.saturating_sub(1)).map(|at| [0, at, at + 1]).collect();
    }
    let mut left: Vec<usize> = (0..count).collect();
    let mut found = Vec::with_capacity(count - 2);
    while left.len() > 3 {
        let around = |at: usize| {
            let (before, after) = ((at + left.len() - 1) % left.len(), (at + 1) % left.len());
            [left[before], left[at], left[after]]
        };
        let is_ear = |at: &usize| {
            let [a, b, c] = around(*at);
            let within = |&point: &usize| {
                ![a, b, c].contains(&point)
                    && turn(a, b, point) >= 0.0
                    && turn(b, c, point) >= 0.0
                    && turn(c, a, point) >= 0.0
            };
            turn(a, b, c) > 0.0 && !left.iter().any(within)
        };
        // A polygon that crosses itself may have none: any corner will do.
        let ear = (0..left.len()).find(is_ear).unwrap_or(0);
        found.push(around(ear));
        left.remove(ear);
    }
    found.push([left[0], left[1], left[2]]);
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    fn area(corners: &[Vec3]) -> f32 {
        let area = |&[a, b, c]: &[usize; 3]| (corners[b] - corners[a]).cross(corners[c] - corners[a]).z / 2.0;
        let parts: Vec<f32> = triangles(corners).iter().map(area).collect();
        assert!(parts.iter().all(|part| *part >= 0.0), "{parts:?}");
        assert_eq!(parts.len(), corners.len() - 2);
        parts.iter().sum()
    }

    fn flat(corners: &[[f32; 2]]) -> Vec<Vec3> {
        corners.iter().map(|&[x, y]| Vec3::new(x, y, 0.0)).collect()
    }

    #[test]
    fn concave_polygons_keep_their_area() {
        assert_eq!(area(&flat(&[[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]])), 2.0);
        // Turned so that the corner that points inwards comes first, then second.
        assert_eq!(area(&flat(&[[1.0, 1.0], [0.0, 4.0], [0.0, 0.0], [4.0, 0.0]])), 4.0);
        assert_eq!(area(&flat(&[[4.0, 0.0], [1.0, 1.0], [0.0, 4.0], [0.0, 0.0]])), 4.0);
        let letter = [
            [0.0, 0.0],
            [3.0, 0.0],
            [3.0, 1.0],
            [1.0, 1.0],
            [1.0, 2.0],
            [3.0, 2.0],
            [3.0, 3.0],
            [0.0, 3.0],
        ];
        assert_eq!(area(&flat(&letter)), 7.0);
    }

    #[test]
    fn any_polygon_ends() {
        assert_eq!(
            triangles(&flat(&[[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0], [0.5, 0.5]])).len(),
            3
        );
        assert_eq!(triangles(&[Vec3::NAN; 6]).len(), 4);
    }
}
