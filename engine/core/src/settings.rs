//! What a caller may choose, checked once at the door.

use crate::limits;
use serde::{Deserialize, Serialize};

/// A setting outside its range.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{name} is {value}, must be {expected}")]
pub struct SettingsError {
    /// The setting, as the command line spells it.
    pub name: &'static str,
    /// What was given.
    pub value: String,
    /// What is allowed.
    pub expected: String,
}

fn check(holds: bool, name: &'static str, value: impl ToString, expected: impl ToString) -> Result<(), SettingsError> {
    if holds {
        Ok(())
    } else {
        Err(SettingsError {
            name,
            value: value.to_string(),
            expected: expected.to_string(),
        })
    }
}

/// How an octree is built and laid out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BuildSettings {
    /// Most points in a leaf (paper section 4.1).
    pub leaf_max: u32,
    /// Levels written as one chunk; 0 writes siblings when their parent is finalized (paper section 4.2).
    pub chunk_levels: u32,
    /// Nodes in a page.
    pub nodes_per_page: u32,
    /// Points in a page.
    pub points_per_page: u32,
}

impl Default for BuildSettings {
    fn default() -> Self {
        Self {
            leaf_max: limits::LEAF_MAX_DEFAULT,
            chunk_levels: limits::CHUNK_LEVELS_DEFAULT,
            nodes_per_page: limits::NODES_PER_PAGE_DEFAULT,
            points_per_page: limits::POINTS_PER_PAGE_DEFAULT,
        }
    }
}

impl BuildSettings {
    /// Checks every range.
    ///
    /// # Errors
    /// The first setting out of range.
    pub fn validate(&self) -> Result<(), SettingsError> {
        let leaf_range = 1..=limits::LEAF_MAX_LIMIT;
        check(
            leaf_range.contains(&self.leaf_max),
            "leaf-max",
            self.leaf_max,
            format!("{leaf_range:?}"),
        )?;
        let chunk_range = 0..=limits::CHUNK_LEVELS_LIMIT;
        check(
            chunk_range.contains(&self.chunk_levels),
            "chunk-levels",
            self.chunk_levels,
            format!("{chunk_range:?}"),
        )?;
        let page_range = limits::RECORDS_PER_PAGE_RANGE;
        check(
            page_range.contains(&self.nodes_per_page),
            "nodes-per-page",
            self.nodes_per_page,
            format!("{page_range:?}"),
        )?;
        check(
            page_range.contains(&self.points_per_page),
            "points-per-page",
            self.points_per_page,
            format!("{page_range:?}"),
        )
    }
}

/// Which sides of surfaces block and send light (`hitsides`); the front is the one that normals point to.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum HitSides {
    /// Both.
    #[default]
    Both,
    /// A surface is not there for who sees its back.
    Front,
    /// A surface is not there for who sees its front.
    Back,
}

impl HitSides {
    /// As options and files spell it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Both => "both",
            Self::Front => "front",
            Self::Back => "back",
        }
    }
}

/// How receivers are shaded. Names are RenderMan's.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ShadeSettings {
    /// Largest solid angle of a cut element above a receiver, steradian (`maxsolidangle`); toward the horizon, where light counts
    /// for less, up to four times as large.
    pub max_solid_angle: f32,
    /// Rows and columns of the raster (`rasterresolution`).
    pub raster_resolution: u32,
    /// Distance beyond which surfaces do not occlude, world units (`maxdist`); infinite by default. Acts on occlusion and
    /// bent normal only.
    pub max_dist: f32,
    /// How fast occlusion fades with distance d: its weight is `exp(-falloff d)` (`falloff`, mode 0).
    pub falloff: f32,
    /// Surfaces that a receiver lies on are those within this fraction of a point radius (`bias`, made relative).
    pub bias: f32,
    /// How often light is reflected on its way at most (`bounces`). More than once takes a scene of its own for every bounce.
    pub bounces: u32,
    /// Error within which neighbours on the same surface must tell what a receiver gets for others to be given that: of occlusion,
    /// and of irradiance over that of the neighbours. It holds where receivers are shaded; what is smaller than the distance between
    /// those may be missed. 0 shades all.
    pub interpolation: f32,
    /// Which sides of surfaces count. Light of a cluster without a plane cannot be told by sides: there, both send it.
    pub hit_sides: HitSides,
}

impl Default for ShadeSettings {
    fn default() -> Self {
        Self {
            max_solid_angle: limits::MAX_SOLID_ANGLE_DEFAULT,
            raster_resolution: limits::RASTER_RESOLUTION_DEFAULT,
            max_dist: f32::INFINITY,
            falloff: 0.0,
            bias: 0.1,
            bounces: 1,
            interpolation: 0.0,
            hit_sides: HitSides::default(),
        }
    }
}

impl ShadeSettings {
    /// Rasters are rows of one machine word in blocks of eight.
    const RESOLUTIONS: [u32; 4] = [8, 16, 32, 64];

    /// Whether the distance of a surface decides how much it occludes.
    pub fn weighs_distance(&self) -> bool {
        self.max_dist < f32::INFINITY || self.falloff > 0.0
    }

    /// Checks every range.
    ///
    /// # Errors
    /// The first setting out of range.
    pub fn validate(&self) -> Result<(), SettingsError> {
        let angle = self.max_solid_angle;
        check(
            angle > 0.0 && angle <= 1.0,
            "max-solid-angle",
            angle,
            "above 0 and at most 1 steradian",
        )?;
        let resolution = self.raster_resolution;
        check(
            Self::RESOLUTIONS.contains(&resolution),
            "raster-resolution",
            resolution,
            "8, 16, 32 or 64",
        )?;
        check(self.max_dist > 0.0, "max-dist", self.max_dist, "above 0")?;
        check(
            self.falloff >= 0.0 && self.falloff.is_finite(),
            "falloff",
            self.falloff,
            "0 or a finite positive number",
        )?;
        check(
            (0.0..=1.0).contains(&self.bias),
            "bias",
            self.bias,
            "from 0 to 1 point radii",
        )?;
        let bounces = 1..=limits::BOUNCES_MAX;
        check(
            bounces.contains(&self.bounces),
            "bounces",
            self.bounces,
            format!("{bounces:?}"),
        )?;
        check(
            (0.0..=0.5).contains(&self.interpolation),
            "interpolation",
            self.interpolation,
            "from 0 to 0.5",
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_are_valid() {
        BuildSettings::default().validate().unwrap();
        ShadeSettings::default().validate().unwrap();
    }

    #[test]
    fn nonsense_is_named() {
        let shade = ShadeSettings {
            max_solid_angle: f32::NAN,
            ..Default::default()
        };
        assert_eq!(
            shade.validate().unwrap_err().to_string(),
            "max-solid-angle is NaN, must be above 0 and at most 1 steradian"
        );
        let build = BuildSettings {
            leaf_max: 0,
            ..Default::default()
        };
        assert_eq!(
            build.validate().unwrap_err().to_string(),
            "leaf-max is 0, must be 1..=1024"
        );
    }
}
