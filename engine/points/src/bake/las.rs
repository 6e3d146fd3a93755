//! A file of the LAS family once more, with what was baked: [`copy_las`].
//!
//! Records are carried over byte for byte; what is added goes into extra dimensions (described in the record `LASF_Spec` 4),
//! the intensity or the colours. What makes a file a COPC file is left out: its index would not fit the new records.

use super::values::Rows;
use super::{BakeOptions, LasForm, sky_visibility};
use crate::cloud::las::{damaged, open, white_of};
use crate::cloud::{linear_from_srgb, srgb_from_linear};
use crate::error::PointsError;
use crate::limits;
use crate::output::OutputFile;
use las::point::Format;
use las::{Builder, PointData, PointDataBuilder, Vlr, Writer};
use std::io::{self, Seek, SeekFrom, Write};
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

/// Where the intensity lies in a record of any format.
const INTENSITY_AT: usize = 12;
const COLOUR_BYTES: usize = 6;
/// A description of an extra dimension.
const DIMENSION_BYTES: usize = 192;
const FLOAT_TYPE: u8 = 9;
const SPEC: &str = "LASF_Spec";
const EXTRA_BYTES_RECORD: u16 = 4;

/// Writes `input` to `output` with the values of `rows`, one a point.
pub(super) fn copy_las(
    input: &Path,
    output: &Path,
    rows: &mut Rows<'_>,
    options: &BakeOptions,
) -> Result<(), PointsError> {
    let mut reader = open(input)?;
    let unfit = |error: las::Error| PointsError::unsupported(output, error.to_string(), "bake other forms (--as)");
    let count = reader.header().number_of_points();
    let mut builder = Builder::from(reader.header().clone());
    let mut extra = Extra::of(&builder);
    let plan = Plan::new(&builder.point_format, &mut extra, options);
    builder.vlrs.retain(|vlr| !is_replaced(vlr));
    builder.evlrs.retain(|vlr| !is_replaced(vlr));
    if builder.evlrs.is_empty() {
        builder.point_padding.clear();
    }
    builder.point_format.extra_bytes = extra.bytes() as u16;
    builder.vlrs.extend(extra.record());
    builder.point_format.has_color |= plan.takes(LasForm::Rgb);
    builder.point_format.is_compressed = crate::open::extension(output) == "laz";
    let header = builder.into_header().map_err(unfit)?;
    let layout = PointDataBuilder::new().for_header(&header);
    let sink = Sink::create(output)?;
    let mut writer = Writer::new(sink.clone(), header).map_err(unfit)?;
    let (mut left, mut white) = (count, None);
    while left > 0 {
        let batch = reader.read_points(left.min(limits::BATCH_POINTS as u64));
        let batch = batch.map_err(|error| damaged(input, error))?;
        if batch.is_empty() {
            let what = format!("file is truncated: expected {count} points, found {}", count - left);
            return Err(PointsError::invalid(input, what));
        }
        let white = *white.get_or_insert_with(|| f64::from(white_of(&batch)));
        let records = layout
            .clone()
            .build_from_bytes(plan.records(&batch, rows, options, white)?);
        let written = records.and_then(|records| writer.write_points(&records));
        written.map_err(unfit)?;
        sink.check()?;
        left -= batch.len() as u64;
    }
    writer.close().map_err(unfit)?;
    drop(writer);
    sink.publish()
}

/// What readers of the old records needed.
fn is_replaced(vlr: &Vlr) -> bool {
    let is = |user: &str, record| vlr.user_id == user && vlr.record_id == record;
    is(SPEC, EXTRA_BYTES_RECORD) || vlr.user_id == "copc" || vlr.user_id == "laszip encoded"
}

/// Extra dimensions of a file: their descriptions.
struct Extra(Vec<[u8; DIMENSION_BYTES]>);

impl Extra {
    fn of(builder: &Builder) -> Self {
        let is_record = |vlr: &&Vlr| vlr.user_id == SPEC && vlr.record_id == EXTRA_BYTES_RECORD;
        let record = builder.vlrs.iter().chain(&builder.evlrs).find(is_record);
        let described = record.map_or(&[][..], |record| record.data.as_chunks::<DIMENSION_BYTES>().0);
        let mut extra = Self(described.to_vec());
        let bytes = usize::from(builder.point_format.extra_bytes);
        if extra.bytes() > bytes {
            // Descriptions of bytes that are not there.
            extra.0.clear();
        }
        while extra.bytes() < bytes {
            // Bytes that nobody describes: undocumented ones, as the format has it.
            let mut dimension = [0; DIMENSION_BYTES];
            dimension[3] = (bytes - extra.bytes()).min(usize::from(u8::MAX)) as u8;
            extra.0.push(dimension);
        }
        extra
    }

    fn bytes(&self) -> usize {
        self.0.iter().map(dimension_bytes).sum()
    }

    /// The place of a float dimension of this name among the extra bytes; it is added where there is none.
    fn place(&mut self, name: &str) -> usize {
        let mut at = 0;
        for dimension in &self.0 {
            if dimension[2] == FLOAT_TYPE && dimension_name(dimension) == name.as_bytes() {
                return at;
            }
            at += dimension_bytes(dimension);
        }
        let mut dimension = [0; DIMENSION_BYTES];
        dimension[2] = FLOAT_TYPE;
        dimension[4..4 + name.len()].copy_from_slice(name.as_bytes());
        self.0.push(dimension);
        at
    }

    fn record(self) -> Option<Vlr> {
        (!self.0.is_empty()).then(|| Vlr {
            user_id: SPEC.to_owned(),
            record_id: EXTRA_BYTES_RECORD,
            description: "Extra dimensions".to_owned(),
            data: self.0.concat(),
        })
    }
}

fn dimension_name(dimension: &[u8; DIMENSION_BYTES]) -> &[u8] {
    let name = &dimension[4..36];
    let end = name.iter().position(|&byte| byte == 0).unwrap_or(name.len());
    &name[..end]
}

fn dimension_bytes(dimension: &[u8; DIMENSION_BYTES]) -> usize {
    const SIZES: [usize; 10] = [1, 1, 2, 2, 4, 4, 8, 8, 4, 8];
    match dimension[2] {
        0 => usize::from(dimension[3]),
        // From 11 on come pairs, from 21 on triples.
        kind => {
            let kind = usize::from(kind) - 1;
            SIZES[kind % SIZES.len()] * (kind / SIZES.len() + 1)
        }
    }
}

/// How an old record becomes a new one.
struct Plan {
    forms: Vec<LasForm>,
    /// Where the colour lies, and whether it has to be put there first.
    colour_at: usize,
    has_colour: bool,
    /// Where numbers lie in the new record.
    places: Vec<usize>,
    record_bytes: usize,
}

impl Plan {
    fn new(format: &Format, extra: &mut Extra, options: &BakeOptions) -> Self {
        let mut base = usize::from(format.len()) - usize::from(format.extra_bytes);
        if options.las.contains(&LasForm::Rgb) && !format.has_color {
            base += COLOUR_BYTES;
        }
        let names = options.channels.iter().flat_map(|channel| channel.names());
        let wanted = names.filter(|_| options.las.contains(&LasForm::Extra));
        let places = wanted.map(|name| base + extra.place(name)).collect();
        Self {
            forms: options.las.clone(),
            colour_at: match (format.is_extended, format.has_gps_time) {
                (true, _) => 30,
                (false, true) => 28,
                (false, false) => 20,
            },
            has_colour: format.has_color,
            places,
            record_bytes: base + extra.bytes(),
        }
    }

    fn takes(&self, form: LasForm) -> bool {
        self.forms.contains(&form)
    }

    fn records(
        &self,
        batch: &PointData,
        rows: &mut Rows<'_>,
        options: &BakeOptions,
        white: f64,
    ) -> Result<Vec<u8>, PointsError> {
        let mut bytes = Vec::with_capacity(batch.len() * self.record_bytes);
        let mut numbers = Vec::new();
        for old in batch.raw_bytes().chunks_exact(batch.record_len()) {
            let start = bytes.len();
            let baked = rows.next()?;
            if self.takes(LasForm::Rgb) && !self.has_colour {
                bytes.extend_from_slice(&old[..self.colour_at]);
                bytes.extend_from_slice(&[u8::MAX; COLOUR_BYTES]);
                bytes.extend_from_slice(&old[self.colour_at..]);
            } else {
                bytes.extend_from_slice(old);
            }
            bytes.resize(start + self.record_bytes, 0);
            let record = &mut bytes[start..];
            let visible = sky_visibility(baked);
            if self.takes(LasForm::Intensity) {
                put(
                    record,
                    INTENSITY_AT,
                    ((visible * 65_535.0).round() as u16).to_le_bytes(),
                );
            }
            if self.takes(LasForm::Rgb) {
                darken(&mut record[self.colour_at..][..COLOUR_BYTES], visible, white);
            }
            if self.takes(LasForm::Extra) {
                numbers.clear();
                options
                    .channels
                    .iter()
                    .for_each(|channel| channel.push(baked, &mut numbers));
                for (&place, number) in self.places.iter().zip(&numbers) {
                    put(record, place, number.to_le_bytes());
                }
            }
        }
        Ok(bytes)
    }
}

fn put<const N: usize>(record: &mut [u8], at: usize, bytes: [u8; N]) {
    record[at..at + N].copy_from_slice(&bytes);
}

/// Multiplies sRGB colours in linear light.
fn darken(colour: &mut [u8], visible: f32, white: f64) {
    for level in colour.as_chunks_mut::<2>().0 {
        let linear = linear_from_srgb(f64::from(u16::from_le_bytes(*level)) / white);
        let dark = srgb_from_linear(linear * f64::from(visible)) * white;
        *level = (dark.round() as u16).to_le_bytes();
    }
}

/// The output, for a writer that must never see it fail: it would panic when it is dropped. What went wrong is kept.
#[derive(Clone)]
struct Sink(Arc<Mutex<State>>);

struct State {
    file: Option<OutputFile>,
    error: Option<PointsError>,
    path: std::path::PathBuf,
    position: u64,
}

impl Sink {
    fn create(path: &Path) -> Result<Self, PointsError> {
        let state = State {
            file: Some(OutputFile::create(path)?),
            error: None,
            path: path.to_owned(),
            position: 0,
        };
        Ok(Self(Arc::new(Mutex::new(state))))
    }

    fn state(&self) -> std::sync::MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The first thing that went wrong.
    fn check(&self) -> Result<(), PointsError> {
        self.state().error.take().map_or(Ok(()), Err)
    }

    fn publish(self) -> Result<(), PointsError> {
        self.check()?;
        let file = self.state().file.take();
        file.map_or(Ok(()), OutputFile::publish)
    }
}

impl State {
    /// Does something with the file, unless something failed before.
    fn attempt<T>(&mut self, work: impl FnOnce(&mut OutputFile) -> io::Result<T>) -> Option<T> {
        let done = work(self.file.as_mut()?);
        match done {
            Ok(value) => Some(value),
            Err(error) => {
                self.error = Some(PointsError::io("write", &self.path)(error));
                self.file = None;
                None
            }
        }
    }
}

impl Write for Sink {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut state = self.state();
        state.attempt(|file| file.write_all(bytes));
        state.position += bytes.len() as u64;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.state().attempt(Write::flush);
        Ok(())
    }
}

impl Seek for Sink {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let mut state = self.state();
        let position = match state.attempt(|file| file.seek(to)) {
            Some(position) => position,
            // A place that makes sense will do for a file that is given up.
            None => match to {
                SeekFrom::Start(position) => position,
                SeekFrom::Current(_) | SeekFrom::End(_) => state.position,
            },
        };
        state.position = position;
        Ok(position)
    }
}
