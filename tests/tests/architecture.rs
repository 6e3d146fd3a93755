//! The layout's arrows: which crate may depend on which. A new arrow is a decision; it is made here and in the design.

#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

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

/// Files below a folder of the workspace that end like this, by their path from the root.
fn files(folder: &Path, ending: &str, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap().flatten() {
        let path = entry.path();
        let name = entry.file_name().to_string_lossy().into_owned();
        if entry.file_type().unwrap().is_dir() {
            if name != "target" && !name.starts_with('.') {
                files(&path, ending, found);
            }
        } else if name.ends_with(ending) {
            found.push(path);
        }
    }
}

#[test]
fn unsafe_code_is_in_the_cache_and_in_one_module_of_shade() {
    let root = pbgi_tests::workspace_root();
    let mut sources = Vec::new();
    files(&root, ".rs", &mut sources);
    assert!(sources.len() > 100, "{sources:?}");
    let words = ["unsafe {", "unsafe fn ", "unsafe impl ", "unsafe_code, reason"];
    for source in sources {
        let path = source.strip_prefix(&root).unwrap();
        let allowed = path.starts_with("engine/cache") || path == Path::new("engine/shade/src/simd.rs");
        let text = std::fs::read_to_string(&source).unwrap();
        let found = words.iter().find(|word| text.contains(**word));
        assert!(
            allowed || found.is_none() || path.ends_with(file!()),
            "{path:?} has {found:?}"
        );
    }
}

#[test]
fn every_row_of_the_reliability_table_names_a_test_that_is_there_and_prints_its_number() {
    let root = pbgi_tests::workspace_root();
    let table = std::fs::read_to_string(root.join("tests/reliability.toml")).unwrap();
    let table: toml::Table = table.parse().unwrap();
    let metadata = cargo_metadata::MetadataCommand::new().no_deps().exec().unwrap();
    let rows = table["row"].as_array().unwrap();
    for row in rows {
        let word = |key: &str| {
            row.get(key)
                .and_then(|value| value.as_str())
                .unwrap_or_else(|| panic!("{row} has no {key}"))
        };
        let (id, test) = (word("id"), word("test").rsplit("::").next().unwrap());
        let package = metadata
            .packages
            .iter()
            .find(|package| *package.name == word("package"))
            .unwrap();
        let mut sources = Vec::new();
        files(
            package.manifest_path.parent().unwrap().as_std_path(),
            ".rs",
            &mut sources,
        );
        let texts: Vec<String> = sources
            .iter()
            .map(|source| std::fs::read_to_string(source).unwrap())
            .collect();
        let has = |words: &str| texts.iter().any(|text| text.contains(words));
        assert!(has(&format!("fn {test}(")), "row {id}: there is no test {test}");
        // A property has no one number.
        assert!(
            id == "S9" || has(&format!("RELIABILITY {id}: ")),
            "row {id}: nobody prints its number"
        );
    }
    assert!(rows.len() >= 70, "{} rows", rows.len());
}
