//! Options about how files become points, and points an octree.

use super::camera::CameraArgs;
use super::{Size, picture_size, positive, triple};
use crate::cmd::answer::note;
use crate::cmd::failure::Failure;
use crate::cmd::files;
use clap::Args;
use pbgi_client::size::parse_count;
use pbgi_core::BuildSettings;
use pbgi_points::{CloudOptions, Density, Facing, InvalidPoints, Radius, ViewDensity};
use std::path::PathBuf;

/// How densely meshes are sampled.
#[derive(Args, Clone, Copy, Debug)]
#[command(next_help_heading = "Sampling of meshes")]
pub(crate) struct DensityArgs {
    /// Number of points on all surfaces together: 2000000, 2M
    #[arg(long, allow_negative_numbers = true, value_name = "N", value_parser = parse_count, conflicts_with = "spacing")]
    pub(crate) points: Option<u64>,
    /// Distance between neighbouring points, world units
    #[arg(long, allow_negative_numbers = true, value_name = "D", value_parser = positive)]
    pub(crate) spacing: Option<f32>,
    /// Distance between neighbouring points as a camera sees them, pixels: finer near, coarser far and out of its sight
    #[arg(long, allow_negative_numbers = true, value_name = "PIXELS", value_parser = positive, conflicts_with_all = ["points", "spacing"])]
    view_spacing: Option<f32>,
    /// Which of the scene's cameras that is, from 0 [default: that of the picture, else 0]
    #[arg(long, value_name = "N", requires = "view_spacing")]
    view_camera: Option<usize>,
    /// Pixels of its picture [default: --size of the picture, else 1920x1080]
    #[arg(long, value_name = "WxH", value_parser = picture_size, requires = "view_spacing")]
    view_size: Option<Size>,
    /// Least distance between points, world units [default: a 20,000th of the scene's diagonal]
    #[arg(long, allow_negative_numbers = true, value_name = "D", value_parser = positive, requires = "view_spacing")]
    spacing_min: Option<f32>,
    /// Greatest distance between points, world units [default: a 200th of the scene's diagonal]
    #[arg(long, allow_negative_numbers = true, value_name = "D", value_parser = positive, requires = "view_spacing")]
    spacing_max: Option<f32>,
}

/// Of a picture that is not known yet.
const VIEW_SIZE: Size = Size {
    width: 1920,
    height: 1080,
};

impl DensityArgs {
    pub(crate) fn density(&self) -> Option<Density> {
        self.density_for(&CameraArgs::default())
    }

    /// For a picture that this camera takes.
    pub(crate) fn density_for(&self, picture: &CameraArgs) -> Option<Density> {
        let size = self.view_size.or(picture.size).unwrap_or(VIEW_SIZE);
        let view = |pixels| {
            Density::View(ViewDensity {
                camera: self.view_camera.or(picture.camera).unwrap_or(0),
                size: [size.width, size.height],
                pixels,
                floor: self.spacing_min,
                ceiling: self.spacing_max,
            })
        };
        let points = self.points.map(Density::Points);
        points
            .or(self.spacing.map(Density::Spacing))
            .or(self.view_spacing.map(view))
    }
}

/// How point clouds are read.
#[derive(Args, Clone, Copy, Debug, Default)]
#[command(next_help_heading = "Point clouds")]
pub(crate) struct ReadingArgs {
    /// Estimate normals from neighbouring points, turned up, out (of the body they enclose) or to a viewpoint X,Y,Z
    /// [default: up for LAS and LAZ, else out]
    #[arg(long, value_name = "SIDE", num_args = 0..=1, require_equals = true, default_missing_value = "auto", value_parser = facing)]
    estimate_normals: Option<Facing>,
    /// Subtract X,Y,Z (in the file's axes) from positions that are too large for 32-bit floats [default: chosen from LAS headers]
    #[arg(long, allow_negative_numbers = true, value_name = "X,Y,Z", value_parser = triple::<f64>)]
    origin: Option<[f64; 3]>,
    /// What to do with points that cannot be used: refuse the input, or skip and count them [default: refuse]
    #[arg(long, value_name = "POLICY", value_parser = invalid_points)]
    invalid_points: Option<InvalidPoints>,
    /// Measure the points instead of believing the box that the file declares
    #[arg(long)]
    recompute_bounds: bool,
}

impl ReadingArgs {
    pub(crate) fn options(&self) -> CloudOptions {
        CloudOptions {
            origin: self.origin,
            invalid_points: self.invalid_points.unwrap_or_default(),
            recompute_bounds: self.recompute_bounds,
            estimate_normals: self.estimate_normals,
            ..CloudOptions::default()
        }
    }
}

/// How point clouds become points of a scene.
#[derive(Args, Clone, Copy, Debug, Default)]
pub(crate) struct CloudArgs {
    #[command(flatten)]
    reading: ReadingArgs,
    /// Radius of points whose file has none: auto, from their distances, or a length
    #[arg(long, allow_negative_numbers = true, value_name = "R", value_parser = radius, help_heading = "Point clouds")]
    radius: Option<Radius>,
    /// Albedo of points whose file has none, 0 to 1: what --bounces needs to know of scans
    #[arg(long, allow_negative_numbers = true, value_name = "A", value_parser = albedo, help_heading = "Point clouds")]
    albedo: Option<f32>,
}

impl CloudArgs {
    pub(crate) fn options(&self) -> CloudOptions {
        CloudOptions {
            radius: self.radius,
            albedo: self.albedo,
            ..self.reading.options()
        }
    }

    /// Tells where the world's origin is, if the files have it elsewhere, and can be read here.
    pub(crate) fn say_origin(&self, inputs: &[PathBuf]) -> Result<(), Failure> {
        if inputs.iter().any(|path| files::in_a_root(path)) {
            return Ok(());
        }
        let origin = pbgi_points::origin_of(inputs, &self.options())?;
        if origin != [0.0; 3] {
            let [x, y, z] = origin;
            note(format_args!(
                "positions are relative to {x},{y},{z} of the files (--origin)"
            ));
        }
        Ok(())
    }
}

fn facing(text: &str) -> Result<Facing, String> {
    match text {
        "auto" => Ok(Facing::Auto),
        "up" => Ok(Facing::Up),
        "out" => Ok(Facing::Outward),
        _ => triple(text)
            .map(Facing::Viewpoint)
            .map_err(|_| "write up, out or a viewpoint X,Y,Z".to_owned()),
    }
}

fn radius(text: &str) -> Result<Radius, String> {
    match text {
        "auto" => Ok(Radius::Estimate),
        _ => positive(text)
            .map(Radius::Fixed)
            .map_err(|_| "it must be auto or a number above 0".to_owned()),
    }
}

fn albedo(text: &str) -> Result<f32, String> {
    match text.parse::<f32>() {
        Ok(value) if (0.0..=1.0).contains(&value) => Ok(value),
        _ => Err("it must be from 0 to 1".to_owned()),
    }
}

fn invalid_points(text: &str) -> Result<InvalidPoints, String> {
    match text {
        "refuse" => Ok(InvalidPoints::Refuse),
        "skip" => Ok(InvalidPoints::Skip),
        _ => Err("write refuse or skip".to_owned()),
    }
}

/// How octrees are built.
#[derive(Args, Debug, Default)]
#[command(next_help_heading = "Octree")]
pub(crate) struct OctreeArgs {
    /// Most points in a leaf [default: 16]
    #[arg(long, allow_negative_numbers = true, value_name = "N")]
    pub(crate) leaf_max: Option<u32>,
    /// Levels written together; 0 writes siblings as soon as their parent is known [default: 3]
    #[arg(long, allow_negative_numbers = true, value_name = "N")]
    pub(crate) chunk_levels: Option<u32>,
    /// Nodes in a page [default: 256]
    #[arg(long, allow_negative_numbers = true, value_name = "N")]
    pub(crate) nodes_per_page: Option<u32>,
    /// Points in a page [default: 1024]
    #[arg(long, allow_negative_numbers = true, value_name = "N")]
    pub(crate) points_per_page: Option<u32>,
}

impl OctreeArgs {
    pub(crate) fn settings(&self) -> Result<BuildSettings, Failure> {
        let default = BuildSettings::default();
        let settings = BuildSettings {
            leaf_max: self.leaf_max.unwrap_or(default.leaf_max),
            chunk_levels: self.chunk_levels.unwrap_or(default.chunk_levels),
            nodes_per_page: self.nodes_per_page.unwrap_or(default.nodes_per_page),
            points_per_page: self.points_per_page.unwrap_or(default.points_per_page),
        };
        settings.validate()?;
        Ok(settings)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sides_and_radii_are_read() {
        assert_eq!(facing("0,1,2"), Ok(Facing::Viewpoint([0.0, 1.0, 2.0])));
        assert_eq!((facing("up"), facing("out")), (Ok(Facing::Up), Ok(Facing::Outward)));
        assert!(facing("down").is_err() && radius("0").is_err() && invalid_points("drop").is_err());
        assert_eq!(
            (radius("auto"), radius("0.5")),
            (Ok(Radius::Estimate), Ok(Radius::Fixed(0.5)))
        );
    }

    #[test]
    fn files_of_another_machine_are_not_looked_for_here() {
        let args = CloudArgs::default();
        assert!(args.say_origin(&["scans:a.ply".into(), "scans:b.laz".into()]).is_ok());
        assert!(args.say_origin(&["/gone/b.laz".into()]).is_err());
    }

    #[test]
    fn help_states_the_real_defaults() {
        let build = BuildSettings::default();
        assert_eq!(OctreeArgs::default().settings().unwrap(), build);
        assert_eq!((build.leaf_max, build.chunk_levels), (16, 3));
        assert_eq!((build.nodes_per_page, build.points_per_page), (256, 1024));
    }
}
