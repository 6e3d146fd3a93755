//! How far two pictures are apart, layer by layer: [`Difference`].

use super::{LayeredImage, Window};
use serde::Serialize;
use std::collections::BTreeMap;

/// Differences of whose share of pixels is told.
pub const SHARE_LEVELS: [f32; 3] = [0.001, 0.01, 0.1];

/// Two pictures compared over the pixels that both have.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Difference {
    /// Those pixels.
    pub window: Window,
    /// Layers that both have, by name; the root is `""`.
    pub layers: Vec<LayerDifference>,
    /// Channels that only the first picture has.
    pub only_first: Vec<String>,
    /// Channels that only the second picture has.
    pub only_second: Vec<String>,
}

/// How far a layer's channels are apart, the second picture being the reference.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LayerDifference {
    /// Its name.
    pub layer: String,
    /// Root of the mean square over all samples that are finite in both.
    pub rms: f64,
    /// The same, divided by the mean of the reference's absolute values; `None` where those are all 0.
    pub relative_rms: Option<f64>,
    /// Largest difference of a sample.
    pub maximum: f32,
    /// Its pixel, x and y on the plane of both files.
    pub maximum_at: [i32; 2],
    /// Share of the pixels with a difference above each of [`SHARE_LEVELS`], 0 to 1.
    pub shares: [f64; 3],
    /// Pixels with a sample that is finite in one picture only, or two different ones that are not: no distance says how far.
    pub not_comparable: u64,
    /// Largest difference of each pixel, row-major over the window; infinite where they are not comparable.
    #[serde(skip)]
    pub map: Vec<f32>,
}

impl Difference {
    /// Compares two pictures; `None` if they have no pixel in common.
    pub fn between(first: &LayeredImage, second: &LayeredImage) -> Option<Self> {
        let window = common(first.data_window, second.data_window)?;
        let lacking = |of: &LayeredImage, other: &LayeredImage| {
            let names = of.channels.keys().filter(|name| !other.channels.contains_key(*name));
            names.cloned().collect::<Vec<String>>()
        };
        let mut channels: BTreeMap<&str, Vec<[&[f32]; 2]>> = BTreeMap::new();
        for (name, channel) in &first.channels {
            if let Some(other) = second.channel(name) {
                let layer = name.rsplit_once('.').map_or("", |(layer, _)| layer);
                channels.entry(layer).or_default().push([&channel.values, other]);
            }
        }
        let windows = [first.data_window, second.data_window];
        let compare = |(layer, channels): (&str, Vec<[&[f32]; 2]>)| layer_difference(layer, &channels, windows, window);
        Some(Self {
            window,
            layers: channels.into_iter().map(compare).collect(),
            only_first: lacking(first, second),
            only_second: lacking(second, first),
        })
    }
}

fn layer_difference(layer: &str, channels: &[[&[f32]; 2]], windows: [Window; 2], window: Window) -> LayerDifference {
    let mut result = LayerDifference {
        layer: layer.to_owned(),
        rms: 0.0,
        relative_rms: None,
        maximum: 0.0,
        maximum_at: [window.x, window.y],
        shares: [0.0; 3],
        not_comparable: 0,
        map: Vec::with_capacity(window.pixel_count()),
    };
    let (mut squares, mut reference, mut count) = (0.0, 0.0, 0u64);
    for (y, x) in (0..window.height as i32).flat_map(|y| (0..window.width as i32).map(move |x| (y, x))) {
        let place = [window.x + x, window.y + y];
        let [a_index, b_index] = windows.map(|window| index(window, place));
        let mut largest = 0.0f32;
        for [a, b] in channels {
            let (a, b) = (a[a_index], b[b_index]);
            if a.is_finite() && b.is_finite() {
                let difference = f64::from(a) - f64::from(b);
                squares += difference * difference;
                reference += f64::from(b.abs());
                count += 1;
                largest = largest.max(difference.abs() as f32);
            } else if !(a == b || a.is_nan() && b.is_nan()) {
                largest = f32::INFINITY;
            }
        }
        if largest == f32::INFINITY {
            result.not_comparable += 1;
        } else if largest > result.maximum {
            (result.maximum, result.maximum_at) = (largest, place);
        }
        result.map.push(largest);
    }
    if count > 0 {
        result.rms = (squares / count as f64).sqrt();
        result.relative_rms = (reference > 0.0).then(|| result.rms / (reference / count as f64));
    }
    result.shares = SHARE_LEVELS.map(|level| {
        let above = result.map.iter().filter(|&&value| value > level).count();
        above as f64 / result.map.len().max(1) as f64
    });
    result
}

fn index(window: Window, [x, y]: [i32; 2]) -> usize {
    let offset = |value: i32, start: i32| (i64::from(value) - i64::from(start)) as usize;
    offset(y, window.y) * window.width as usize + offset(x, window.x)
}

/// The pixels that two windows share.
fn common(a: Window, b: Window) -> Option<Window> {
    let span = |starts: [i32; 2], lengths: [u32; 2]| {
        let end = |axis: usize| i64::from(starts[axis]) + i64::from(lengths[axis]);
        let start = starts[0].max(starts[1]);
        let length = end(0).min(end(1)) - i64::from(start);
        (length > 0).then_some((start, length as u32))
    };
    let (x, width) = span([a.x, b.x], [a.width, b.width])?;
    let (y, height) = span([a.y, b.y], [a.height, b.height])?;
    Some(Window { x, y, width, height })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::Precision;

    fn window(x: i32, y: i32, width: u32, height: u32) -> Window {
        Window { x, y, width, height }
    }

    #[test]
    fn layers_are_compared_over_the_common_pixels() {
        let mut a = LayeredImage::with_windows(window(0, 0, 4, 1), window(0, 0, 4, 1));
        let mut b = LayeredImage::with_windows(window(1, 0, 4, 1), window(0, 0, 4, 1));
        a.add("s.R", Precision::Float, vec![9.0, 1.0, 2.0, 3.0]);
        b.add("s.R", Precision::Float, vec![1.0, 2.5, 3.0, 9.0]);
        a.add("s.G", Precision::Float, vec![9.0, 1.0, f32::NAN, f32::NAN]);
        b.add("s.G", Precision::Float, vec![1.005, f32::NAN, 3.0, 9.0]);
        a.add("A", Precision::Half, vec![1.0; 4]);
        let found = Difference::between(&a, &b).unwrap();
        assert_eq!(found.window, window(1, 0, 3, 1));
        assert_eq!((found.only_first, found.only_second), (vec!["A".to_owned()], vec![]));
        let layer = &found.layers[0];
        assert_eq!((layer.layer.as_str(), layer.not_comparable), ("s", 1));
        assert_eq!((layer.maximum, layer.maximum_at), (0.5, [2, 0]));
        // Differences 0, 0.5, 0 and 0.005, references 1, 2.5, 3 and 1.005.
        let rms = ((0.25 + 0.005f64.powi(2)) / 4.0).sqrt();
        assert!((layer.rms - rms).abs() < 1e-7);
        assert!((layer.relative_rms.unwrap() - rms / (7.505 / 4.0)).abs() < 1e-7);
        assert_eq!(layer.shares, [1.0, 2.0 / 3.0, 2.0 / 3.0]);
        assert_eq!(layer.map[2], f32::INFINITY);
    }

    #[test]
    fn pictures_without_a_common_pixel_are_not_compared() {
        let image = |x: i32| LayeredImage::with_windows(window(x, 0, 2, 2), window(0, 0, 2, 2));
        assert!(Difference::between(&image(0), &image(2)).is_none());
        assert!(Difference::between(&image(0), &image(1)).unwrap().layers.is_empty());
        assert!(Difference::between(&image(i32::MIN), &image(i32::MAX - 1)).is_none());
    }
}
