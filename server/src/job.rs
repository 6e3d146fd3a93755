//! What a job is to the rest of the daemon: its request, and what can be told about it.

use crate::error::{JobError, JobErrorKind};
use crate::limits;
use crate::roots::{Roots, Want};
use crate::scheduler::{JobNo, Kind};
use pbgi_core::{BuildSettings, ShadeSettings, Statistics};
use pbgi_points::{CloudOptions, Density, GBufferOptions};
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};

/// Points or meshes in, a scene out.
#[derive(Clone, Debug, PartialEq)]
pub struct BuildTask {
    /// Input files, absolute.
    pub inputs: Vec<PathBuf>,
    /// The scene directory, absolute.
    pub output: PathBuf,
    /// Whether a scene that is there is replaced.
    pub overwrite: bool,
    /// How.
    pub settings: BuildSettings,
    /// How densely meshes are sampled; `None` for the sampler's default.
    pub density: Option<Density>,
    /// For clouds.
    pub cloud: CloudOptions,
}

/// A scene and a G-buffer in, a picture out.
#[derive(Clone, Debug, PartialEq)]
pub struct ShadeTask {
    /// The scene directory, absolute.
    pub scene: PathBuf,
    /// The G-buffer, absolute.
    pub gbuffer: PathBuf,
    /// How it is read.
    pub passes: GBufferOptions,
    /// The picture, absolute.
    pub output: PathBuf,
    /// Whether a picture that is there is replaced.
    pub overwrite: bool,
    /// How.
    pub settings: ShadeSettings,
    /// The environment map, absolute; `None` for black.
    pub environment: Option<PathBuf>,
    /// Most workers at once; `None` for all.
    pub workers: Option<usize>,
}

/// What a client asks for.
#[derive(Clone, Debug, PartialEq)]
pub enum Request {
    /// A scene.
    Build(BuildTask),
    /// A picture.
    Shade(ShadeTask),
}

impl Request {
    /// Checks what can be checked without opening a file.
    ///
    /// # Errors
    /// [`JobErrorKind::Invalid`], naming the field.
    pub fn validate(&self, roots: &Roots) -> Result<(), JobError> {
        let invalid = |error: pbgi_core::SettingsError| JobError::invalid(error.to_string());
        match self {
            Self::Build(task) => {
                task.settings.validate().map_err(invalid)?;
                if task.inputs.is_empty() || task.inputs.len() > limits::BUILD_INPUTS_MAX {
                    let max = limits::BUILD_INPUTS_MAX;
                    return Err(JobError::invalid(format!(
                        "{} inputs given, must be 1 to {max}",
                        task.inputs.len()
                    )));
                }
                match task.density {
                    Some(Density::Spacing(spacing)) if !(spacing > 0.0 && spacing.is_finite()) => {
                        return Err(JobError::invalid(format!("spacing is {spacing}, must be above 0")));
                    }
                    Some(Density::Points(0)) => return Err(JobError::invalid("points is 0, must be above 0")),
                    _ => {}
                }
                task.inputs
                    .iter()
                    .try_for_each(|path| roots.check("input", path, Want::Read))?;
                roots.check("output", &task.output, Want::output(task.overwrite))
            }
            Self::Shade(task) => {
                task.settings.validate().map_err(invalid)?;
                roots.check("scene", &task.scene, Want::Read)?;
                roots.check("gbuffer", &task.gbuffer, Want::Read)?;
                roots.check("output", &task.output, Want::output(task.overwrite))?;
                task.environment
                    .iter()
                    .try_for_each(|path| roots.check("environment", path, Want::Read))
            }
        }
    }

    /// Where the result goes.
    pub fn output(&self) -> &Path {
        match self {
            Self::Build(task) => &task.output,
            Self::Shade(task) => &task.output,
        }
    }

    /// For people.
    pub fn title(&self) -> String {
        let name = self.output().file_name().unwrap_or_default().to_string_lossy();
        match self {
            Self::Build(_) => format!("build {name}"),
            Self::Shade(_) => format!("shade {name}"),
        }
    }

    /// For the scheduler.
    pub fn kind(&self) -> Kind {
        match self {
            Self::Build(_) => Kind::Build,
            Self::Shade(task) => Kind::Shade {
                workers_max: task.workers.unwrap_or(usize::MAX),
            },
        }
    }
}

/// Checks a client's name for a job.
///
/// # Errors
/// [`JobErrorKind::Invalid`].
pub fn check_job_id(id: &str) -> Result<(), JobError> {
    let allowed = |byte: u8| byte.is_ascii_alphanumeric() || b"._-".contains(&byte);
    if id.is_empty() || id.len() > limits::JOB_ID_CHARS_MAX || !id.bytes().all(allowed) {
        let max = limits::JOB_ID_CHARS_MAX;
        return Err(JobError::invalid(format!(
            "job id must be 1 to {max} characters of A-Z a-z 0-9 . _ -"
        )));
    }
    Ok(())
}

/// What is wanted beside the task itself.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct JobOptions {
    /// For whom.
    pub user: String,
    /// Free words.
    pub labels: BTreeMap<String, String>,
    /// Higher ones go first.
    pub priority: i32,
    /// Names of jobs that must succeed first.
    pub after: Vec<String>,
    /// Whether it rests.
    pub paused: bool,
}

impl JobOptions {
    /// Checks lengths and ranges.
    ///
    /// # Errors
    /// [`JobErrorKind::Invalid`], naming the field.
    pub fn validate(&self) -> Result<(), JobError> {
        let max = limits::LABEL_CHARS_MAX;
        let words = self.labels.iter().flat_map(|(key, value)| [key, value]);
        if words
            .chain([&self.user])
            .any(|word| word.chars().count() > max || word.chars().any(char::is_control))
        {
            return Err(JobError::invalid(format!(
                "user and labels must be at most {max} characters each, none of them control characters"
            )));
        }
        if self.labels.len() > limits::LABELS_MAX || self.labels.contains_key("") {
            let (count, max) = (self.labels.len(), limits::LABELS_MAX);
            return Err(JobError::invalid(format!(
                "{count} labels, at most {max} with names are taken"
            )));
        }
        if self.priority.abs() > limits::PRIORITY_MAX {
            let (priority, max) = (self.priority, limits::PRIORITY_MAX);
            return Err(JobError::invalid(format!(
                "priority is {priority}, must be from -{max} to {max}"
            )));
        }
        if self.after.len() > limits::AFTER_MAX {
            let (count, max) = (self.after.len(), limits::AFTER_MAX);
            return Err(JobError::invalid(format!(
                "comes after {count} jobs, at most {max} are taken"
            )));
        }
        self.after.iter().try_for_each(|id| check_job_id(id))
    }
}

/// A line of a job's history.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct JobEvent {
    /// Milliseconds since the Unix epoch.
    pub unix_millis: i64,
    /// What happened.
    pub text: String,
}

/// Where a job is in its life.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JobState {
    /// Waits.
    Queued,
    /// Runs.
    Running,
    /// Its output is in place.
    Succeeded,
    /// It will not be.
    Failed,
    /// Somebody asked.
    Cancelled,
}

impl JobState {
    /// Whether nothing more will happen.
    pub fn ended(self) -> bool {
        matches!(self, Self::Succeeded | Self::Failed | Self::Cancelled)
    }
}

/// What can be told about a job at a moment, and what is kept of it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct JobStatus {
    /// The client's name for it.
    pub id: String,
    /// Number, for order.
    pub number: JobNo,
    /// Where it is.
    pub state: JobState,
    /// What it is doing, for people.
    pub stage: Cow<'static, str>,
    /// Units done.
    pub done: u64,
    /// Units in all; 0 while unknown.
    pub total: u64,
    /// Why it failed.
    pub error: String,
    /// Complete when the job is.
    pub statistics: Statistics,
    /// For people.
    pub title: String,
    /// What is wanted beside the task.
    pub options: JobOptions,
    /// What happened to it, oldest first.
    pub history: VecDeque<JobEvent>,
    /// The daemon stops, and the next one goes on with it.
    #[serde(skip)]
    pub suspended: bool,
}

impl JobStatus {
    /// Adds a line to the history; the oldest make room.
    pub fn note(&mut self, text: impl Into<String>) {
        if self.history.len() >= limits::HISTORY_MAX {
            // The first tells when it was submitted.
            self.history.remove(1);
        }
        let (unix_millis, text) = (crate::telemetry::unix_millis(), text.into());
        self.history.push_back(JobEvent { unix_millis, text });
    }
}

/// The error for a job that is not there.
pub fn no_such_job(id: &str) -> JobError {
    JobError::new(
        JobErrorKind::NotFound,
        format!("no job {id:?}: it never was, or ended long ago"),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn job_names_are_checked() {
        for good in ["a", "render-12_3.x", &"x".repeat(128)] {
            check_job_id(good).unwrap();
        }
        for bad in ["", "a b", "ä", "a/b", &"x".repeat(129)] {
            assert_eq!(check_job_id(bad).unwrap_err().kind, JobErrorKind::Invalid);
        }
    }

    #[test]
    fn requests_that_make_no_sense_are_refused_by_field() {
        let good = BuildTask {
            inputs: vec!["/in.ply".into()],
            output: "/out.pbgi".into(),
            overwrite: false,
            settings: BuildSettings::default(),
            density: None,
            cloud: CloudOptions::default(),
        };
        Request::Build(good.clone()).validate(&Roots::default()).unwrap();
        type Change = fn(&mut BuildTask);
        let cases: [(Change, &str); 6] = [
            (|task| task.inputs.clear(), "0 inputs"),
            (|task| task.inputs = vec!["in.ply".into()], "input path is not absolute"),
            (|task| task.output = "/".into(), "output path names no file"),
            (|task| task.density = Some(Density::Spacing(f32::NAN)), "spacing is NaN"),
            (|task| task.density = Some(Density::Points(0)), "points is 0"),
            (|task| task.settings.leaf_max = 0, "leaf-max is 0"),
        ];
        for (change, text) in cases {
            let mut task = good.clone();
            change(&mut task);
            let error = Request::Build(task).validate(&Roots::default()).unwrap_err();
            assert!(error.text.contains(text), "{error}");
        }
    }
}
