//! Options about cameras and pictures.

use super::triple;
use crate::cmd::failure::Failure;
use clap::Args;
use pbgi_core::limits;
use std::path::PathBuf;

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
}
