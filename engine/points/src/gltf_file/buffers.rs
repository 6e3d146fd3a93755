//! The bytes of a glTF file: the GLB container, buffers beside it, data URIs. What lies in a file stays there until it is
//! asked for: buffers hold millions of instances, and every mesh, but no two of them are needed at once.

use super::instancing;
use crate::error::PointsError;
use crate::limits;
use crate::named_file::beside;
use std::fs::File;
use std::ops::Range;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

/// Every buffer of a document.
pub(super) struct Buffers(Vec<Buffer>);

/// Bytes in memory or in a file.
pub(super) enum Buffer {
    Memory(Vec<u8>),
    File {
        file: File,
        path: PathBuf,
        range: Range<u64>,
    },
}

/// A part of a buffer.
pub(super) struct View<'a> {
    buffer: &'a Buffer,
    range: Range<u64>,
}

impl Buffers {
    /// A buffer view; `None` if it reaches beyond its buffer.
    pub(super) fn view(&self, document: &gltf::Document, index: usize) -> Option<View<'_>> {
        let view = document.as_json().buffer_views.get(index)?;
        let start = view.byte_offset.unwrap_or_default().0;
        let range = start..start.checked_add(view.byte_length.0)?;
        let buffer = self.0.get(view.buffer.value())?;
        (range.end <= buffer.len()).then_some(View { buffer, range })
    }
}

impl View<'_> {
    pub(super) fn len(&self) -> u64 {
        self.range.end - self.range.start
    }

    /// Bytes `range` of it.
    pub(super) fn read(&self, range: Range<u64>) -> Result<Vec<u8>, PointsError> {
        let start = self.range.start;
        self.buffer.read(start + range.start..start + range.end)
    }
}

impl Buffer {
    fn len(&self) -> u64 {
        match self {
            Self::Memory(bytes) => bytes.len() as u64,
            Self::File { range, .. } => range.end - range.start,
        }
    }

    /// Bytes `range` of it, which it has.
    fn read(&self, range: Range<u64>) -> Result<Vec<u8>, PointsError> {
        match self {
            Self::Memory(bytes) => Ok(bytes[range.start as usize..range.end as usize].to_vec()),
            Self::File { file, path, range: own } => {
                let mut bytes = vec![0; (range.end - range.start) as usize];
                file.read_exact_at(&mut bytes, own.start + range.start)
                    .map_err(PointsError::io("read", path))?;
                Ok(bytes)
            }
        }
    }

    /// A part of it, in the same place.
    fn part(self, part: Range<u64>) -> Self {
        match self {
            Self::Memory(bytes) => Self::Memory(bytes[part.start as usize..part.end as usize].to_vec()),
            Self::File { file, path, range } => Self::File {
                file,
                path,
                range: range.start + part.start..range.start + part.end,
            },
        }
    }
}

/// Reads the document, and finds the binary chunk of a GLB file.
pub(super) fn open(path: &Path) -> Result<(gltf::Document, Option<Buffer>), PointsError> {
    let file = open_file(path, path)?;
    let (json, chunk) = match file.len() >= 4 && file.read(0..4)? == b"glTF" {
        true => split_glb(path, &file)?,
        false => (0..file.len(), None),
    };
    let json = file.read(json)?;
    let damaged = |error: gltf::json::Error| PointsError::invalid(path, format!("not a usable glTF file: {error}"));
    let mut root: gltf::json::Root = gltf::json::deserialize::from_slice(&json).map_err(damaged)?;
    drop(json);
    check_positions(path, &root)?;
    // Read by us, and refused by the crate.
    root.extensions_required.retain(|name| name != instancing::EXTENSION);
    let document = gltf::Document::from_json(root).map_err(|error| {
        let what = match error {
            gltf::Error::Validation(errors) => match errors.first() {
                Some((place, error)) => format!("{place} is invalid: {error} ({} such places)", errors.len()),
                None => "the document is invalid".to_owned(),
            },
            other => format!("not a usable glTF file: {other}"),
        };
        PointsError::invalid(path, what)
    })?;
    Ok((document, chunk.map(|chunk| file.part(chunk))))
}

/// The crate's validation looks these up before it has checked them.
fn check_positions(path: &Path, root: &gltf::json::Root) -> Result<(), PointsError> {
    for (index, mesh) in root.meshes.iter().enumerate() {
        for accessor in mesh
            .primitives
            .iter()
            .flat_map(|primitive| primitive.attributes.values())
        {
            if accessor.value() >= root.accessors.len() {
                let what = format!(
                    "mesh {index} names accessor {}, which is not in the file",
                    accessor.value()
                );
                return Err(PointsError::invalid(path, what));
            }
        }
    }
    Ok(())
}

/// Where the JSON chunk is, and the binary chunk.
fn split_glb(path: &Path, file: &Buffer) -> Result<(Range<u64>, Option<Range<u64>>), PointsError> {
    const HEADER: u64 = 12;
    const CHUNK_HEADER: u64 = 8;
    let word = |at: u64| {
        if at + 4 > file.len() {
            return Err(PointsError::invalid(path, "the GLB file ends within a header"));
        }
        let word = file.read(at..at + 4)?;
        Ok([word[0], word[1], word[2], word[3]])
    };
    let number = |at: u64| word(at).map(u32::from_le_bytes);
    if number(4)? != 2 {
        let what = format!("GLB version {}", number(4)?);
        return Err(PointsError::unsupported(path, what, "export glTF 2.0"));
    }
    let announced = u64::from(number(8)?);
    if announced > file.len() {
        return Err(PointsError::Truncated {
            expected: announced,
            actual: file.len(),
            path: path.to_owned(),
        });
    }
    let chunk = |at: u64, kind: &[u8; 4]| {
        let start = at + CHUNK_HEADER;
        let body = start..start + u64::from(number(at)?);
        if body.end <= file.len() && word(at + 4)? == *kind {
            return Ok(body);
        }
        let kind = String::from_utf8_lossy(kind);
        let what = format!("the GLB file has no whole chunk {kind:?} at byte {at}");
        Err(PointsError::invalid(path, what))
    };
    let json = chunk(HEADER, b"JSON")?;
    let next = HEADER + CHUNK_HEADER + (json.end - json.start).next_multiple_of(4);
    if next + CHUNK_HEADER > file.len() {
        return Ok((json, None));
    }
    Ok((json, Some(chunk(next, b"BIN\0")?)))
}

/// Opens every buffer, and checks its length.
pub(super) fn load(path: &Path, document: &gltf::Document, blob: Option<Buffer>) -> Result<Buffers, PointsError> {
    let mut blob = blob;
    let mut buffers = Vec::new();
    for (index, json) in document.as_json().buffers.iter().enumerate() {
        let buffer = match &json.uri {
            Some(uri) => open_uri(path, uri)?,
            None => blob.take().ok_or_else(|| {
                PointsError::invalid(path, format!("buffer {index} has no uri, and there is no binary chunk"))
            })?,
        };
        let (expected, found) = (json.byte_length.0, buffer.len());
        if found < expected {
            let what = format!("buffer {index} has {found} bytes, must have {expected}: it is truncated");
            return Err(PointsError::invalid(path, what));
        }
        buffers.push(buffer);
    }
    Ok(Buffers(buffers))
}

/// The bytes behind a URI.
pub(super) fn read_uri(path: &Path, uri: &str) -> Result<Vec<u8>, PointsError> {
    match open_uri(path, uri)? {
        Buffer::Memory(bytes) => Ok(bytes),
        file => file.read(0..file.len()),
    }
}

/// What is behind a URI: base64 data, or a file relative to the glTF file.
fn open_uri(path: &Path, uri: &str) -> Result<Buffer, PointsError> {
    if let Some(data) = uri.strip_prefix("data:") {
        let encoded = data.split_once(";base64,").map(|(_, encoded)| encoded);
        return encoded
            .and_then(decode_base64)
            .map(Buffer::Memory)
            .ok_or_else(|| PointsError::invalid(path, "a data URI is not valid base64"));
    }
    if uri.contains("://") {
        let what = format!("the URI {uri:?}");
        return Err(PointsError::unsupported(path, what, "put the file beside the scene"));
    }
    open_file(path, &resolve(path, uri)?)
}

/// Where a relative URI points to.
pub(super) fn resolve(path: &Path, uri: &str) -> Result<PathBuf, PointsError> {
    beside(path, &decode_percent(uri))
}

fn open_file(scene: &Path, path: &Path) -> Result<Buffer, PointsError> {
    let missing = |error: std::io::Error| {
        if scene != path && error.kind() == std::io::ErrorKind::NotFound {
            let what = format!("file {path:?} is named but missing: copy it beside the scene");
            return PointsError::invalid(scene, what);
        }
        PointsError::io("read", path)(error)
    };
    let file = File::open(path).map_err(missing)?;
    let length = file.metadata().map_err(missing)?.len();
    if length > limits::MESH_FILE_BYTES_MAX {
        return Err(PointsError::Limit {
            what: "size of the file in bytes",
            value: length,
            limit: limits::MESH_FILE_BYTES_MAX,
            path: path.to_owned(),
        });
    }
    Ok(Buffer::File {
        file,
        path: path.to_owned(),
        range: 0..length,
    })
}

fn decode_percent(uri: &str) -> String {
    let mut bytes = Vec::with_capacity(uri.len());
    let mut rest = uri.as_bytes();
    while let Some((&first, tail)) = rest.split_first() {
        let digits = tail.get(..2).and_then(|hex| std::str::from_utf8(hex).ok());
        let decoded = digits.and_then(|hex| u8::from_str_radix(hex, 16).ok());
        match decoded {
            Some(byte) if first == b'%' => {
                bytes.push(byte);
                rest = &tail[2..];
            }
            _ => {
                bytes.push(first);
                rest = tail;
            }
        }
    }
    String::from_utf8_lossy(&bytes).into_owned()
}

fn decode_base64(text: &str) -> Option<Vec<u8>> {
    let mut bytes = Vec::with_capacity(text.len() / 4 * 3);
    let (mut bits, mut filled) = (0u32, 0);
    for byte in text.trim_end_matches('=').bytes() {
        let value = match byte {
            b'A'..=b'Z' => byte - b'A',
            b'a'..=b'z' => byte - b'a' + 26,
            b'0'..=b'9' => byte - b'0' + 52,
            b'+' | b'-' => 62,
            b'/' | b'_' => 63,
            _ => return None,
        };
        bits = bits << 6 | u32::from(value);
        filled += 6;
        if filled >= 8 {
            filled -= 8;
            bytes.push((bits >> filled) as u8);
            bits &= (1 << filled) - 1;
        }
    }
    Some(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn uris_are_decoded() {
        assert_eq!(decode_percent("a%20b%2Fc.png"), "a b/c.png");
        assert_eq!(decode_percent("100%"), "100%");
        assert_eq!(decode_base64("aGVsbG8gd29ybGQ=").unwrap(), b"hello world");
        assert!(decode_base64("a*b").is_none());
    }

    #[test]
    fn damaged_containers_are_errors() {
        let path = Path::new("x.glb");
        let whole = [
            b"glTF".as_slice(),
            &2u32.to_le_bytes(),
            &20u32.to_le_bytes(),
            &0u32.to_le_bytes(),
            b"JSON",
        ]
        .concat();
        let split = |length| split_glb(path, &Buffer::Memory(whole[..length].to_vec()));
        assert!(split(whole.len()).is_ok());
        for length in 4..whole.len() {
            assert!(split(length).is_err(), "{length} bytes");
        }
    }
}
