//! The bytes of a glTF file: the GLB container, buffers beside it, data URIs.

use super::instancing;
use crate::error::PointsError;
use crate::limits;
use crate::named_file::beside;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

/// The contents of every buffer.
pub(super) struct Buffers(Vec<Vec<u8>>);

impl Buffers {
    /// The bytes of a buffer view; `None` if it reaches beyond its buffer.
    pub(super) fn view(&self, document: &gltf::Document, index: usize) -> Option<&[u8]> {
        let view = document.as_json().buffer_views.get(index)?;
        let start = usize::try_from(view.byte_offset.unwrap_or_default().0).ok()?;
        let length = usize::try_from(view.byte_length.0).ok()?;
        self.0.get(view.buffer.value())?.get(start..start.checked_add(length)?)
    }
}

/// Reads the document, and the binary chunk of a GLB file.
pub(super) fn open(path: &Path) -> Result<(gltf::Document, Option<Vec<u8>>), PointsError> {
    let bytes = read_bytes(path, path)?;
    let (json, blob) = if bytes.starts_with(b"glTF") {
        let (json, blob) = split_glb(path, &bytes)?;
        (json, blob.map(<[u8]>::to_vec))
    } else {
        (bytes.as_slice(), None)
    };
    let damaged = |error: gltf::json::Error| PointsError::invalid(path, format!("not a usable glTF file: {error}"));
    let mut root: gltf::json::Root = gltf::json::deserialize::from_slice(json).map_err(damaged)?;
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
    Ok((document, blob))
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

/// The JSON chunk and the binary chunk.
fn split_glb<'a>(path: &Path, bytes: &'a [u8]) -> Result<(&'a [u8], Option<&'a [u8]>), PointsError> {
    const HEADER: usize = 12;
    const CHUNK_HEADER: usize = 8;
    let word = |at: usize| {
        let word = bytes
            .get(at..at + 4)
            .map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]));
        word.ok_or_else(|| PointsError::invalid(path, "the GLB file ends within a header"))
    };
    if word(4)? != 2 {
        let what = format!("GLB version {}", word(4)?);
        return Err(PointsError::unsupported(path, what, "export glTF 2.0"));
    }
    let announced = word(8)? as usize;
    if announced > bytes.len() {
        return Err(PointsError::Truncated {
            expected: announced as u64,
            actual: bytes.len() as u64,
            path: path.to_owned(),
        });
    }
    let chunk = |at: usize, kind: &[u8; 4]| {
        let (length, found) = (word(at)? as usize, bytes.get(at + 4..at + CHUNK_HEADER));
        let body = bytes.get(at + CHUNK_HEADER..(at + CHUNK_HEADER).saturating_add(length));
        match body {
            Some(body) if found == Some(kind) => Ok(body),
            _ => {
                let what = format!(
                    "the GLB file has no whole chunk {:?} at byte {at}",
                    String::from_utf8_lossy(kind)
                );
                Err(PointsError::invalid(path, what))
            }
        }
    };
    let json = chunk(HEADER, b"JSON")?;
    let next = HEADER + CHUNK_HEADER + json.len().next_multiple_of(4);
    if next + CHUNK_HEADER > bytes.len() {
        return Ok((json, None));
    }
    Ok((json, Some(chunk(next, b"BIN\0")?)))
}

/// Reads every buffer, and checks its length.
pub(super) fn load(path: &Path, document: &gltf::Document, blob: Option<Vec<u8>>) -> Result<Buffers, PointsError> {
    let mut blob = blob;
    let mut buffers = Vec::new();
    for (index, buffer) in document.as_json().buffers.iter().enumerate() {
        let bytes = match &buffer.uri {
            Some(uri) => read_uri(path, uri)?,
            None => blob.take().ok_or_else(|| {
                PointsError::invalid(path, format!("buffer {index} has no uri, and there is no binary chunk"))
            })?,
        };
        let expected = buffer.byte_length.0;
        if (bytes.len() as u64) < expected {
            let what = format!(
                "buffer {index} has {} bytes, must have {expected}: it is truncated",
                bytes.len()
            );
            return Err(PointsError::invalid(path, what));
        }
        buffers.push(bytes);
    }
    Ok(Buffers(buffers))
}

/// The bytes behind a URI: base64 data, or a file relative to the glTF file.
pub(super) fn read_uri(path: &Path, uri: &str) -> Result<Vec<u8>, PointsError> {
    if let Some(data) = uri.strip_prefix("data:") {
        let encoded = data.split_once(";base64,").map(|(_, encoded)| encoded);
        return encoded
            .and_then(decode_base64)
            .ok_or_else(|| PointsError::invalid(path, "a data URI is not valid base64"));
    }
    if uri.contains("://") {
        let what = format!("the URI {uri:?}");
        return Err(PointsError::unsupported(path, what, "put the file beside the scene"));
    }
    let file = resolve(path, uri)?;
    read_bytes(path, &file)
}

/// Where a relative URI points to.
pub(super) fn resolve(path: &Path, uri: &str) -> Result<PathBuf, PointsError> {
    beside(path, &decode_percent(uri))
}

fn read_bytes(scene: &Path, path: &Path) -> Result<Vec<u8>, PointsError> {
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
    let mut bytes = Vec::with_capacity(length as usize);
    file.take(limits::MESH_FILE_BYTES_MAX)
        .read_to_end(&mut bytes)
        .map_err(missing)?;
    Ok(bytes)
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
        assert!(split_glb(path, &whole).is_ok());
        for length in 4..whole.len() {
            assert!(split_glb(path, &whole[..length]).is_err(), "{length} bytes");
        }
    }
}
