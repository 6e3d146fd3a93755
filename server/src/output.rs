//! The finished picture as an EXR file that appears complete or not at all.

use crate::framebuffer::Planes;
use crate::job::ShadeTask;
use crate::roots::Place;
use pbgi_core::{BuildId, Statistics};
use pbgi_points::{LayeredImage, PassThrough, Precision};
use pbgi_store::{AtomicFile, Overwrite, StoreError};
use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

/// What the file says beside its pixels, and where it goes.
pub struct Picture {
    /// What was shaded.
    pub build_id: BuildId,
    /// What was asked for.
    pub task: ShadeTask,
    /// What it took.
    pub statistics: Statistics,
    /// The memory that it took at most, by the daemon's settings.
    pub memory_bytes: u64,
    /// What the G-buffer's file has for it.
    pub passed: PassThrough,
    /// The G-buffer.
    pub gbuffer: Place,
    /// Where the file is encoded before it goes beside its target.
    pub scratch: PathBuf,
    /// Its target.
    pub place: Place,
}

/// Writes the picture; returns its bytes.
///
/// # Errors
/// A text for people: a name that is taken, a disk that is full, or `stopped` said so.
pub fn write(picture: &Picture, planes: Planes, stopped: &dyn Fn() -> bool) -> Result<u64, String> {
    let task = &picture.task;
    let overwrite = if task.overwrite {
        Overwrite::Replace
    } else {
        Overwrite::Refuse
    };
    let text = |error: StoreError| picture.place.hide(&error.to_string());
    let mut file = AtomicFile::create(&picture.place.path, overwrite).map_err(text)?;
    let image = layered(picture, planes)?;
    let encoded = Encoded(picture.scratch.join(format!("picture-{}.exr", unique())));
    image.write_exr(&encoded.0).map_err(|error| error.to_string())?;
    drop(image);
    let bytes = copy(&encoded.0, &mut file)
        .map_err(|error| format!("cannot write picture: {error}, at {}", task.output.display()))?;
    if stopped() {
        return Err("stopped".into());
    }
    file.publish().map_err(text)?;
    Ok(bytes)
}

/// Deletes the encoded picture whatever happens.
struct Encoded(PathBuf);

impl Drop for Encoded {
    fn drop(&mut self) {
        // A leftover is swept at the next start.
        let _ = fs::remove_file(&self.0);
    }
}

/// Removes encoded pictures that a dead daemon left in its scratch directory; returns how many.
pub fn sweep(scratch: &Path) -> io::Result<usize> {
    let mut count = 0;
    for entry in fs::read_dir(scratch)? {
        let entry = entry?;
        let name = entry.file_name();
        let ours = name
            .to_str()
            .is_some_and(|name| name.starts_with("picture-") && name.contains(".exr"));
        if ours && entry.file_type()?.is_file() && fs::remove_file(entry.path()).is_ok() {
            count += 1;
        }
    }
    Ok(count)
}

/// A part of a name that nobody else uses.
pub(crate) fn unique() -> String {
    use std::sync::atomic::{AtomicU64, Ordering};
    static NEXT: AtomicU64 = AtomicU64::new(0);
    format!("{}-{}", std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed))
}

fn copy(from: &Path, to: &mut AtomicFile) -> io::Result<u64> {
    let mut to = BufWriter::with_capacity(1 << 20, to);
    let bytes = io::copy(&mut File::open(from)?, &mut to)?;
    to.flush()?;
    Ok(bytes)
}

fn layered(picture: &Picture, planes: Planes) -> Result<LayeredImage, String> {
    let passed = picture.passed.read(planes.data);
    let mut image = passed.map_err(|error| picture.gbuffer.hide(&error.to_string()))?;
    image.display_window = planes.display;
    // Irradiance of bright scenes leaves the range of half precision, and readers compare: floats throughout.
    image.add_rgb("indirect", Precision::Float, &planes.irradiance);
    image.add_rgb("", Precision::Float, &planes.irradiance);
    drop(planes.irradiance);
    image.add("A", Precision::Half, planes.coverage);
    image.add("occlusion.Z", Precision::Float, planes.occlusion);
    image.add_xyz("bentnormal", Precision::Float, &planes.bent_normal);
    let task = &picture.task;
    let mut set = |name: &str, value: String| image.metadata.insert(format!("pbgi/{name}"), value);
    set("scene", name(&task.scene));
    set("build_id", picture.build_id.to_string());
    set("memory_bytes", picture.memory_bytes.to_string());
    let settings = &task.settings;
    set("max_solid_angle", settings.max_solid_angle.to_string());
    set("raster_resolution", settings.raster_resolution.to_string());
    set("max_dist", settings.max_dist.to_string());
    set("falloff", settings.falloff.to_string());
    set("bias", settings.bias.to_string());
    set("bounces", settings.bounces.to_string());
    set("interpolation", settings.interpolation.to_string());
    set("hitsides", settings.hit_sides.name().to_owned());
    if let Some(environment) = &task.environment {
        set("environment", name(environment));
    }
    for row in picture.statistics.rows() {
        if let Some(value) = row.value {
            set(row.name, value.to_string());
        }
    }
    Ok(image)
}

/// The last part of a path, as far as an EXR text can hold it.
fn name(path: &Path) -> String {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    name.chars().map(|c| if u32::from(c) < 256 { c } else { '?' }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::roots::Roots;
    use pbgi_core::ShadeSettings;
    use pbgi_points::Window;

    /// Of a G-buffer with a camera, a Cryptomatte layer, and attributes of its own.
    fn picture(folder: &Path, overwrite: bool) -> Picture {
        let mut passes = LayeredImage::with_windows(planes().data, planes().display);
        passes.world_to_ndc = Some(glam::Mat4::from_scale(glam::Vec3::splat(3.0)));
        passes.add("P.X", Precision::Float, vec![1.0, 2.0]);
        passes.add("CryptoObject00.R", Precision::Float, vec![1.5e-30, 2.5e30]);
        let texts = [
            ("cryptomatte/3cb6acf/name", "CryptoObject"),
            ("renderer", "other 1.0"),
            ("pbgi/holes", "99"),
            ("pbgi/old", "of another picture"),
        ];
        passes.metadata = texts.map(|(key, value)| (key.to_owned(), value.to_owned())).into();
        passes.write_exr(&folder.join("g.exr")).unwrap();
        let passed = PassThrough::open(&folder.join("g.exr")).unwrap();
        let gbuffer = Roots::default().read(&folder.join("g.exr")).unwrap();
        fs::remove_file(folder.join("g.exr")).unwrap();
        Picture {
            passed,
            gbuffer,
            memory_bytes: 1 << 30,
            build_id: BuildId(7),
            task: ShadeTask {
                scene: "/scenes/cité 日本.pbgi".into(),
                gbuffer: "/g.exr".into(),
                passes: Default::default(),
                output: folder.join("out.exr"),
                overwrite,
                settings: ShadeSettings::default(),
                environment: None,
                workers: None,
            },
            statistics: Statistics {
                holes: Some(1.0),
                ..Statistics::default()
            },
            scratch: folder.to_owned(),
            place: Roots::default().write(&folder.join("out.exr"), overwrite).unwrap(),
        }
    }

    fn planes() -> Planes {
        let window = |x, y, width, height| Window { x, y, width, height };
        Planes {
            data: window(-1, 2, 2, 1),
            display: window(0, 0, 10, 10),
            irradiance: vec![[1.0, 2.0, 70_000.0], [0.0; 3]],
            occlusion: vec![0.25, 0.0],
            bent_normal: vec![[0.0, 1.0, 0.0], [0.0; 3]],
            coverage: vec![1.0, 0.0],
        }
    }

    #[test]
    fn layers_windows_and_attributes_come_back() {
        let folder = tempfile::tempdir().unwrap();
        let picture = picture(folder.path(), false);
        let bytes = write(&picture, planes(), &|| false).unwrap();
        assert_eq!(fs::metadata(&picture.task.output).unwrap().len(), bytes);
        let image = LayeredImage::read_exr(&picture.task.output).unwrap();
        assert_eq!(
            (image.data_window, image.display_window),
            (planes().data, planes().display)
        );
        assert_eq!(image.triple("indirect").unwrap(), planes().irradiance);
        assert_eq!(image.triple("").unwrap(), planes().irradiance);
        assert_eq!(image.triple("bentnormal").unwrap(), planes().bent_normal);
        assert_eq!(image.channel("occlusion.Z").unwrap(), planes().occlusion);
        assert_eq!(image.channel("A").unwrap(), planes().coverage);
        assert_eq!(image.channel("CryptoObject00.R").unwrap(), [1.5e-30, 2.5e30]);
        assert_eq!(image.channels.len(), 12);
        assert_eq!(image.world_to_ndc, Some(glam::Mat4::from_scale(glam::Vec3::splat(3.0))));
        assert_eq!(image.metadata["renderer"], "other 1.0");
        assert!(!image.metadata.contains_key("pbgi/old"));
        assert_eq!(image.metadata["pbgi/holes"], "1");
        assert_eq!(image.metadata["pbgi/max_dist"], "inf");
        assert_eq!(image.metadata["pbgi/build_id"], BuildId(7).to_string());
    }

    #[test]
    fn taken_name_is_refused_unless_overwriting_was_asked_for() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("out.exr");
        fs::write(&target, "old").unwrap();
        let error = write(&picture(folder.path(), false), planes(), &|| false).unwrap_err();
        assert!(error.contains("--overwrite"), "{error}");
        assert_eq!(fs::read(&target).unwrap(), b"old");
        write(&picture(folder.path(), true), planes(), &|| false).unwrap();
        assert!(fs::metadata(&target).unwrap().len() > 100);
    }

    #[test]
    fn stopped_job_leaves_nothing() {
        let folder = tempfile::tempdir().unwrap();
        write(&picture(folder.path(), false), planes(), &|| true).unwrap_err();
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
    }

    #[test]
    fn sweep_takes_encoded_pictures_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["picture-1-0.exr", "picture-9-3.exr.tmp-9", "mine.exr", "picture.txt"] {
            fs::write(folder.path().join(name), "").unwrap();
        }
        assert_eq!(sweep(folder.path()).unwrap(), 2);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 2);
    }
}
