//! Numbers out of buffers, every offset checked: a damaged file is an error, never a panic.

use super::buffers::Buffers;
use crate::error::PointsError;
use gltf::accessor::{DataType, Dimensions};
use std::path::Path;

pub(super) struct Accessors<'a> {
    path: &'a Path,
    document: &'a gltf::Document,
    buffers: &'a Buffers,
}

/// Largest number of elements of one accessor.
const COUNT_MAX: usize = crate::limits::TRIANGLES_MAX * 3;

impl<'a> Accessors<'a> {
    pub(super) fn new(path: &'a Path, document: &'a gltf::Document, buffers: &'a Buffers) -> Self {
        Self {
            path,
            document,
            buffers,
        }
    }

    /// Elements of an accessor; `None` if the file has no such accessor.
    pub(super) fn count(&self, index: usize) -> Option<usize> {
        self.document.accessors().nth(index).map(|accessor| accessor.count())
    }

    /// Vectors of an accessor that may be named or not; none of one that is not.
    pub(super) fn optional<const N: usize>(
        &self,
        index: Option<usize>,
        place: &str,
    ) -> Result<Vec<[f32; N]>, PointsError> {
        match index.and_then(|index| self.document.accessors().nth(index)) {
            Some(accessor) => self.vectors(&accessor, place),
            None => Ok(Vec::new()),
        }
    }

    /// Vectors of `N` numbers; whole numbers are normalised.
    pub(super) fn vectors<const N: usize>(
        &self,
        accessor: &gltf::Accessor<'_>,
        place: &str,
    ) -> Result<Vec<[f32; N]>, PointsError> {
        let expected = match N {
            2 => Dimensions::Vec2,
            3 => Dimensions::Vec3,
            _ => Dimensions::Vec4,
        };
        if accessor.dimensions() != expected {
            let found = accessor.dimensions();
            return Err(self.invalid(accessor, place, &format!("is {found:?}, must be {expected:?}")));
        }
        let component: fn(&[u8]) -> f32 = match accessor.data_type() {
            DataType::F32 => |b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]),
            DataType::U8 => |b| f32::from(b[0]) / 255.0,
            DataType::U16 => |b| f32::from(u16::from_le_bytes([b[0], b[1]])) / 65535.0,
            DataType::I8 if accessor.normalized() => |b| (f32::from(b[0] as i8) / 127.0).max(-1.0),
            DataType::I16 if accessor.normalized() => {
                |b| (f32::from(i16::from_le_bytes([b[0], b[1]])) / 32767.0).max(-1.0)
            }
            other => return Err(self.invalid(accessor, place, &format!("has components {other:?}, must be F32"))),
        };
        let size = accessor.data_type().size();
        self.read(accessor, place, |bytes| {
            std::array::from_fn(|axis| component(&bytes[axis * size..(axis + 1) * size]))
        })
    }

    /// Vertex indices.
    pub(super) fn indices(&self, accessor: &gltf::Accessor<'_>, place: &str) -> Result<Vec<u32>, PointsError> {
        let index = self.index_reader(accessor.data_type());
        let Some(index) = index.filter(|_| accessor.dimensions() == Dimensions::Scalar) else {
            return Err(self.invalid(accessor, place, "is no list of unsigned indices"));
        };
        self.read(accessor, place, index)
    }

    fn index_reader(&self, data_type: DataType) -> Option<fn(&[u8]) -> u32> {
        match data_type {
            DataType::U8 => Some(|b| u32::from(b[0])),
            DataType::U16 => Some(|b| u32::from(u16::from_le_bytes([b[0], b[1]]))),
            DataType::U32 => Some(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]])),
            _ => None,
        }
    }

    /// Elements of an accessor, sparse ones included. `decode` gets as many bytes as an element has.
    fn read<T: Clone>(
        &self,
        accessor: &gltf::Accessor<'_>,
        place: &str,
        decode: impl Fn(&[u8]) -> T,
    ) -> Result<Vec<T>, PointsError> {
        let (count, size) = (accessor.count(), accessor.size());
        if count > COUNT_MAX {
            return Err(self.invalid(accessor, place, &format!("announces {count} elements")));
        }
        let zeros = [0u8; 64];
        let mut elements = match accessor.view() {
            Some(view) => {
                let pieces = self.pieces(accessor, place, &view, accessor.offset(), count, size)?;
                pieces.iter().map(&decode).collect()
            }
            None => vec![decode(&zeros); count],
        };
        let Some(sparse) = accessor.sparse() else {
            return Ok(elements);
        };
        let (indices, values) = (sparse.indices(), sparse.values());
        let data_type = match indices.index_type() {
            gltf::accessor::sparse::IndexType::U8 => DataType::U8,
            gltf::accessor::sparse::IndexType::U16 => DataType::U16,
            gltf::accessor::sparse::IndexType::U32 => DataType::U32,
        };
        let index = self.index_reader(data_type).unwrap_or(|_| u32::MAX);
        let places = self.pieces(
            accessor,
            place,
            &indices.view(),
            indices.offset(),
            sparse.count(),
            data_type.size(),
        )?;
        let replacements = self.pieces(accessor, place, &values.view(), values.offset(), sparse.count(), size)?;
        for (at, bytes) in places.iter().zip(replacements.iter()) {
            match elements.get_mut(index(at) as usize) {
                Some(element) => *element = decode(bytes),
                None => return Err(self.invalid(accessor, place, "replaces an element that it does not have")),
            }
        }
        Ok(elements)
    }

    /// `count` pieces of `size` bytes of a buffer view.
    fn pieces(
        &self,
        accessor: &gltf::Accessor<'_>,
        place: &str,
        view: &gltf::buffer::View<'_>,
        offset: usize,
        count: usize,
        size: usize,
    ) -> Result<Pieces, PointsError> {
        let stride = view.stride().unwrap_or(size).max(size);
        let needed = match count {
            0 => Some(0),
            _ => (count - 1).checked_mul(stride).and_then(|last| last.checked_add(size)),
        };
        let view = self.buffers.view(self.document, view.index());
        let end = needed
            .and_then(|needed| offset.checked_add(needed))
            .map(|end| end as u64);
        match (view, end) {
            (Some(view), Some(end)) if end <= view.len() => Ok(Pieces {
                bytes: view.read(offset as u64..end)?,
                stride,
                size,
            }),
            (view, _) => {
                let found = view.map_or(0, |view| view.len());
                let what = format!("needs {count} elements of {size} bytes, its buffer view has {found} bytes");
                Err(self.invalid(accessor, place, &what))
            }
        }
    }

    fn invalid(&self, accessor: &gltf::Accessor<'_>, place: &str, what: &str) -> PointsError {
        PointsError::invalid(self.path, format!("{place}: accessor {} {what}", accessor.index()))
    }
}

/// Elements of an accessor, as they are in its buffer.
struct Pieces {
    bytes: Vec<u8>,
    /// Bytes from one to the next, and of one.
    stride: usize,
    size: usize,
}

impl Pieces {
    fn iter(&self) -> impl Iterator<Item = &[u8]> {
        self.bytes.chunks(self.stride).map(|piece| &piece[..self.size])
    }
}
