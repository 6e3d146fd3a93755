//! Files that a stage opens: beside its root file or below, bounded in size, nested within bounds; those within a `.usdz` too.

use super::contain::Pulse;
use super::crate_check;
use crate::error::PointsError;
use crate::limits;
use crate::scene::Room;
use openusd::ar::{Asset, DefaultResolver, ResolvedPath, Resolver, split_package_relative_path_outer};
use openusd::usdc;
use std::cell::{Cell, RefCell};
use std::collections::BTreeSet;
use std::fs::File;
use std::io::{self, Cursor, Read};
use std::path::{Path, PathBuf};
use std::rc::Rc;
use zip::{CompressionMethod, ZipArchive};

/// What a ZIP file begins with.
const ZIP_MAGIC: &[u8] = b"PK";

/// Finds and opens files; all its clones share what they know.
#[derive(Clone)]
pub(super) struct Files(Rc<Shared>);

struct Shared {
    scene: PathBuf,
    /// The folder of the root file, canonical.
    folder: PathBuf,
    room: Room,
    pulse: Pulse,
    names: DefaultResolver,
    opened: RefCell<BTreeSet<PathBuf>>,
    bytes: Cell<u64>,
    /// What was first refused, in our words: those of the library lose them.
    refused: RefCell<Option<PointsError>>,
}

impl Files {
    pub(super) fn new(scene: &Path, room: Room, pulse: &Pulse) -> Result<Self, PointsError> {
        let canonical = std::fs::canonicalize(scene).map_err(PointsError::io("open", scene))?;
        let folder = canonical.parent().unwrap_or(Path::new("/")).to_owned();
        Ok(Self(Rc::new(Shared {
            scene: scene.to_owned(),
            folder,
            room,
            pulse: pulse.clone(),
            names: DefaultResolver::new(),
            opened: RefCell::default(),
            bytes: Cell::new(0),
            refused: RefCell::default(),
        })))
    }

    /// All files that were opened so far.
    pub(super) fn opened(&self) -> Vec<PathBuf> {
        self.0.opened.borrow().iter().cloned().collect()
    }

    /// What was first refused, if anything was.
    pub(super) fn refused(&self) -> Option<PointsError> {
        self.0.refused.borrow_mut().take()
    }

    /// The bytes of a picture.
    pub(super) fn picture(&self, resolved: &str) -> Result<Vec<u8>, PointsError> {
        self.read(Path::new(resolved))
    }

    fn read(&self, path: &Path) -> Result<Vec<u8>, PointsError> {
        let shared = &*self.0;
        shared.pulse.beat();
        let text = path.to_string_lossy();
        match split_package_relative_path_outer(&text) {
            Some((package, inner)) => self.read_packed(Path::new(&package), &inner),
            None => self.read_file(path),
        }
    }

    /// The bytes of a layer, or of a package of layers.
    fn layer(&self, path: &Path) -> Result<Vec<u8>, PointsError> {
        let bytes = self.read(path)?;
        if bytes.starts_with(usdc::MAGIC) {
            let damaged = |what| PointsError::invalid(path, format!("not a usable USD layer: {what}"));
            crate_check::check(&bytes).map_err(damaged)?;
        } else if !bytes.starts_with(ZIP_MAGIC) {
            check_nesting(path, &bytes)?;
        }
        Ok(bytes)
    }

    fn read_file(&self, path: &Path) -> Result<Vec<u8>, PointsError> {
        let file = self.open(path)?;
        let length = file.metadata().map_err(PointsError::io("read", path))?.len();
        self.take(path, length)?;
        let mut bytes = Vec::with_capacity(length as usize);
        file.take(length)
            .read_to_end(&mut bytes)
            .map_err(PointsError::io("read", path))?;
        Ok(bytes)
    }

    fn read_packed(&self, package: &Path, inner: &str) -> Result<Vec<u8>, PointsError> {
        let damaged = |error: zip::result::ZipError| PointsError::invalid(package, format!("{inner:?}: {error}"));
        let mut archive = ZipArchive::new(self.open(package)?).map_err(damaged)?;
        let entry = archive.by_name(inner).map_err(damaged)?;
        if entry.compression() != CompressionMethod::Stored {
            let what = format!("{inner:?}, which is compressed,");
            return Err(PointsError::unsupported(
                package,
                what,
                "pack it with usdzip, as the format wants",
            ));
        }
        let length = entry.size();
        self.take(package, length)?;
        let mut bytes = Vec::new();
        entry
            .take(length)
            .read_to_end(&mut bytes)
            .map_err(PointsError::io("read", package))?;
        Ok(bytes)
    }

    fn open(&self, path: &Path) -> Result<File, PointsError> {
        let file = File::open(path).map_err(PointsError::io("open", path))?;
        self.0.opened.borrow_mut().insert(path.to_owned());
        Ok(file)
    }

    /// Whether so many bytes more may be read.
    fn take(&self, path: &Path, length: u64) -> Result<(), PointsError> {
        let shared = &*self.0;
        if length > limits::MESH_FILE_BYTES_MAX {
            return Err(PointsError::Limit {
                what: "size of the file in bytes",
                value: length,
                limit: limits::MESH_FILE_BYTES_MAX,
                path: path.to_owned(),
            });
        }
        let bytes = shared.bytes.get().saturating_add(length);
        shared.bytes.set(bytes);
        shared.room.fits(bytes)
    }

    /// Keeps the first refusal.
    fn refuse(&self, error: PointsError) {
        self.0.refused.borrow_mut().get_or_insert(error);
    }
}

impl Resolver for Files {
    fn create_identifier(&self, asset_path: &str, anchor: Option<&ResolvedPath>) -> String {
        self.0.names.create_identifier(asset_path, anchor)
    }

    fn resolve(&self, asset_path: &str) -> Option<ResolvedPath> {
        let resolved = self.0.names.resolve(asset_path)?;
        if resolved.starts_with(&self.0.folder) {
            return Some(resolved);
        }
        self.refuse(PointsError::unsupported(
            &self.0.scene,
            format!("the file {asset_path:?}, which is outside of the scene's folder,"),
            "put that file beside the scene, or below",
        ));
        None
    }

    /// Nothing is written.
    fn resolve_for_new_asset(&self, _asset_path: &str) -> Option<ResolvedPath> {
        None
    }

    fn open_asset(&self, resolved_path: &ResolvedPath) -> io::Result<Box<dyn Asset>> {
        match self.layer(resolved_path) {
            Ok(bytes) => Ok(Box::new(Cursor::new(bytes))),
            Err(error) => {
                let text = error.to_string();
                self.refuse(error);
                Err(io::Error::other(text))
            }
        }
    }
}

/// Brackets of a text layer nest no deeper than the parser's stack holds; in texts, which may be expressions, as well.
fn check_nesting(path: &Path, layer: &[u8]) -> Result<(), PointsError> {
    let mut depth = 0;
    let mut at = 0;
    while at < layer.len() {
        let rest = &layer[at..];
        let piece = match rest {
            [b'#', ..] | [b'/', b'/', ..] => length_to(rest, 1, b"\n"),
            [b'/', b'*', ..] => length_to(rest, 2, b"*/"),
            [b'@', b'@', b'@', ..] => length_to(rest, 3, b"@@@"),
            [b'@', ..] => length_to(rest, 1, b"@"),
            [b'"', b'"', b'"', ..] => text_length(rest, b"\"\"\""),
            [b'\'', b'\'', b'\'', ..] => text_length(rest, b"'''"),
            [b'"', ..] => text_length(rest, b"\""),
            [b'\'', ..] => text_length(rest, b"'"),
            _ => 1,
        };
        let deepest = match piece {
            1 => {
                depth = nested(depth, rest[0]);
                depth
            }
            // A text, a name or a comment: whatever it holds is none of the structure around it.
            _ => rest[..piece]
                .iter()
                .scan(0, |depth, &byte| {
                    *depth = nested(*depth, byte);
                    Some(*depth)
                })
                .max()
                .unwrap_or(0),
        };
        if deepest > limits::USD_DEPTH_MAX {
            let line = 1 + layer[..at].iter().filter(|&&byte| byte == b'\n').count();
            let what = format!("line {line}: brackets are nested deeper than {}", limits::USD_DEPTH_MAX);
            return Err(PointsError::invalid(path, what));
        }
        at += piece;
    }
    Ok(())
}

fn nested(depth: usize, byte: u8) -> usize {
    match byte {
        b'{' | b'[' | b'(' => depth + 1,
        b'}' | b']' | b')' => depth.saturating_sub(1),
        _ => depth,
    }
}

/// Bytes up to the end of `end`, which may begin at `from`; all there are without it.
fn length_to(rest: &[u8], from: usize, end: &[u8]) -> usize {
    let found = rest[from..].windows(end.len()).position(|window| window == end);
    found.map_or(rest.len(), |at| from + at + end.len())
}

/// Bytes of a text in these marks; one in single marks ends with its line.
fn text_length(rest: &[u8], mark: &[u8]) -> usize {
    let mut at = mark.len();
    while at < rest.len() && !rest[at..].starts_with(mark) {
        match rest[at] {
            b'\\' => at += 2,
            b'\n' if mark.len() == 1 => return at,
            _ => at += 1,
        }
    }
    (at + mark.len()).min(rest.len())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn deep(text: &str) -> bool {
        check_nesting(Path::new("a.usda"), text.as_bytes()).is_err()
    }

    #[test]
    fn only_the_structure_counts_as_nesting() {
        let open = "{".repeat(limits::USD_DEPTH_MAX);
        assert!(!deep(&open));
        assert!(deep(&format!("{open}\n(")));
        // Closed in prose is not closed.
        for prose in [
            "# }\n",
            "// }\n",
            "/* } */",
            "@}@",
            "@@@}@@@",
            "\"}\"",
            "'}'",
            "\"\"\"\n}\n\"\"\"",
            "\"\\\"}\"",
        ] {
            assert!(deep(&format!("{open}{prose}{{")), "{prose}");
        }
        let prose = "{ doc = \"a lone (\" } # isn't (\n".repeat(1000);
        assert!(!deep(&prose));
        assert!(deep(&format!("a = \"`{}`\"", "if(".repeat(1000))));
    }
}
