//! Pictures in and out.

#![allow(clippy::unwrap_used, reason = "a step that fails is a test that fails")]

mod common;

use common::{assert_says, mutate, shared};
use pbgi_points::{LayeredImage, Precision, ToneMap, Window, read_environment, write_png};
use std::fs;
use std::path::Path;

#[test]
fn layers_metadata_windows_and_precision_survive_a_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("out.exr");
    let data = Window {
        x: 3,
        y: -2,
        width: 70,
        height: 45,
    };
    let mut image = LayeredImage::with_windows(data, Window::of_size(200, 100));
    let ramp: Vec<[f32; 3]> = (0..data.pixel_count())
        .map(|i| [i as f32, 0.1, 1.0 / (i + 1) as f32])
        .collect();
    image.add_rgb("", Precision::Half, &vec![[0.5, 0.25, 2.0]; data.pixel_count()]);
    image.add_rgb(
        "indirect",
        Precision::Half,
        &vec![[1.0, 0.0, 65504.0]; data.pixel_count()],
    );
    image.add_xyz("P", Precision::Float, &ramp);
    image.add("occlusion.Z", Precision::Half, vec![0.75; data.pixel_count()]);
    image.metadata.insert("pbgi/points".to_owned(), "12345".to_owned());
    image
        .metadata
        .insert("pbgi/settings".to_owned(), "{\"max_solid_angle\": 0.05}".to_owned());
    image.write_exr(&path).unwrap();
    let read = LayeredImage::read_exr(&path).unwrap();
    assert_eq!(
        (read.data_window, read.display_window),
        (image.data_window, image.display_window)
    );
    assert_eq!(read.channels, image.channels);
    for (key, value) in &image.metadata {
        assert_eq!(read.metadata.get(key), Some(value));
    }
    assert_eq!(read.triple("P").unwrap(), ramp);
    assert_eq!(read.triple("").unwrap()[7], [0.5, 0.25, 2.0]);
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "no temporary stays");
    let some = LayeredImage::read_exr_channels(&path, |name| name.starts_with("P.")).unwrap();
    assert_eq!(some.channels.len(), 3);
}

#[test]
fn pictures_are_not_made_where_they_cannot_be() {
    let path = Path::new("/nowhere/at/all.exr");
    let mut image = LayeredImage::new(2, 2);
    image.add("A", Precision::Half, vec![1.0; 4]);
    assert_says(image.write_exr(path), &["No such file", "/nowhere/at"]);
    assert_says(
        write_png(path, 1, 1, &[[0.0; 3]], ToneMap::Exposure(1.0)),
        &["No such file", "/nowhere/at"],
    );
}

#[test]
fn light_probes_are_read_from_both_formats() {
    for name in ["kiara_1_dawn_1k.hdr", "courtyard.exr"] {
        let Some(path) = shared(&format!("data/{name}")) else {
            continue;
        };
        let probe = read_environment(&path).unwrap();
        assert_eq!((probe.width(), probe.height()), (1024, 512));
        let at = |row: usize| probe.pixels()[row * 1024 + 560].iter().sum::<f32>();
        assert!(at(150) > 2.0 * at(450), "the sky is up: {} {}", at(150), at(450));
    }
}

#[test]
fn bad_light_probes_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("probe.exr");
    assert_says(read_environment(&path), &["cannot open", "probe.exr"]);
    let other = folder.path().join("a.tiff");
    std::fs::write(&other, b"II*\0").unwrap();
    assert_says(read_environment(&other), &["unknown kind", "convert", "a.tiff"]);
    let mut image = LayeredImage::new(4, 2);
    image.add("Y", Precision::Float, vec![1.0; 8]);
    image.write_exr(&path).unwrap();
    assert_says(read_environment(&path), &["R, G and B", "probe.exr"]);
    let mut pixels = vec![[1.0f32, 2.0, -0.5]; 8];
    image.add_rgb("sky", Precision::Float, &pixels);
    image.write_exr(&path).unwrap();
    assert_eq!(
        read_environment(&path).unwrap().pixels()[5],
        [1.0, 2.0, 0.0],
        "below zero is black"
    );
    pixels[6] = [f32::NAN; 3];
    image.add_rgb("", Precision::Float, &pixels);
    image.write_exr(&path).unwrap();
    assert_says(read_environment(&path), &["pixel (2, 1)", "not finite", "probe.exr"]);
    let hdr = folder.path().join("probe.hdr");
    fs::write(&hdr, b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 100000 +X 100000\n").unwrap();
    assert_says(read_environment(&hdr), &["number of pixels", "probe.hdr"]);
    fs::write(&hdr, b"#?not a picture").unwrap();
    assert_says(read_environment(&hdr), &["not a usable HDR", "probe.hdr"]);
}

#[test]
fn mutations_of_an_exr_file_are_survived() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.exr");
    let mut image = LayeredImage::new(40, 40);
    image.add_xyz("P", Precision::Float, &vec![[1.0, 2.0, 3.0]; 1600]);
    image.add("A", Precision::Half, vec![1.0; 1600]);
    image.write_exr(&path).unwrap();
    let bytes = fs::read(&path).unwrap();
    mutate(&bytes, 0..bytes.len(), 400, |broken| {
        fs::write(&path, broken).unwrap();
        drop(LayeredImage::read_exr(&path));
    });
}
