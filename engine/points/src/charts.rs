//! Charts: connected pieces of a surface that are nearly flat. Points are laid out on the plane of a chart, so that they
//! are even across the edges of its triangles, however small those are.

use crate::geometry::area_vector;
use glam::{DVec3, Vec3};

/// How far a triangle may lean from the plane of its chart, as a cosine (18 degrees): points on it are stretched by at most
/// 5 %, and a curved surface still has charts of many points.
const COS_MIN: f64 = 0.95;

const NONE: u32 = u32::MAX;

/// A partition of the triangles of a geometry.
#[derive(Default)]
pub(crate) struct Charts {
    /// Triangles, chart by chart; the first of each is the seed whose plane is the chart's.
    order: Vec<u32>,
    /// Where each chart starts in `order`, and the end.
    starts: Vec<u32>,
    /// Of each chart, in the geometry's space.
    areas: Vec<f64>,
}

impl Charts {
    /// Grows charts over shared edges from the first triangle that has none yet. Vertices at the same position are the
    /// same vertex.
    pub(crate) fn of(positions: &[[f32; 3]], triangles: &[[u32; 3]]) -> Self {
        let neighbours = neighbours(positions, triangles);
        let area_vectors: Vec<DVec3> = triangles.iter().map(|triangle| area_of(positions, triangle)).collect();
        let normals: Vec<Vec3> = area_vectors
            .iter()
            .map(|area| area.normalize_or_zero().as_vec3())
            .collect();
        let mut charts = Self::default();
        let mut taken = vec![false; triangles.len()];
        for seed in 0..triangles.len() {
            if std::mem::replace(&mut taken[seed], true) {
                continue;
            }
            let start = charts.order.len();
            charts.starts.push(start as u32);
            charts.order.push(seed as u32);
            let mut next = start;
            while let Some(&triangle) = charts.order.get(next) {
                next += 1;
                for neighbour in neighbours[triangle as usize] {
                    let fits = neighbour != NONE
                        && !taken[neighbour as usize]
                        && f64::from(normals[neighbour as usize].dot(normals[seed])) >= COS_MIN;
                    if fits {
                        taken[neighbour as usize] = true;
                        charts.order.push(neighbour);
                    }
                }
            }
        }
        charts.starts.push(charts.order.len() as u32);
        let area = |chart| {
            charts
                .triangles(chart)
                .iter()
                .map(|&triangle| area_vectors[triangle as usize].length())
                .sum()
        };
        charts.areas = (0..charts.len()).map(area).collect();
        charts
    }

    pub(crate) fn len(&self) -> usize {
        self.starts.len().saturating_sub(1)
    }

    /// Area of each chart, in the geometry's space.
    pub(crate) fn areas(&self) -> &[f64] {
        &self.areas
    }

    /// The triangles of a chart, its seed first.
    pub(crate) fn triangles(&self, chart: usize) -> &[u32] {
        &self.order[self.starts[chart] as usize..self.starts[chart + 1] as usize]
    }
}

fn area_of(positions: &[[f32; 3]], triangle: &[u32; 3]) -> DVec3 {
    area_vector(&triangle.map(|index| DVec3::from_array(positions[index as usize].map(f64::from))))
}

/// For each edge of each triangle the triangle on its other side.
fn neighbours(positions: &[[f32; 3]], triangles: &[[u32; 3]]) -> Vec<[u32; 3]> {
    let welded = weld(positions);
    let mut edges: Vec<(u64, u32)> = Vec::with_capacity(triangles.len() * 3);
    for (index, triangle) in triangles.iter().enumerate() {
        for edge in 0..3 {
            let (a, b) = (
                welded[triangle[edge] as usize],
                welded[triangle[(edge + 1) % 3] as usize],
            );
            edges.push((
                u64::from(a.min(b)) << 32 | u64::from(a.max(b)),
                (index * 3 + edge) as u32,
            ));
        }
    }
    edges.sort_unstable();
    let mut neighbours = vec![[NONE; 3]; triangles.len()];
    for sides in edges.chunk_by(|a, b| a.0 == b.0) {
        // More than two triangles on an edge: pairs of them, whichever come first.
        for pair in sides.chunks_exact(2) {
            let (one, other) = (pair[0].1 as usize, pair[1].1 as usize);
            neighbours[one / 3][one % 3] = (other / 3) as u32;
            neighbours[other / 3][other % 3] = (one / 3) as u32;
        }
    }
    neighbours
}

/// For each vertex the first vertex at the same position.
fn weld(positions: &[[f32; 3]]) -> Vec<u32> {
    // Adding zero turns -0 into 0.
    let key = |index: u32| positions[index as usize].map(|x| (x + 0.0).to_bits());
    let mut order: Vec<u32> = (0..positions.len() as u32).collect();
    order.sort_unstable_by_key(|&index| (key(index), index));
    let mut first = vec![0; positions.len()];
    for same in order.chunk_by(|&a, &b| key(a) == key(b)) {
        for &index in same {
            first[index as usize] = same[0];
        }
    }
    first
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cube_has_six_charts_even_with_split_vertices() {
        let mut positions = Vec::new();
        let mut triangles = Vec::new();
        for axis in 0..3 {
            for side in [0.0f32, 1.0] {
                let corner = |u: f32, v: f32| {
                    let mut p = [0.0; 3];
                    p[axis] = side;
                    p[(axis + 1) % 3] = u;
                    p[(axis + 2) % 3] = v;
                    p
                };
                let base = positions.len() as u32;
                let (a, b, c, d) = (corner(0.0, 0.0), corner(1.0, 0.0), corner(1.0, 1.0), corner(0.0, 1.0));
                positions.extend([a, b, c, a, c, d]);
                triangles.extend([[base, base + 1, base + 2], [base + 3, base + 4, base + 5]]);
            }
        }
        let charts = Charts::of(&positions, &triangles);
        assert_eq!(charts.len(), 6);
        assert!((0..6).all(|chart| charts.triangles(chart).len() == 2));
    }

    #[test]
    fn every_triangle_is_in_one_chart() {
        let (n, mut positions, mut triangles) = (20u32, Vec::new(), Vec::new());
        for y in 0..=n {
            for x in 0..=n {
                let (fx, fy) = (x as f32 / n as f32, y as f32 / n as f32);
                positions.push([fx, (fx * 9.0).sin() * (fy * 7.0).cos(), fy]);
            }
        }
        for y in 0..n {
            for x in 0..n {
                let a = y * (n + 1) + x;
                triangles.extend([[a, a + n + 1, a + 1], [a + 1, a + n + 1, a + n + 2]]);
            }
        }
        let charts = Charts::of(&positions, &triangles);
        let mut seen: Vec<u32> = (0..charts.len()).flat_map(|c| charts.triangles(c).to_vec()).collect();
        seen.sort_unstable();
        assert!(seen.into_iter().eq(0..2 * n * n));
    }
}
