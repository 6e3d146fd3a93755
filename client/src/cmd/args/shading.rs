//! Options about how receivers are shaded, and where they come from.

use crate::cmd::failure::Failure;
use clap::Args;
use pbgi_core::{HitSides, ShadeSettings};
use pbgi_points::{GBufferOptions, Space};
use std::path::PathBuf;

/// How receivers are shaded.
#[derive(Args, Debug, Default)]
#[command(next_help_heading = "Shading")]
pub(crate) struct QualityArgs {
    /// Largest solid angle of a cut element, steradian: smaller is finer and slower [default: 0.05]
    #[arg(long, allow_negative_numbers = true, value_name = "SR")]
    pub(crate) max_solid_angle: Option<f32>,
    /// Rows and columns of the raster: 8, 16, 32 or 64 [default: 64]
    #[arg(long, allow_negative_numbers = true, value_name = "N")]
    pub(crate) raster_resolution: Option<u32>,
    /// Distance beyond which surfaces do not occlude, world units; acts on occlusion and bent normal [default: unlimited]
    #[arg(long, allow_negative_numbers = true, value_name = "D")]
    pub(crate) max_dist: Option<f32>,
    /// How fast occlusion fades with distance d: exp(-falloff d) [default: 0]
    #[arg(long, allow_negative_numbers = true, value_name = "F")]
    pub(crate) falloff: Option<f32>,
    /// Surfaces within this fraction of a point's radius are the receiver's own [default: 0.1]
    #[arg(long, allow_negative_numbers = true, value_name = "B")]
    pub(crate) bias: Option<f32>,
    /// How often light is reflected on its way, 1 to 16: each beyond the first shades the scene's points [default: 1]
    #[arg(long, allow_negative_numbers = true, value_name = "N")]
    pub(crate) bounces: Option<u32>,
    /// Interpolate between neighbours on one surface where they tell each other within this error, of occlusion and of irradiance over
    /// its mean: 0.03 takes two fifths of the time where light is smooth, and may miss what is smaller than four pixels
    /// [default: 0, shade all]
    #[arg(long, allow_negative_numbers = true, value_name = "E")]
    pub(crate) interpolation: Option<f32>,
    /// Sides of surfaces that block and send light: both, front (where normals point to) or back [default: both]
    #[arg(long, value_name = "SIDES", value_parser = hit_sides)]
    pub(crate) hitsides: Option<HitSides>,
    /// Light probe around the scene: a latitude-longitude .hdr or .exr, y up [default: black]
    #[arg(long, value_name = "FILE")]
    pub(crate) environment: Option<PathBuf>,
}

impl QualityArgs {
    pub(crate) fn settings(&self) -> Result<ShadeSettings, Failure> {
        let default = ShadeSettings::default();
        let settings = ShadeSettings {
            max_solid_angle: self.max_solid_angle.unwrap_or(default.max_solid_angle),
            raster_resolution: self.raster_resolution.unwrap_or(default.raster_resolution),
            max_dist: self.max_dist.unwrap_or(default.max_dist),
            falloff: self.falloff.unwrap_or(default.falloff),
            bias: self.bias.unwrap_or(default.bias),
            bounces: self.bounces.unwrap_or(default.bounces),
            interpolation: self.interpolation.unwrap_or(default.interpolation),
            hit_sides: self.hitsides.unwrap_or(default.hit_sides),
        };
        settings.validate()?;
        Ok(settings)
    }
}

fn hit_sides(text: &str) -> Result<HitSides, String> {
    [HitSides::Both, HitSides::Front, HitSides::Back]
        .into_iter()
        .find(|sides| sides.name() == text)
        .ok_or_else(|| "write both, front or back".to_owned())
}

/// How a G-buffer is read.
#[derive(Args, Debug)]
#[command(next_help_heading = "G-buffer")]
pub(crate) struct PassArgs {
    /// Layer of the positions [default: found by its usual names: P, Pworld, WP, position, ViewLayer.Position, ...]
    #[arg(long, value_name = "LAYER")]
    position: Option<String>,
    /// Layer of the normals [default: found by its usual names: N, Nworld, normal, normals, ViewLayer.Normal, ...]
    #[arg(long, value_name = "LAYER")]
    normal: Option<String>,
    /// Space of both: checked (world space, refused if it is plainly a camera's), world (not checked), or camera (converted
    /// with the file's worldToCamera)
    #[arg(long, value_name = "SPACE", default_value = "checked", value_parser = space)]
    space: Space,
}

impl PassArgs {
    pub(crate) fn options(&self) -> GBufferOptions {
        GBufferOptions {
            position: self.position.clone(),
            normal: self.normal.clone(),
            space: self.space,
        }
    }
}

fn space(text: &str) -> Result<Space, String> {
    match text {
        "checked" => Ok(Space::Checked),
        "world" => Ok(Space::World),
        "camera" => Ok(Space::Camera),
        _ => Err("write checked, world or camera".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_setting_out_of_range_is_a_usage_error_that_names_the_option() {
        let args = QualityArgs {
            raster_resolution: Some(7),
            ..Default::default()
        };
        let failure = args.settings().unwrap_err();
        assert_eq!(failure.to_string(), "--raster-resolution is 7, must be 8, 16, 32 or 64");
        assert!(matches!(failure, Failure::Usage(_)));
    }

    #[test]
    fn help_states_the_real_defaults() {
        let shade = ShadeSettings::default();
        assert_eq!(QualityArgs::default().settings().unwrap(), shade);
        let (sr, raster, bias) = (shade.max_solid_angle, shade.raster_resolution, shade.bias);
        assert_eq!((sr, raster, bias, shade.falloff), (0.05, 64, 0.1, 0.0));
        assert_eq!(
            (shade.bounces, shade.interpolation, shade.hit_sides),
            (1, 0.0, HitSides::Both)
        );
    }
}
