//! The price of the cache when nothing has to be fetched: the same shading code over plain arrays, over memory-mapped files and
//! over a cache that holds the scene.

use crate::costs::{MOUNT, owner, with_worker};
use crate::policy::{arrays, tiles};
use crate::town::Town;
use nix::fcntl::{FcntlArg, SealFlag, fcntl};
use nix::sys::memfd::{MFdFlags, memfd_create};
use pbgi_core::{NodeRecord, PageKind, PointRecord, ShadeSettings};
use pbgi_shade::{ArraySource, Receiver, SceneSource, Shaded, Shader};
use pbgi_store::Scene;
use pbgi_worker::pages::{PageSource, SceneView};
use std::fs::File;
use std::time::Instant;

const SIZE: (u32, u32) = (64, 64);
const ROUNDS: usize = 3;
/// Bytes before the first page of a file.
const HEADER_BYTES: usize = 4096;

/// The scene's files in the address space: what a renderer without a cache would do.
struct Mapped {
    nodes: memmap2::Mmap,
    points: memmap2::Mmap,
    node_count: usize,
    point_count: usize,
}

impl Mapped {
    fn open(scene: &Scene) -> Self {
        let map = |name: &str| {
            // A sealed copy in memory: nobody can write to it, so that mapping it is sound; the kernel serves it like a file
            // whose pages it holds.
            let copy = memfd_create(name, MFdFlags::MFD_ALLOW_SEALING | MFdFlags::MFD_CLOEXEC).unwrap();
            let mut copy = File::from(copy);
            std::io::copy(&mut File::open(scene.path().join(name)).unwrap(), &mut copy).unwrap();
            let seals = SealFlag::F_SEAL_SHRINK | SealFlag::F_SEAL_GROW | SealFlag::F_SEAL_WRITE;
            fcntl(&copy, FcntlArg::F_ADD_SEALS(seals)).unwrap();
            memmap2::MmapOptions::new().map_if_safe(&copy).unwrap()
        };
        Self {
            nodes: map("nodes.pages"),
            points: map("points.pages"),
            node_count: scene.info().node_slots as usize,
            point_count: scene.info().point_count as usize,
        }
    }
}

impl Mapped {
    fn source(&self) -> ArraySource<&[NodeRecord], &[PointRecord]> {
        let nodes = &self.nodes[HEADER_BYTES..][..self.node_count * size_of::<NodeRecord>()];
        let points = &self.points[HEADER_BYTES..][..self.point_count * size_of::<PointRecord>()];
        ArraySource {
            nodes: bytemuck::cast_slice(nodes),
            points: bytemuck::cast_slice(points),
        }
    }
}

/// The seconds and the values of one group of receivers.
fn shade(shader: &mut Shader, group: &[Receiver], source: &mut impl SceneSource) -> (f64, Vec<Shaded>) {
    let mut values = vec![Shaded::default(); group.len()];
    let start = Instant::now();
    shader.shade_group(group, source, &mut values).unwrap();
    (start.elapsed().as_secs_f64(), values)
}

/// Prints the table.
pub(crate) fn print(scene: &Scene) {
    let info = scene.info();
    let receivers = Town::new(info.point_count).receivers(SIZE.0, SIZE.1);
    let tiles = tiles(&receivers, SIZE);
    let (mut arrays, mapped) = (arrays(scene), Mapped::open(scene));
    let mut mapped = mapped.source();
    // Half of the frames may be held by the worker, and all pages fit into that half.
    let frames = |kind| 2 * info.page_count(kind) as u32 + 8;
    let owner = owner(info, frames(PageKind::Node), frames(PageKind::Point));
    let seconds = with_worker(&owner, scene, |mut pages| {
        let mut view = SceneView::new(info, MOUNT);
        let mut source = PageSource::new(&mut pages, &mut view, 1);
        let mut shader = Shader::new(info, ShadeSettings::default(), None).unwrap();
        // Each group with each source in turn, so that others on the machine disturb all alike; the best of its rounds counts.
        let mut seconds = [0.0; 3];
        for group in tiles.iter().flatten() {
            let mut best = [f64::INFINITY; 3];
            for round in 0..=ROUNDS {
                let (a, values) = shade(&mut shader, group, &mut arrays);
                let (b, from_files) = shade(&mut shader, group, &mut mapped);
                let (c, from_cache) = shade(&mut shader, group, &mut source);
                assert!(values == from_files && values == from_cache, "other values");
                // The first round warms up.
                if round > 0 {
                    best = [best[0].min(a), best[1].min(b), best[2].min(c)];
                }
            }
            for (sum, best) in seconds.iter_mut().zip(best) {
                *sum += best;
            }
        }
        seconds
    });
    println!(
        "in core, {} receivers, one thread, best of {ROUNDS} rounds: the same values from each",
        receivers.len()
    );
    for (name, source_seconds) in ["plain arrays", "memory-mapped files", "this cache, all pages resident"]
        .iter()
        .zip(seconds)
    {
        println!(
            "  {name:<32} {:8.2} us a receiver, {:.3} of the speed of arrays",
            source_seconds * 1e6 / receivers.len() as f64,
            seconds[0] / source_seconds
        );
    }
    println!();
}
