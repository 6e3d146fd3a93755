//! Options that several commands share, and how their values are read.

use super::failure::Failure;
use super::files::{self, Existing};
use clap::Args;
use pbgi_client::JobOptions;
use pbgi_client::private::PrivateOptions;
use pbgi_client::size::parse_bytes;
use pbgi_core::{BuildSettings, HitSides, ShadeSettings, limits};
use pbgi_points::{CloudOptions, Density, Facing, GBufferOptions, InvalidPoints, Radius, Space, ViewDensity};
use std::path::{Path, PathBuf};

/// Which daemon.
#[derive(Args, Debug, Default)]
#[command(next_help_heading = "Daemon")]
pub(crate) struct ServerArgs {
    /// Use the daemon at this address, unix:/path/to/jobs.sock or https://host:port, instead of a private one
    #[arg(long, value_name = "URI")]
    pub(crate) server: Option<String>,
    /// Memory of the private daemon, all of its processes together: 2G, 512M
    #[arg(long, value_name = "SIZE", value_parser = parse_bytes, conflicts_with = "server")]
    pub(crate) memory: Option<u64>,
    /// Worker processes of the private daemon; with --server, most workers for this job
    #[arg(long, allow_negative_numbers = true, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=limits::WORKERS_MAX as i64))]
    pub(crate) workers: Option<u32>,
}

impl ServerArgs {
    pub(crate) fn private_options(&self) -> PrivateOptions {
        PrivateOptions {
            memory_bytes: self.memory,
            workers: self.workers,
        }
    }

    /// A private daemon has as many workers as were asked for; a shared one is asked to use no more for this job.
    pub(crate) fn job_workers(&self) -> Option<u32> {
        self.workers.filter(|_| self.server.is_some())
    }
}

/// Which of the running daemons, for commands that start none.
#[derive(Args, Debug, Default)]
pub(crate) struct RunningArgs {
    /// The daemon's address, unix:/path/to/jobs.sock; without it, your private daemons
    #[arg(long, value_name = "URI")]
    pub(crate) server: Option<String>,
}

/// How answers are printed.
#[derive(Args, Clone, Copy, Debug, Default)]
pub(crate) struct FormArgs {
    /// Print JSON instead of a table
    #[arg(long)]
    pub(crate) json: bool,
}

/// Where results go.
#[derive(Args, Debug)]
pub(crate) struct OutputArgs {
    /// The file to write
    #[arg(short, long, value_name = "OUT")]
    pub(crate) output: PathBuf,
    /// Replace an existing output
    #[arg(long)]
    pub(crate) overwrite: bool,
}

/// The statistics file.
#[derive(Args, Debug, Default)]
pub(crate) struct StatsArgs {
    /// Write the statistics to this file as one JSON object
    #[arg(long, value_name = "FILE.json", help_heading = "Statistics")]
    pub(crate) stats: Option<PathBuf>,
}

impl StatsArgs {
    /// Finds out before any work is done that the file cannot be written.
    pub(crate) fn check(&self) -> Result<(), Failure> {
        match &self.stats {
            Some(path) => files::output(path, Existing::Replace).map(drop),
            None => Ok(()),
        }
    }
}

/// How densely meshes are sampled.
#[derive(Args, Clone, Copy, Debug)]
#[command(next_help_heading = "Sampling of meshes")]
pub(crate) struct DensityArgs {
    /// Number of points on all surfaces together
    #[arg(long, allow_negative_numbers = true, value_name = "N", value_parser = clap::value_parser!(u64).range(1..), conflicts_with = "spacing")]
    pub(crate) points: Option<u64>,
    /// Distance between neighbouring points, world units
    #[arg(long, allow_negative_numbers = true, value_name = "D", value_parser = positive)]
    pub(crate) spacing: Option<f32>,
    /// Distance between neighbouring points as a camera sees them, pixels: finer near, coarser far and out of its sight
    #[arg(long, allow_negative_numbers = true, value_name = "PIXELS", value_parser = positive, conflicts_with_all = ["points", "spacing"])]
    view_spacing: Option<f32>,
    /// Which of the scene's cameras that is, from 0
    #[arg(long, value_name = "N", default_value_t = 0, requires = "view_spacing")]
    view_camera: usize,
    /// Pixels of its picture
    #[arg(long, value_name = "WxH", default_value = "1920x1080", value_parser = picture_size, requires = "view_spacing")]
    view_size: Size,
    /// Least distance between points, world units [default: a 20,000th of the scene's diagonal]
    #[arg(long, allow_negative_numbers = true, value_name = "D", value_parser = positive, requires = "view_spacing")]
    spacing_min: Option<f32>,
    /// Greatest distance between points, world units [default: a 200th of the scene's diagonal]
    #[arg(long, allow_negative_numbers = true, value_name = "D", value_parser = positive, requires = "view_spacing")]
    spacing_max: Option<f32>,
}

impl DensityArgs {
    pub(crate) fn density(&self) -> Option<Density> {
        let view = |pixels| {
            Density::View(ViewDensity {
                camera: self.view_camera,
                size: [self.view_size.width, self.view_size.height],
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
    /// Estimate normals from neighbouring points, turned up, out (away from the middle) or to a viewpoint X,Y,Z
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
            eprintln!("positions are relative to {x},{y},{z} of the files (--origin)");
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

/// Three finite numbers with commas between them.
fn triple<T: std::str::FromStr + Copy + Into<f64>>(text: &str) -> Result<[T; 3], String> {
    let numbers: Option<Vec<T>> = text.split(',').map(|word| word.trim().parse().ok()).collect();
    let numbers = numbers.filter(|numbers| numbers.iter().all(|&number| number.into().is_finite()));
    let triple = numbers.and_then(|numbers| <[T; 3]>::try_from(numbers).ok());
    triple.ok_or_else(|| format!("{text:?} is no place: write three numbers with commas, such as 1,2.5,-3"))
}

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
    /// Interpolate between neighbours on one surface within this error, of occlusion and of irradiance over its mean: 0.02 is
    /// faster by half and more where light is smooth [default: 0, shade all]
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

/// What the camera is.
#[derive(Args, Clone, Copy, Debug, Default)]
#[command(next_help_heading = "Camera")]
pub(crate) struct CameraArgs {
    /// Which of the file's cameras, from 0; a file without cameras is seen from its front [default: 0]
    #[arg(long, allow_negative_numbers = true, value_name = "N")]
    pub(crate) camera: Option<usize>,
    /// Pixels of the picture [default: 540 rows, columns as the camera asks, else 960]
    #[arg(long, value_name = "WxH", value_parser = picture_size)]
    pub(crate) size: Option<Size>,
}

/// How a camera sees a scene that has no meshes.
#[derive(Args, Clone, Debug, Default)]
#[command(next_help_heading = "Camera")]
pub(crate) struct SeenArgs {
    /// The camera: auto, an overview of the scene, or a number, of the cameras of --camera-file [default: auto]
    #[arg(long, value_name = "auto|N")]
    pub(crate) camera: Option<String>,
    /// A mesh whose camera it is, such as the one that the scene was built of: .glb, .gltf
    #[arg(long, value_name = "FILE", conflicts_with = "eye")]
    pub(crate) camera_file: Option<PathBuf>,
    /// Where the camera stands, world units
    #[arg(long, allow_hyphen_values = true, value_name = "X,Y,Z", value_parser = triple::<f32>, conflicts_with = "camera")]
    pub(crate) eye: Option<[f32; 3]>,
    /// What it looks at [default: the middle of the scene]
    #[arg(long, allow_hyphen_values = true, value_name = "X,Y,Z", value_parser = triple::<f32>, requires = "eye")]
    pub(crate) look_at: Option<[f32; 3]>,
    /// Height of what it sees, degrees
    #[arg(long, value_name = "DEGREES", default_value_t = 45.0, value_parser = field_of_view, requires = "eye")]
    pub(crate) fov: f32,
    /// Which way is up
    #[arg(long, value_name = "x|y|z", default_value = "y", value_parser = ["x", "y", "z"], requires = "eye")]
    pub(crate) up: String,
    /// Pixels of the picture [default: 960x540]
    #[arg(long, value_name = "WxH", value_parser = picture_size)]
    size: Option<Size>,
}

impl SeenArgs {
    /// Whether any of it was asked for.
    pub(crate) fn is_given(&self) -> bool {
        self.camera.is_some() || self.camera_file.is_some() || self.eye.is_some()
    }

    pub(crate) fn size(&self) -> Size {
        self.size.unwrap_or(Size {
            width: 960,
            height: 540,
        })
    }

    pub(crate) fn up(&self) -> [f32; 3] {
        match self.up.as_str() {
            "x" => [1.0, 0.0, 0.0],
            "z" => [0.0, 0.0, 1.0],
            _ => [0.0, 1.0, 0.0],
        }
    }

    /// Checks `--camera`: a number goes with a file, `auto` with none.
    pub(crate) fn camera_number(&self) -> Result<usize, Failure> {
        let fault = || Failure::usage("--camera is auto, or with --camera-file the number of one of its cameras");
        match (self.camera.as_deref(), &self.camera_file) {
            (None | Some("auto"), None) | (None, Some(_)) => Ok(0),
            (Some(number), Some(_)) => number.parse().map_err(|_| fault()),
            (Some(_), None) => Err(fault()),
        }
    }
}

fn field_of_view(text: &str) -> Result<f32, String> {
    match text.parse::<f32>() {
        Ok(degrees) if (1.0..=170.0).contains(&degrees) => Ok(degrees),
        _ => Err("it must be from 1 to 170 degrees".to_owned()),
    }
}

/// Pixels of a picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Size {
    pub(crate) width: u32,
    pub(crate) height: u32,
}

pub(crate) fn picture_size(text: &str) -> Result<Size, String> {
    let fault = || format!("{text:?} is no size in pixels: write width x height, such as 1920x1080");
    let (width, height) = text.split_once(['x', 'X']).ok_or_else(fault)?;
    let number = |text: &str| text.parse::<u32>().ok().filter(|&pixels| pixels > 0).ok_or_else(fault);
    let size = Size {
        width: number(width)?,
        height: number(height)?,
    };
    let pixels = u64::from(size.width) * u64::from(size.height);
    if pixels > limits::IMAGE_PIXELS_MAX {
        return Err(format!(
            "{text} has {pixels} pixels, at most {} are possible",
            limits::IMAGE_PIXELS_MAX
        ));
    }
    Ok(size)
}

pub(crate) fn positive(text: &str) -> Result<f32, String> {
    match text.parse::<f32>() {
        Ok(value) if value > 0.0 && value.is_finite() => Ok(value),
        _ => Err("it must be a number above 0".to_owned()),
    }
}

/// How a job stands among others.
#[derive(Args, Clone, Debug, Default)]
#[command(next_help_heading = "Job")]
pub(crate) struct JobArgs {
    /// The job's id, for jobs, watch and cancel; the same id with the same task is the same job [default: made up]
    #[arg(long, value_name = "ID")]
    pub(crate) job_id: Option<String>,
    /// For whom; users of equal priority share the workers [default: you]
    #[arg(long, value_name = "USER")]
    user: Option<String>,
    /// Words that records, logs and metrics bear, like show=dune or shot=12; may be repeated
    #[arg(long = "label", value_name = "NAME=VALUE", value_parser = label)]
    labels: Vec<(String, String)>,
    /// Higher ones go first, -1000 to 1000
    #[arg(long, value_name = "N", default_value_t = 0, allow_negative_numbers = true)]
    priority: i32,
    /// A job that must succeed first; may be repeated
    #[arg(long, value_name = "JOB")]
    after: Vec<String>,
    /// Submit the job, print its id, and leave
    #[arg(long)]
    pub(crate) detach: bool,
}

impl JobArgs {
    /// A scene to shade: a job that comes after others may take what these make.
    pub(crate) fn scene(&self, path: &Path) -> Result<PathBuf, Failure> {
        match self.after.as_slice() {
            [] => files::input(path),
            _ => files::input_to_come(path),
        }
    }

    pub(crate) fn options(&self) -> JobOptions {
        JobOptions {
            user: self.user.clone().unwrap_or_default(),
            labels: self.labels.iter().cloned().collect(),
            priority: self.priority,
            after: self.after.clone(),
            ..JobOptions::default()
        }
    }
}

fn label(text: &str) -> Result<(String, String), String> {
    match text.split_once('=') {
        Some((name, value)) if !name.is_empty() => Ok((name.to_owned(), value.to_owned())),
        _ => Err("it must look like show=dune".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn picture_sizes_are_read() {
        let size = picture_size("1920x1080").unwrap();
        assert_eq!((size.width, size.height), (1920, 1080));
        for text in [
            "",
            "1920",
            "0x5",
            "5x0",
            "-1x2",
            "axb",
            "4294967295x4294967295",
            "1x2x3",
        ] {
            assert!(picture_size(text).is_err(), "{text}");
        }
    }

    #[test]
    fn places_sides_and_radii_are_read() {
        assert_eq!(triple::<f64>("1, -2.5,3e6"), Ok([1.0, -2.5, 3e6]));
        for text in ["", "1,2", "1,2,3,4", "1,2,x", "1,2,inf", "1,2,nan"] {
            assert!(triple::<f64>(text).is_err(), "{text}");
        }
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
    fn unset_options_take_the_defaults() {
        assert_eq!(QualityArgs::default().settings().unwrap(), ShadeSettings::default());
        assert_eq!(OctreeArgs::default().settings().unwrap(), BuildSettings::default());
    }

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
        let build = BuildSettings::default();
        let (sr, raster, bias) = (shade.max_solid_angle, shade.raster_resolution, shade.bias);
        assert_eq!((sr, raster, bias, shade.falloff), (0.05, 64, 0.1, 0.0));
        assert_eq!((build.leaf_max, build.chunk_levels), (16, 3));
        assert_eq!((build.nodes_per_page, build.points_per_page), (256, 1024));
    }
}
