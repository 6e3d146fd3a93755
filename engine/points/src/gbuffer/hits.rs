//! A G-buffer from what rays met: [`HitBuffer`] says which rays, and puts together what they met.

use super::GBuffer;
use crate::camera::Camera;
use crate::image::Window;
use glam::Vec3;

/// Rays along each side of a pixel.
const PIXEL_RAYS: u32 = 2;
/// Pixels along each side of a block, whose rays are traced together.
const BLOCK_EDGE: u32 = 4;
/// Rays of a block.
const BLOCK_RAYS: usize = ((BLOCK_EDGE * PIXEL_RAYS) * (BLOCK_EDGE * PIXEL_RAYS)) as usize;
/// Hits of a pixel whose depths differ by less than this share are of one surface.
const ONE_SURFACE: f32 = 0.01;
/// An empty pixel among at least this many of its eight neighbours is a gap between points, not the end of a surface.
const GAP_NEIGHBOURS: usize = 5;
/// How often gaps are closed from their rims.
const GAP_ROUNDS: usize = 4;

/// What a ray met: position x y z, normal x y z, radiance R G B, coverage.
pub type RayHit = [f32; 10];

/// A picture of a scene without meshes on its way: rays out, hits in, in the same order.
pub struct HitBuffer {
    camera: Camera,
    width: u32,
    height: u32,
    buffer: GBuffer,
    pending: Vec<RayHit>,
    blocks_done: u32,
}

impl HitBuffer {
    /// An empty picture of `width` times `height` pixels.
    pub fn new(camera: &Camera, width: u32, height: u32) -> Self {
        let pixels = width as usize * height as usize;
        Self {
            camera: camera.clone(),
            width,
            height,
            buffer: GBuffer {
                data_window: Window::of_size(width, height),
                display_window: Window::of_size(width, height),
                world_to_camera: Some(camera.exr_world_to_camera()),
                world_to_ndc: Some(camera.exr_world_to_ndc(width, height)),
                position: vec![[0.0; 3]; pixels],
                normal: vec![[0.0; 3]; pixels],
                coverage: vec![0.0; pixels],
                albedo: Some(vec![[0.0; 3]; pixels]),
                direct: None,
                emission: None,
            },
            pending: Vec::new(),
            blocks_done: 0,
        }
    }

    /// Angle between neighbouring rays, radians.
    pub fn pixel_angle(&self) -> f32 {
        2.0 * (self.camera.fov_y / 2.0).tan() / (self.height * PIXEL_RAYS) as f32
    }

    /// All rays.
    pub fn ray_count(&self) -> u64 {
        u64::from(self.block_count()) * BLOCK_RAYS as u64
    }

    /// Rays, block by block: origin x y z, direction x y z. Those beyond the picture's edge have no direction.
    pub fn rays(&self) -> impl Iterator<Item = Vec<[f32; 6]>> + Send + use<> {
        let (camera, width, height, columns) = (self.camera.clone(), self.width, self.height, self.block_columns());
        let [x, y, z] = camera.eye().to_array();
        (0..self.block_count()).map(move |block| {
            let ray = |index: usize| {
                let (column, row) = ray_place(block, columns, index);
                if column >= width * PIXEL_RAYS || row >= height * PIXEL_RAYS {
                    return [x, y, z, 0.0, 0.0, 0.0];
                }
                let direction = camera.direction(column, row, width * PIXEL_RAYS, height * PIXEL_RAYS);
                [x, y, z, direction.x, direction.y, direction.z]
            };
            (0..BLOCK_RAYS).map(ray).collect()
        })
    }

    /// Takes what the next rays met.
    pub fn take(&mut self, hits: &[RayHit]) {
        self.pending.extend_from_slice(hits);
        let whole = self.pending.len() / BLOCK_RAYS;
        for index in 0..whole {
            let hits: Vec<RayHit> = self.pending[index * BLOCK_RAYS..(index + 1) * BLOCK_RAYS].to_vec();
            self.resolve(&hits);
            self.blocks_done += 1;
        }
        self.pending.drain(..whole * BLOCK_RAYS);
    }

    /// The G-buffer, with gaps between points closed. The radiance of the points is its albedo.
    pub fn finish(mut self) -> GBuffer {
        for _ in 0..GAP_ROUNDS {
            close_gaps(&mut self.buffer, self.width as usize, self.height as usize);
        }
        self.buffer
    }

    fn block_columns(&self) -> u32 {
        self.width.div_ceil(BLOCK_EDGE)
    }

    fn block_count(&self) -> u32 {
        self.block_columns() * self.height.div_ceil(BLOCK_EDGE)
    }

    /// Pixels of a block from its hits.
    fn resolve(&mut self, hits: &[RayHit]) {
        let eye = self.camera.eye();
        let columns = self.block_columns();
        let mut pixels = vec![Vec::new(); (BLOCK_EDGE * BLOCK_EDGE) as usize];
        for (index, hit) in hits.iter().enumerate() {
            let (column, row) = ray_place(0, 1, index);
            pixels[(row / PIXEL_RAYS * BLOCK_EDGE + column / PIXEL_RAYS) as usize].push(*hit);
        }
        for (index, hits) in (0..).zip(&mut pixels) {
            let column = self.blocks_done % columns * BLOCK_EDGE + index % BLOCK_EDGE;
            let row = self.blocks_done / columns * BLOCK_EDGE + index / BLOCK_EDGE;
            if column >= self.width || row >= self.height {
                continue;
            }
            let pixel = (row * self.width + column) as usize;
            let depth = |hit: &RayHit| Vec3::new(hit[0], hit[1], hit[2]).distance(eye);
            let coverage: f32 = hits.iter().map(|hit| hit[9]).sum();
            hits.retain(|hit| hit[9] > 0.0);
            hits.sort_by(|a, b| depth(a).total_cmp(&depth(b)));
            let Some(middle) = hits.get(hits.len() / 2).map(&depth) else {
                continue;
            };
            self.buffer.coverage[pixel] = coverage / (PIXEL_RAYS * PIXEL_RAYS) as f32;
            if let Some(albedo) = &mut self.buffer.albedo {
                albedo[pixel] = mean(hits, 6);
            }
            hits.retain(|hit| (depth(hit) - middle).abs() <= ONE_SURFACE * middle);
            self.buffer.position[pixel] = mean(hits, 0);
            self.buffer.normal[pixel] = Vec3::from(mean(hits, 3)).normalize_or_zero().to_array();
        }
    }
}

/// Column and row of a ray.
fn ray_place(block: u32, block_columns: u32, index: usize) -> (u32, u32) {
    const EDGE: u32 = BLOCK_EDGE * PIXEL_RAYS;
    let (column, row) = (index as u32 % EDGE, index as u32 / EDGE);
    (
        block % block_columns * EDGE + column,
        block / block_columns * EDGE + row,
    )
}

/// Mean of three numbers of hits, weighted with their coverage.
fn mean(hits: &[RayHit], first: usize) -> [f32; 3] {
    let weight: f32 = hits.iter().map(|hit| hit[9]).sum();
    std::array::from_fn(|axis| {
        hits.iter().map(|hit| hit[first + axis] * hit[9]).sum::<f32>() / weight.max(f32::MIN_POSITIVE)
    })
}

/// Fills empty pixels that are nearly surrounded with the mean of their neighbours.
fn close_gaps(buffer: &mut GBuffer, width: usize, height: usize) {
    let before = buffer.clone();
    for row in 1..height.saturating_sub(1) {
        for column in 1..width.saturating_sub(1) {
            let pixel = row * width + column;
            if before.coverage[pixel] >= 0.5 {
                continue;
            }
            let around = (0..9usize).filter(|&at| at != 4).map(|at| {
                let (down, right) = (at / 3, at % 3);
                (row + down - 1) * width + column + right - 1
            });
            let full: Vec<usize> = around.filter(|&other| before.coverage[other] >= 0.5).collect();
            if full.len() < GAP_NEIGHBOURS {
                continue;
            }
            let share = 1.0 / full.len() as f32;
            let mean = |plane: &[[f32; 3]]| -> [f32; 3] {
                std::array::from_fn(|axis| full.iter().map(|&other| plane[other][axis]).sum::<f32>() * share)
            };
            buffer.position[pixel] = mean(&before.position);
            buffer.normal[pixel] = Vec3::from(mean(&before.normal)).normalize_or_zero().to_array();
            buffer.coverage[pixel] = 1.0;
            if let (Some(albedo), Some(old)) = (&mut buffer.albedo, &before.albedo) {
                albedo[pixel] = mean(old);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_pixel_gets_what_its_own_rays_met_and_gaps_are_closed() {
        let camera = Camera::look_at(Vec3::new(0.0, 0.0, 5.0), Vec3::ZERO, 0.8);
        let mut buffer = HitBuffer::new(&camera, 21, 10);
        let rays: Vec<[f32; 6]> = buffer.rays().flatten().collect();
        assert_eq!(rays.len() as u64, buffer.ray_count());
        // A wall at z = 0, with a hole of a pixel, in answers that are cut anywhere.
        let wall = |ray: &[f32; 6]| -> RayHit {
            if ray[5] == 0.0 {
                return [0.0; 10];
            }
            let t = -ray[2] / ray[5];
            let (x, y) = (ray[0] + t * ray[3], ray[1] + t * ray[4]);
            if x.abs() < 0.2 && (y - 0.2).abs() < 0.2 {
                return [0.0; 10];
            }
            [x, y, 0.0, 0.0, 0.0, 1.0, x.abs(), 0.5, 0.25, 1.0]
        };
        let hits: Vec<RayHit> = rays.iter().map(wall).collect();
        hits.chunks(37).for_each(|some| buffer.take(some));
        let gbuffer = buffer.finish();
        assert_eq!(gbuffer.hole_count(), 0);
        for row in 0..10 {
            for column in 0..21 {
                let direction = camera.direction(column, row, 21, 10);
                let expected = camera.eye() + direction * (-5.0 / direction.z);
                let pixel = (row * 21 + column) as usize;
                let position = Vec3::from(gbuffer.position[pixel]);
                assert!(
                    position.distance(expected) < 0.2,
                    "{column} {row}: {position} {expected}"
                );
                assert_eq!(gbuffer.normal[pixel], [0.0, 0.0, 1.0]);
            }
        }
    }
}
