//! Small scenes for the tests of this crate. Their records are arbitrary: the store does not look inside.

use bytemuck::Zeroable;
use pbgi_core::{
    Bounds, BuildId, BuildSettings, NodeIndex, NodeRecord, PageKind, PageNo, PointRecord, Quantizer, SceneInfo,
};
use pbgi_store::{IoMode, OsVolume, Overwrite, Scene, SceneWriter, StoreError, Volume};
use std::path::Path;
use std::sync::Arc;

pub(crate) fn os_volume() -> Arc<dyn Volume> {
    Arc::new(OsVolume)
}

pub(crate) fn settings() -> BuildSettings {
    BuildSettings {
        nodes_per_page: 16,
        points_per_page: 32,
        ..BuildSettings::default()
    }
}

pub(crate) fn point(i: u32) -> PointRecord {
    let mut point = PointRecord::zeroed();
    point.position = [i as f32, 1.0, 2.0];
    point.radius = 0.5;
    point
}

pub(crate) fn node(i: u32) -> NodeRecord {
    let mut node = NodeRecord::zeroed();
    node.centroid = [i as f32, 3.0, 4.0];
    node
}

pub(crate) fn info(points: u32, nodes: u32, slots: u64, build_id: u128) -> SceneInfo {
    let bounds = Bounds {
        min: [-1.5, 0.1, 0.0],
        max: [1000.25, 1.0, 2.0],
    };
    let filled = points > 0;
    SceneInfo {
        build_id: BuildId(build_id),
        point_count: u64::from(points),
        node_count: u64::from(nodes),
        node_slots: slots,
        root: filled.then(|| NodeIndex(slots as u32 - 1)),
        bounds: filled.then_some(bounds),
        quantizer: filled.then(|| Quantizer::from_bounds(&bounds).unwrap()),
        radius_max: if filled { 0.5 } else { 0.0 },
        origin: [0.0; 3],
        settings: settings(),
    }
}

/// Writes a scene of `points` points and as many nodes, in groups of three; `build_id` sets it apart from others.
pub(crate) fn write(
    volume: &Arc<dyn Volume>,
    path: &Path,
    overwrite: Overwrite,
    points: u32,
    build_id: u128,
) -> Result<SceneInfo, StoreError> {
    let mut writer = SceneWriter::create(volume, path, overwrite, &settings(), IoMode::Direct)?;
    for i in 0..points {
        writer.append_points(&[point(i)])?;
    }
    for first in (0..points).step_by(3) {
        let group: Vec<_> = (first..points.min(first + 3)).map(node).collect();
        writer.append_siblings(&group)?;
    }
    let info = info(points, points, writer.node_slots(), build_id);
    writer.finish(&info)?;
    Ok(info)
}

/// All records of a scene, in file order; padding nodes have a centroid of zero.
pub(crate) fn read(scene: &Scene) -> (Vec<NodeRecord>, Vec<PointRecord>) {
    fn records<T: bytemuck::Pod>(scene: &Scene, kind: PageKind) -> Vec<T> {
        let mut all = Vec::new();
        for page in 0..scene.info().page_count(kind) {
            let mut records = vec![T::zeroed(); scene.info().page_bytes(kind) / size_of::<T>()];
            let bytes = bytemuck::cast_slice_mut(&mut records);
            scene.read_page(kind, PageNo(page as u32), bytes).unwrap();
            all.append(&mut records);
        }
        all
    }
    (records(scene, PageKind::Node), records(scene, PageKind::Point))
}

/// Names in a folder.
pub(crate) fn names(volume: &dyn Volume, dir: &Path) -> Vec<String> {
    let entries = volume.list(dir).unwrap();
    entries
        .into_iter()
        .map(|entry| entry.name.to_string_lossy().into_owned())
        .collect()
}
