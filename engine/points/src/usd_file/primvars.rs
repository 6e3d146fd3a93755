//! Attributes that vary over a mesh: by face, by point, or by the corners of its faces.

use super::values::{Values, pairs, vectors};
use crate::error::PointsError;
use openusd::sdf::Value;
use openusd::usd::Prim;

/// What an attribute has a value for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Per {
    Mesh,
    Face,
    Point,
    Corner,
}

/// Values of an attribute, and which of them is whose.
#[derive(Debug)]
pub(super) struct Primvar<T> {
    pub(super) values: Vec<T>,
    /// Places in `values`; in their order without.
    indices: Option<Vec<i32>>,
    pub(super) per: Per,
}

/// How many of each a mesh has.
#[derive(Clone, Copy)]
pub(super) struct Counts {
    pub(super) faces: usize,
    pub(super) points: usize,
    pub(super) corners: usize,
}

/// A place on a mesh.
#[derive(Clone, Copy)]
pub(super) struct At {
    pub(super) face: usize,
    pub(super) point: usize,
    pub(super) corner: usize,
}

impl<T: Copy> Primvar<T> {
    /// Which of the values belongs there.
    pub(super) fn index(&self, at: At) -> usize {
        let index = match self.per {
            Per::Mesh => 0,
            Per::Face => at.face,
            Per::Point => at.point,
            Per::Corner => at.corner,
        };
        // Both were checked when it was read.
        self.indices.as_ref().map_or(index, |indices| indices[index] as usize)
    }

    pub(super) fn at(&self, at: At) -> T {
        self.values[self.index(at)]
    }
}

impl Values {
    pub(super) fn vector_primvar(
        &self,
        prim: &Prim,
        name: &str,
        missing: Per,
        counts: Counts,
    ) -> Result<Option<Primvar<[f32; 3]>>, PointsError> {
        self.primvar(prim, name, missing, counts, vectors)
    }

    pub(super) fn pair_primvar(
        &self,
        prim: &Prim,
        name: &str,
        counts: Counts,
    ) -> Result<Option<Primvar<[f32; 2]>>, PointsError> {
        self.primvar(prim, name, Per::Mesh, counts, pairs)
    }

    /// An attribute with its interpolation, `missing` where it says none, and its indices, all in range.
    fn primvar<T>(
        &self,
        prim: &Prim,
        name: &str,
        missing: Per,
        counts: Counts,
        list: impl Fn(Value) -> Option<Vec<T>>,
    ) -> Result<Option<Primvar<T>>, PointsError> {
        let Some(values) = self.value(prim, name)?.and_then(list) else {
            return Ok(None);
        };
        let per = self.per(prim, name)?.unwrap_or(missing);
        let indices = self.integers(prim, &format!("{name}:indices"))?;
        let needed = match per {
            Per::Mesh => 1,
            Per::Face => counts.faces,
            Per::Point => counts.points,
            Per::Corner => counts.corners,
        };
        let found = indices.as_ref().map_or(values.len(), Vec::len);
        if found < needed {
            let what = format!("{name} has {found} values, must have {needed} ({per:?})");
            return Err(self.wrong(prim, what));
        }
        let beyond = |index: &&i32| usize::try_from(**index).map_or(true, |index| index >= values.len());
        if let Some(index) = indices.iter().flatten().find(beyond) {
            let what = format!(
                "{name}:indices has {index}, which is beyond its {} values",
                values.len()
            );
            return Err(self.wrong(prim, what));
        }
        Ok(Some(Primvar { values, indices, per }))
    }

    fn per(&self, prim: &Prim, name: &str) -> Result<Option<Per>, PointsError> {
        let interpolation = self.said(prim.attribute(name).get_metadata::<Value>("interpolation"))?;
        Ok(match interpolation.as_ref().and_then(super::values::word).as_deref() {
            Some("constant") => Some(Per::Mesh),
            Some("uniform") => Some(Per::Face),
            Some("varying" | "vertex") => Some(Per::Point),
            Some("faceVarying") => Some(Per::Corner),
            _ => None,
        })
    }
}
