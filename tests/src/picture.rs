//! Pictures as numbers: channels of an EXR file by name.

use exr::prelude::{ReadChannels, ReadLayers, read};
use std::collections::BTreeMap;
use std::path::Path;

/// Channels that every shaded picture has, besides coverage.
pub const SHADED: [&str; 7] = [
    "indirect.R",
    "indirect.G",
    "indirect.B",
    "occlusion.Z",
    "bentnormal.X",
    "bentnormal.Y",
    "bentnormal.Z",
];

/// Channels of a single-part EXR file, row-major over its data window.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// Pixels a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Values by channel name, as they stand in the file (`indirect.R`).
    pub channels: BTreeMap<String, Vec<f32>>,
}

impl Picture {
    /// Reads a file.
    pub fn read(path: &Path) -> Self {
        let image = read()
            .no_deep_data()
            .largest_resolution_level()
            .all_channels()
            .first_valid_layer()
            .all_attributes();
        let image = image
            .from_file(path)
            .unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        let layer = image.layer_data;
        let list = layer.channel_data.list;
        let channels = list.into_iter().map(|channel| {
            (
                channel.name.to_string(),
                channel.sample_data.values_as_f32().collect::<Vec<_>>(),
            )
        });
        let mut channels: BTreeMap<_, _> = channels.collect();
        // A layer's name is the prefix of all its channels.
        if let Some(name) = layer.attributes.layer_name {
            channels = channels
                .into_iter()
                .map(|(channel, values)| (format!("{name}.{channel}"), values))
                .collect();
        }
        Self {
            width: layer.size.0,
            height: layer.size.1,
            channels,
        }
    }

    /// A channel that must be there.
    pub fn channel(&self, name: &str) -> &[f32] {
        self.channels
            .get(name)
            .unwrap_or_else(|| panic!("no channel {name} among {:?}", self.channels.keys()))
    }
}

/// Asserts that two pictures have the same size, channels and values, bit for bit; says where they differ first.
#[track_caller]
pub fn assert_same(a: &Picture, b: &Picture) {
    assert_eq!((a.width, a.height), (b.width, b.height));
    assert!(a.channels.keys().eq(b.channels.keys()), "other channels");
    for (name, values) in &a.channels {
        assert_same_values(name, values, b.channel(name));
    }
}

/// Asserts that two channels are the same, bit for bit; says how much they differ.
#[track_caller]
pub fn assert_same_values(name: &str, a: &[f32], b: &[f32]) {
    assert_eq!(a.len(), b.len(), "{name}");
    let pairs = || a.iter().zip(b);
    let different = pairs().filter(|(a, b)| a.to_bits() != b.to_bits()).count();
    let most = pairs().map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    let first = pairs().position(|(a, b)| a.to_bits() != b.to_bits());
    assert!(
        different == 0,
        "{name}: {different} of {} values differ by up to {most}, the first at {first:?}",
        a.len()
    );
}

/// Root mean square difference over the pixels where `mask` is above one half.
pub fn rms(values: &[f32], reference: &[f32], mask: &[f32]) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for ((value, reference), _) in values.iter().zip(reference).zip(mask).filter(|(_, mask)| **mask > 0.5) {
        sum += f64::from(value - reference).powi(2);
        count += 1.0;
    }
    (sum / f64::max(count, 1.0)).sqrt()
}

/// Root mean square difference over the mean of the reference, over several channels together.
pub fn relative_rms(pairs: &[(&[f32], &[f32])], mask: &[f32]) -> f64 {
    let (mut sum, mut mean, mut count) = (0.0, 0.0, 0.0);
    for (values, reference) in pairs {
        for ((value, reference), _) in values.iter().zip(*reference).zip(mask).filter(|(_, mask)| **mask > 0.5) {
            sum += f64::from(value - reference).powi(2);
            mean += f64::from(*reference);
            count += 1.0;
        }
    }
    (sum / count).sqrt() / (mean / count)
}
