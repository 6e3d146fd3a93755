//! Pictures of named channels: [`LayeredImage`] and its EXR form, [`write_png`], [`Difference`], [`read_environment`].

mod attributes;
mod difference;
mod environment;
mod exr_read;
mod exr_write;
mod png;

pub use attributes::Attributes;
pub use difference::{Difference, LayerDifference, SHARE_LEVELS};
pub use environment::read_environment;
pub(crate) use exr_read::{Contents, contents, read};
pub use png::{ToneMap, tone_mapped, write_heat_png, write_png};

use glam::Mat4;
use serde::Serialize;
use std::collections::BTreeMap;

/// A rectangle of pixels on the plane of an EXR file: x to the right, y down.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Window {
    /// Leftmost column.
    pub x: i32,
    /// Topmost row.
    pub y: i32,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

impl Window {
    /// A window at the origin.
    pub fn of_size(width: u32, height: u32) -> Self {
        Self {
            x: 0,
            y: 0,
            width,
            height,
        }
    }

    /// Pixels inside.
    pub fn pixel_count(&self) -> usize {
        self.width as usize * self.height as usize
    }
}

/// How the numbers of a channel are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precision {
    /// 16 bits: colour, occlusion.
    Half,
    /// 32 bits: positions.
    Float,
}

/// One channel, row-major over the data window.
#[derive(Clone, Debug, PartialEq)]
pub struct Channel {
    /// How it is (to be) stored.
    pub precision: Precision,
    /// A value a pixel.
    pub values: Vec<f32>,
}

/// A picture with any number of named channels (`R`, `indirect.R`, `P.X`) and texts that describe it.
#[derive(Clone, Debug, PartialEq)]
pub struct LayeredImage {
    /// The pixels that there are.
    pub data_window: Window,
    /// The picture they are part of.
    pub display_window: Window,
    /// Every channel has `data_window.pixel_count()` values.
    pub channels: BTreeMap<String, Channel>,
    /// String attributes that no standard names, ours under `pbgi/...`.
    pub metadata: BTreeMap<String, String>,
    /// The standard attribute `worldToCamera`: column vectors, left-handed camera space with +z along the view.
    pub world_to_camera: Option<Mat4>,
    /// The standard attribute `worldToNDC`: column vectors; (0, 0) is the upper left, (1, 1) the lower right corner of the
    /// display window.
    pub world_to_ndc: Option<Mat4>,
    /// What else a file said of itself.
    pub attributes: Attributes,
}

impl LayeredImage {
    /// A picture without channels whose data fill the display.
    pub fn new(width: u32, height: u32) -> Self {
        let window = Window::of_size(width, height);
        Self::with_windows(window, window)
    }

    /// A picture without channels.
    pub fn with_windows(data_window: Window, display_window: Window) -> Self {
        Self {
            data_window,
            display_window,
            channels: BTreeMap::new(),
            metadata: BTreeMap::new(),
            world_to_camera: None,
            world_to_ndc: None,
            attributes: Attributes::default(),
        }
    }

    /// Adds or replaces a channel.
    ///
    /// # Panics
    /// If the number of values is not that of the data window: a bug of the caller.
    pub fn add(&mut self, name: impl Into<String>, precision: Precision, values: Vec<f32>) {
        assert_eq!(values.len(), self.data_window.pixel_count(), "one value a pixel");
        self.channels.insert(name.into(), Channel { precision, values });
    }

    /// Adds `LAYER.R`, `LAYER.G`, `LAYER.B`; the layer `""` is the root: `R`, `G`, `B`.
    ///
    /// # Panics
    /// As [`Self::add`].
    pub fn add_rgb(&mut self, layer: &str, precision: Precision, pixels: &[[f32; 3]]) {
        self.add_triple(layer, ["R", "G", "B"], precision, pixels);
    }

    /// Adds `LAYER.X`, `LAYER.Y`, `LAYER.Z`.
    ///
    /// # Panics
    /// As [`Self::add`].
    pub fn add_xyz(&mut self, layer: &str, precision: Precision, pixels: &[[f32; 3]]) {
        self.add_triple(layer, ["X", "Y", "Z"], precision, pixels);
    }

    fn add_triple(&mut self, layer: &str, suffixes: [&str; 3], precision: Precision, pixels: &[[f32; 3]]) {
        for (axis, suffix) in suffixes.into_iter().enumerate() {
            let name = if layer.is_empty() {
                suffix.to_owned()
            } else {
                format!("{layer}.{suffix}")
            };
            self.add(name, precision, pixels.iter().map(|pixel| pixel[axis]).collect());
        }
    }

    /// The values of a channel, by its exact name.
    pub fn channel(&self, name: &str) -> Option<&[f32]> {
        self.channels.get(name).map(|channel| channel.values.as_slice())
    }

    /// The pixels of a layer: `LAYER.R/.G/.B` or `LAYER.X/.Y/.Z`, upper or lower case; the layer `""` is the root.
    pub fn triple(&self, layer: &str) -> Option<Vec<[f32; 3]>> {
        let find = |suffix: &str| {
            let wanted = if layer.is_empty() {
                suffix.to_owned()
            } else {
                format!("{layer}.{suffix}")
            };
            let mut names = self.channels.iter();
            names
                .find(|(name, _)| name.eq_ignore_ascii_case(&wanted))
                .map(|(_, channel)| &channel.values)
        };
        let suffixes = [["R", "G", "B"], ["X", "Y", "Z"]];
        let [a, b, c] = suffixes
            .into_iter()
            .find_map(|[r, g, b]| Some([find(r)?, find(g)?, find(b)?]))?;
        Some(a.iter().zip(b).zip(c).map(|((a, b), c)| [*a, *b, *c]).collect())
    }
}
