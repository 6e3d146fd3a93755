//! The prims of a stage, depth first: what each draws or lights, and where. What is there many times, instances and prototypes of
//! instancers, is looked at once.

use super::contain::Pulse;
use super::lights::{self, Lamp};
use super::materials::{Materials, Skin};
use super::values::{Values, vectors, word};
use super::{cameras, meshes, shapes, skies};
use crate::camera::Camera;
use crate::error::PointsError;
use crate::geometry::Geometry;
use crate::limits;
use crate::scene::Room;
use crate::surroundings::Surroundings;
use glam::{DAffine3, DQuat, DVec3};
use openusd::sdf::{self, Value};
use openusd::usd::Prim;
use std::collections::BTreeMap;
use std::rc::Rc;

/// What a prim has from those above it.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Context {
    /// To the space of the branch.
    place: DAffine3,
    visible: bool,
    /// Whether its purpose is one that pictures are made of.
    rendered: bool,
    /// Bindings for pictures like ours and for all, and whether nothing below may differ.
    preview: Option<(String, bool)>,
    full: Option<(String, bool)>,
    /// The colour of what has no material.
    pub(super) color: Option<[f32; 3]>,
}

/// What a part of the stage holds, in the space of its root.
#[derive(Default)]
pub(super) struct Branch {
    /// Numbers of geometries.
    pub(super) meshes: Vec<(usize, DAffine3)>,
    pub(super) lamps: Vec<(Lamp, DAffine3)>,
    pub(super) cameras: Vec<(Camera, DAffine3)>,
    pub(super) skies: Vec<Surroundings>,
}

impl Branch {
    fn len(&self) -> usize {
        self.meshes.len() + self.lamps.len() + self.cameras.len() + self.skies.len()
    }

    /// Puts all of another one there.
    fn add(&mut self, part: &Self, place: &DAffine3) {
        fn put<T: Clone>(things: &mut Vec<(T, DAffine3)>, more: &[(T, DAffine3)], place: &DAffine3) {
            things.extend(more.iter().map(|(thing, inner)| (thing.clone(), *place * *inner)));
        }
        put(&mut self.meshes, &part.meshes, place);
        put(&mut self.lamps, &part.lamps, place);
        put(&mut self.cameras, &part.cameras, place);
        self.skies.extend(part.skies.iter().map(|sky| sky.clone().moved(place)));
    }
}

/// Walks a stage.
pub(super) struct Walk<'a> {
    values: &'a Values,
    pulse: &'a Pulse,
    room: Room,
    pub(super) materials: Materials,
    pub(super) geometries: Vec<Geometry>,
    /// Shared parts by the path of their root and what they have from above.
    shared: BTreeMap<String, Rc<Branch>>,
    /// Shared parts that are being looked at: one that holds itself has no end.
    open: Vec<String>,
    visited: usize,
    bytes: u64,
}

impl Context {
    const ROOT: Self = Self {
        place: DAffine3::IDENTITY,
        visible: true,
        rendered: true,
        preview: None,
        full: None,
        color: None,
    };

    /// The material that is bound.
    pub(super) fn bound(&self) -> Option<String> {
        let bound = self.preview.as_ref().or(self.full.as_ref());
        bound.map(|(material, _)| material.clone())
    }

    /// The material that is bound to a part of the prim, such as some faces.
    pub(super) fn rebound(&self, values: &Values, part: &Prim) -> Result<Option<String>, PointsError> {
        let mut inner = self.clone();
        inner.bind(values, part)?;
        Ok(inner.bound())
    }

    fn bind(&mut self, values: &Values, prim: &Prim) -> Result<(), PointsError> {
        for (name, bound) in [
            ("material:binding:preview", &mut self.preview),
            ("material:binding", &mut self.full),
        ] {
            if matches!(bound, Some((_, true))) {
                continue;
            }
            let relation = prim.relationship(name);
            if let Some(material) = values.said(relation.targets())?.into_iter().next() {
                let strength = values.said(prim.attribute(name).get_metadata::<Value>("bindMaterialAs"))?;
                let strong = strength.as_ref().and_then(word).as_deref() == Some("strongerThanDescendants");
                *bound = Some((material.as_str().to_owned(), strong));
            }
        }
        Ok(())
    }

    /// As it is for a prim below.
    fn below(&self, values: &Values, prim: &Prim) -> Result<Self, PointsError> {
        let mut inner = self.clone();
        inner.bind(values, prim)?;
        if values.token(prim, "visibility")?.as_deref() == Some("invisible") {
            inner.visible = false;
        }
        if let Some(purpose) = values.token(prim, "purpose")? {
            inner.rendered = matches!(purpose.as_str(), "default" | "render");
        }
        if let Some([color]) = values
            .value(prim, "primvars:displayColor")?
            .and_then(vectors)
            .as_deref()
        {
            inner.color = Some(values.checked_color(prim, "primvars:displayColor", *color)?);
        }
        let (place, apart) = values.place(prim)?;
        inner.place = if apart { place } else { self.place * place };
        Ok(inner)
    }
}

impl<'a> Walk<'a> {
    pub(super) fn new(values: &'a Values, materials: Materials, room: Room, pulse: &'a Pulse) -> Self {
        Self {
            values,
            pulse,
            room,
            materials,
            geometries: Vec::new(),
            shared: BTreeMap::new(),
            open: Vec::new(),
            visited: 0,
            bytes: 0,
        }
    }

    /// All prims at the root, with the stage's space at `place`.
    pub(super) fn stage(&mut self, place: &DAffine3) -> Result<Branch, PointsError> {
        let mut branch = Branch::default();
        for name in self.values.said(self.values.stage.root_prims())? {
            let path = self.values.said(sdf::Path::abs_root().append_path(name.as_str()))?;
            self.visit(&self.values.stage.prim(path), &Context::ROOT, &mut branch, 0)?;
        }
        let mut world = Branch::default();
        world.add(&branch, place);
        Ok(world)
    }

    /// A prim that is there, and all below it.
    fn visit(&mut self, prim: &Prim, above: &Context, branch: &mut Branch, depth: usize) -> Result<(), PointsError> {
        let defined = self.values.said(prim.specifier())? == Some(sdf::Specifier::Def);
        if !defined || !self.values.said(prim.is_active())? {
            return Ok(());
        }
        self.look(prim, above, branch, depth)
    }

    fn look(&mut self, prim: &Prim, above: &Context, branch: &mut Branch, depth: usize) -> Result<(), PointsError> {
        self.pulse.beat();
        self.visited += 1;
        if depth > limits::USD_DEPTH_MAX || self.visited > limits::USD_PRIMS_MAX {
            let what = format!(
                "the stage is deeper than {} or has more than {} prims",
                limits::USD_DEPTH_MAX,
                limits::USD_PRIMS_MAX
            );
            return Err(self.values.wrong(prim, what));
        }
        let kind = self.values.type_of(prim)?;
        if matches!(kind.as_str(), "Material" | "Shader" | "NodeGraph" | "GeomSubset") {
            return Ok(());
        }
        let context = above.below(self.values, prim)?;
        if kind == "Camera" {
            branch
                .cameras
                .extend(cameras::read(self.values, prim)?.map(|camera| (camera, context.place)));
        }
        if context.visible && context.rendered {
            self.draw(prim, &kind, &context, branch)?;
        }
        if kind == "PointInstancer" {
            return self.scatter(prim, &context, branch, depth);
        }
        if self.values.said(prim.is_instance())? {
            let prototype = self.values.said(prim.prototype())?;
            let key = prototype.unwrap_or_else(|| prim.path().clone());
            let inner = self.shared(key.as_str(), &context, |walk, context, branch| {
                walk.children(prim, context, branch, depth)
            })?;
            return self.extend(prim, branch, &inner, &context.place);
        }
        self.children(prim, &context, branch, depth)
    }

    fn children(
        &mut self,
        prim: &Prim,
        context: &Context,
        branch: &mut Branch,
        depth: usize,
    ) -> Result<(), PointsError> {
        for child in self.values.said(prim.children())? {
            self.visit(&child, context, branch, depth + 1)?;
        }
        Ok(())
    }

    /// What the prim itself is.
    fn draw(&mut self, prim: &Prim, kind: &str, context: &Context, branch: &mut Branch) -> Result<(), PointsError> {
        let values = self.values;
        if let Some(lamp) = lights::read(values, prim, kind)? {
            branch.lamps.push((lamp, context.place));
            return Ok(());
        }
        let geometry = match kind {
            "DomeLight" | "DomeLight_1" => {
                branch.skies.push(skies::read(values, prim, kind, &context.place)?);
                return Ok(());
            }
            "Mesh" => meshes::read(values, prim, context, &mut self.materials)?,
            "Sphere" | "Cube" | "Cylinder" | "Cone" | "Plane" => {
                let skin = Skin {
                    material: context.bound(),
                    double_sided: values.flag(prim, "doubleSided")?,
                };
                let dress = self.materials.dress(values, &skin, &[])?;
                let material = self.materials.colored(&dress, context.color);
                match shapes::read(values, prim, kind, material)? {
                    Some(shape) => shape,
                    None => return Ok(()),
                }
            }
            _ => return Ok(()),
        };
        if !geometry.triangles.is_empty() {
            self.bytes += geometry.memory_bytes() as u64;
            self.room.fits(self.bytes)?;
            branch.meshes.push((self.geometries.len(), context.place));
            self.geometries.push(geometry);
        }
        Ok(())
    }

    /// A part that may be there many times, in the space of its root.
    fn shared(
        &mut self,
        root: &str,
        context: &Context,
        look: impl FnOnce(&mut Self, &Context, &mut Branch) -> Result<(), PointsError>,
    ) -> Result<Rc<Branch>, PointsError> {
        let inner = Context {
            place: DAffine3::IDENTITY,
            ..context.clone()
        };
        let key = format!("{root} {inner:?}");
        if let Some(known) = self.shared.get(&key) {
            return Ok(known.clone());
        }
        if self.open.contains(&key) {
            return Err(PointsError::invalid(
                self.values.file(),
                format!("{root} holds itself as an instance"),
            ));
        }
        self.open.push(key.clone());
        let mut branch = Branch::default();
        look(self, &inner, &mut branch)?;
        self.open.pop();
        let branch = Rc::new(branch);
        self.shared.insert(key, branch.clone());
        Ok(branch)
    }

    /// Puts a shared part there.
    fn extend(&self, prim: &Prim, branch: &mut Branch, part: &Branch, place: &DAffine3) -> Result<(), PointsError> {
        if branch.len() + part.len() > limits::INSTANCES_MAX {
            let what = format!("more than {} placed meshes and lights", limits::INSTANCES_MAX);
            return Err(self.values.wrong(prim, what));
        }
        branch.add(part, place);
        Ok(())
    }

    /// A `UsdGeomPointInstancer`: its prototypes, each as often as there are points for it.
    fn scatter(
        &mut self,
        prim: &Prim,
        context: &Context,
        branch: &mut Branch,
        depth: usize,
    ) -> Result<(), PointsError> {
        let values = self.values;
        let mut prototypes = Vec::new();
        for target in values.said(prim.relationship("prototypes").targets())? {
            let root = values.stage.prim(target.prim_path());
            // It may stand in an `over`, so that nothing draws it where it is.
            prototypes.push(self.shared(target.as_str(), context, |walk, context, branch| {
                walk.look(&root, context, branch, depth + 1)
            })?);
        }
        let places = instances(values, prim, prototypes.len())?;
        let placed: usize = places
            .iter()
            .map(|(prototype, _)| prototypes[*prototype].meshes.len())
            .sum();
        self.room.fits(self.bytes + (placed * limits::NODE_BYTES) as u64)?;
        let views = branch.cameras.len();
        for (prototype, place) in places {
            self.extend(prim, branch, &prototypes[prototype], &(context.place * place))?;
        }
        // Views out of scattered things are of no use.
        branch.cameras.truncate(views);
        Ok(())
    }
}

/// The prototype of each visible instance, and where it is in the instancer.
fn instances(values: &Values, prim: &Prim, prototypes: usize) -> Result<Vec<(usize, DAffine3)>, PointsError> {
    let of = values.integers(prim, "protoIndices")?.unwrap_or_default();
    let positions = values.vectors(prim, "positions")?.unwrap_or_default();
    let scales = values.vectors(prim, "scales")?.unwrap_or_default();
    let turns = match values.value(prim, "orientationsf")?.and_then(turns) {
        Some(turns) if !turns.is_empty() => turns,
        _ => values.value(prim, "orientations")?.and_then(turns).unwrap_or_default(),
    };
    let ids = values.long_integers(prim, "ids")?.unwrap_or_default();
    let mut hidden = values.long_integers(prim, "invisibleIds")?.unwrap_or_default();
    hidden.sort_unstable();
    for (name, found) in [
        ("positions", positions.len()),
        ("scales", scales.len()),
        ("orientations", turns.len()),
    ] {
        if found != of.len() && (found > 0 || name == "positions") {
            let what = format!("{name} has {found} values, protoIndices {}", of.len());
            return Err(values.wrong(prim, what));
        }
    }
    let mut places = Vec::new();
    for (index, prototype) in of.iter().enumerate() {
        let id = ids.get(index).copied().unwrap_or(index as i64);
        if hidden.binary_search(&id).is_ok() {
            continue;
        }
        let prototype = usize::try_from(*prototype).ok().filter(|number| *number < prototypes);
        let prototype = prototype.ok_or_else(|| {
            values.wrong(
                prim,
                format!("instance {index} is of prototype {}, there are {prototypes}", of[index]),
            )
        })?;
        let vector = |list: &[[f32; 3]], missing: f64| {
            list.get(index)
                .map_or(DVec3::splat(missing), |vector| glam::Vec3::from(*vector).as_dvec3())
        };
        let turn = turns.get(index).copied().unwrap_or(DQuat::IDENTITY);
        let place = DAffine3::from_scale_rotation_translation(vector(&scales, 1.0), turn, vector(&positions, 0.0));
        if !place.is_finite() {
            return Err(values.wrong(prim, format!("the place of instance {index} is not finite")));
        }
        places.push((prototype, place));
    }
    Ok(places)
}

fn turns(value: Value) -> Option<Vec<DQuat>> {
    let turn = |w: f32, x: f32, y: f32, z: f32| {
        let turn = DQuat::from_xyzw(f64::from(x), f64::from(y), f64::from(z), f64::from(w));
        if turn.length_squared() > 0.0 {
            turn.normalize()
        } else {
            DQuat::IDENTITY
        }
    };
    Some(match value {
        Value::QuathVec(list) => {
            let turn = |q: &openusd::gf::Quath| turn(q.w.to_f32(), q.x.to_f32(), q.y.to_f32(), q.z.to_f32());
            list.iter().map(turn).collect()
        }
        Value::QuatfVec(list) => list.iter().map(|q| turn(q.w, q.x, q.y, q.z)).collect(),
        _ => return None,
    })
}
