//! A picture between its G-buffer and its result: cut into tiles of receivers on the way out, filled with values on the way
//! back.
//!
//! Tiles and groups lie on a grid anchored at the display window, so that a crop or an overscan does not move them. A tile's
//! values take the place of its positions and normals, which nobody needs any more: a pixel is 32 bytes all along.

use pbgi_core::limits::{GROUP_EDGE, TILE_EDGE};
use pbgi_points::{GBuffer, Window};
use std::collections::HashSet;

/// Floats that describe a receiver: position and normal.
const RECEIVER_FLOATS: usize = 6;
/// Floats that come back for it: irradiance, occlusion, bent normal.
const VALUE_FLOATS: usize = 7;

/// A picture in work.
#[derive(Debug)]
pub struct Framebuffer {
    data: Window,
    display: Window,
    /// First column and row of tiles, and how many columns, on the grid of the display window.
    tile_origin: [i64; 2],
    tile_columns: u32,
    /// Receiver positions; irradiance where the tile is done.
    first: Vec<[f32; 3]>,
    /// Receiver normals, zero in holes; bent normals where the tile is done.
    second: Vec<[f32; 3]>,
    /// Zero until the tile is done.
    occlusion: Vec<f32>,
    /// Zero in holes.
    coverage: Vec<f32>,
    holes: u64,
    /// Tiles that are done.
    done: HashSet<u32>,
}

/// A small version of a picture, for people who wait for it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Preview {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Red, green, blue, opacity; tiles that are not done are transparent.
    pub rgba: Vec<u8>,
}

/// The receivers of a tile, as they go to a worker.
#[derive(Clone, Debug, PartialEq)]
pub struct TileReceivers {
    /// Six little-endian floats each.
    pub bytes: Vec<u8>,
    /// Receivers of each group.
    pub group_lengths: Vec<u32>,
}

/// The finished planes of a picture, row-major over the data window.
#[derive(Debug)]
pub struct Planes {
    /// The pixels there are.
    pub data: Window,
    /// The picture they are part of.
    pub display: Window,
    /// W/m2.
    pub irradiance: Vec<[f32; 3]>,
    /// 0 open, 1 closed.
    pub occlusion: Vec<f32>,
    /// Unit, or zero.
    pub bent_normal: Vec<[f32; 3]>,
    /// The G-buffer's, zero in holes.
    pub coverage: Vec<f32>,
}

impl Framebuffer {
    /// Takes a G-buffer; what is not needed for shading is let go.
    pub fn new(gbuffer: GBuffer) -> Self {
        let holes: Vec<usize> = (0..gbuffer.pixel_count())
            .filter(|&pixel| gbuffer.is_hole(pixel))
            .collect();
        let GBuffer {
            data_window: data,
            display_window: display,
            mut position,
            mut normal,
            mut coverage,
            ..
        } = gbuffer;
        for &pixel in &holes {
            position[pixel] = [0.0; 3];
            normal[pixel] = [0.0; 3];
            coverage[pixel] = 0.0;
        }
        let edge = i64::from(TILE_EDGE);
        let cell = |position: i64, anchor: i32| (position - i64::from(anchor)).div_euclid(edge);
        let tile_origin = [cell(i64::from(data.x), display.x), cell(i64::from(data.y), display.y)];
        let last_column = cell(i64::from(data.x) + i64::from(data.width) - 1, display.x);
        Self {
            data,
            display,
            tile_origin,
            tile_columns: (last_column - tile_origin[0] + 1).max(0) as u32,
            occlusion: vec![0.0; position.len()],
            first: position,
            second: normal,
            coverage,
            holes: holes.len() as u64,
            done: HashSet::new(),
        }
    }

    /// A small version of what there is: irradiance as a white surface shows it.
    pub fn preview(&self, edge_max: u32) -> Preview {
        let step = self.data.width.max(self.data.height).div_ceil(edge_max).max(1);
        let (width, height) = (self.data.width / step, self.data.height / step);
        let mut rgba = Vec::with_capacity((width * height * 4) as usize);
        for (row, column) in (0..height).flat_map(|row| (0..width).map(move |column| (row, column))) {
            let (x, y) = (column * step, row * step);
            let pixel = y as usize * self.data.width as usize + x as usize;
            let tile = self.tile_of(x, y);
            if self.done.contains(&tile) && self.coverage[pixel] > 0.0 {
                rgba.extend(self.first[pixel].map(shown));
                rgba.push(255);
            } else {
                rgba.extend([0; 4]);
            }
        }
        Preview { width, height, rgba }
    }

    /// The tile that a pixel of the data window is in.
    fn tile_of(&self, x: u32, y: u32) -> u32 {
        let cell = |offset: u32, start: i32, anchor: i32, origin: i64| {
            let position = i64::from(offset) + i64::from(start) - i64::from(anchor);
            (position.div_euclid(i64::from(TILE_EDGE)) - origin) as u32
        };
        let column = cell(x, self.data.x, self.display.x, self.tile_origin[0]);
        let row = cell(y, self.data.y, self.display.y, self.tile_origin[1]);
        row * self.tile_columns + column
    }

    /// Pixels.
    pub fn pixel_count(&self) -> u64 {
        self.coverage.len() as u64
    }

    /// Pixels without a receiver.
    pub fn holes(&self) -> u64 {
        self.holes
    }

    /// Tiles that have a receiver, along a Z-curve.
    pub fn tiles(&self) -> Vec<u32> {
        let edge = i64::from(TILE_EDGE);
        let bottom = i64::from(self.data.y) + i64::from(self.data.height) - i64::from(self.display.y);
        let rows = (bottom - self.tile_origin[1] * edge).max(0).div_ceil_signed(edge) as u32;
        let mut tiles: Vec<(u64, u32)> = (0..rows)
            .flat_map(|row| (0..self.tile_columns).map(move |column| (column, row)))
            .map(|(column, row)| (interleave(column, row), row * self.tile_columns + column))
            .filter(|&(_, tile)| self.groups(tile).next().is_some())
            .collect();
        tiles.sort_unstable();
        tiles.into_iter().map(|(_, tile)| tile).collect()
    }

    /// The receivers of a tile that is not done.
    pub fn receivers(&self, tile: u32) -> TileReceivers {
        let mut bytes = Vec::with_capacity((TILE_EDGE * TILE_EDGE) as usize * RECEIVER_FLOATS * 4);
        let mut group_lengths = Vec::new();
        for group in self.groups(tile) {
            group_lengths.push(group.len() as u32);
            for pixel in group {
                for value in self.first[pixel].iter().chain(&self.second[pixel]) {
                    bytes.extend_from_slice(&value.to_le_bytes());
                }
            }
        }
        TileReceivers { bytes, group_lengths }
    }

    /// Checks the values of a tile that is not done.
    ///
    /// # Errors
    /// What is wrong with them.
    pub fn check(&self, tile: u32, values: &[u8]) -> Result<(), String> {
        let receivers: usize = self.groups(tile).map(|group| group.len()).sum();
        let expected = receivers * VALUE_FLOATS * 4;
        if values.len() != expected {
            return Err(format!(
                "{expected} bytes of values expected, {} received",
                values.len()
            ));
        }
        match floats(values).position(|value| !value.is_finite()) {
            Some(index) => Err(format!(
                "value {} of receiver {} is not finite",
                index % VALUE_FLOATS,
                index / VALUE_FLOATS
            )),
            None => Ok(()),
        }
    }

    /// Puts the values of a tile in place, once; [`Self::check`] has seen them.
    pub fn fill(&mut self, tile: u32, values: &[u8]) {
        self.done.insert(tile);
        let pixels: Vec<usize> = self.groups(tile).flatten().collect();
        let mut values = floats(values);
        let mut next = || values.next().unwrap_or(0.0);
        for pixel in pixels {
            let hole = self.second[pixel] == [0.0; 3];
            let irradiance = [next(), next(), next()];
            let occlusion = next();
            let bent_normal = [next(), next(), next()];
            if !hole {
                self.first[pixel] = irradiance;
                self.occlusion[pixel] = occlusion;
                self.second[pixel] = bent_normal;
            }
        }
    }

    /// The finished picture.
    pub fn into_planes(self) -> Planes {
        Planes {
            data: self.data,
            display: self.display,
            irradiance: self.first,
            occlusion: self.occlusion,
            bent_normal: self.second,
            coverage: self.coverage,
        }
    }

    /// The pixels of a tile's groups, groups along a Z-curve, row-major within; a group of holes only is left out.
    fn groups(&self, tile: u32) -> impl Iterator<Item = Vec<usize>> + '_ {
        let columns = self.tile_columns.max(1);
        let corner = |axis: usize, index: u32, anchor: i32| {
            (self.tile_origin[axis] + i64::from(index)) * i64::from(TILE_EDGE) + i64::from(anchor)
        };
        let left = corner(0, tile % columns, self.display.x);
        let top = corner(1, tile / columns, self.display.y);
        let per_edge = TILE_EDGE / GROUP_EDGE;
        (0..per_edge * per_edge).filter_map(move |code| {
            let (column, row) = deinterleave(code);
            let x = left + i64::from(column * GROUP_EDGE);
            let y = top + i64::from(row * GROUP_EDGE);
            let pixels = self.pixels(x, y);
            pixels
                .iter()
                .any(|&pixel| self.second[pixel] != [0.0; 3])
                .then_some(pixels)
        })
    }

    /// Pixels of the group at `x`, `y` that are inside the data window.
    fn pixels(&self, x: i64, y: i64) -> Vec<usize> {
        let clip = |start: i64, origin: i32, size: u32| {
            let start = start - i64::from(origin);
            start.max(0)..(start + i64::from(GROUP_EDGE)).min(i64::from(size))
        };
        let columns = clip(x, self.data.x, self.data.width);
        let rows = clip(y, self.data.y, self.data.height);
        let width = self.data.width as usize;
        rows.flat_map(|row| {
            columns
                .clone()
                .map(move |column| row as usize * width + column as usize)
        })
        .collect()
    }
}

/// Irradiance on white as a screen shows it.
fn shown(irradiance: f32) -> u8 {
    let radiance = (irradiance / std::f32::consts::PI).max(0.0);
    // Bright parts are bent, not cut.
    let bent = radiance / (1.0 + radiance);
    (bent.powf(1.0 / 2.2) * 255.0).round() as u8
}

trait DivCeilSigned {
    fn div_ceil_signed(self, divisor: i64) -> i64;
}

impl DivCeilSigned for i64 {
    fn div_ceil_signed(self, divisor: i64) -> i64 {
        -(-self).div_euclid(divisor)
    }
}

fn floats(bytes: &[u8]) -> impl Iterator<Item = f32> + '_ {
    bytes.as_chunks::<4>().0.iter().map(|chunk| f32::from_le_bytes(*chunk))
}

fn interleave(x: u32, y: u32) -> u64 {
    let spread = |value: u32| (0..32).fold(0, |code, bit| code | u64::from(value >> bit & 1) << (2 * bit));
    spread(x) | spread(y) << 1
}

fn deinterleave(code: u32) -> (u32, u32) {
    let gather = |code: u32| (0..16).fold(0, |value, bit| value | (code >> (2 * bit) & 1) << bit);
    (gather(code), gather(code >> 1))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn window(x: i32, y: i32, width: u32, height: u32) -> Window {
        Window { x, y, width, height }
    }

    /// Position is the pixel's place on the display's plane.
    fn gbuffer(data: Window, display: Window) -> GBuffer {
        let places = (0..data.height as i32).flat_map(|row| (0..data.width as i32).map(move |column| (column, row)));
        let position: Vec<[f32; 3]> = places
            .map(|(x, y)| [(x + data.x) as f32, (y + data.y) as f32, 0.0])
            .collect();
        GBuffer {
            data_window: data,
            display_window: display,
            world_to_camera: None,
            world_to_ndc: None,
            normal: vec![[0.0, 1.0, 0.0]; position.len()],
            coverage: vec![1.0; position.len()],
            position,
            albedo: None,
            direct: None,
            emission: None,
        }
    }

    fn value_of(x: f32, y: f32) -> [f32; VALUE_FLOATS] {
        [x, y, 1.0, 0.5, x, 2.0, y]
    }

    /// Shades every tile: values name the receiver they came from.
    fn shade(frame: &mut Framebuffer) -> usize {
        let mut receivers = 0;
        for tile in frame.tiles() {
            let sent = frame.receivers(tile);
            let positions: Vec<f32> = floats(&sent.bytes).collect();
            let count: u32 = sent.group_lengths.iter().sum();
            assert_eq!(positions.len(), count as usize * RECEIVER_FLOATS);
            receivers += count as usize;
            let values: Vec<u8> = positions
                .chunks(RECEIVER_FLOATS)
                .flat_map(|receiver| value_of(receiver[0], receiver[1]))
                .flat_map(f32::to_le_bytes)
                .collect();
            frame.check(tile, &values).unwrap();
            assert!(frame.check(tile, &values[4..]).is_err());
            frame.fill(tile, &values);
        }
        receivers
    }

    #[test]
    fn every_pixel_is_sent_once_and_comes_back_to_its_place() {
        let display = window(0, 0, 100, 70);
        for data in [
            display,
            window(-5, -40, 120, 130),
            window(33, 31, 1, 1),
            window(7, 9, 64, 40),
            window(200, 300, 33, 9),
        ] {
            let mut frame = Framebuffer::new(gbuffer(data, display));
            assert_eq!(shade(&mut frame), data.pixel_count());
            let planes = frame.into_planes();
            for (pixel, irradiance) in planes.irradiance.iter().enumerate() {
                let x = (pixel as i32 % data.width as i32 + data.x) as f32;
                let y = (pixel as i32 / data.width as i32 + data.y) as f32;
                let [r, g, b, occlusion, bent @ ..] = value_of(x, y);
                assert_eq!(*irradiance, [r, g, b]);
                assert_eq!((planes.occlusion[pixel], planes.bent_normal[pixel]), (occlusion, bent));
            }
        }
    }

    #[test]
    fn groups_lie_on_the_grid_of_the_display_window() {
        let frame = Framebuffer::new(gbuffer(window(5, 3, 20, 20), window(0, 0, 64, 64)));
        assert_eq!(frame.tiles(), [0]);
        let sent = frame.receivers(0);
        // Columns 5..8, 8..16, 16..24, 24..25 and rows 3..8, 8..16, 16..23.
        assert_eq!(sent.group_lengths, [15, 40, 24, 64, 40, 5, 64, 8, 21, 56, 56, 7]);
        let first: Vec<f32> = floats(&sent.bytes).take(6).collect();
        assert_eq!(first, [5.0, 3.0, 0.0, 0.0, 1.0, 0.0]);
    }

    #[test]
    fn tiles_go_out_along_a_z_curve() {
        let frame = Framebuffer::new(gbuffer(window(0, 0, 128, 96), window(0, 0, 128, 96)));
        assert_eq!(frame.tiles(), [0, 1, 4, 5, 2, 3, 6, 7, 8, 9, 10, 11]);
    }

    #[test]
    fn holes_are_zero_and_groups_of_holes_are_not_sent() {
        let display = window(0, 0, 64, 32);
        let mut input = gbuffer(display, display);
        for row in 0..32 {
            for column in 0..64 {
                let pixel = row * 64 + column;
                match (row, column) {
                    (_, 32..) => input.coverage[pixel] = 0.0,
                    (..8, ..8) => input.normal[pixel] = [0.0; 3],
                    (8, 8) => input.position[pixel][1] = f32::NAN,
                    _ => {}
                }
            }
        }
        let mut frame = Framebuffer::new(input);
        assert_eq!(frame.holes(), 32 * 32 + 64 + 1);
        assert_eq!(frame.tiles(), [0]);
        assert_eq!(frame.receivers(0).group_lengths, [64; 15]);
        shade(&mut frame);
        let planes = frame.into_planes();
        for hole in [0, 8 * 64 + 8, 40] {
            assert_eq!(planes.irradiance[hole], [0.0; 3]);
            assert_eq!(planes.bent_normal[hole], [0.0; 3]);
            assert_eq!((planes.occlusion[hole], planes.coverage[hole]), (0.0, 0.0));
        }
        assert_eq!(planes.occlusion[9 * 64 + 9], 0.5);
    }

    #[test]
    fn preview_shows_done_tiles_only_and_stays_small() {
        let mut frame = Framebuffer::new(gbuffer(window(-5, 3, 700, 90), window(0, 0, 700, 90)));
        let blank = frame.preview(100);
        assert_eq!((blank.width, blank.height), (100, 12));
        assert!(blank.rgba.iter().all(|&byte| byte == 0));
        shade(&mut frame);
        let full = frame.preview(1_000);
        assert_eq!((full.width, full.height), (700, 90));
        assert!(full.rgba.chunks(4).all(|pixel| pixel[3] == 255));
    }

    #[test]
    fn values_that_are_not_finite_are_refused() {
        let frame = Framebuffer::new(gbuffer(window(0, 0, 1, 1), window(0, 0, 1, 1)));
        let values: Vec<u8> = [0.0, 0.0, f32::NAN, 0.0, 0.0, 0.0, 0.0]
            .into_iter()
            .flat_map(f32::to_le_bytes)
            .collect();
        assert_eq!(
            frame.check(0, &values).unwrap_err(),
            "value 2 of receiver 0 is not finite"
        );
    }
}
