//! Baking onto clouds: receivers know their place, and files come back in their order with all that they had.

#![allow(clippy::unwrap_used, reason = "tests")]

use las::point::Format;
use las::{Color, Point, Reader, Transform, Vector, Vlr, Writer};
use pbgi_core::point::Sides;
use pbgi_core::{Bounds, PointRecord, PointStream};
use pbgi_points::{
    BakeChannel, BakeOptions, BakedValues, CloudOptions, InputOptions, InvalidPoints, LasForm, PlyForm, PointsError,
    Receivers, check_bake, open_input, write_baked, write_point_ply,
};
use std::fs;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

/// Values that tell their place.
fn values_of(place: u64) -> [f32; 7] {
    let part = place as f32 / 1024.0;
    [part, part + 1.0, part + 2.0, part, 0.0, 1.0, 0.0]
}

fn options() -> BakeOptions {
    BakeOptions {
        channels: vec![BakeChannel::Occlusion, BakeChannel::Irradiance],
        las: vec![LasForm::Extra],
        invalid_points: InvalidPoints::Refuse,
    }
}

fn reading(folder: &Path, cloud: CloudOptions) -> InputOptions {
    InputOptions {
        cloud,
        memory_bytes: 8_000_000,
        scratch_dir: folder.to_owned(),
        ..InputOptions::default()
    }
}

/// Bakes [`values_of`] onto a cloud; the places in the order in which the receivers came.
fn bake(input: &Path, output: &Path, cloud: CloudOptions, options: &BakeOptions) -> Result<Vec<u64>, PointsError> {
    let folder = tempfile::tempdir().unwrap();
    let mut receivers = Receivers::open(input, &reading(folder.path(), cloud))?;
    let mut values = BakedValues::create(folder.path(), receivers.count())?;
    let (mut batch, mut places) = (Vec::new(), Vec::new());
    while receivers.next_batch(&mut batch)? {
        for receiver in batch.drain(..) {
            values.put(receiver.place, values_of(receiver.place))?;
            places.push(receiver.place);
        }
    }
    values.flush()?;
    let count = write_baked(input, output, &values, options, &mut |_| ControlFlow::Continue(()))?;
    assert_eq!(count, receivers.count());
    Ok(places)
}

const COUNT: u64 = 500;

/// Scattered, so that the order of the file is not that of the curve.
fn place(index: u64) -> [f32; 3] {
    let spread = |step: u64| (index * step % COUNT) as f32 / COUNT as f32;
    [spread(7), spread(13) * 0.1, spread(31)]
}

fn text_ply(folder: &Path, names: &str, row: impl Fn(u64) -> String) -> PathBuf {
    let mut text = format!("ply\nformat ascii 1.0\ncomment kept as it is\nelement vertex {COUNT}\n");
    for name in names.split_whitespace() {
        text += &format!("property float {name}\n");
    }
    text += "element face 1\nproperty list uchar int vertex_indices\nend_header\n";
    for index in 0..COUNT {
        text += &format!("{}\n", row(index));
    }
    text += "3 0 1 2\n";
    let path = folder.join("in.ply");
    fs::write(&path, text).unwrap();
    path
}

#[test]
fn text_keeps_its_lines_and_gets_numbers_behind_them() {
    let folder = tempfile::tempdir().unwrap();
    let row = |index: u64| {
        let [x, y, z] = place(index);
        format!("{x} {y} {z} 0 1 0 {index}")
    };
    let input = text_ply(folder.path(), "x y z nx ny nz quality", row);
    let output = folder.path().join("out.ply");
    let places = bake(&input, &output, CloudOptions::default(), &options()).unwrap();
    let mut sorted = places.clone();
    sorted.sort_unstable();
    assert_eq!(sorted, (0..COUNT).collect::<Vec<_>>());
    assert_ne!(sorted, places, "receivers come along the curve");
    let text = fs::read_to_string(&output).unwrap();
    let header = "property float quality\nproperty float occlusion\nproperty float irradiance_r\n\
                  property float irradiance_g\nproperty float irradiance_b\nelement face 1\n";
    assert!(
        text.contains(header) && text.contains("comment kept as it is"),
        "{text}"
    );
    let body: Vec<&str> = text.split_once("end_header\n").unwrap().1.lines().collect();
    for index in 0..COUNT {
        let [r, g, b, occlusion, ..] = values_of(index);
        assert_eq!(body[index as usize], format!("{} {occlusion} {r} {g} {b}", row(index)));
    }
    assert_eq!(body[COUNT as usize..], ["3 0 1 2"]);
    // Once more: the numbers are replaced, not added.
    let again = folder.path().join("again.ply");
    bake(&output, &again, CloudOptions::default(), &options()).unwrap();
    let again = fs::read_to_string(&again).unwrap();
    assert_eq!(again.matches("property float occlusion").count(), 1);
    assert_eq!(again, text);
}

#[test]
fn binary_files_of_both_ends_keep_their_bytes() {
    let folder = tempfile::tempdir().unwrap();
    for (format, big) in [("binary_little_endian", false), ("binary_big_endian", true)] {
        let (input, output) = (folder.path().join("in.ply"), folder.path().join("out.ply"));
        let float = |value: f32| {
            let mut bytes = value.to_le_bytes();
            if big {
                bytes.reverse();
            }
            bytes
        };
        let mut bytes = format!(
            "ply\nformat {format} 1.0\nelement before 2\nproperty uchar a\nelement vertex {COUNT}\nproperty float x\n\
             property float y\nproperty float z\nproperty uchar class\nelement after 1\nproperty uchar b\nend_header\n"
        )
        .into_bytes();
        bytes.extend([7, 8]);
        for index in 0..COUNT {
            place(index).iter().for_each(|&value| bytes.extend(float(value)));
            bytes.push(index as u8);
        }
        bytes.push(9);
        fs::write(&input, &bytes).unwrap();
        bake(&input, &output, CloudOptions::default(), &options()).unwrap();
        let written = fs::read(&output).unwrap();
        let start = written.windows(11).position(|text| text == b"end_header\n").unwrap() + 11;
        let old = bytes.windows(11).position(|text| text == b"end_header\n").unwrap() + 11;
        assert_eq!(written[start..start + 2], [7, 8]);
        assert_eq!(written.last(), Some(&9));
        let (from, to) = (&bytes[old + 2..], &written[start + 2..]);
        for (index, (from, to)) in (0..COUNT).zip(from.chunks(13).zip(to.chunks(13 + 16))) {
            assert_eq!(from, &to[..13]);
            let [r, g, b, occlusion, ..] = values_of(index);
            let expected: Vec<u8> = [occlusion, r, g, b].into_iter().flat_map(float).collect();
            assert_eq!(to[13..], expected, "point {index}");
        }
    }
}

#[test]
fn points_that_cannot_be_used_are_refused_or_get_zeros() {
    let folder = tempfile::tempdir().unwrap();
    let row = |index: u64| {
        let [x, y, z] = place(index);
        let x = if index == 3 { f32::NAN } else { x };
        format!("{x} {y} {z} 0 1 0")
    };
    let input = text_ply(folder.path(), "x y z nx ny nz", row);
    let output = folder.path().join("out.ply");
    let refused = bake(&input, &output, CloudOptions::default(), &options()).unwrap_err();
    assert!(refused.to_string().contains("point 3 of 500"), "{refused}");
    assert!(fs::metadata(&output).is_err());
    let cloud = CloudOptions {
        invalid_points: InvalidPoints::Skip,
        ..CloudOptions::default()
    };
    bake(&input, &output, cloud, &options()).unwrap();
    let text = fs::read_to_string(&output).unwrap();
    let body: Vec<&str> = text.split_once("end_header\n").unwrap().1.lines().collect();
    assert_eq!(body[3], format!("{} 0 0 0 0", row(3)));
    assert!(body[4].ends_with(&format!(" {}", values_of(4)[2])));
}

/// Points of our own records, which have no room for more numbers.
struct Records(Vec<PointRecord>);

impl PointStream for Records {
    type Error = PointsError;

    fn bounds(&self) -> Option<Bounds> {
        None
    }

    fn len_hint(&self) -> Option<u64> {
        None
    }

    fn next_batch(&mut self, batch: &mut Vec<PointRecord>) -> Result<bool, PointsError> {
        batch.append(&mut self.0);
        Ok(!batch.is_empty())
    }

    fn rewind(&mut self) -> Result<(), PointsError> {
        Ok(())
    }
}

#[test]
fn records_become_floats_with_their_light() {
    let folder = tempfile::tempdir().unwrap();
    let (input, output) = (folder.path().join("in.ply"), folder.path().join("out.ply"));
    let sides = Sides {
        front: [0.5, 0.25, 2.0],
        back: [0.0, 0.125, 0.0],
    };
    let record = |index| PointRecord::new(place(index), [0.6, 0.8, 0.0], 0.01, sides).unwrap();
    let records: Vec<PointRecord> = (0..COUNT).map(record).collect();
    write_point_ply(&input, PlyForm::Records, &mut Records(records.clone()), &mut |_| {
        ControlFlow::Continue(())
    })
    .unwrap();
    bake(&input, &output, CloudOptions::default(), &options()).unwrap();
    let mut read = Vec::new();
    let mut stream = open_input(&[output], &InputOptions::default()).unwrap();
    while stream.next_batch(&mut read).unwrap() {}
    assert_eq!(read, records);
}

fn las(folder: &Path, name: &str, format: u8, extra: u16) -> PathBuf {
    let transform = |offset| Transform { scale: 0.001, offset };
    let mut builder = las::Builder::from((1, 4));
    builder.point_format = Format::new(format).unwrap();
    builder.point_format.extra_bytes = extra;
    builder.transforms = Vector {
        x: transform(600_000.0),
        y: transform(0.0),
        z: transform(0.0),
    };
    builder.vlrs.push(Vlr {
        user_id: "somebody".to_owned(),
        record_id: 7,
        description: String::new(),
        data: vec![1, 2, 3],
    });
    let path = folder.join(name);
    let mut writer = Writer::from_path(&path, builder.into_header().unwrap()).unwrap();
    for index in 0..COUNT {
        let [x, y, z] = place(index).map(f64::from);
        let format = *writer.header().point_format();
        let point = Point {
            x: 600_000.0 + x * 100.0,
            y: z * 100.0,
            z: y * 100.0,
            intensity: index as u16,
            user_data: (index % 256) as u8,
            gps_time: format.has_gps_time.then_some(index as f64),
            color: format.has_color.then(|| Color::new(40_000, 20_000, index as u16)),
            extra_bytes: vec![(index % 251) as u8; usize::from(extra)],
            ..Point::default()
        };
        writer.write_point(point).unwrap();
    }
    writer.close().unwrap();
    path
}

fn points(path: &Path) -> (las::Header, Vec<Point>) {
    let mut reader = Reader::from_path(path).unwrap();
    let header = reader.header().clone();
    let data = reader.read_all().unwrap();
    (header, data.points().map(Result::unwrap).collect())
}

#[test]
fn las_and_laz_keep_every_attribute_and_get_dimensions() {
    let folder = tempfile::tempdir().unwrap();
    for (name, format, extra) in [("a.las", 1, 0), ("b.laz", 3, 0), ("c.las", 7, 3), ("d.laz", 6, 0)] {
        let input = las(folder.path(), name, format, extra);
        for output in ["out.las", "out.laz"] {
            let output = folder.path().join(output);
            bake(&input, &output, CloudOptions::default(), &options()).unwrap();
            let ((before, old), (after, new)) = (points(&input), points(&output));
            assert_eq!(before.transforms(), after.transforms());
            // A header may be rounded to fewer digits than its points.
            let corner = |header: &las::Header| [header.bounds().max.x, header.bounds().max.y, header.bounds().max.z];
            let near = |(a, b): (f64, f64)| (a - b).abs() < 0.002;
            assert!(corner(&before).into_iter().zip(corner(&after)).all(near));
            assert!(
                after
                    .vlrs()
                    .iter()
                    .any(|vlr| vlr.user_id == "somebody" && vlr.data == [1, 2, 3])
            );
            let described = after
                .vlrs()
                .iter()
                .find(|vlr| vlr.user_id == "LASF_Spec" && vlr.record_id == 4);
            let described = &described.unwrap().data;
            assert_eq!(described.len(), 192 * (4 + usize::from(extra > 0)));
            let last = &described[described.len() - 192..];
            assert_eq!((last[2], &last[4..16]), (9, &b"irradiance_b"[..]));
            for (index, (old, new)) in (0..).zip(old.iter().zip(&new)) {
                let [r, g, b, occlusion, ..] = values_of(index);
                let numbers: Vec<u8> = [occlusion, r, g, b]
                    .iter()
                    .flat_map(|number| number.to_le_bytes())
                    .collect();
                let expected = Point {
                    extra_bytes: [old.extra_bytes.clone(), numbers].concat(),
                    ..old.clone()
                };
                assert_eq!(*new, expected, "{name} {index}");
            }
        }
    }
    // Once more: the dimensions are replaced, not added.
    let output = folder.path().join("again.laz");
    bake(
        &folder.path().join("out.laz"),
        &output,
        CloudOptions::default(),
        &options(),
    )
    .unwrap();
    assert_eq!(points(&output).1, points(&folder.path().join("out.laz")).1);
}

#[test]
fn las_carries_visibility_as_intensity_and_in_its_colours() {
    let folder = tempfile::tempdir().unwrap();
    let options = BakeOptions {
        las: vec![LasForm::Intensity, LasForm::Rgb],
        ..options()
    };
    for (name, format) in [("coloured.las", 3), ("plain.las", 1)] {
        let input = las(folder.path(), name, format, 0);
        let output = folder.path().join("out.las");
        bake(&input, &output, CloudOptions::default(), &options).unwrap();
        let ((_, old), (header, new)) = (points(&input), points(&output));
        assert_eq!(
            (header.point_format().has_color, header.point_format().extra_bytes),
            (true, 0)
        );
        for (index, (old, new)) in (0..).zip(old.iter().zip(&new)) {
            let visible = 1.0 - values_of(index)[3];
            assert_eq!(new.intensity, (visible * 65_535.0).round() as u16);
            assert_eq!(
                (new.x, new.gps_time, new.user_data),
                (old.x, old.gps_time, old.user_data)
            );
            let (before, after) = (old.color.map_or(65_535, |colour| colour.red), new.color.unwrap().red);
            assert!(
                after <= before && (visible < 1.0 || after == before),
                "{before} {after} {visible}"
            );
        }
    }
}

#[test]
fn what_cannot_be_written_is_said_before_work_begins() {
    for (input, output, word) in [
        ("a.las", "b.ply", ".las or .laz"),
        ("a.ply", "b.las", ".ply"),
        ("a.ptc", "b.ptc", ".ply"),
        ("a.glb", "b.ply", "mesh"),
    ] {
        let text = check_bake(Path::new(input), Path::new(output)).unwrap_err().to_string();
        assert!(text.contains(word), "{text}");
    }
    for (input, output) in [("a.laz", "b.las"), ("a.ply", "b.ply"), ("a.pbgi", "b.ply")] {
        check_bake(Path::new(input), Path::new(output)).unwrap();
    }
}
