//! Options that several commands share, and how their values are read: about daemon, job and files here, about [`points`],
//! [`shading`] and [`camera`] beside.

mod camera;
mod points;
mod shading;

pub(crate) use camera::{CameraArgs, SeenArgs, Size, picture_size};
pub(crate) use points::{CloudArgs, DensityArgs, OctreeArgs, ReadingArgs};
pub(crate) use shading::{PassArgs, QualityArgs};

use super::failure::Failure;
use super::files::{self, Existing};
use clap::Args;
use pbgi_client::JobOptions;
use pbgi_client::private::PrivateOptions;
use pbgi_client::size::parse_bytes;
use pbgi_core::limits;
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

pub(crate) fn positive(text: &str) -> Result<f32, String> {
    match text.parse::<f32>() {
        Ok(value) if value > 0.0 && value.is_finite() => Ok(value),
        _ => Err("it must be a number above 0".to_owned()),
    }
}

/// Three finite numbers with commas between them.
pub(crate) fn triple<T: std::str::FromStr + Copy + Into<f64>>(text: &str) -> Result<[T; 3], String> {
    let numbers: Option<Vec<T>> = text.split(',').map(|word| word.trim().parse().ok()).collect();
    let numbers = numbers.filter(|numbers| numbers.iter().all(|&number| number.into().is_finite()));
    let triple = numbers.and_then(|numbers| <[T; 3]>::try_from(numbers).ok());
    triple.ok_or_else(|| format!("{text:?} is no place: write three numbers with commas, such as 1,2.5,-3"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_read() {
        assert_eq!(triple::<f64>("1, -2.5,3e6"), Ok([1.0, -2.5, 3e6]));
        for text in ["", "1,2", "1,2,3,4", "1,2,x", "1,2,inf", "1,2,nan"] {
            assert!(triple::<f64>(text).is_err(), "{text}");
        }
    }
}
