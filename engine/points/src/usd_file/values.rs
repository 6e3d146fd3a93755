//! Values of attributes as our kinds of numbers, at the one time that is read: the stage's `startTimeCode`, or the earliest.

use crate::error::PointsError;
use glam::{DAffine3, DMat4, DVec3};
use openusd::schemas::geom::{Imageable, Xformable};
use openusd::sdf::{self, Value};
use openusd::usd::{Attribute, Prim, SchemaBase, SchemaKind, Stage, TimeCode};
use std::path::{Path, PathBuf};

/// Longest chain of connections: a cycle has no end.
const HOPS_MAX: usize = 16;

/// Reads attributes of a stage.
pub(super) struct Values {
    pub(super) stage: Stage,
    file: PathBuf,
    time: TimeCode,
}

/// What an input of a shader is.
pub(super) enum Input {
    /// Nothing is said.
    None,
    /// A value, of its own or of the interface that it is connected to.
    Value(Value),
    /// An output of a shader.
    Shader(Prim, String),
}

impl Values {
    pub(super) fn new(file: &Path, stage: Stage) -> Result<Self, PointsError> {
        let mut values = Self {
            stage,
            file: file.to_owned(),
            time: TimeCode::EARLIEST,
        };
        let start = values.said(values.stage.stage_metadata("startTimeCode"))?;
        if let Some(start) = start.as_ref().and_then(number) {
            values.time = TimeCode::new(start);
        }
        Ok(values)
    }

    /// An error of the library as one of the file.
    pub(super) fn said<T, E: std::fmt::Display>(&self, result: Result<T, E>) -> Result<T, PointsError> {
        result.map_err(|error| PointsError::invalid(&self.file, format!("not a usable USD stage: {error:#}")))
    }

    /// What is wrong with a prim.
    pub(super) fn wrong(&self, prim: &Prim, what: impl std::fmt::Display) -> PointsError {
        PointsError::invalid(&self.file, format!("{}: {what}", prim.path()))
    }

    /// What a prim uses that is not read.
    pub(super) fn unsupported(&self, prim: &Prim, what: impl std::fmt::Display, remedy: &str) -> PointsError {
        PointsError::unsupported(&self.file, format!("{}: {what}", prim.path()), remedy)
    }

    pub(super) fn file(&self) -> &Path {
        &self.file
    }

    pub(super) fn value(&self, prim: &Prim, name: &str) -> Result<Option<Value>, PointsError> {
        self.value_of(&prim.attribute(name))
    }

    fn value_of(&self, attribute: &Attribute) -> Result<Option<Value>, PointsError> {
        let value = self.said(attribute.get_at::<Value>(self.time))?;
        match value {
            // Names of files are made whole in values without time only.
            Some(Value::AssetPath(_)) => Ok(self.said(attribute.get::<Value>())?.or(value)),
            value => Ok(value),
        }
    }

    pub(super) fn number(&self, prim: &Prim, name: &str, missing: f64) -> Result<f64, PointsError> {
        let found = self.value(prim, name)?.as_ref().and_then(number);
        let number = found.unwrap_or(missing);
        match number.is_finite() {
            true => Ok(number),
            false => Err(self.wrong(prim, format!("{name} is {number}, must be finite"))),
        }
    }

    /// A length, which must not be negative.
    pub(super) fn length(&self, prim: &Prim, name: &str, missing: f64) -> Result<f64, PointsError> {
        let length = self.number(prim, name, missing)?;
        match length >= 0.0 {
            true => Ok(length),
            false => Err(self.wrong(prim, format!("{name} is {length}, must not be negative"))),
        }
    }

    pub(super) fn flag(&self, prim: &Prim, name: &str) -> Result<bool, PointsError> {
        Ok(matches!(self.value(prim, name)?, Some(Value::Bool(true))))
    }

    pub(super) fn token(&self, prim: &Prim, name: &str) -> Result<Option<String>, PointsError> {
        Ok(self.value(prim, name)?.as_ref().and_then(word))
    }

    /// A colour, which must not be negative.
    pub(super) fn color(&self, prim: &Prim, name: &str) -> Result<Option<[f32; 3]>, PointsError> {
        let found = self.value(prim, name)?.as_ref().and_then(vector);
        found.map(|color| self.checked_color(prim, name, color)).transpose()
    }

    pub(super) fn checked_color(&self, prim: &Prim, name: &str, color: [f32; 3]) -> Result<[f32; 3], PointsError> {
        match color.iter().all(|value| value.is_finite() && *value >= 0.0) {
            true => Ok(color),
            false => Err(self.wrong(prim, format!("{name} is {color:?}, must be finite and not negative"))),
        }
    }

    pub(super) fn integers(&self, prim: &Prim, name: &str) -> Result<Option<Vec<i32>>, PointsError> {
        Ok(self.value(prim, name)?.and_then(|value| match value {
            Value::IntVec(list) => Some(list),
            _ => None,
        }))
    }

    pub(super) fn long_integers(&self, prim: &Prim, name: &str) -> Result<Option<Vec<i64>>, PointsError> {
        Ok(self.value(prim, name)?.and_then(|value| match value {
            Value::Int64Vec(list) => Some(list),
            Value::IntVec(list) => Some(list.into_iter().map(i64::from).collect()),
            _ => None,
        }))
    }

    pub(super) fn vectors(&self, prim: &Prim, name: &str) -> Result<Option<Vec<[f32; 3]>>, PointsError> {
        Ok(self.value(prim, name)?.and_then(vectors))
    }

    /// The composed type of a prim, empty for none.
    pub(super) fn type_of(&self, prim: &Prim) -> Result<String, PointsError> {
        let name = self.said(prim.type_name())?;
        Ok(name.map(String::from).unwrap_or_default())
    }

    /// Whether the pole of a dome light points along z.
    pub(super) fn pole_is_z(&self, prim: &Prim) -> Result<bool, PointsError> {
        match self.token(prim, "poleAxis")?.as_deref() {
            Some("Y") => Ok(false),
            Some("Z") => Ok(true),
            _ => self.up_is_z(),
        }
    }

    /// Whether the stage's z is up.
    pub(super) fn up_is_z(&self) -> Result<bool, PointsError> {
        let up = self.said(self.stage.stage_metadata("upAxis"))?;
        Ok(up.as_ref().and_then(word).as_deref() == Some("Z"))
    }

    /// Where a prim is within its parent, and whether it is there without regard to it.
    pub(super) fn place(&self, prim: &Prim) -> Result<(DAffine3, bool), PointsError> {
        let placed = Placed(prim.clone());
        let matrix = placed
            .local_to_parent_transform(self.time)
            .map_err(|error| self.wrong(prim, error))?;
        // Rows there are columns here, because points stand on the other side.
        let matrix = DMat4::from_cols_array(&matrix.0);
        if !matrix.is_finite() {
            return Err(self.wrong(prim, "its transform is not finite"));
        }
        let apart = self.said(placed.resets_xform_stack())?;
        Ok((DAffine3::from_mat4(matrix), apart))
    }

    /// What an attribute of a shader is, along its connections.
    pub(super) fn input(&self, shader: &Prim, name: &str) -> Result<Input, PointsError> {
        let mut attribute = shader.attribute(name);
        for _ in 0..HOPS_MAX {
            let Some(source) = self.said(attribute.connections())?.into_iter().next() else {
                return Ok(self.value_of(&attribute)?.map_or(Input::None, Input::Value));
            };
            let prim = self.stage.prim(source.prim_path());
            if self.type_of(&prim)? == "Shader" {
                let output = source.property_suffix().trim_start_matches('.');
                return Ok(Input::Shader(prim, output.trim_start_matches("outputs:").to_owned()));
            }
            attribute = self.stage.attribute(source);
        }
        Err(self.wrong(shader, format!("the connections of {name} are a cycle or too long")))
    }
}

/// Any prim as one with a transform.
struct Placed(Prim);

impl SchemaBase for Placed {
    const KIND: SchemaKind = SchemaKind::AbstractTyped;

    fn prim(&self) -> &Prim {
        &self.0
    }
}

impl Imageable for Placed {}
impl Xformable for Placed {}

pub(super) fn number(value: &Value) -> Option<f64> {
    Some(match value {
        Value::Double(number) => *number,
        Value::Float(number) => f64::from(*number),
        Value::Half(number) => f64::from(number.to_f32()),
        Value::Int(number) => f64::from(*number),
        Value::Uint(number) => f64::from(*number),
        _ => return None,
    })
}

pub(super) fn word(value: &Value) -> Option<String> {
    Some(match value {
        Value::Token(word) => word.as_str().to_owned(),
        Value::String(word) => word.clone(),
        _ => return None,
    })
}

pub(super) fn vector(value: &Value) -> Option<[f32; 3]> {
    Some(match value {
        Value::Vec3f(v) => [v.x, v.y, v.z],
        Value::Vec3d(v) => [v.x, v.y, v.z].map(|value| value as f32),
        Value::Vec3h(v) => [v.x, v.y, v.z].map(|value| value.to_f32()),
        _ => return None,
    })
}

pub(super) fn vectors(value: Value) -> Option<Vec<[f32; 3]>> {
    Some(match value {
        Value::Vec3fVec(list) => list.into_iter().map(|v| [v.x, v.y, v.z]).collect(),
        Value::Vec3dVec(list) => list.iter().map(|v| [v.x, v.y, v.z].map(|value| value as f32)).collect(),
        Value::Vec3hVec(list) => list
            .iter()
            .map(|v| [v.x, v.y, v.z].map(|value| value.to_f32()))
            .collect(),
        _ => return None,
    })
}

pub(super) fn pairs(value: Value) -> Option<Vec<[f32; 2]>> {
    Some(match value {
        Value::Vec2fVec(list) => list.into_iter().map(|v| [v.x, v.y]).collect(),
        Value::Vec2dVec(list) => list.iter().map(|v| [v.x, v.y].map(|value| value as f32)).collect(),
        Value::Vec2hVec(list) => list.iter().map(|v| [v.x, v.y].map(|value| value.to_f32())).collect(),
        _ => return None,
    })
}

/// The last name of a path.
pub(super) fn name_of(path: &sdf::Path) -> String {
    path.name().unwrap_or_default().to_owned()
}

/// The cube root of the volume that a unit cube has there: the factor of lengths where it scales alike along all axes.
pub(super) fn scale_of(place: &DAffine3) -> f64 {
    place.matrix3.determinant().abs().cbrt()
}

/// The direction of a prim's own -z there.
pub(super) fn forward_of(place: &DAffine3) -> DVec3 {
    place.transform_vector3(DVec3::NEG_Z).normalize_or(DVec3::NEG_Z)
}
