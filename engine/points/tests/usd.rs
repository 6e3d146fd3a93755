//! USD stages: what they draw, light and see, what they are made of, and what damaged ones say.

#![allow(clippy::unwrap_used, reason = "a step that fails is a test that fails")]

mod common;

#[cfg(not(feature = "usd"))]
#[test]
fn without_the_feature_a_stage_is_refused_with_what_to_do() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.usdz");
    std::fs::write(&path, "PK").unwrap();
    let says = ["USD", "cargo build --release --features usd", "a.usdz"];
    common::assert_says(pbgi_points::MeshScene::load(&path), &says);
    common::assert_says(pbgi_points::open_input(&[path], &Default::default()), &says);
}

#[cfg(feature = "usd")]
#[path = "usd/mod.rs"]
mod usd;
