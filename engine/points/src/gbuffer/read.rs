//! Other renderers' passes: positions and normals under the many names they have.

use super::GBuffer;
use crate::error::PointsError;
use crate::image::LayeredImage;
use crate::image::channel_names;
use std::path::Path;

/// Names of the layers to read, where the usual ones (`P`, `Pworld`, `WP`, `position`; `N`, `Nworld`, `normal`) do not fit.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct GBufferChannels {
    /// Layer of the world position.
    pub position: Option<String>,
    /// Layer of the world normal.
    pub normal: Option<String>,
}

const POSITION_NAMES: [&str; 8] = [
    "p",
    "pworld",
    "p_world",
    "wp",
    "position",
    "worldposition",
    "world_position",
    "pos",
];
const NORMAL_NAMES: [&str; 7] = ["n", "nworld", "n_world", "wn", "normal", "normals", "world_normal"];
const ALBEDO_NAMES: [&str; 3] = ["albedo", "diffuse_albedo", "basecolor"];
const DIRECT_NAMES: [&str; 1] = ["direct"];
const EMISSION_NAMES: [&str; 1] = ["emission"];
const COVERAGE_NAMES: [&str; 2] = ["a", "alpha"];

impl GBuffer {
    /// Reads an EXR file with the usual layer names.
    ///
    /// # Errors
    /// As [`Self::read_named`].
    pub fn read(path: &Path) -> Result<Self, PointsError> {
        Self::read_named(path, &GBufferChannels::default())
    }

    /// Reads an EXR file. Layers are found whatever their case, with the suffixes `.X .Y .Z` or `.R .G .B`, alone or below
    /// another layer (`ViewLayer.Position.X`). Without a channel `A`, every pixel with a normal is covered.
    ///
    /// # Errors
    /// No or a damaged file, a picture beyond the limits, or no position or normal: the error lists the channels there are.
    pub fn read_named(path: &Path, channels: &GBufferChannels) -> Result<Self, PointsError> {
        let names = channel_names(path)?;
        let find = |what: &str, flag: &str, wanted: Option<&String>, usual: &[&str]| {
            let layer = match wanted {
                Some(layer) => find_layer(&names, &[&layer.to_ascii_lowercase()]),
                None => find_layer(&names, usual),
            };
            layer.ok_or_else(|| missing(path, what, flag, wanted, usual, &names))
        };
        let position = find("position", "--position", channels.position.as_ref(), &POSITION_NAMES)?;
        let normal = find("normal", "--normal", channels.normal.as_ref(), &NORMAL_NAMES)?;
        let albedo = find_layer(&names, &ALBEDO_NAMES);
        let direct = find_layer(&names, &DIRECT_NAMES);
        let emission = find_layer(&names, &EMISSION_NAMES);
        let coverage = find_scalar(&names, &COVERAGE_NAMES);
        let layers = [
            Some(&position),
            Some(&normal),
            albedo.as_ref(),
            direct.as_ref(),
            emission.as_ref(),
        ];
        let image = LayeredImage::read_exr_channels(path, |name| {
            let in_layer = layers.iter().flatten().any(|layer| layer.contains(&name.to_owned()));
            in_layer || coverage.as_deref() == Some(name)
        })?;
        let required = |layer: &Layer| {
            layer
                .pixels(&image)
                .ok_or_else(|| PointsError::invalid(path, "a channel has no pixels"))
        };
        let pixel_count = image.data_window.pixel_count();
        Ok(Self {
            data_window: image.data_window,
            display_window: image.display_window,
            world_to_camera: image.world_to_camera,
            position: required(&position)?,
            normal: required(&normal)?,
            coverage: coverage
                .and_then(|name| image.channel(&name).map(<[f32]>::to_vec))
                .unwrap_or_else(|| vec![1.0; pixel_count]),
            albedo: albedo.and_then(|layer| layer.pixels(&image)),
            direct: direct.and_then(|layer| layer.pixels(&image)),
            emission: emission.and_then(|layer| layer.pixels(&image)),
        })
    }
}

/// Full names of the three channels of a layer.
struct Layer([String; 3]);

impl Layer {
    fn contains(&self, name: &String) -> bool {
        self.0.contains(name)
    }

    fn pixels(&self, image: &LayeredImage) -> Option<Vec<[f32; 3]>> {
        let [a, b, c] = &self.0;
        let (a, b, c) = (image.channel(a)?, image.channel(b)?, image.channel(c)?);
        Some(a.iter().zip(b).zip(c).map(|((a, b), c)| [*a, *b, *c]).collect())
    }
}

/// Which part of a layer's name must be the one looked for.
#[derive(Clone, Copy)]
enum Match {
    FullName,
    LastWord,
}

impl Match {
    fn fits(self, layer: &str, wanted: &str) -> bool {
        match self {
            Self::FullName => layer == wanted,
            Self::LastWord => layer.rsplit('.').next() == Some(wanted),
        }
    }
}

/// The layer that bears one of `wanted` (lower case): first by its full name, then by the last word of it; earlier names win.
fn find_layer(names: &[String], wanted: &[&str]) -> Option<Layer> {
    let rules = [Match::FullName, Match::LastWord];
    let mut tries = rules
        .iter()
        .flat_map(|&rule| wanted.iter().map(move |&want| (rule, want)));
    tries.find_map(|(rule, want)| names.iter().find_map(|first| layer_from(names, first, rule, want)))
}

/// The layer whose first channel is `first`, if it is the one looked for.
fn layer_from(names: &[String], first: &str, rule: Match, wanted: &str) -> Option<Layer> {
    let lower = first.to_ascii_lowercase();
    let (layer, suffix) = lower.rsplit_once('.')?;
    let others = match suffix {
        "x" => ["y", "z"],
        "r" => ["g", "b"],
        _ => return None,
    };
    if !rule.fits(layer, wanted) {
        return None;
    }
    let sibling = |suffix: &str| {
        let full = format!("{layer}.{suffix}");
        names.iter().find(|name| name.eq_ignore_ascii_case(&full)).cloned()
    };
    Some(Layer([first.to_owned(), sibling(others[0])?, sibling(others[1])?]))
}

/// The channel at the root, or else in any layer but a position's, that bears one of `wanted`.
fn find_scalar(names: &[String], wanted: &[&str]) -> Option<String> {
    let root = names
        .iter()
        .find(|name| wanted.iter().any(|want| name.eq_ignore_ascii_case(want)));
    let last = |name: &&String| {
        let lower = name.to_ascii_lowercase();
        let combined = lower.contains("combined") || lower.contains("beauty") || lower.contains("rgba");
        combined && wanted.iter().any(|want| lower.rsplit('.').next() == Some(want))
    };
    root.or_else(|| names.iter().find(last)).cloned()
}

fn missing(
    path: &Path,
    what: &str,
    flag: &str,
    wanted: Option<&String>,
    usual: &[&str],
    names: &[String],
) -> PointsError {
    let looked = match wanted {
        Some(layer) => format!("{layer:?}"),
        None => usual.join(", "),
    };
    PointsError::invalid(
        path,
        format!(
            "no world {what} (looked for layers {looked} with .X .Y .Z or .R .G .B); the channels are: {}; \
             name the layer with {flag}, or render a world-space {what} pass",
            names.join(", ")
        ),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(list: &[&str]) -> Vec<String> {
        list.iter().map(|name| (*name).to_owned()).collect()
    }

    #[test]
    fn layers_are_found_under_the_names_of_other_renderers() {
        for layer in ["P", "Pworld", "WP", "position", "Position", "ViewLayer.Position"] {
            for suffixes in ["XYZ", "xyz", "RGB", "rgb"] {
                let list: Vec<String> = suffixes.chars().map(|suffix| format!("{layer}.{suffix}")).collect();
                let found = find_layer(&list, &POSITION_NAMES);
                assert_eq!(found.map(|layer| layer.0.to_vec()), Some(list));
            }
        }
        assert!(
            find_layer(&names(&["P.X", "P.Y"]), &POSITION_NAMES).is_none(),
            "two axes are no position"
        );
    }

    #[test]
    fn a_layer_of_that_very_name_wins() {
        let list = names(&["other.P.X", "other.P.Y", "other.P.Z", "P.X", "P.Y", "P.Z"]);
        assert_eq!(find_layer(&list, &POSITION_NAMES).unwrap().0[0], "P.X");
    }
}
