//! The writing side: [`PlyWriter`] and [`write_point_ply`].

use crate::error::PointsError;
use crate::output::OutputFile;
use pbgi_core::{PointRecord, PointStream};
use std::io::{self, Seek, SeekFrom, Write};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

/// Numbers of a point, in file order.
const PROPERTIES: [&str; 13] = [
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
];

/// A binary little-endian PLY file of points whose number is not known before. It appears when it is finished.
pub struct PlyWriter {
    path: PathBuf,
    file: OutputFile,
    extra: Vec<String>,
    count: u64,
    row: Vec<u8>,
}

impl PlyWriter {
    /// Starts a file whose points have the numbers named in `extra` (such as `occlusion`) after their own.
    ///
    /// # Errors
    /// The file cannot be made.
    pub fn create(path: &Path, extra: &[&str]) -> Result<Self, PointsError> {
        let mut writer = Self {
            path: path.to_owned(),
            file: OutputFile::create(path)?,
            extra: extra.iter().map(|&name| name.to_owned()).collect(),
            count: 0,
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
        let (normal, sides) = (point.normal().to_array(), point.sides());
        self.row.clear();
        let numbers = [
            &point.position[..],
            &normal,
            &[point.radius],
            &sides.front,
            &sides.back,
            extra,
        ];
        for number in numbers.into_iter().flatten() {
            self.row.extend_from_slice(&number.to_le_bytes());
        }
        self.file
            .write_all(&self.row)
            .map_err(PointsError::io("write", &self.path))?;
        self.count += 1;
        Ok(())
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

    /// The header has the same length whatever the count: a comment takes up the difference.
    fn write_header(&mut self) -> io::Result<()> {
        const DIGITS: usize = 20;
        let count = self.count.to_string();
        let padding = "-".repeat(DIGITS - count.len().min(DIGITS));
        let mut header = format!(
            "ply\nformat binary_little_endian 1.0\ncomment made by pbgi, radiance is linear {padding}\nelement vertex {count}\n"
        );
        for name in PROPERTIES.into_iter().chain(self.extra.iter().map(String::as_str)) {
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
    stream: &mut S,
    observer: &mut dyn FnMut(u64) -> ControlFlow<()>,
) -> Result<u64, PointsError>
where
    S: PointStream<Error = PointsError> + ?Sized,
{
    let mut writer = PlyWriter::create(path, &[])?;
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
