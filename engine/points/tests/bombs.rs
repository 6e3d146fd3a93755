//! EXR files that announce more than they should: refused from their headers, before memory is taken. Alone in its program, because
//! it measures that.

#![allow(clippy::unwrap_used, reason = "a step that fails is a test that fails")]

use pbgi_points::{GBuffer, LayeredImage, Precision, read_environment};
use std::fs;

/// Most memory that the process ever had, bytes.
fn peak_bytes() -> u64 {
    let status = fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find(|line| line.starts_with("VmHWM:")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap() << 10
}

/// Puts `value` over the bytes of an attribute, `offset` behind its start.
fn patch(bytes: &mut [u8], attribute: &[u8], offset: usize, value: &[u8]) {
    let at = bytes
        .windows(attribute.len())
        .position(|window| window == attribute)
        .unwrap();
    let start = at + attribute.len() + offset;
    bytes[start..start + value.len()].copy_from_slice(value);
}

fn words(values: &[i32]) -> Vec<u8> {
    values.iter().flat_map(|value| value.to_le_bytes()).collect()
}

#[test]
fn exr_bombs_are_refused_before_memory_is_taken() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bomb.exr");
    let mut image = LayeredImage::new(64, 64);
    image.add_xyz("P", Precision::Float, &vec![[1.0, 2.0, 3.0]; 4096]);
    image.add_xyz("N", Precision::Float, &vec![[0.0, 1.0, 0.0]; 4096]);
    image.metadata.insert("note".to_owned(), "x".repeat(100));
    image.write_exr(&path).unwrap();
    let sound = fs::read(&path).unwrap();
    let (size, window) = (4, b"dataWindow\0box2i\0".as_slice());
    let bombs: [(&str, &[u8], usize, Vec<u8>); 9] = [
        ("2^30 pixels", window, size, words(&[0, 0, 32_767, 32_767])),
        (
            "2^62 pixels",
            window,
            size,
            words(&[i32::MIN / 2, i32::MIN / 2, i32::MAX / 2, i32::MAX / 2]),
        ),
        ("a window inside out", window, size, words(&[10, 10, -10, -10])),
        ("2^28 pixels, one chunk", window, size, words(&[0, 0, 16_383, 16_383])),
        (
            "tiles of 2^15 by 2^15",
            b"tiles\0tiledesc\0",
            size,
            words(&[32_768, 32_768]),
        ),
        ("tiles of 0 pixels", b"tiles\0tiledesc\0", size, words(&[0, 0])),
        ("2^31 chunks", b"chunkCount\0int\0", size, words(&[i32::MAX])),
        ("a text of 2 GiB", b"note\0string\0", 0, words(&[i32::MAX])),
        (
            "a list of channels of 2 GiB",
            b"channels\0chlist\0",
            0,
            words(&[i32::MAX]),
        ),
    ];
    let before = peak_bytes();
    for (name, attribute, offset, value) in &bombs {
        let mut bytes = sound.clone();
        patch(&mut bytes, attribute, *offset, value);
        fs::write(&path, &bytes).unwrap();
        let errors = [
            GBuffer::read(&path).map(drop).unwrap_err(),
            LayeredImage::read_exr(&path).map(drop).unwrap_err(),
            read_environment(&path).map(drop).unwrap_err(),
        ];
        for error in errors {
            assert!(error.to_string().contains("bomb.exr"), "{name}: {error}");
        }
    }
    let growth = (peak_bytes() - before) >> 20;
    println!("RELIABILITY D16: {} bombs refused, {growth} MiB taken", bombs.len());
    assert!(growth < 64, "{growth} MiB");
}
