//! The points of a built scene (`NAME.pbgi`), to be built again with other settings or together with others.

use super::{Cloud, CloudOptions, Door, Missing, relative};
use crate::error::PointsError;
use pbgi_core::{Bounds, PageKind, PageNo, PointRecord, PointStream};
use pbgi_store::Scene;
use std::path::Path;

/// A scene as a stream of points, in the order of its file.
pub(crate) struct ScenePoints {
    scene: Scene,
    page: Vec<PointRecord>,
    next: u64,
    door: Door,
    origin: [f64; 3],
}

impl ScenePoints {
    pub(crate) fn open(path: &Path, origin: [f64; 3], options: &CloudOptions) -> Result<Self, PointsError> {
        let scene = Scene::open(path)?;
        let info = scene.info();
        Ok(Self {
            page: vec![bytemuck::Zeroable::zeroed(); info.settings.points_per_page as usize],
            door: Door::new(path, info.point_count, options),
            scene,
            next: 0,
            origin,
        })
    }
}

impl PointStream for ScenePoints {
    type Error = PointsError;

    fn bounds(&self) -> Option<Bounds> {
        let bounds = self.scene.info().bounds.unwrap_or(Bounds::EMPTY);
        let moved = |corner: [f32; 3]| relative(corner.map(f64::from), self.origin);
        Some(Bounds {
            min: moved(bounds.min),
            max: moved(bounds.max),
        })
    }

    fn len_hint(&self) -> Option<u64> {
        Some(self.scene.info().point_count)
    }

    fn origin(&self) -> [f64; 3] {
        self.scene.info().origin
    }

    fn next_batch(&mut self, batch: &mut Vec<PointRecord>) -> Result<bool, PointsError> {
        let info = self.scene.info();
        if self.next == info.page_count(PageKind::Point) {
            self.door.close()?;
            return Ok(false);
        }
        let number = PageNo(self.next as u32);
        self.scene
            .read_page(PageKind::Point, number, bytemuck::cast_slice_mut(&mut self.page))?;
        let left = info.point_count - self.next * u64::from(info.settings.points_per_page);
        for point in self.page.iter().take(left.min(self.page.len() as u64) as usize) {
            let moved = PointRecord {
                position: relative(point.position.map(f64::from), self.origin),
                ..*point
            };
            self.door.take(moved.validate().map(|()| moved), batch);
        }
        self.next += 1;
        Ok(true)
    }

    fn rewind(&mut self) -> Result<(), PointsError> {
        self.next = 0;
        self.door.rewind();
        Ok(())
    }
}

impl Cloud for ScenePoints {
    fn missing(&self) -> Missing {
        Missing::default()
    }

    fn skipped(&self) -> u64 {
        self.door.skipped()
    }

    fn number(&mut self) {
        self.door.number();
    }
}
