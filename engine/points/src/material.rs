//! Materials: diffuse albedo, cut-outs and emission, from factors and textures.

use glam::{Affine2, Vec2};
use std::sync::LazyLock;

/// What a surface is made of.
#[derive(Clone, Debug)]
pub(crate) struct Material {
    /// Linear albedo factor.
    pub(crate) albedo: [f32; 3],
    /// Opacity factor.
    pub(crate) alpha: f32,
    pub(crate) albedo_texture: Option<TextureSlot>,
    /// Opacity is the alpha of this one; without it, of the albedo's.
    pub(crate) opacity_texture: Option<TextureSlot>,
    /// Emitted radiance factor, W/(m2 sr).
    pub(crate) emission: [f32; 3],
    pub(crate) emission_texture: Option<TextureSlot>,
    /// Opacity below which there is no surface; `None` for opaque materials.
    pub(crate) cutoff: Option<f32>,
    /// Whether the back emits too. Both sides receive and reflect light always.
    pub(crate) double_sided: bool,
}

impl Default for Material {
    fn default() -> Self {
        Self {
            albedo: [1.0; 3],
            alpha: 1.0,
            albedo_texture: None,
            opacity_texture: None,
            emission: [0.0; 3],
            emission_texture: None,
            cutoff: None,
            double_sided: true,
        }
    }
}

impl Material {
    pub(crate) fn emits(&self) -> bool {
        self.emission.iter().any(|&value| value > 0.0)
    }
}

/// A use of a texture.
#[derive(Clone, Debug)]
pub(crate) struct TextureSlot {
    pub(crate) texture: usize,
    /// Which of the two sets of coordinates.
    pub(crate) uv_set: usize,
    /// KHR_texture_transform.
    pub(crate) transform: Option<Affine2>,
    pub(crate) wrap: [Wrap; 2],
}

/// What lies outside of the unit square of a texture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Wrap {
    Clamp,
    Mirror,
    Repeat,
}

/// An 8-bit sRGB picture with linear alpha.
pub(crate) struct Texture {
    pub(crate) width: u32,
    pub(crate) height: u32,
    /// Row-major, row 0 at v = 0.
    pub(crate) texels: Vec<[u8; 4]>,
}

/// Linear value of each 8-bit sRGB level.
pub(crate) static LINEAR_FROM_SRGB: LazyLock<[f32; 256]> = LazyLock::new(|| {
    std::array::from_fn(|level| {
        let encoded = level as f64 / 255.0;
        let linear = if encoded <= 0.040_45 {
            encoded / 12.92
        } else {
            ((encoded + 0.055) / 1.055).powf(2.4)
        };
        linear as f32
    })
});

impl Texture {
    /// Linear RGBA at `uv`, bilinear.
    pub(crate) fn sample(&self, slot: &TextureSlot, uv: Vec2) -> [f32; 4] {
        self.blend(slot, uv, |texel| {
            let table = &*LINEAR_FROM_SRGB;
            let [r, g, b, a] = texel;
            [
                table[usize::from(r)],
                table[usize::from(g)],
                table[usize::from(b)],
                f32::from(a) / 255.0,
            ]
        })
    }

    /// A picture of opacity: that of a picture without an alpha channel is how bright it is.
    pub(crate) fn into_opacity(mut self) -> Self {
        if self.texels.iter().all(|texel| texel[3] == u8::MAX) {
            for texel in &mut self.texels {
                texel[3] = texel[0];
            }
        }
        self
    }

    /// Opacity at `uv`, bilinear.
    pub(crate) fn alpha(&self, slot: &TextureSlot, uv: Vec2) -> f32 {
        self.blend(slot, uv, |texel| [f32::from(texel[3]) / 255.0])[0]
    }

    fn blend<const N: usize>(&self, slot: &TextureSlot, uv: Vec2, decode: impl Fn([u8; 4]) -> [f32; N]) -> [f32; N] {
        let uv = slot.transform.map_or(uv, |transform| transform.transform_point2(uv));
        let (columns, x) = taps(uv.x, self.width, slot.wrap[0]);
        let (rows, y) = taps(uv.y, self.height, slot.wrap[1]);
        let texel = |column: u32, row: u32| decode(self.texels[row as usize * self.width as usize + column as usize]);
        let corners = [
            (texel(columns[0], rows[0]), (1.0 - x) * (1.0 - y)),
            (texel(columns[1], rows[0]), x * (1.0 - y)),
            (texel(columns[0], rows[1]), (1.0 - x) * y),
            (texel(columns[1], rows[1]), x * y),
        ];
        let mut sum = [0.0; N];
        for (value, weight) in corners {
            for (sum, value) in sum.iter_mut().zip(value) {
                *sum += value * weight;
            }
        }
        sum
    }
}

/// The two texels around a coordinate along one axis, and the weight of the second.
fn taps(coordinate: f32, size: u32, wrap: Wrap) -> ([u32; 2], f32) {
    // A coordinate beyond this has no fraction left; not-a-number lands at 0.
    let coordinate = if coordinate.abs() < 1e6 { coordinate } else { 0.0 };
    let scaled = coordinate * size as f32 - 0.5;
    let floor = scaled.floor();
    let first = floor as i64;
    ([wrap.texel(first, size), wrap.texel(first + 1, size)], scaled - floor)
}

impl Wrap {
    fn texel(self, index: i64, size: u32) -> u32 {
        let size = i64::from(size);
        let inside = match self {
            Self::Clamp => index.clamp(0, size - 1),
            Self::Repeat => index.rem_euclid(size),
            Self::Mirror => {
                let period = index.rem_euclid(2 * size);
                if period < size { period } else { 2 * size - 1 - period }
            }
        };
        inside as u32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn slot(wrap: Wrap) -> TextureSlot {
        TextureSlot {
            texture: 0,
            uv_set: 0,
            transform: None,
            wrap: [wrap; 2],
        }
    }

    fn checker() -> Texture {
        Texture {
            width: 2,
            height: 1,
            texels: vec![[0, 0, 0, 255], [255, 255, 255, 0]],
        }
    }

    #[test]
    fn textures_are_decoded_from_srgb_and_blended_in_linear_light() {
        let grey = Texture {
            width: 1,
            height: 1,
            texels: vec![[188, 188, 188, 128]],
        };
        let [r, _, _, a] = grey.sample(&slot(Wrap::Repeat), Vec2::splat(0.3));
        assert!((r - 0.503).abs() < 2e-3, "{r}");
        assert!((a - 0.502).abs() < 1e-3, "{a}");
        let middle = checker().sample(&slot(Wrap::Clamp), Vec2::new(0.5, 0.5));
        assert!((middle[0] - 0.5).abs() < 1e-6);
    }

    #[test]
    fn wrap_modes_differ_outside_of_the_unit_square() {
        let at = |wrap, u| checker().sample(&slot(wrap), Vec2::new(u, 0.5))[0];
        assert_eq!(at(Wrap::Clamp, 1.25), 1.0);
        assert_eq!(at(Wrap::Repeat, 1.25), 0.0);
        assert_eq!(at(Wrap::Mirror, 1.25), 1.0);
        assert_eq!(at(Wrap::Mirror, 1.75), 0.0);
        assert_eq!(at(Wrap::Repeat, -0.25), 1.0);
        assert!(at(Wrap::Repeat, f32::NAN).is_finite());
    }

    #[test]
    fn texture_transforms_move_the_coordinates() {
        let mut moved = slot(Wrap::Repeat);
        moved.transform = Some(Affine2::from_translation(Vec2::new(0.5, 0.0)));
        assert_eq!(checker().sample(&moved, Vec2::new(0.25, 0.5))[0], 1.0);
    }
}
