//! Triangles in their own space, and where they are placed.

use crate::charts::Charts;
use crate::error::PointsError;
use crate::limits;
use glam::{DAffine3, DMat3, DVec3, Vec2, Vec3};
use pbgi_core::Bounds;
use std::path::Path;

/// Triangles in their own space.
pub(crate) struct Geometry {
    pub(crate) positions: Vec<[f32; 3]>,
    /// A normal a position, zero where the file has none; or empty.
    pub(crate) normals: Vec<[f32; 3]>,
    /// Two sets of texture coordinates, each a pair a position, or empty.
    pub(crate) uvs: [Vec<[f32; 2]>; 2],
    /// A factor of the albedo a position, linear; or empty.
    pub(crate) colors: Vec<[f32; 3]>,
    pub(crate) triangles: Vec<[u32; 3]>,
    /// A material a triangle.
    pub(crate) materials: Vec<u32>,
    /// Nearly flat pieces, the unit of sampling; made by [`Self::index`].
    pub(crate) charts: Charts,
    /// The exact box; made by [`Self::index`].
    pub(crate) bounds: Bounds,
}

/// A geometry placed in the world: 52 bytes, for there may be millions.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Instance {
    geometry: u32,
    /// Columns of the matrix, then the translation.
    world_from_local: [f32; 12],
}

/// A triangle's corner weights for its second and third corner.
pub(crate) type Barycentric = [f32; 2];

impl Default for Geometry {
    fn default() -> Self {
        Self {
            positions: Vec::new(),
            normals: Vec::new(),
            uvs: [Vec::new(), Vec::new()],
            colors: Vec::new(),
            triangles: Vec::new(),
            materials: Vec::new(),
            charts: Charts::default(),
            bounds: Bounds::EMPTY,
        }
    }
}

impl Geometry {
    /// Makes what is derived from its triangles, once they are complete.
    pub(crate) fn index(&mut self) {
        self.charts = Charts::of(&self.positions, &self.triangles);
        self.bounds = Bounds::EMPTY;
        self.positions
            .iter()
            .for_each(|&position| self.bounds.include(position));
    }

    /// Area of all triangles, square units of its own space.
    pub(crate) fn area(&self) -> f64 {
        self.charts.areas().iter().sum()
    }

    /// Adds `other`, transformed. Triangles without area are dropped; mirrored ones are turned round.
    pub(crate) fn append(&mut self, path: &Path, other: &Self, transform: &DAffine3) -> Result<(), PointsError> {
        let base = self.positions.len();
        let (vertices, triangles) = (
            base + other.positions.len(),
            self.triangles.len() + other.triangles.len(),
        );
        let largest = vertices.max(triangles);
        if largest > limits::TRIANGLES_MAX {
            return Err(PointsError::Limit {
                what: "number of triangles or vertices",
                value: largest as u64,
                limit: limits::TRIANGLES_MAX as u64,
                path: path.to_owned(),
            });
        }
        self.positions.reserve(other.positions.len());
        for (index, &position) in other.positions.iter().enumerate() {
            let world = transform.transform_point3(Vec3::from(position).as_dvec3()).as_vec3();
            if !world.is_finite() {
                let what = format!("vertex {index} is not finite in world space: {position:?}");
                return Err(PointsError::invalid(path, what));
            }
            self.positions.push(world.to_array());
        }
        let added = other.positions.len();
        pad(&mut self.normals, &other.normals, base, added, [0.0; 3]);
        pad(&mut self.colors, &other.colors, base, added, [1.0; 3]);
        if let Some(new) = self.normals.get_mut(base..) {
            turn_normals(new, transform.matrix3);
        }
        for (mine, theirs) in self.uvs.iter_mut().zip(&other.uvs) {
            pad(mine, theirs, base, added, [0.0; 2]);
        }
        let mirrored = transform.matrix3.determinant() < 0.0;
        for (&[a, b, c], &material) in other.triangles.iter().zip(&other.materials) {
            let (b, c) = if mirrored { (c, b) } else { (b, c) };
            let triangle = [a, b, c].map(|index| index + base as u32);
            let [a, b, c] = triangle.map(|index| Vec3::from(self.positions[index as usize]).as_dvec3());
            if (b - a).cross(c - a).length_squared() > 0.0 {
                self.triangles.push(triangle);
                self.materials.push(material);
            }
        }
        Ok(())
    }

    /// Bytes that it takes at its peak.
    pub(crate) fn memory_bytes(&self) -> usize {
        let vertices = size_of_val(&self.positions[..])
            + size_of_val(&self.normals[..])
            + self.uvs.iter().map(|uvs| size_of_val(&uvs[..])).sum::<usize>()
            + size_of_val(&self.colors[..]);
        vertices + self.triangles.len() * limits::TRIANGLE_BYTES
    }

    /// Corner positions in its own space.
    pub(crate) fn corners(&self, triangle: usize) -> [Vec3; 3] {
        self.triangles[triangle].map(|index| Vec3::from(self.positions[index as usize]))
    }

    pub(crate) fn uv(&self, set: usize, triangle: usize, [v, w]: Barycentric) -> Vec2 {
        let corner = |index: u32| {
            self.uvs[set]
                .get(index as usize)
                .map_or(Vec2::ZERO, |uv| Vec2::from(*uv))
        };
        let [a, b, c] = self.triangles[triangle].map(corner);
        a * (1.0 - v - w) + b * v + c * w
    }

    pub(crate) fn color(&self, triangle: usize, [v, w]: Barycentric) -> Vec3 {
        if self.colors.is_empty() {
            return Vec3::ONE;
        }
        let [a, b, c] = self.triangles[triangle].map(|index| Vec3::from(self.colors[index as usize]));
        a * (1.0 - v - w) + b * v + c * w
    }

    /// Interpolated vertex normal in its own space, if the file has them here.
    pub(crate) fn vertex_normal(&self, triangle: usize, [v, w]: Barycentric) -> Option<Vec3> {
        if self.normals.is_empty() {
            return None;
        }
        let [a, b, c] = self.triangles[triangle].map(|index| Vec3::from(self.normals[index as usize]));
        (a * (1.0 - v - w) + b * v + c * w).try_normalize()
    }
}

impl Instance {
    pub(crate) fn new(geometry: usize, world_from_local: &DAffine3) -> Self {
        Self {
            geometry: geometry as u32,
            world_from_local: world_from_local.to_cols_array().map(|value| value as f32),
        }
    }

    pub(crate) fn geometry(&self) -> usize {
        self.geometry as usize
    }

    /// Once `before` geometries are put before its own.
    pub(crate) fn renumber(&mut self, before: usize) {
        self.geometry += before as u32;
    }

    pub(crate) fn world_from_local(&self) -> DAffine3 {
        DAffine3::from_cols_array(&self.world_from_local.map(f64::from))
    }

    /// Corner positions in the world.
    pub(crate) fn corners(&self, geometry: &Geometry, triangle: usize) -> [DVec3; 3] {
        let world_from_local = self.world_from_local();
        geometry
            .corners(triangle)
            .map(|corner| world_from_local.transform_point3(corner.as_dvec3()))
    }

    /// Corner positions of all triangles in the world.
    pub(crate) fn triangles<'a>(&'a self, geometry: &'a Geometry) -> impl Iterator<Item = [DVec3; 3]> + 'a {
        (0..geometry.triangles.len()).map(|triangle| self.corners(geometry, triangle))
    }

    /// That every vertex is finite as an f32 in the world.
    pub(crate) fn check(&self, path: &Path, geometry: &Geometry) -> Result<(), PointsError> {
        let world_from_local = self.world_from_local();
        for (index, &position) in geometry.positions.iter().enumerate() {
            let world = world_from_local.transform_point3(Vec3::from(position).as_dvec3());
            if !world.as_vec3().is_finite() {
                let what = format!("vertex {index} is not finite in world space: {position:?}");
                return Err(PointsError::invalid(path, what));
            }
        }
        Ok(())
    }

    /// By how much it scales areas; `None` where it does so in some directions more than in others.
    pub(crate) fn area_scale(&self) -> Option<f64> {
        /// What rounding the matrix to f32 leaves of a similarity.
        const ROUNDING: f64 = 1e-6;
        let DMat3 { x_axis, y_axis, z_axis } = self.world_from_local().matrix3;
        let scale = x_axis.length_squared();
        let alike = [y_axis, z_axis].map(|axis| axis.length_squared() - scale);
        let askew = [x_axis.dot(y_axis), y_axis.dot(z_axis), z_axis.dot(x_axis)];
        let exact = alike.iter().chain(&askew).all(|error| error.abs() <= ROUNDING * scale);
        exact.then_some(scale)
    }

    /// The exact box, world space.
    pub(crate) fn bounds(&self, geometry: &Geometry) -> Bounds {
        let world_from_local = self.world_from_local();
        let mut bounds = Bounds::EMPTY;
        for &position in &geometry.positions {
            let world = world_from_local.transform_point3(Vec3::from(position).as_dvec3());
            bounds.include(world.as_vec3().to_array());
        }
        bounds
    }

    /// Middle of the geometry's box, world space.
    pub(crate) fn middle(&self, geometry: &Geometry) -> DVec3 {
        let [min, max] = [geometry.bounds.min, geometry.bounds.max].map(|corner| Vec3::from(corner).as_dvec3());
        self.world_from_local().transform_point3((min + max) / 2.0)
    }

    /// Whether it mirrors: the front of its triangles is then on the other side of their winding.
    pub(crate) fn mirrors(&self) -> bool {
        self.world_from_local().matrix3.determinant() < 0.0
    }
}

/// Appends attributes of `count` vertices after `base` others, keeping an attribute that nobody has empty. Who lacks it gets
/// `missing`.
fn pad<const N: usize>(mine: &mut Vec<[f32; N]>, theirs: &[[f32; N]], base: usize, count: usize, missing: [f32; N]) {
    if mine.is_empty() && theirs.is_empty() {
        return;
    }
    mine.resize(base, missing);
    mine.extend_from_slice(&theirs[..theirs.len().min(count)]);
    mine.resize(base + count, missing);
}

fn turn_normals(normals: &mut [[f32; 3]], world_from_local: DMat3) {
    if world_from_local == DMat3::IDENTITY {
        return;
    }
    // The cofactors, up to a sign that the user of vertex normals does not look at.
    let normal_matrix = world_from_local.inverse().transpose();
    for normal in normals {
        let turned = normal_matrix * Vec3::from(*normal).as_dvec3();
        *normal = turned.normalize_or_zero().as_vec3().to_array();
    }
}

/// Normal of a counter-clockwise triangle times its area.
pub(crate) fn area_vector([a, b, c]: &[DVec3; 3]) -> DVec3 {
    (b - a).cross(c - a) * 0.5
}
