//! What the procedural scenes are made of: flat patches, unit by unit, each unit from its number and the seed alone.

use super::Kind;
use crate::camera::Camera;
use glam::{Vec2, Vec3};
use std::f32::consts::{PI, TAU};

/// A parallelogram, lit from both sides.
#[derive(Clone, Copy, Debug)]
pub(super) struct Patch {
    pub(super) corner: Vec3,
    pub(super) u: Vec3,
    pub(super) v: Vec3,
    pub(super) material: Material,
}

/// Colours of the scenes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Material {
    Asphalt,
    Wall,
    Glass,
    Bark,
    Leaf,
    Grass,
    Skin,
    Hair,
}

impl Material {
    pub(super) const ALL: [Self; 8] = [
        Self::Asphalt,
        Self::Wall,
        Self::Glass,
        Self::Bark,
        Self::Leaf,
        Self::Grass,
        Self::Skin,
        Self::Hair,
    ];

    pub(super) fn albedo(self) -> [f32; 3] {
        match self {
            Self::Asphalt => [0.12, 0.12, 0.13],
            Self::Wall => [0.62, 0.54, 0.45],
            Self::Glass => [0.10, 0.14, 0.18],
            Self::Bark => [0.24, 0.16, 0.10],
            Self::Leaf => [0.14, 0.36, 0.08],
            Self::Grass => [0.22, 0.34, 0.12],
            Self::Skin => [0.66, 0.44, 0.36],
            Self::Hair => [0.42, 0.12, 0.05],
        }
    }

    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Asphalt => "asphalt",
            Self::Wall => "wall",
            Self::Glass => "glass",
            Self::Bark => "bark",
            Self::Leaf => "leaf",
            Self::Grass => "grass",
            Self::Skin => "skin",
            Self::Hair => "hair",
        }
    }
}

/// Numbers that follow from a seed.
pub(super) struct Random(u64);

impl Random {
    pub(super) fn new(seed: u64, stream: u64) -> Self {
        let mut random = Self(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ stream.wrapping_mul(0xd1b5_4a32_d192_ed03));
        random.bits();
        random
    }

    /// SplitMix64.
    fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ z >> 31
    }

    /// From 0, below 1.
    pub(super) fn unit(&mut self) -> f32 {
        (self.bits() >> 40) as f32 / (1u64 << 24) as f32
    }

    fn between(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.unit()
    }

    fn direction(&mut self) -> Vec3 {
        let (y, turn) = (self.between(-1.0, 1.0), self.between(0.0, TAU));
        let across = (1.0 - y * y).max(0.0).sqrt();
        Vec3::new(across * turn.cos(), y, across * turn.sin())
    }
}

impl Kind {
    /// Points of a unit at the density that the scene is made for.
    pub(super) fn points_per_unit(self) -> u64 {
        match self {
            Self::Tree => 600,
            Self::Tighten => 1300,
            Self::City => 12_000,
            Self::Forest => 15_000,
        }
    }

    /// The patches of one of `units` units.
    pub(super) fn unit(self, index: u64, units: u64, seed: u64, patches: &mut Vec<Patch>) {
        let mut random = Random::new(seed, index);
        match self {
            Self::City => city_lot(lot(index, units, LOT_EDGE), &mut random, patches),
            Self::Forest => forest_lot(lot(index, units, GLADE_EDGE), &mut random, patches),
            Self::Tree if index == 0 => {
                trunk(Vec3::ZERO, 9.0, 0.35, &mut random, patches);
                patches.push(horizontal(Vec2::splat(-8.0), Vec2::splat(16.0), 0.0, Material::Grass));
            }
            Self::Tree => {
                let at = crown_place(&mut random, Vec3::Y * 8.0, Vec3::new(5.0, 4.0, 5.0));
                twig(at, 48, 0.09, &mut random, patches);
            }
            Self::Tighten if index == 0 => head(patches),
            Self::Tighten => hair(&mut random, patches),
        }
    }

    /// The view of a walker who stands in the middle, between the lots; `None` where nobody could walk.
    pub(super) fn walker(self, units: u64) -> Option<Camera> {
        const EYE: f32 = 1.7;
        const FOV_Y: f32 = 0.9;
        let edge = match self {
            Self::City => LOT_EDGE,
            Self::Forest => GLADE_EDGE,
            Self::Tree | Self::Tighten => return None,
        };
        let side = lots_along_edge(units);
        let crossing = lot(side / 2 * (side + 1), units, edge);
        let eye = Vec3::new(crossing.x, EYE, crossing.y);
        // Along the way, a little across it and up.
        Some(Camera::look_at(eye, eye + Vec3::new(0.25, 0.15, -1.0), FOV_Y))
    }
}

const LOT_EDGE: f32 = 24.0;
const GLADE_EDGE: f32 = 6.0;

/// Lots along an edge of the square that they make.
fn lots_along_edge(units: u64) -> u64 {
    (units as f64).sqrt().ceil().max(1.0) as u64
}

/// Lower corner of a lot on a square of lots around the origin.
fn lot(index: u64, units: u64, edge: f32) -> Vec2 {
    let side = lots_along_edge(units);
    let place = Vec2::new((index % side) as f32, (index / side) as f32);
    (place - Vec2::splat(side as f32 / 2.0)) * edge
}

/// Faces up.
fn horizontal(corner: Vec2, size: Vec2, height: f32, material: Material) -> Patch {
    Patch {
        corner: Vec3::new(corner.x, height, corner.y),
        u: Vec3::Z * size.y,
        v: Vec3::X * size.x,
        material,
    }
}

fn city_lot(corner: Vec2, random: &mut Random, patches: &mut Vec<Patch>) {
    const FLOOR: f32 = 3.2;
    patches.push(horizontal(corner, Vec2::splat(LOT_EDGE), 0.0, Material::Asphalt));
    let mut size = Vec2::new(random.between(11.0, 18.0), random.between(11.0, 18.0));
    let mut low = corner + (Vec2::splat(LOT_EDGE) - size) / 2.0;
    let tall = random.unit().powi(4);
    let floors = 2 + (tall * 50.0) as u32;
    let tiers = if floors > 12 { 3 } else { 1 };
    let mut height = 0.0;
    for _ in 0..tiers {
        for _ in 0..floors.div_ceil(tiers) {
            storey(low, size, height, FLOOR, patches);
            height += FLOOR;
        }
        patches.push(horizontal(low, size, height, Material::Wall));
        let inset = random.between(0.8, 2.0);
        low += Vec2::splat(inset);
        size -= Vec2::splat(2.0 * inset);
    }
}

/// Four walls with a band of windows that lies deeper than they do.
fn storey(low: Vec2, size: Vec2, height: f32, floor: f32, patches: &mut Vec<Patch>) {
    const SILL: f32 = 1.1;
    const DEPTH: f32 = 0.3;
    let corners = [
        low,
        low + Vec2::new(size.x, 0.0),
        low + size,
        low + Vec2::new(0.0, size.y),
    ];
    for side in 0..4 {
        let (a, b) = (corners[side], corners[(side + 1) % 4]);
        let along = Vec3::new(b.x - a.x, 0.0, b.y - a.y);
        let inwards = Vec3::new(-along.z, 0.0, along.x).normalize_or_zero() * DEPTH;
        let at = Vec3::new(a.x, height, a.y);
        let mut push = |corner, u, v, material| patches.push(Patch { corner, u, v, material });
        // The front, on the side of u cross v, looks outwards, up from the sill and down from the lintel.
        push(at, Vec3::Y * SILL, along, Material::Wall);
        push(at + Vec3::Y * SILL, inwards, along, Material::Wall);
        push(
            at + Vec3::Y * SILL + inwards,
            Vec3::Y * (floor - SILL),
            along,
            Material::Glass,
        );
        push(at + Vec3::Y * floor + inwards, -inwards, along, Material::Wall);
    }
}

fn forest_lot(corner: Vec2, random: &mut Random, patches: &mut Vec<Patch>) {
    patches.push(horizontal(corner, Vec2::splat(GLADE_EDGE), 0.0, Material::Grass));
    let place = corner + Vec2::new(random.between(1.5, 4.5), random.between(1.5, 4.5));
    let foot = Vec3::new(place.x, 0.0, place.y);
    let height = random.between(5.0, 11.0);
    trunk(foot, height, height * 0.03, random, patches);
    let radii = Vec3::new(0.28, 0.4, 0.28) * height;
    for _ in 0..40 {
        let at = crown_place(random, foot + Vec3::Y * height * 0.85, radii);
        twig(at, 24, 0.14, random, patches);
    }
}

/// A place in an ellipsoid, more often near its surface.
fn crown_place(random: &mut Random, centre: Vec3, radii: Vec3) -> Vec3 {
    centre + random.direction() * radii * random.unit().powf(0.25)
}

/// A tapering prism that leans a little.
fn trunk(foot: Vec3, height: f32, radius: f32, random: &mut Random, patches: &mut Vec<Patch>) {
    const SIDES: usize = 8;
    const RINGS: usize = 10;
    let lean = Vec3::new(random.between(-0.05, 0.05), 1.0, random.between(-0.05, 0.05)) * (height / RINGS as f32);
    for ring in 0..RINGS {
        let width = radius * (1.0 - 0.85 * ring as f32 / RINGS as f32);
        let corner = |side: usize| {
            let turn = side as f32 / SIDES as f32 * TAU;
            foot + lean * ring as f32 + Vec3::new(turn.cos(), 0.0, turn.sin()) * width
        };
        for side in 0..SIDES {
            patches.push(Patch {
                corner: corner(side),
                u: lean,
                v: corner(side + 1) - corner(side),
                material: Material::Bark,
            });
        }
    }
}

/// A twig with leaves around it.
fn twig(at: Vec3, leaves: usize, leaf: f32, random: &mut Random, patches: &mut Vec<Patch>) {
    const REACH: f32 = 0.45;
    let along = random.direction() * REACH;
    let across = along.any_orthonormal_vector() * 0.01;
    patches.push(Patch {
        corner: at - across / 2.0,
        u: along,
        v: across,
        material: Material::Bark,
    });
    for _ in 0..leaves {
        let corner = at + along * random.unit() + random.direction() * 0.15 * random.unit();
        let stem = random.direction();
        let side = stem.cross(random.direction()).normalize_or(Vec3::X);
        let size = leaf * random.between(0.7, 1.2);
        // A rhombus: two sides of equal length.
        patches.push(Patch {
            corner,
            u: (stem + side * 0.35) * size,
            v: (stem - side * 0.35) * size,
            material: Material::Leaf,
        });
    }
}

const HEAD: Vec3 = Vec3::new(0.095, 0.13, 0.11);

fn on_head(theta: f32, phi: f32) -> Vec3 {
    HEAD * Vec3::new(theta.sin() * phi.cos(), theta.cos(), theta.sin() * phi.sin())
}

fn head(patches: &mut Vec<Patch>) {
    const ROWS: usize = 40;
    const COLUMNS: usize = 80;
    for row in 0..ROWS {
        for column in 0..COLUMNS {
            let at = |row: usize, column: usize| {
                on_head(row as f32 / ROWS as f32 * PI, column as f32 / COLUMNS as f32 * TAU)
            };
            let corner = at(row, column);
            // Half of each side's two edges, so that patches meet in the middle of both.
            let u = ((at(row, column + 1) - corner) + (at(row + 1, column + 1) - at(row + 1, column))) / 2.0;
            patches.push(Patch {
                corner,
                u,
                v: at(row + 1, column) - corner,
                material: Material::Skin,
            });
        }
    }
}

/// A lock of strands that stand up and fall over.
fn hair(random: &mut Random, patches: &mut Vec<Patch>) {
    const STRANDS: usize = 32;
    const SEGMENTS: usize = 12;
    const WIDTH: f32 = 0.0006;
    let (theta, phi) = (random.unit().sqrt() * 1.5, random.between(0.0, TAU));
    let length = random.between(0.06, 0.16) / SEGMENTS as f32;
    let wind = Vec3::new(random.between(-0.3, 0.3), -0.25, random.between(-0.3, 0.3));
    for _ in 0..STRANDS {
        let root = on_head(theta + random.between(-0.03, 0.03), phi + random.between(-0.05, 0.05));
        let mut at = root;
        let mut direction = (root / (HEAD * HEAD)).normalize_or(Vec3::Y) + random.direction() * 0.15;
        for _ in 0..SEGMENTS {
            direction = (direction + wind * 0.2 + random.direction() * 0.05).normalize_or(Vec3::Y);
            let across = direction.any_orthonormal_vector() * WIDTH;
            patches.push(Patch {
                corner: at - across / 2.0,
                u: direction * length,
                v: across,
                material: Material::Hair,
            });
            at += direction * length;
        }
    }
}
