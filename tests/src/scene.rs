//! Scene folders: how many pages they have, how to spoil one, all of one in memory.

use pbgi_core::{PageKind, PageNo, SceneInfo};
use pbgi_shade::ArraySource;
use pbgi_store::Scene;
use std::fs::OpenOptions;
use std::os::unix::fs::FileExt;
use std::path::Path;

/// Bytes of a page file's header and of a page's checksum.
const HEADER_BYTES: u64 = 4096;
const CHECKSUM_BYTES: u64 = 4;

fn page_bytes(scene: &Path, file: &str) -> u64 {
    let settings = Scene::open(scene).unwrap().info().settings;
    match file {
        "nodes.pages" => u64::from(settings.nodes_per_page) * size_of::<pbgi_core::NodeRecord>() as u64,
        _ => u64::from(settings.points_per_page) * size_of::<pbgi_core::PointRecord>() as u64,
    }
}

/// Pages of both files of a scene together.
pub fn page_count(scene: &Path) -> u64 {
    let count = |file: &str| {
        let length = std::fs::metadata(scene.join(file)).unwrap().len();
        (length - HEADER_BYTES) / (page_bytes(scene, file) + CHECKSUM_BYTES)
    };
    count("nodes.pages") + count("points.pages")
}

/// Flips one bit in the first record of a page.
pub fn flip_bit(scene: &Path, file: &str, page: u64) {
    let offset = HEADER_BYTES + page * page_bytes(scene, file) + 5;
    let file = OpenOptions::new()
        .read(true)
        .write(true)
        .open(scene.join(file))
        .unwrap();
    let mut byte = [0];
    file.read_exact_at(&mut byte, offset).unwrap();
    byte[0] ^= 0x10;
    file.write_all_at(&byte, offset).unwrap();
}

/// A built scene as plain arrays.
pub fn load(path: &Path) -> (SceneInfo, ArraySource) {
    let scene = Scene::open(path).unwrap();
    let info = scene.info().clone();
    let mut source: ArraySource = ArraySource::default();
    for kind in [PageKind::Node, PageKind::Point] {
        let mut page = vec![0u64; info.page_bytes(kind).div_ceil(8)];
        for number in 0..info.page_count(kind) {
            let bytes: &mut [u8] = &mut bytemuck::cast_slice_mut(&mut page)[..info.page_bytes(kind)];
            scene.read_page(kind, PageNo(number as u32), bytes).unwrap();
            match kind {
                PageKind::Node => source.nodes.extend_from_slice(bytemuck::cast_slice(bytes)),
                PageKind::Point => source.points.extend_from_slice(bytemuck::cast_slice(bytes)),
            }
        }
    }
    source.points.truncate(info.point_count as usize);
    (info, source)
}
