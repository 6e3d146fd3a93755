//! A town of boxes on a plane, of any size: a stream of points that keeps nothing, and receivers spread over all of its surfaces.

use glam::Vec3;
use pbgi_core::point::Sides;
use pbgi_core::{Bounds, PointRecord, PointStream};
use pbgi_points::{GBuffer, Window};
use pbgi_shade::Receiver;
use std::convert::Infallible;

/// Edge of a block, of the house on it, and the range of heights.
const BLOCK: f32 = 10.0;
const HOUSE: f32 = 6.0;
const HEIGHT: [f32; 2] = [4.0, 16.0];
/// Mean area of a block's surfaces: ground around the house, roof, four walls.
const BLOCK_AREA: f32 = BLOCK * BLOCK + 4.0 * HOUSE * (HEIGHT[0] + HEIGHT[1]) / 2.0;
const SUN: Vec3 = Vec3::new(0.48, 0.8, 0.36);

/// The town.
pub(crate) struct Town {
    blocks: u32,
    spacing: f32,
    next: u32,
}

fn hash(a: u32, b: u32) -> f32 {
    let mut state = a.wrapping_mul(0x9e37_79b9) ^ b.wrapping_mul(0x85eb_ca6b) ^ 0x5bd1_e995;
    state = (state ^ state >> 15).wrapping_mul(0x2c1b_3c6d);
    state = (state ^ state >> 12).wrapping_mul(0x297a_2d39);
    ((state ^ state >> 15) >> 8) as f32 / (1 << 24) as f32
}

impl Town {
    /// About `points` points, four thousand a block.
    pub(crate) fn new(points: u64) -> Self {
        let blocks = ((points as f64 / 4_000.0).sqrt().ceil() as u32).max(2);
        let area = BLOCK_AREA * (blocks * blocks) as f32;
        Self {
            blocks,
            spacing: (area / points as f32).sqrt(),
            next: 0,
        }
    }

    fn height(block: u32) -> f32 {
        HEIGHT[0] + (HEIGHT[1] - HEIGHT[0]) * hash(block, 1)
    }

    fn corner(&self, block: u32) -> Vec3 {
        Vec3::new((block % self.blocks) as f32, 0.0, (block / self.blocks) as f32) * BLOCK
    }

    /// Jittered points of a parallelogram, but for those that `keep` refuses.
    fn sheet(
        &self,
        corner: Vec3,
        u: Vec3,
        v: Vec3,
        normal: Vec3,
        out: &mut Vec<PointRecord>,
        keep: impl Fn(Vec3) -> bool,
    ) {
        let count = |edge: Vec3| ((edge.length() / self.spacing).round() as u32).max(1);
        let (columns, rows) = (count(u), count(v));
        let area = u.length() * v.length() / (columns * rows) as f32;
        let radius = (area / std::f32::consts::PI).sqrt();
        let seed = (corner.x * 31.0 + corner.y * 17.0 + corner.z * 7.0) as u32;
        let lit = 0.1 + 0.9 * normal.dot(SUN).max(0.0);
        let color = [0, 1, 2].map(|channel| lit * (0.2 + 0.6 * hash(seed, channel)));
        for index in 0..columns * rows {
            let jitter = |salt: u32| 0.5 + 0.5 * (hash(index ^ seed.rotate_left(16), salt) - 0.5);
            let s = ((index % columns) as f32 + jitter(5)) / columns as f32;
            let t = ((index / columns) as f32 + jitter(6)) / rows as f32;
            let position = corner + u * s + v * t;
            let sides = Sides {
                front: color,
                back: [0.0; 3],
            };
            if keep(position)
                && let Ok(point) = PointRecord::new(position.to_array(), normal.to_array(), radius, sides)
            {
                out.push(point);
            }
        }
    }

    fn block(&self, block: u32, out: &mut Vec<PointRecord>) {
        let (ground, height) = (self.corner(block), Self::height(block));
        let low = ground + Vec3::new(BLOCK - HOUSE, 0.0, BLOCK - HOUSE) / 2.0;
        let (x, y, z) = (Vec3::X * HOUSE, Vec3::Y * height, Vec3::Z * HOUSE);
        let under = |p: Vec3| p.x > low.x && p.x < low.x + HOUSE && p.z > low.z && p.z < low.z + HOUSE;
        self.sheet(ground, Vec3::X * BLOCK, Vec3::Z * BLOCK, Vec3::Y, out, |p| !under(p));
        self.sheet(low + y, x, z, Vec3::Y, out, |_| true);
        self.sheet(low, x, y, Vec3::NEG_Z, out, |_| true);
        self.sheet(low + z, x, y, Vec3::Z, out, |_| true);
        self.sheet(low, z, y, Vec3::NEG_X, out, |_| true);
        self.sheet(low + x, z, y, Vec3::X, out, |_| true);
    }

    /// The surface of the town unrolled from south to north: where column and row (each from 0 to 1) are.
    fn receiver(&self, column: f32, row: f32) -> Receiver {
        let along = (row * self.blocks as f32).min(self.blocks as f32 - 1e-3);
        let x = column * self.blocks as f32 * BLOCK;
        let block = (x / BLOCK).min(self.blocks as f32 - 1.0) as u32 + along as u32 * self.blocks;
        let (ground, height, yard) = (self.corner(block), Self::height(block), (BLOCK - HOUSE) / 2.0);
        let inside = (x - ground.x - BLOCK / 2.0).abs() < HOUSE / 2.0;
        let rise = if inside { height } else { 0.0 };
        let mut way = along.fract() * (BLOCK + 2.0 * rise);
        let at = |y: f32, z: f32, normal: Vec3| Receiver {
            position: Vec3::new(x, y, ground.z + z),
            normal,
        };
        if way < yard {
            return at(0.0, way, Vec3::Y);
        }
        way -= yard;
        if way < rise {
            return at(way, yard, Vec3::NEG_Z);
        }
        way -= rise;
        if way < HOUSE {
            return at(rise, yard + way, Vec3::Y);
        }
        way -= HOUSE;
        if way < rise {
            return at(rise - way, yard + HOUSE, Vec3::Z);
        }
        at(0.0, yard + HOUSE + way - rise, Vec3::Y)
    }

    /// Receivers of a picture of the whole town, row-major.
    pub(crate) fn receivers(&self, width: u32, height: u32) -> Vec<Receiver> {
        let place = |index: u32, count: u32| (index as f32 + 0.5) / count as f32;
        (0..width * height)
            .map(|pixel| self.receiver(place(pixel % width, width), place(pixel / width, height)))
            .collect()
    }

    /// The same as a G-buffer.
    pub(crate) fn gbuffer(&self, width: u32, height: u32) -> GBuffer {
        let receivers = self.receivers(width, height);
        let window = Window {
            x: 0,
            y: 0,
            width,
            height,
        };
        GBuffer {
            data_window: window,
            display_window: window,
            world_to_camera: None,
            world_to_ndc: None,
            position: receivers.iter().map(|receiver| receiver.position.to_array()).collect(),
            normal: receivers.iter().map(|receiver| receiver.normal.to_array()).collect(),
            coverage: vec![1.0; receivers.len()],
            albedo: None,
            direct: None,
            emission: None,
        }
    }
}

impl PointStream for Town {
    type Error = Infallible;

    fn bounds(&self) -> Option<Bounds> {
        let mut bounds = Bounds::EMPTY;
        let edge = self.blocks as f32 * BLOCK;
        bounds.include([0.0; 3]);
        bounds.include([edge, HEIGHT[1], edge]);
        Some(bounds)
    }

    fn len_hint(&self) -> Option<u64> {
        None
    }

    fn next_batch(&mut self, batch: &mut Vec<PointRecord>) -> Result<bool, Infallible> {
        if self.next == self.blocks * self.blocks {
            return Ok(false);
        }
        self.block(self.next, batch);
        self.next += 1;
        Ok(true)
    }

    fn rewind(&mut self) -> Result<(), Infallible> {
        self.next = 0;
        Ok(())
    }
}
