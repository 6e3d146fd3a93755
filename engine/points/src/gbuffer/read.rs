//! Other renderers' passes: positions and normals under the many names they have.

use super::{GBuffer, Space};
use crate::error::PointsError;
use crate::image::{LayeredImage, contents, read};
use std::fs::File;
use std::path::Path;

/// How an EXR file is read, where the usual way does not fit.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct GBufferOptions {
    /// Layer of the position; `None` for the usual names (`P`, `Pworld`, `WP`, `position`).
    pub position: Option<String>,
    /// Layer of the normal; `None` for the usual names (`N`, `Nworld`, `normal`).
    pub normal: Option<String>,
    /// What space both are in.
    pub space: Space,
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
    /// Reads an EXR file the usual way.
    ///
    /// # Errors
    /// As [`Self::read_with`].
    pub fn read(path: &Path) -> Result<Self, PointsError> {
        Self::read_with(path, &GBufferOptions::default())
    }

    /// Reads an EXR file. Layers are found whatever their case, with the suffixes `.X .Y .Z` or `.R .G .B`, alone or below
    /// another layer (`ViewLayer.Position.X`). Without a channel `A`, every pixel with a normal is covered.
    ///
    /// # Errors
    /// No or a damaged file, a picture beyond the limits, no position or normal (the error lists the channels there are), or
    /// positions that are in another space than `options` say.
    pub fn read_with(path: &Path, options: &GBufferOptions) -> Result<Self, PointsError> {
        let file = File::open(path).map_err(PointsError::io("open", path))?;
        let names = contents(path, &file)?.channels;
        let find = |what: &str, flag: &str, wanted: Option<&String>, usual: &[&str]| {
            let layer = match wanted {
                Some(layer) => find_layer(&names, &[&layer.to_ascii_lowercase()]),
                None => find_layer(&names, usual),
            };
            layer.ok_or_else(|| missing(path, what, flag, wanted, usual, &names))
        };
        let position = find("position", "--position", options.position.as_ref(), &POSITION_NAMES)?;
        let normal = find("normal", "--normal", options.normal.as_ref(), &NORMAL_NAMES)?;
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
        let image = read(path, &file, None, |name| {
            let in_layer = layers.iter().flatten().any(|layer| layer.contains(&name.to_owned()));
            in_layer || coverage.as_deref() == Some(name)
        })?;
        let required = |layer: &Layer| {
            layer
                .pixels(&image)
                .ok_or_else(|| PointsError::invalid(path, "a channel has no pixels"))
        };
        let pixel_count = image.data_window.pixel_count();
        let gbuffer = Self {
            data_window: image.data_window,
            display_window: image.display_window,
            world_to_camera: image.world_to_camera,
            world_to_ndc: image.world_to_ndc,
            position: required(&position)?,
            normal: required(&normal)?,
            coverage: coverage
                .and_then(|name| image.channel(&name).map(<[f32]>::to_vec))
                .unwrap_or_else(|| vec![1.0; pixel_count]),
            albedo: albedo.and_then(|layer| layer.pixels(&image)),
            direct: direct.and_then(|layer| layer.pixels(&image)),
            emission: emission.and_then(|layer| layer.pixels(&image)),
        };
        gbuffer.into_world(path, options.space)
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
