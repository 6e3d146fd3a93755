//! The manifest of a scene: a small TOML file for people and programs, with a checksum in its last line.

use crate::data_file::DataFile;
use crate::error::StoreError;
use crate::limits::{MANIFEST_BYTES_MAX, RECORDS_MAX};
use crate::volume::Volume;
use pbgi_core::{Bounds, BuildId, BuildSettings, NodeIndex, PageKind, Quantizer, SceneInfo};
use serde::{Deserialize, Serialize};
use std::path::Path;
use std::sync::Arc;

/// Name of the manifest in a scene's folder.
pub const MANIFEST_NAME: &str = "manifest.toml";

const FORMAT: &str = "pbgi scene";
const VERSION: u32 = 4;
const PREAMBLE: &str =
    "# A built octree. Written whole and never changed: the last line is a checksum of those above it.\n";
const CHECKSUM_LABEL: &str = "# crc32c ";

/// What is looked at first, so that another version is named as such and not as a list of unknown fields.
#[derive(Deserialize)]
struct Versioned {
    format: String,
    version: u32,
}

/// The file's fields in the file's order: plain values before tables.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Manifest {
    format: String,
    version: u32,
    build_id: BuildId,
    point_count: u64,
    node_count: u64,
    node_slots: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    root: Option<NodeIndex>,
    radius_max: f32,
    #[serde(default, skip_serializing_if = "is_zero")]
    origin: [f64; 3],
    settings: BuildSettings,
    pages: Pages,
    #[serde(skip_serializing_if = "Option::is_none")]
    bounds: Option<Bounds>,
    #[serde(skip_serializing_if = "Option::is_none")]
    quantizer: Option<Quantizer>,
}

fn is_zero(origin: &[f64; 3]) -> bool {
    *origin == [0.0; 3]
}

/// For people: what follows from the counts and settings. Checked all the same.
#[derive(Serialize, Deserialize, PartialEq, Debug)]
#[serde(deny_unknown_fields)]
struct Pages {
    node_pages: u64,
    node_page_bytes: u64,
    point_pages: u64,
    point_page_bytes: u64,
}

impl Pages {
    fn of(info: &SceneInfo) -> Self {
        Self {
            node_pages: info.page_count(PageKind::Node),
            node_page_bytes: info.page_bytes(PageKind::Node) as u64,
            point_pages: info.page_count(PageKind::Point),
            point_page_bytes: info.page_bytes(PageKind::Point) as u64,
        }
    }
}

/// The manifest's text.
///
/// # Errors
/// [`StoreError::Invalid`] if `info` contradicts itself.
pub fn encode(info: &SceneInfo, path: &Path) -> Result<String, StoreError> {
    check(info, path)?;
    let manifest = Manifest {
        format: FORMAT.to_owned(),
        version: VERSION,
        build_id: info.build_id,
        point_count: info.point_count,
        node_count: info.node_count,
        node_slots: info.node_slots,
        root: info.root,
        radius_max: info.radius_max,
        origin: info.origin,
        settings: info.settings,
        pages: Pages::of(info),
        bounds: info.bounds,
        quantizer: info.quantizer,
    };
    let body = toml::to_string(&manifest).map_err(|error| StoreError::Invalid(error.to_string()))?;
    let mut text = format!("{PREAMBLE}{body}");
    let sum = crc32c::crc32c(text.as_bytes());
    text.push_str(&format!("{CHECKSUM_LABEL}{sum:08x}\n"));
    Ok(text)
}

/// Reads a manifest's text; `path` is for errors.
///
/// # Errors
/// [`StoreError::Mismatch`] for another format or version, [`StoreError::Corrupt`] for damage.
pub fn decode(text: &str, path: &Path) -> Result<SceneInfo, StoreError> {
    let last_line = text
        .strip_suffix('\n')
        .unwrap_or(text)
        .rfind('\n')
        .map_or(0, |at| at + 1);
    let (body, tail) = text.split_at(last_line);
    let actual = format!("{CHECKSUM_LABEL}{:08x}\n", crc32c::crc32c(body.as_bytes()));
    if let Ok(found) = toml::from_str::<Versioned>(text) {
        if found.format != FORMAT {
            return Err(StoreError::mismatch(path, "format", FORMAT, found.format));
        }
        if found.version != VERSION {
            return Err(StoreError::mismatch(path, "format version", VERSION, found.version));
        }
    }
    if tail != actual {
        return Err(StoreError::corrupt(
            path,
            "manifest",
            actual.trim_end(),
            tail.trim_end(),
        ));
    }
    let manifest: Manifest = toml::from_str(body)
        .map_err(|error| StoreError::corrupt(path, "manifest", "the fields of version 1", error.message()))?;
    let info = SceneInfo {
        build_id: manifest.build_id,
        point_count: manifest.point_count,
        node_count: manifest.node_count,
        node_slots: manifest.node_slots,
        root: manifest.root,
        bounds: manifest.bounds,
        quantizer: manifest.quantizer,
        radius_max: manifest.radius_max,
        origin: manifest.origin,
        settings: manifest.settings,
    };
    check(&info, path)?;
    if manifest.pages != Pages::of(&info) {
        let (expected, actual) = (format!("{:?}", Pages::of(&info)), format!("{:?}", manifest.pages));
        return Err(StoreError::corrupt(path, "manifest", expected, actual));
    }
    Ok(info)
}

/// Reads the manifest of a scene.
///
/// # Errors
/// As [`decode`], and [`StoreError::Io`].
pub fn read(volume: &Arc<dyn Volume>, path: &Path) -> Result<SceneInfo, StoreError> {
    let file = DataFile::open(volume, path)?;
    let len = file.byte_len()?;
    if len > MANIFEST_BYTES_MAX {
        let expected = format!("at most {MANIFEST_BYTES_MAX} bytes");
        return Err(StoreError::corrupt(path, "manifest", expected, len));
    }
    let mut bytes = vec![0; len as usize];
    file.read_at(0, &mut bytes, &|| "manifest".to_owned())?;
    let text = String::from_utf8(bytes).map_err(|error| StoreError::corrupt(path, "manifest", "UTF-8", error))?;
    decode(&text, path)
}

/// Whether the numbers agree with each other; nothing behind this looks again.
fn check(info: &SceneInfo, path: &Path) -> Result<(), StoreError> {
    let settings = info.settings.validate();
    settings.map_err(|error| StoreError::mismatch(path, error.name, &error.expected, &error.value))?;
    let refuse = |what: &'static str, expected: &str, actual: String| {
        Err(StoreError::corrupt(path, format!("manifest, {what}"), expected, actual))
    };
    for (what, count) in [("point_count", info.point_count), ("node_slots", info.node_slots)] {
        if count > RECORDS_MAX {
            return refuse(what, "fewer than 2^32", count.to_string());
        }
    }
    let filled = info.point_count > 0;
    if info.node_count > info.node_slots || (info.node_count > 0) != filled {
        return refuse(
            "node_count",
            "nodes exactly where there are points",
            info.node_count.to_string(),
        );
    }
    let root_fits = info.root.is_none_or(|root| u64::from(root.0) < info.node_slots);
    if info.root.is_some() != filled || !root_fits {
        return refuse(
            "root",
            "a slot of the node file where there are points",
            format!("{:?}", info.root),
        );
    }
    let finite = |values: &[f32]| values.iter().all(|value| value.is_finite());
    let bounds_fit = info
        .bounds
        .is_none_or(|b| finite(&b.min) && finite(&b.max) && !b.is_empty());
    if info.bounds.is_some() != filled || !bounds_fit {
        return refuse(
            "bounds",
            "a finite box where there are points",
            format!("{:?}", info.bounds),
        );
    }
    let lattice_fits = info
        .quantizer
        .is_none_or(|q| q.origin.iter().all(|value| value.is_finite()) && q.edge.is_finite() && q.edge > 0.0);
    if info.quantizer.is_some() != filled || !lattice_fits {
        return refuse(
            "quantizer",
            "a finite cube where there are points",
            format!("{:?}", info.quantizer),
        );
    }
    if !info.origin.iter().all(|axis| axis.is_finite()) {
        return refuse("origin", "three finite numbers", format!("{:?}", info.origin));
    }
    if !info.radius_max.is_finite() || info.radius_max < 0.0 || (info.radius_max > 0.0) != filled {
        return refuse(
            "radius_max",
            "a positive radius where there are points",
            info.radius_max.to_string(),
        );
    }
    Ok(())
}
