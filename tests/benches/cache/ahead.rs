//! What asking ahead is worth: the same picture with what the walk knows of its way and without them, in a cache that holds a part of the scene.

use crate::costs::{MOUNT, owner, with_worker};
use crate::policy::tiles;
use crate::town::Town;
use pbgi_core::{NodeIndex, NodeRecord, PageKind, PointIndex, PointRecord, ShadeSettings};
use pbgi_proto::v1::TileCounters;
use pbgi_shade::{SceneSource, Shaded, Shader, SourceError, Upcoming};
use pbgi_store::Scene;
use pbgi_worker::pages::{PageSource, SceneView};
use std::time::Instant;

const SIZE: (u32, u32) = (64, 64);

/// A source that keeps what the walk knows to itself.
struct Deaf<'a, 'b>(&'a mut PageSource<'b>);

impl SceneSource for Deaf<'_, '_> {
    fn node(&mut self, index: NodeIndex, receivers: u8, _: &impl Upcoming) -> Result<&NodeRecord, SourceError> {
        self.0.node(index, receivers, &())
    }

    fn points(
        &mut self,
        first: PointIndex,
        count: u32,
        receivers: u8,
        _: &impl Upcoming,
    ) -> Result<&[PointRecord], SourceError> {
        self.0.points(first, count, receivers, &())
    }

    fn begin_pack(&mut self) {
        self.0.begin_pack();
    }
}

/// The counters, and the seconds.
fn shade(scene: &Scene, share: f64, hints: bool) -> (TileCounters, f64) {
    let info = scene.info();
    let receivers = Town::new(info.point_count).receivers(SIZE.0, SIZE.1);
    let frames = |kind| ((info.page_count(kind) as f64 * share) as u32).max(16);
    let owner = owner(info, frames(PageKind::Node), frames(PageKind::Point));
    with_worker(&owner, scene, |mut pages| {
        let mut view = SceneView::new(info, MOUNT);
        let mut source = PageSource::new(&mut pages, &mut view, 1);
        let mut shader = Shader::new(info, ShadeSettings::default(), None).unwrap();
        let start = Instant::now();
        for group in tiles(&receivers, SIZE).iter().flatten() {
            let mut out = vec![Shaded::default(); group.len()];
            let shaded = match hints {
                true => shader.shade_group(group, &mut source, &mut out),
                false => shader.shade_group(group, &mut Deaf(&mut source), &mut out),
            };
            shaded.unwrap();
        }
        (source.counters(), start.elapsed().as_secs_f64())
    })
}

/// Prints the table.
pub(crate) fn print(scene: &Scene) {
    println!("asking ahead, {} receivers, one worker", SIZE.0 * SIZE.1);
    println!("  cache of the scene   pages from     hints   pages read   waiting for pages   of the time");
    for share in [0.1, 0.3, 2.1] {
        for (place, held) in [("memory", true), ("disk", false)] {
            for (name, hints) in [("unheard", false), ("heard", true)] {
                if !held {
                    for file in ["nodes.pages", "points.pages"] {
                        pbgi_tests::forget(&scene.path().join(file));
                    }
                }
                let (counters, seconds) = shade(scene, share, hints);
                println!(
                    "  {:15.0} % {place:>12} {name:>9} {:12} {:16.2} ms {:11.2} %",
                    (share * 100.0_f64).min(100.0),
                    counters.cache_misses,
                    counters.io_nanos as f64 * 1e-6,
                    counters.io_nanos as f64 * 1e-7 / seconds
                );
            }
        }
    }
    println!();
}
