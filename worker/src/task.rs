//! What a worker knows of a job, from the wire, checked.

use pbgi_core::{
    Bounds, BuildId, BuildSettings, Environment, HitSides, MountId, NodeIndex, Quantizer, SceneInfo, ShadeSettings,
    limits,
};
use pbgi_proto::v1;

/// A job's scene and settings.
#[derive(Debug)]
pub(crate) struct Task {
    pub(crate) id: u64,
    pub(crate) scene: SceneInfo,
    pub(crate) mount: MountId,
    pub(crate) settings: ShadeSettings,
    pub(crate) environment: Option<Environment>,
    /// Angle between neighbouring rays, radians, where rays are traced.
    pub(crate) pixel_angle: Option<f32>,
}

impl Task {
    pub(crate) fn from_wire(id: u64, wire: v1::Task) -> Result<Self, String> {
        let scene = wire.scene.as_ref().ok_or("a task without a scene")?;
        let slot = u8::try_from(wire.mount_slot).ok();
        let slot = slot.filter(|&slot| usize::from(slot) < limits::MOUNTS_MAX);
        let mount = MountId {
            slot: slot.ok_or_else(|| format!("mount slot {}", wire.mount_slot))?,
            generation: u16::try_from(wire.mount_generation)
                .map_err(|_| format!("mount generation {}", wire.mount_generation))?,
        };
        Ok(Self {
            id,
            scene: scene_info(scene)?,
            mount,
            settings: shade_settings(wire.settings.as_ref())?,
            pixel_angle: wire.rays.map(|rays| pixel_angle(rays.pixel_angle)).transpose()?,
            environment: environment(wire.environment_width, wire.environment_height, &wire.environment)?,
        })
    }
}

fn pixel_angle(angle: f32) -> Result<f32, String> {
    if angle > 0.0 && angle < 1.0 {
        Ok(angle)
    } else {
        Err(format!("a pixel angle of {angle}"))
    }
}

fn scene_info(wire: &v1::SceneInfo) -> Result<SceneInfo, String> {
    let build_id = BuildId::try_from(wire.build_id.clone()).map_err(|_| format!("build id {:?}", wire.build_id))?;
    let bounds = match &wire.bounds {
        None => None,
        Some(bounds) => match (bounds.min[..].try_into(), bounds.max[..].try_into()) {
            (Ok(min), Ok(max)) => Some(Bounds { min, max }),
            _ => return Err("bounds that are no box".to_owned()),
        },
    };
    let quantizer = match wire.lattice[..] {
        [] => None,
        [x, y, z, edge] => Some(Quantizer {
            origin: [x, y, z],
            edge,
        }),
        _ => return Err(format!("a lattice of {} numbers", wire.lattice.len())),
    };
    // A page layout that is guessed would read nonsense: every field has to be there.
    let wire_settings = wire.settings.unwrap_or_default();
    let whole = |value: Option<u32>, name: &str| value.ok_or_else(|| format!("a scene without {name}"));
    let settings = BuildSettings {
        leaf_max: whole(wire_settings.leaf_max, "leaf_max")?,
        chunk_levels: whole(wire_settings.chunk_levels, "chunk_levels")?,
        nodes_per_page: whole(wire_settings.nodes_per_page, "nodes_per_page")?,
        points_per_page: whole(wire_settings.points_per_page, "points_per_page")?,
    };
    settings.validate().map_err(|error| error.to_string())?;
    let records_max = 1 << 32;
    if wire.point_count > records_max || wire.node_slots > records_max {
        return Err(format!(
            "{} points and {} node slots",
            wire.point_count, wire.node_slots
        ));
    }
    Ok(SceneInfo {
        build_id,
        point_count: wire.point_count,
        node_count: wire.node_count,
        node_slots: wire.node_slots,
        root: wire.root.map(NodeIndex),
        bounds,
        quantizer,
        radius_max: wire.radius_max,
        // Positions on the wire are relative to it already.
        origin: [0.0; 3],
        settings,
    })
}

fn shade_settings(wire: Option<&v1::ShadeSettings>) -> Result<ShadeSettings, String> {
    let wire = wire.copied().unwrap_or_default();
    let default = ShadeSettings::default();
    let settings = ShadeSettings {
        max_solid_angle: wire.max_solid_angle.unwrap_or(default.max_solid_angle),
        raster_resolution: wire.raster_resolution.unwrap_or(default.raster_resolution),
        max_dist: wire.max_dist.unwrap_or(default.max_dist),
        falloff: wire.falloff.unwrap_or(default.falloff),
        bias: wire.bias.unwrap_or(default.bias),
        interpolation: wire.interpolation.unwrap_or(default.interpolation),
        hit_sides: match wire.hit_sides() {
            v1::HitSides::Both => HitSides::Both,
            v1::HitSides::Front => HitSides::Front,
            v1::HitSides::Back => HitSides::Back,
        },
        ..default
    };
    settings.validate().map_err(|error| error.to_string())?;
    Ok(settings)
}

fn environment(width: u32, height: u32, bytes: &[u8]) -> Result<Option<Environment>, String> {
    if bytes.is_empty() {
        return Ok(None);
    }
    let (floats, rest) = bytes.as_chunks::<4>();
    let floats: Vec<f32> = floats.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
    let (pixels, left) = floats.as_chunks::<3>();
    if !rest.is_empty() || !left.is_empty() {
        return Err(format!("an environment of {} bytes", bytes.len()));
    }
    let environment = Environment::new(width, height, pixels.to_vec());
    environment.map(Some).map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    pub(crate) fn wire() -> v1::Task {
        v1::Task {
            scene: Some(v1::SceneInfo {
                build_id: format!("{:032x}", 7),
                settings: Some(v1::BuildSettings {
                    leaf_max: Some(16),
                    chunk_levels: Some(3),
                    nodes_per_page: Some(256),
                    points_per_page: Some(1024),
                }),
                ..Default::default()
            }),
            mount_slot: 2,
            mount_generation: 3,
            ..Default::default()
        }
    }

    #[test]
    fn a_task_is_read() {
        let task = Task::from_wire(1, wire()).unwrap();
        assert_eq!((task.mount.slot, task.mount.generation), (2, 3));
        assert_eq!(task.settings, ShadeSettings::default());
        assert!(task.environment.is_none());
    }

    #[test]
    fn nonsense_is_refused() {
        let refused = |change: fn(&mut v1::Task)| {
            let mut task = wire();
            change(&mut task);
            Task::from_wire(1, task).unwrap_err()
        };
        assert!(refused(|task| task.scene = None).contains("scene"));
        let angle = refused(|task| task.rays = Some(v1::RayTracing { pixel_angle: f32::NAN }));
        assert!(angle.contains("pixel angle"));
        assert!(refused(|task| task.mount_slot = 64).contains("mount slot"));
        assert!(refused(|task| task.mount_generation = 1 << 16).contains("generation"));
        assert!(refused(|task| task.environment = vec![0; 5]).contains("5 bytes"));
        let no_pages = refused(|task| {
            if let Some(scene) = &mut task.scene {
                scene.settings = None;
            }
        });
        assert!(no_pages.contains("leaf_max"));
    }
}
