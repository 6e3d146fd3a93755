//! Wire types to plain types and back.

use crate::job::{
    BuildJob, DaemonStatus, Job, JobEvent, JobOptions, JobState, MountStatus, Pool, ShadeJob, WorkerStatus,
};
use crate::live::LiveJob;
use pbgi_core::{Bounds, BuildId, BuildSettings, HitSides, NodeIndex, Quantizer, SceneInfo, ShadeSettings, Statistics};
use pbgi_points::{CloudOptions, Density, Facing, InvalidPoints, Radius, Space};
use pbgi_proto::v1;
use std::path::Path;

pub(crate) fn build_task(job: &BuildJob) -> Result<v1::BuildTask, String> {
    Ok(v1::BuildTask {
        inputs: job.inputs.iter().map(|path| text(path)).collect::<Result<_, _>>()?,
        output: text(&job.output)?,
        overwrite: job.overwrite,
        settings: Some(wire_build_settings(&job.settings)),
        density: job.density.map(|density| match density {
            Density::Spacing(spacing) => v1::build_task::Density::Spacing(spacing),
            Density::Points(points) => v1::build_task::Density::Points(points),
            Density::View(view) => v1::build_task::Density::View(v1::ViewDensity {
                camera: view.camera as u32,
                width: view.size[0],
                height: view.size[1],
                pixels: view.pixels,
                floor: view.floor,
                ceiling: view.ceiling,
            }),
        }),
        cloud: Some(wire_cloud(&job.cloud)),
    })
}

pub(crate) fn shade_task(job: &ShadeJob) -> Result<v1::ShadeTask, String> {
    Ok(v1::ShadeTask {
        scene: text(&job.scene)?,
        gbuffer: text(&job.gbuffer)?,
        output: text(&job.output)?,
        overwrite: job.overwrite,
        settings: Some(wire_shade_settings(&job.settings)),
        environment: job.environment.as_deref().map(text).transpose()?.unwrap_or_default(),
        workers: job.workers.unwrap_or(0),
        position: job.passes.position.clone().unwrap_or_default(),
        normal: job.passes.normal.clone().unwrap_or_default(),
        space: match job.passes.space {
            Space::Checked => v1::Space::Checked,
            Space::World => v1::Space::World,
            Space::Camera => v1::Space::Camera,
        }
        .into(),
    })
}

pub(crate) fn live_start(job: &LiveJob) -> Result<v1::ShadePointsStart, String> {
    Ok(v1::ShadePointsStart {
        scene: text(&job.scene)?,
        settings: Some(wire_shade_settings(&job.settings)),
        environment: job.environment.as_deref().map(text).transpose()?.unwrap_or_default(),
        priority: job.priority,
        workers: job.workers.unwrap_or(0),
        report: true,
        rays: None,
    })
}

pub(crate) fn job_options(options: &JobOptions) -> v1::JobOptions {
    v1::JobOptions {
        user: options.user.clone(),
        labels: options.labels.clone().into_iter().collect(),
        priority: options.priority,
        after: options.after.clone(),
        paused: options.paused,
    }
}

/// A path as the wire carries it.
pub(crate) fn text(path: &Path) -> Result<String, String> {
    match path.to_str() {
        Some(text) => Ok(text.to_owned()),
        None => Err(format!("path {path:?} is not UTF-8; rename it")),
    }
}

fn wire_cloud(cloud: &CloudOptions) -> v1::CloudSettings {
    let (estimate_normals, viewpoint) = match cloud.estimate_normals {
        None => (None, Vec::new()),
        Some(Facing::Auto) => (Some(v1::Facing::Auto), Vec::new()),
        Some(Facing::Up) => (Some(v1::Facing::Up), Vec::new()),
        Some(Facing::Outward) => (Some(v1::Facing::Outward), Vec::new()),
        Some(Facing::Viewpoint(eye)) => (Some(v1::Facing::Viewpoint), eye.to_vec()),
    };
    v1::CloudSettings {
        origin: cloud.origin.map_or_else(Vec::new, |origin| origin.to_vec()),
        skip_invalid_points: cloud.invalid_points == InvalidPoints::Skip,
        recompute_bounds: cloud.recompute_bounds,
        estimate_normals: estimate_normals.map(Into::into),
        viewpoint,
        radius: cloud.radius.map(|radius| match radius {
            Radius::Estimate => v1::cloud_settings::Radius::EstimateRadius(true),
            Radius::Fixed(radius) => v1::cloud_settings::Radius::FixedRadius(radius),
        }),
        albedo: cloud.albedo,
    }
}

fn wire_build_settings(settings: &BuildSettings) -> v1::BuildSettings {
    v1::BuildSettings {
        leaf_max: Some(settings.leaf_max),
        chunk_levels: Some(settings.chunk_levels),
        nodes_per_page: Some(settings.nodes_per_page),
        points_per_page: Some(settings.points_per_page),
    }
}

fn wire_shade_settings(settings: &ShadeSettings) -> v1::ShadeSettings {
    v1::ShadeSettings {
        max_solid_angle: Some(settings.max_solid_angle),
        raster_resolution: Some(settings.raster_resolution),
        max_dist: Some(settings.max_dist),
        falloff: Some(settings.falloff),
        bias: Some(settings.bias),
        bounces: Some(settings.bounces),
        interpolation: Some(settings.interpolation),
        hit_sides: Some(match settings.hit_sides {
            HitSides::Both => v1::HitSides::Both.into(),
            HitSides::Front => v1::HitSides::Front.into(),
            HitSides::Back => v1::HitSides::Back.into(),
        }),
    }
}

pub(crate) fn job(wire: v1::Job) -> Result<Job, String> {
    let state = match wire.state() {
        v1::JobState::Queued => JobState::Queued,
        v1::JobState::Running => JobState::Running,
        v1::JobState::Succeeded => JobState::Succeeded,
        v1::JobState::Failed => JobState::Failed,
        v1::JobState::Cancelled => JobState::Cancelled,
        v1::JobState::Unspecified => return Err(format!("job state {}", wire.state)),
    };
    let options = wire.options.unwrap_or_default();
    let event = |event: v1::JobEvent| JobEvent {
        unix_millis: event.unix_millis,
        text: event.text,
    };
    Ok(Job {
        id: wire.job_id,
        state,
        stage: wire.stage,
        done: wire.done,
        total: wire.total,
        error: wire.error,
        statistics: statistics(wire.statistics.unwrap_or_default()),
        title: wire.title,
        options: JobOptions {
            user: options.user,
            labels: options.labels.into_iter().collect(),
            priority: options.priority,
            after: options.after,
            paused: options.paused,
            attach: false,
        },
        history: wire.history.into_iter().map(event).collect(),
    })
}

/// Rows of names that this version does not know are left out: a newer daemon may count more.
pub(crate) fn statistics(wire: v1::Statistics) -> Statistics {
    let mut statistics = Statistics::default();
    for (name, value) in wire.rows {
        statistics.set(&name, value);
    }
    statistics
}

pub(crate) fn scene_info(wire: &v1::SceneInfo) -> Result<SceneInfo, String> {
    let build_id = BuildId::try_from(wire.build_id.clone()).map_err(|_| format!("build id {:?}", wire.build_id))?;
    let bounds = wire.bounds.as_ref().map(bounds).transpose()?;
    let quantizer = match wire.lattice[..] {
        [] => None,
        [x, y, z, edge] => Some(Quantizer {
            origin: [x, y, z],
            edge,
        }),
        _ => return Err(format!("a lattice of {} numbers", wire.lattice.len())),
    };
    let settings = wire.settings.unwrap_or_default();
    let default = BuildSettings::default();
    let settings = BuildSettings {
        leaf_max: settings.leaf_max.unwrap_or(default.leaf_max),
        chunk_levels: settings.chunk_levels.unwrap_or(default.chunk_levels),
        nodes_per_page: settings.nodes_per_page.unwrap_or(default.nodes_per_page),
        points_per_page: settings.points_per_page.unwrap_or(default.points_per_page),
    };
    settings.validate().map_err(|e| e.to_string())?;
    Ok(SceneInfo {
        build_id,
        point_count: wire.point_count,
        node_count: wire.node_count,
        node_slots: wire.node_slots,
        root: wire.root.map(NodeIndex),
        bounds,
        quantizer,
        radius_max: wire.radius_max,
        origin: origin(&wire.origin)?,
        settings,
    })
}

fn origin(wire: &[f64]) -> Result<[f64; 3], String> {
    match wire {
        [] => Ok([0.0; 3]),
        &[x, y, z] => Ok([x, y, z]),
        _ => Err(format!("an origin of {} numbers", wire.len())),
    }
}

fn bounds(wire: &v1::Bounds) -> Result<Bounds, String> {
    match (wire.min[..].try_into(), wire.max[..].try_into()) {
        (Ok(min), Ok(max)) => Ok(Bounds { min, max }),
        _ => Err(format!("bounds of {} and {} numbers", wire.min.len(), wire.max.len())),
    }
}

pub(crate) fn daemon_status(wire: v1::DaemonStatus) -> DaemonStatus {
    let worker = |w: v1::WorkerStatus| WorkerStatus {
        slot: w.slot,
        epoch: w.epoch,
        pid: w.pid,
        busy: w.busy,
        frames_pinned: w.frames_pinned,
    };
    let mount = |m: v1::MountStatus| MountStatus {
        scene: m.scene,
        build_id: m.build_id,
        pages_loaded: m.pages_loaded,
    };
    DaemonStatus {
        version: wire.version,
        pid: wire.pid,
        memory_bytes: wire.memory_bytes,
        segment_bytes: wire.segment_bytes,
        nodes: Pool {
            frames: wire.node_frames,
            resident: wire.node_frames_resident,
        },
        points: Pool {
            frames: wire.point_frames,
            resident: wire.point_frames_resident,
        },
        workers: wire.workers.into_iter().map(worker).collect(),
        mounts: wire.mounts.into_iter().map(mount).collect(),
        jobs_queued: wire.jobs_queued,
        jobs_running: wire.jobs_running,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unknown_rows_of_a_newer_daemon_are_ignored() {
        let rows = [("points".to_owned(), 3.0), ("surfels".to_owned(), 4.0)].into();
        let read = statistics(v1::Statistics { rows });
        assert_eq!(read.points, Some(3.0));
    }

    #[test]
    fn a_scene_without_sense_is_refused() {
        let wire = v1::SceneInfo {
            build_id: "00".to_owned(),
            lattice: vec![0.0; 3],
            ..Default::default()
        };
        assert_eq!(scene_info(&wire).unwrap_err(), "a lattice of 3 numbers");
        assert!(scene_info(&v1::SceneInfo::default()).unwrap_err().contains("build id"));
    }

    #[test]
    fn a_job_without_a_state_is_refused() {
        assert!(job(v1::Job::default()).is_err());
    }
}
