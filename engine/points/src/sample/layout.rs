//! Where points lie on a surface: on a hexagonal lattice in the plane of each chart, or, on charts too small for one,
//! wherever the area summed along them passes the next whole point.

use super::density::{Alike, Fit, Sizes};
use crate::geometry::area_vector;
use crate::scene::{MeshScene, SurfaceId};
use glam::{DAffine2, DMat2, DVec2, DVec3, Vec3};
use std::f64::consts::{PI, TAU};

/// Charts of fewer points than this are sampled along their summed area: a lattice is only even inside of its border.
const LATTICE_POINTS_MIN: f64 = 12.0;

/// A triangle that leans further than this from its chart's plane (placed geometry that is scaled unevenly) is sampled
/// along its area: a lattice would be stretched too much.
const LEAN_COS_MIN: f64 = 0.7;

/// A disc on a surface, not yet lit.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Surfel {
    pub(crate) position: Vec3,
    /// Unit, on the front.
    pub(crate) normal: Vec3,
    pub(crate) radius: f32,
    pub(crate) surface: SurfaceId,
}

/// Walks over all surfaces of a scene and lays out points, always the same ones.
#[derive(Clone)]
pub(crate) struct Layout {
    sizes: Sizes,
    instance: usize,
    /// How large the points of that instance are, if they are alike.
    alike: Option<Alike>,
    chart: usize,
    /// Next triangle of the chart.
    triangle: usize,
    plane: Option<Plane>,
    /// The triangle whose lattice points are being handed out.
    rows: Option<Rows>,
    /// The triangle that is being sampled along its area, and the area of its points.
    along: Option<(Face, f64)>,
    /// Parts of the triangle whose turn is to come.
    pieces: Vec<Face>,
    /// Area since the last point that was not on a lattice, in points.
    owed: f64,
    /// Points not on a lattice so far: index into the sequence that places them.
    sequence: u64,
}

/// A chart's plane: world space to lattice coordinates, in which points lie at whole numbers.
#[derive(Clone, Copy)]
struct Plane {
    origin: DVec3,
    normal: DVec3,
    axes: [DVec3; 2],
    lattice_from_plane: DAffine2,
    /// Of a point of this lattice.
    area: f64,
}

/// A placed triangle, or a part of one.
#[derive(Clone, Copy)]
pub(super) struct Face {
    pub(super) corners: [DVec3; 3],
    normal: DVec3,
    pub(super) area: f64,
    /// Of its corners, in the whole triangle.
    barycentric: [DVec2; 3],
    instance: u32,
    triangle: u32,
}

/// The lattice points of one triangle, row by row.
#[derive(Clone)]
struct Rows {
    face: Face,
    /// Corners in lattice coordinates.
    corners: [DVec2; 3],
    radius: f32,
    row: i64,
    row_end: i64,
    column: i64,
    column_end: i64,
}

impl Layout {
    pub(crate) fn new(sizes: Sizes) -> Self {
        Self {
            sizes,
            instance: 0,
            alike: None,
            chart: 0,
            triangle: 0,
            plane: None,
            rows: None,
            along: None,
            pieces: Vec::new(),
            owed: 0.5,
            sequence: 0,
        }
    }

    /// Appends surfels until there are `wanted` or no more; `false` at the end of the scene.
    pub(crate) fn fill(&mut self, scene: &MeshScene, wanted: usize, surfels: &mut Vec<Surfel>) -> bool {
        while surfels.len() < wanted {
            if let Some(rows) = &mut self.rows {
                match rows.next() {
                    Some(surfel) => surfels.push(surfel),
                    None => self.rows = None,
                }
            } else if let Some((face, area)) = self.along {
                match self.next_along(&face, area) {
                    Some(surfel) => surfels.push(surfel),
                    None => self.along = None,
                }
            } else if let Some(piece) = self.pieces.pop() {
                self.place(piece);
            } else if !self.step(scene) {
                return !surfels.is_empty();
            }
        }
        true
    }

    /// Takes the next triangle; `false` when there is none. Of what owes no point not every triangle is looked at.
    fn step(&mut self, scene: &MeshScene) -> bool {
        let Some(instance) = scene.instances.get(self.instance) else {
            return false;
        };
        let geometry = &scene.geometries[instance.geometry()];
        let areas = geometry.charts.areas();
        if self.chart == 0 && self.triangle == 0 {
            self.alike = self.sizes.alike(instance, geometry);
            // No chart of it is large enough for a lattice.
            if self
                .alike
                .is_some_and(|alike| self.owes_none(geometry.area() * alike.density))
            {
                self.instance += 1;
                return true;
            }
        }
        let Some(area) = areas.get(self.chart) else {
            self.instance += 1;
            self.chart = 0;
            return true;
        };
        let triangles = geometry.charts.triangles(self.chart);
        if self.triangle == 0 {
            let points = match self.alike {
                Some(alike) => area * alike.density,
                None => {
                    let points = |&triangle: &u32| self.sizes.points_on(&instance.corners(geometry, triangle as usize));
                    triangles.iter().map(points).sum()
                }
            };
            if self.owes_none(points) {
                self.chart += 1;
                return true;
            }
            let large = points >= LATTICE_POINTS_MIN;
            self.plane = triangles
                .first()
                .filter(|_| large)
                .map(|&seed| self.plane_of(scene, seed));
        }
        let Some(&triangle) = triangles.get(self.triangle) else {
            self.chart += 1;
            self.triangle = 0;
            return true;
        };
        self.triangle += 1;
        let face = Face::new(scene, self.instance, triangle);
        if face.area > 0.0 {
            self.pieces.push(face);
        }
        true
    }

    /// Adds the area of so many points, if together with what is owed it comes to no whole point.
    fn owes_none(&mut self, points: f64) -> bool {
        let none = self.owed + points < 1.0;
        if none {
            self.owed += points;
        }
        none
    }

    /// Begins with the points of a face, or cuts it in two where they differ in size.
    fn place(&mut self, face: Face) {
        let fit = self
            .alike
            .map_or_else(|| self.sizes.fit(&face), |alike| Fit::Alike(alike.area));
        let area = match fit {
            Fit::Alike(area) => area,
            Fit::Cut => return self.pieces.extend(face.halves()),
        };
        match self.plane {
            Some(plane) if plane.normal.dot(face.normal) >= LEAN_COS_MIN => {
                self.rows = Rows::new(face, &plane, area);
            }
            _ => {
                self.owed += face.area / area;
                self.along = Some((face, area));
            }
        }
    }

    /// The lattice of the chart that begins with `seed`.
    fn plane_of(&self, scene: &MeshScene, seed: u32) -> Plane {
        let seed = Face::new(scene, self.instance, seed);
        let noise = |salt: u64| {
            let seed = (self.instance as u64) << 32 ^ self.chart as u64;
            hash(seed ^ hash(salt)) as f64 / 2f64.powi(64)
        };
        let area = self.sizes.smallest();
        let edge = (area * 2.0 / 3f64.sqrt()).sqrt();
        let plane_from_lattice = DMat2::from_angle(noise(1) * TAU)
            * DMat2::from_cols(DVec2::new(edge, 0.0), DVec2::new(edge / 2.0, edge * 3f64.sqrt() / 2.0));
        let lattice_from_plane = DAffine2 {
            matrix2: plane_from_lattice.inverse(),
            translation: DVec2::new(noise(2), noise(3)),
        };
        let (u, v) = seed.normal.any_orthonormal_pair();
        Plane {
            origin: seed.corners[0],
            normal: seed.normal,
            axes: [u, v],
            lattice_from_plane,
            area,
        }
    }

    fn next_along(&mut self, face: &Face, area: f64) -> Option<Surfel> {
        if self.owed < 1.0 {
            return None;
        }
        self.owed -= 1.0;
        let [v, w] = r2(self.sequence);
        self.sequence += 1;
        // The far half of the parallelogram is folded onto the triangle.
        let (v, w) = if v + w > 1.0 { (1.0 - v, 1.0 - w) } else { (v, w) };
        Some(face.surfel(v, w, radius_of(area)))
    }
}

impl Face {
    fn new(scene: &MeshScene, index: usize, triangle: u32) -> Self {
        let instance = &scene.instances[index];
        let corners = instance.corners(&scene.geometries[instance.geometry()], triangle as usize);
        let vector = area_vector(&corners);
        let front = if instance.mirrors() { -vector } else { vector };
        Self {
            corners,
            normal: front.normalize_or_zero(),
            area: vector.length(),
            barycentric: [DVec2::ZERO, DVec2::X, DVec2::Y],
            instance: index as u32,
            triangle,
        }
    }

    /// Both sides of a cut from the middle of the longest edge.
    fn halves(&self) -> [Self; 2] {
        let length = |edge: usize| self.corners[edge].distance_squared(self.corners[(edge + 1) % 3]);
        let edge = (0..3).max_by(|&a, &b| length(a).total_cmp(&length(b))).unwrap_or(0);
        let (a, b) = (edge, (edge + 1) % 3);
        let middle = (self.corners[a] + self.corners[b]) / 2.0;
        let weight = (self.barycentric[a] + self.barycentric[b]) / 2.0;
        [a, b].map(|corner| {
            let mut half = *self;
            half.corners[corner] = middle;
            half.barycentric[corner] = weight;
            half.area = self.area / 2.0;
            half
        })
    }

    fn surfel(&self, v: f64, w: f64, radius: f32) -> Surfel {
        let [a, b, c] = self.corners;
        let position = a * (1.0 - v - w) + b * v + c * w;
        let [p, q, r] = self.barycentric;
        let barycentric = p * (1.0 - v - w) + q * v + r * w;
        Surfel {
            position: position.as_vec3(),
            normal: self.normal.as_vec3(),
            radius,
            surface: SurfaceId {
                instance: self.instance,
                triangle: self.triangle,
                barycentric: barycentric.as_vec2().to_array(),
            },
        }
    }
}

impl Plane {
    fn lattice(&self, world: DVec3) -> DVec2 {
        let offset = world - self.origin;
        let on_plane = DVec2::new(offset.dot(self.axes[0]), offset.dot(self.axes[1]));
        self.lattice_from_plane.transform_point2(on_plane)
    }
}

impl Rows {
    /// `None` where no row crosses the triangle. Larger points lie on the same lattice, stretched.
    fn new(face: Face, plane: &Plane, area: f64) -> Option<Self> {
        let stretch = (plane.area / area).sqrt();
        let corners = face.corners.map(|corner| plane.lattice(corner) * stretch);
        let low = corners.iter().map(|corner| corner.y).fold(f64::INFINITY, f64::min);
        let high = corners.iter().map(|corner| corner.y).fold(f64::NEG_INFINITY, f64::max);
        // Rows from the first at or above the lowest corner to the last below the highest.
        let (row, row_end) = (low.ceil() as i64, high.ceil() as i64);
        (row < row_end).then(|| Self {
            face,
            corners,
            radius: radius_of(area / plane.normal.dot(face.normal)),
            row: row - 1,
            row_end,
            column: 0,
            column_end: 0,
        })
    }

    fn next(&mut self) -> Option<Surfel> {
        while self.column >= self.column_end {
            self.row += 1;
            if self.row >= self.row_end {
                return None;
            }
            [self.column, self.column_end] = self.columns(self.row as f64);
        }
        let point = DVec2::new(self.column as f64, self.row as f64);
        self.column += 1;
        let [a, b, c] = self.corners;
        let whole = (b - a).perp_dot(c - a);
        let v = ((point - a).perp_dot(c - a) / whole).clamp(0.0, 1.0);
        let w = ((b - a).perp_dot(point - a) / whole).clamp(0.0, 1.0 - v);
        Some(self.face.surfel(v, w, self.radius))
    }

    /// The columns of a row that lie inside: half open, and each edge is computed alike from both of its triangles, so
    /// that no point is lost or given twice.
    fn columns(&self, row: f64) -> [i64; 2] {
        let mut crossings = [f64::NAN; 2];
        let mut count = 0;
        for edge in 0..3 {
            let (a, b) = (self.corners[edge], self.corners[(edge + 1) % 3]);
            let (low, high) = if (a.y, a.x) <= (b.y, b.x) { (a, b) } else { (b, a) };
            if low.y <= row && row < high.y && count < 2 {
                crossings[count] = low.x + (row - low.y) / (high.y - low.y) * (high.x - low.x);
                count += 1;
            }
        }
        if count < 2 {
            return [0, 0];
        }
        let (left, right) = (crossings[0].min(crossings[1]), crossings[0].max(crossings[1]));
        [left.ceil() as i64, right.ceil() as i64]
    }
}

fn radius_of(area: f64) -> f32 {
    (area / PI).sqrt() as f32
}

/// The R2 sequence: evenly spread points of the unit square (M. Roberts, 2018: multiples of the plastic ratio's powers).
fn r2(index: u64) -> [f64; 2] {
    const STEPS: [f64; 2] = [0.754_877_666_246_692_8, 0.569_840_290_998_053_3];
    STEPS.map(|step| (0.5 + step * index as f64).fract())
}

/// SplitMix64's finalizer.
fn hash(value: u64) -> u64 {
    let mut z = value.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ z >> 31
}
