//! The layout's arrows: which crate may depend on which. A new arrow is a decision; it is made here and in the design.

#![allow(clippy::unwrap_used, reason = "tests")]

use std::collections::{BTreeMap, BTreeSet};

/// Normal and build dependencies inside the workspace.
const ARROWS: [(&str, &[&str]); 11] = [
    ("pbgi-proto", &[]),
    ("pbgi-core", &[]),
    ("pbgi-store", &["pbgi-core"]),
    ("pbgi-cache", &["pbgi-core"]),
    ("pbgi-shade", &["pbgi-core"]),
    ("pbgi-points", &["pbgi-core", "pbgi-store"]),
    ("pbgi-build", &["pbgi-core", "pbgi-store"]),
    (
        "pbgi-server",
        &[
            "pbgi-build",
            "pbgi-cache",
            "pbgi-core",
            "pbgi-points",
            "pbgi-proto",
            "pbgi-store",
        ],
    ),
    ("pbgi-worker", &["pbgi-cache", "pbgi-core", "pbgi-proto", "pbgi-shade"]),
    ("pbgi-client", &["pbgi-core", "pbgi-points", "pbgi-proto"]),
    ("pbgi-tests", ANYTHING),
];

/// The tests use every crate as an oracle.
const ANYTHING: &[&str] = &["*"];

/// Packages that must be in real use, each by the crate that needs it.
const CARD: [(&str, &str); 11] = [
    ("tokio", "pbgi-server"),
    ("tonic", "pbgi-server"),
    ("prost", "pbgi-proto"),
    ("memmap2", "pbgi-cache"),
    ("shared_memory", "pbgi-cache"),
    ("nix", "pbgi-cache"),
    ("glam", "pbgi-shade"),
    ("half", "pbgi-core"),
    ("tracing", "pbgi-worker"),
    ("lru", "pbgi-cache"),
    ("exr", "pbgi-points"),
];

fn dependencies() -> BTreeMap<String, BTreeSet<String>> {
    let metadata = cargo_metadata::MetadataCommand::new().no_deps().exec().unwrap();
    let normal =
        |dependency: &&cargo_metadata::Dependency| dependency.kind != cargo_metadata::DependencyKind::Development;
    let names = |package: &cargo_metadata::Package| {
        let names = package
            .dependencies
            .iter()
            .filter(normal)
            .map(|dependency| dependency.name.clone())
            .collect();
        (package.name.to_string(), names)
    };
    metadata.packages.iter().map(names).collect()
}

#[test]
fn crates_depend_only_along_the_arrows() {
    let actual = dependencies();
    assert_eq!(
        actual.keys().map(String::as_str).collect::<BTreeSet<_>>(),
        ARROWS.map(|(name, _)| name).into()
    );
    for (name, allowed) in ARROWS {
        for dependency in actual[name].iter().filter(|dependency| dependency.starts_with("pbgi-")) {
            let fits = allowed == ANYTHING || allowed.contains(&dependency.as_str());
            assert!(fits, "{name} must not depend on {dependency}");
        }
    }
}

#[test]
fn every_package_of_the_card_is_in_use() {
    let actual = dependencies();
    for (package, user) in CARD {
        assert!(actual[user].contains(package), "{user} no longer uses {package}");
    }
}
