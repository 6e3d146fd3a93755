//! The page cache in figures: what a look-up costs, how well pages are chosen, what shading out of core costs.
//!
//!     cargo bench -p pbgi-tests --bench cache
//!     cargo bench -p pbgi-tests --bench cache -- out-of-core --points 160M --memory 2G --size 1536x1024
//!
//! Sections: `costs`, `policy`, `in-core`, `out-of-core`; without a name all of them, on a small scene. Pages are held by the
//! operating system unless the scene is larger than the machine's memory.
#![allow(
    clippy::unwrap_used,
    clippy::panic,
    reason = "a bench that cannot run has nothing to say"
)]

mod ahead;
mod costs;
mod in_core;
mod out_of_core;
mod policy;
mod town;

use pbgi_build::{BuildRequest, build};
use pbgi_core::{BuildSettings, PageKind, PageNo};
use pbgi_store::{Overwrite, Scene};
use std::ops::ControlFlow;
use std::path::Path;
use std::time::Instant;
use town::Town;

/// What can be asked for on the command line.
struct Options {
    sections: Vec<String>,
    points: u64,
    memory: u64,
    size: (u32, u32),
}

fn number(text: &str) -> u64 {
    let (digits, unit) = match text.chars().last() {
        Some('K') => (&text[..text.len() - 1], 1 << 10),
        Some('M') => (&text[..text.len() - 1], 1 << 20),
        Some('G') => (&text[..text.len() - 1], 1 << 30),
        _ => (text, 1),
    };
    digits
        .parse::<u64>()
        .unwrap_or_else(|_| panic!("{text:?} is no number"))
        * unit
}

impl Options {
    fn from_arguments() -> Self {
        let mut options = Self {
            sections: Vec::new(),
            points: 12 << 20,
            memory: 200 << 20,
            size: (256, 192),
        };
        let mut words = std::env::args().skip(1);
        while let Some(word) = words.next() {
            let mut value = || words.next().unwrap_or_else(|| panic!("{word} has no value"));
            match word.as_str() {
                // What `cargo bench` says to every bench.
                "--bench" => {}
                "--points" => options.points = number(&value()),
                "--memory" => options.memory = number(&value()),
                "--size" => {
                    let text = value();
                    let (width, height) = text.split_once('x').unwrap();
                    options.size = (number(width) as u32, number(height) as u32);
                }
                _ => options.sections.push(word),
            }
        }
        options
    }

    fn wants(&self, section: &str) -> bool {
        self.sections.is_empty() || self.sections.iter().any(|name| name == section)
    }
}

/// Builds the town.
fn build_town(points: u64, folder: &Path, name: &str) -> Scene {
    let request = BuildRequest {
        output: folder.join(name),
        overwrite: Overwrite::Replace,
        scratch_dir: folder.to_path_buf(),
        memory_bytes: 512 << 20,
        settings: BuildSettings::default(),
        input_key: None,
    };
    let start = Instant::now();
    let report = build(&mut Town::new(points), &request, &mut |_| ControlFlow::Continue(())).unwrap();
    let info = &report.info;
    println!(
        "town of {:.2} M points and {:.2} M nodes, {:.0} MiB in {} node and {} point pages, built in {:.1} s\n",
        info.point_count as f64 * 1e-6,
        info.node_count as f64 * 1e-6,
        mib(info.out_of_core_bytes()),
        info.page_count(PageKind::Node),
        info.page_count(PageKind::Point),
        start.elapsed().as_secs_f64()
    );
    Scene::open(&folder.join(name)).unwrap()
}

/// All pages of a kind, one after the other.
fn read_all(scene: &Scene, kind: PageKind) -> Vec<u8> {
    let (bytes, pages) = (scene.info().page_bytes(kind), scene.info().page_count(kind) as usize);
    let mut all = vec![0; bytes * pages];
    for (number, page) in all.chunks_exact_mut(bytes).enumerate() {
        scene.read_page(kind, PageNo(number as u32), page).unwrap();
    }
    all
}

fn mib(bytes: u64) -> f64 {
    bytes as f64 / f64::from(1 << 20)
}

fn main() {
    let options = Options::from_arguments();
    let folder = tempfile::Builder::new().prefix("pbgi-bench-").tempdir().unwrap();
    if ["costs", "policy", "in-core"]
        .iter()
        .any(|section| options.wants(section))
    {
        let scene = build_town(2 << 20, folder.path(), "small.pbgi");
        if options.wants("costs") {
            costs::print(&scene);
            ahead::print(&scene);
        }
        if options.wants("policy") {
            policy::print(&scene);
        }
        if options.wants("in-core") {
            in_core::print(&scene);
        }
    }
    if options.wants("out-of-core") {
        out_of_core::print(&options);
    }
}
