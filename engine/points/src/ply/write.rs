//! The writing side: [`PlyWriter`] and [`write_point_ply`].

use super::{BOUNDS_COMMENT, RECORD_PROPERTIES};
use crate::error::PointsError;
use crate::output::OutputFile;
use pbgi_core::{Bounds, PointRecord, PointStream};
use std::io::{self, Seek, SeekFrom, Write};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

/// Numbers of a point of [`PlyForm::Floats`], in file order.
const FLOAT_PROPERTIES: [&str; 17] = [
    "x",
    "y",
    "z",
    "nx",
    "ny",
    "nz",
    "radius",
    "red",
    "green",
    "blue",
    "back_red",
    "back_green",
    "back_blue",
    "albedo_red",
    "albedo_green",
    "albedo_blue",
    "reflecting_sides",
];

/// How points are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PlyForm {
    /// 17 floats, 68 bytes: for any tool that reads PLY.
    Floats,
    /// The 32 bytes of a point record: what a build reads fastest, without loss.
    Records,
}

/// A binary little-endian PLY file of points whose number is not known before. It appears when it is finished.
pub struct PlyWriter {
    path: PathBuf,
    file: OutputFile,
    form: PlyForm,
    extra: Vec<String>,
    count: u64,
    bounds: Bounds,
    row: Vec<u8>,
}

impl PlyWriter {
    /// Starts a file whose points have the numbers named in `extra` (such as `occlusion`) after their own.
    ///
    /// # Errors
    /// The file cannot be made.
    pub fn create(path: &Path, form: PlyForm, extra: &[&str]) -> Result<Self, PointsError> {
        let mut writer = Self {
            path: path.to_owned(),
            file: OutputFile::create(path)?,
            form,
            extra: extra.iter().map(|&name| name.to_owned()).collect(),
            count: 0,
            bounds: Bounds::EMPTY,
            row: Vec::new(),
        };
        writer.write_header().map_err(PointsError::io("write", path))?;
        Ok(writer)
    }

    /// Adds a point.
    ///
    /// # Errors
    /// A failing disk.
    ///
    /// # Panics
    /// If the number of extra values is not that of the names: a bug of the caller.
    pub fn push(&mut self, point: &PointRecord, extra: &[f32]) -> Result<(), PointsError> {
        assert_eq!(extra.len(), self.extra.len(), "a value for every extra property");
        self.row.clear();
        match self.form {
            PlyForm::Records => self.row.extend_from_slice(bytemuck::bytes_of(point)),
            PlyForm::Floats => {
                let (normal, sides) = (point.normal().to_array(), point.sides());
                let reflectance = point.reflectance();
                let reflecting = [if reflectance.both_sides { 2.0 } else { 1.0 }];
                let numbers = [
                    &point.position[..],
                    &normal,
                    &[point.radius],
                    &sides.front,
                    &sides.back,
                    &reflectance.albedo,
                    &reflecting,
                ];
                let bytes = numbers.into_iter().flatten().flat_map(|number| number.to_le_bytes());
                self.row.extend(bytes);
            }
        }
        self.row.extend(extra.iter().flat_map(|number| number.to_le_bytes()));
        self.file
            .write_all(&self.row)
            .map_err(PointsError::io("write", &self.path))?;
        self.count += 1;
        self.bounds.include(point.position);
        Ok(())
    }

    /// Points so far.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Completes the file; the number of points.
    ///
    /// # Errors
    /// A failing disk.
    pub fn finish(mut self) -> Result<u64, PointsError> {
        let rewound = self.file.seek(SeekFrom::Start(0)).map(drop);
        rewound
            .and_then(|()| self.write_header())
            .map_err(PointsError::io("write", &self.path))?;
        self.file.publish()?;
        Ok(self.count)
    }

    /// The header has the same length whatever the count and the box: a comment takes up the difference.
    fn write_header(&mut self) -> io::Result<()> {
        /// Digits of the largest count, and characters of six floats in their shortest exact form.
        const VARIABLE_CHARS: usize = 20 + 6 * 15;
        let count = self.count.to_string();
        let mut bounds = String::new();
        if !self.bounds.is_empty() {
            for number in self.bounds.min.iter().chain(&self.bounds.max) {
                bounds += &format!(" {number:e}");
            }
        }
        let padding = "-".repeat(VARIABLE_CHARS.saturating_sub(count.len() + bounds.len()));
        let mut header = format!(
            "ply\nformat binary_little_endian 1.0\ncomment made by pbgi, radiance is linear {padding}\n\
             comment {BOUNDS_COMMENT}{bounds}\nelement vertex {count}\n"
        );
        match self.form {
            PlyForm::Floats => FLOAT_PROPERTIES
                .iter()
                .for_each(|name| header += &format!("property float {name}\n")),
            PlyForm::Records => RECORD_PROPERTIES
                .iter()
                .for_each(|(kind, name)| header += &format!("property {kind} {name}\n")),
        }
        for name in &self.extra {
            header += &format!("property float {name}\n");
        }
        header += "end_header\n";
        self.file.write_all(header.as_bytes())
    }
}

/// Writes all points of a stream to a binary PLY file; `observer` hears of the points so far after every batch and may stop
/// it. Returns the number of points.
///
/// # Errors
/// Those of the stream, a failing disk, or [`PointsError::Cancelled`]; there is no file then.
pub fn write_point_ply<S>(
    path: &Path,
    form: PlyForm,
    stream: &mut S,
    observer: &mut dyn FnMut(u64) -> ControlFlow<()>,
) -> Result<u64, PointsError>
where
    S: PointStream<Error = PointsError> + ?Sized,
{
    let mut writer = PlyWriter::create(path, form, &[])?;
    let mut batch = Vec::new();
    while stream.next_batch(&mut batch)? {
        batch.iter().try_for_each(|point| writer.push(point, &[]))?;
        batch.clear();
        if observer(writer.count).is_break() {
            return Err(PointsError::Cancelled);
        }
    }
    writer.finish()
}
