//! Scenes that change under a daemon that has them open: cut, edited, replaced.

#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

use pbgi_core::PageKind;
use pbgi_store::Scene;
use pbgi_tests::{DAEMON, House, PATIENCE, Picture, assert_same, flip_bit, wait_for};
use std::fs;

/// A daemon whose cache is too small for the scene, so that it reads pages again.
const TIGHT: &str = "--memory 58M --workers 2";

fn house() -> House {
    let house = House::new();
    house.furnish(300_000, "32x32");
    for scene in ["small.pbgi", "other.pbgi"] {
        house
            .line(&format!(
                "build demo.ply -o {scene} --nodes-per-page 64 --points-per-page 128 {DAEMON}"
            ))
            .ok();
    }
    house
}

fn shade(scene: &str, output: &str) -> String {
    format!("shade {scene} --gbuffer g.exr -o {output} --overwrite {TIGHT}")
}

#[test]
#[ignore = "minutes: cargo test --release -p pbgi-tests --test changed_scenes -- --ignored"]
fn a_file_cut_or_edited_while_it_is_open_fails_its_jobs_and_no_others() {
    let house = house();
    house.line(&shade("other.pbgi", "calm.exr")).ok();
    let calm = Picture::read(&house.path("calm.exr"));
    house.line("gbuffer demo.glb -o large.exr --size 256x256").ok();
    let daemon = house.running("pbgi-server");
    let file = house.path("small.pbgi").join("nodes.pages");
    let whole = fs::read(&file).unwrap();
    let pages = Scene::open(&house.path("small.pbgi"))
        .unwrap()
        .info()
        .page_count(PageKind::Node);
    for round in 0..20 {
        let mut job = house.start(&shade("small.pbgi", "bad.exr").replace("g.exr", "large.exr"));
        let under_way = wait_for(PATIENCE, || {
            house.share().is_some_and(|share| share > 0.0) || !job.runs()
        });
        assert!(under_way && job.runs(), "the job was over too soon");
        // In place: the daemon has this very file open.
        if round % 2 == 0 {
            let open = fs::OpenOptions::new().write(true).open(&file).unwrap();
            open.set_len(4096).unwrap();
        } else {
            (0..pages).for_each(|page| flip_bit(&house.path("small.pbgi"), "nodes.pages", page));
        }
        job.end().fails_naming(&["nodes.pages", "page "]);
        assert!(house.path("bad.exr").metadata().is_err());
        house.line(&shade("other.pbgi", "o.exr")).ok();
        assert_same(&Picture::read(&house.path("o.exr")), &calm);
        write_in_place(&file, &whole);
    }
    house.line(&shade("small.pbgi", "o.exr")).ok();
    assert_eq!(
        house.running("pbgi-server"),
        daemon,
        "the daemon did not live through it"
    );
    println!("RELIABILITY F5: 10 files cut under load, 10 jobs failed, no other");
    println!("RELIABILITY F8: 10 files edited under load, 10 jobs failed, no other");
}

fn write_in_place(file: &std::path::Path, bytes: &[u8]) {
    use std::io::Write;
    let mut open = fs::OpenOptions::new().write(true).truncate(true).open(file).unwrap();
    open.write_all(bytes).unwrap();
}

#[test]
#[ignore = "minutes: cargo test --release -p pbgi-tests --test changed_scenes -- --ignored"]
fn a_scene_replaced_while_it_is_open_is_the_old_or_the_new_one() {
    let house = house();
    // Two clouds under one name, by turns.
    house.line("sample demo.glb -o sparse.ply --points 20000").ok();
    let build = |input: &str, output: &str| {
        house
            .line(&format!(
                "build {input} -o {output} --overwrite --nodes-per-page 64 --points-per-page 128 {DAEMON}"
            ))
            .ok();
    };
    build("sparse.ply", "sparse.pbgi");
    let picture = |scene: &str| {
        house.line(&shade(scene, "o.exr")).ok();
        Picture::read(&house.path("o.exr")).channels
    };
    let (dense, sparse) = (picture("small.pbgi"), picture("sparse.pbgi"));
    assert_ne!(dense, sparse);
    let (mut olds, mut news) = (0, 0);
    for round in 0..50 {
        let job = house.start(&shade("small.pbgi", &format!("r{round}.exr")));
        build(if round % 2 == 0 { "sparse.ply" } else { "demo.ply" }, "small.pbgi");
        job.end().ok();
        let seen = Picture::read(&house.path(&format!("r{round}.exr"))).channels;
        match (seen == dense, seen == sparse) {
            (true, false) => olds += 1,
            (false, true) => news += 1,
            _ => panic!("round {round} mixes two scenes"),
        }
    }
    println!(
        "RELIABILITY F7: 50 replacements under load: {olds} pictures of one scene, {news} of the other, none mixed"
    );
}
