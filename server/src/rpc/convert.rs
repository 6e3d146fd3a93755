//! Wire types to ours, and back. What a client left unset takes the default here.

use crate::dispatcher::{DaemonStatus, TaskInfo};
use crate::error::JobError;
use crate::job::{BuildTask, JobEvent, JobOptions, JobState, JobStatus, Request, ShadeTask};
use crate::shade_job::Counters;
use pbgi_core::{Bounds, BuildSettings, HitSides, SceneInfo, ShadeSettings, Statistics};
use pbgi_points::{CloudOptions, Density, Facing, GBufferOptions, InvalidPoints, Radius, Space, ViewDensity};
use pbgi_proto::v1;
use pbgi_store::{LevelShape, SceneShape};

pub(super) fn request(task: Option<v1::submit_job_request::Task>) -> Result<Request, JobError> {
    match task {
        Some(v1::submit_job_request::Task::Build(task)) => Ok(Request::Build(BuildTask {
            inputs: task.inputs.into_iter().map(Into::into).collect(),
            output: task.output.into(),
            overwrite: task.overwrite,
            settings: build_settings(task.settings),
            density: task.density.map(density),
            cloud: cloud(task.cloud.unwrap_or_default())?,
        })),
        Some(v1::submit_job_request::Task::Shade(task)) => Ok(Request::Shade(ShadeTask {
            passes: passes(&task)?,
            scene: task.scene.into(),
            gbuffer: task.gbuffer.into(),
            output: task.output.into(),
            overwrite: task.overwrite,
            settings: shade_settings(task.settings),
            environment: (!task.environment.is_empty()).then(|| task.environment.into()),
            workers: (task.workers > 0).then_some(task.workers as usize),
        })),
        None => Err(JobError::invalid("the request has no task")),
    }
}

fn density(density: v1::build_task::Density) -> Density {
    match density {
        v1::build_task::Density::Spacing(spacing) => Density::Spacing(spacing),
        v1::build_task::Density::Points(points) => Density::Points(points),
        v1::build_task::Density::View(view) => Density::View(ViewDensity {
            camera: view.camera as usize,
            size: [view.width, view.height],
            pixels: view.pixels,
            floor: view.floor,
            ceiling: view.ceiling,
        }),
    }
}

pub(super) fn options(options: Option<v1::JobOptions>, caller: &str) -> JobOptions {
    let given = options.unwrap_or_default();
    JobOptions {
        user: if given.user.is_empty() {
            caller.to_owned()
        } else {
            given.user
        },
        labels: given.labels.into_iter().collect(),
        priority: given.priority,
        after: given.after,
        paused: given.paused,
    }
}

fn passes(task: &v1::ShadeTask) -> Result<GBufferOptions, JobError> {
    let layer = |name: &String| (!name.is_empty()).then(|| name.clone());
    Ok(GBufferOptions {
        position: layer(&task.position),
        normal: layer(&task.normal),
        space: match v1::Space::try_from(task.space) {
            Ok(v1::Space::Checked) => Space::Checked,
            Ok(v1::Space::World) => Space::World,
            Ok(v1::Space::Camera) => Space::Camera,
            Err(unknown) => return Err(JobError::invalid(format!("space is {unknown}"))),
        },
    })
}

fn cloud(given: v1::CloudSettings) -> Result<CloudOptions, JobError> {
    let estimate_normals = match given.estimate_normals.map(v1::Facing::try_from) {
        None => None,
        Some(Ok(v1::Facing::Auto)) => Some(Facing::Auto),
        Some(Ok(v1::Facing::Up)) => Some(Facing::Up),
        Some(Ok(v1::Facing::Outward)) => Some(Facing::Outward),
        Some(Ok(v1::Facing::Viewpoint)) => Some(Facing::Viewpoint(triple("viewpoint", &given.viewpoint)?)),
        Some(Err(unknown)) => return Err(JobError::invalid(format!("estimate_normals is {unknown}"))),
    };
    Ok(CloudOptions {
        origin: match &given.origin[..] {
            [] => None,
            origin => Some(triple("origin", origin)?),
        },
        invalid_points: match given.skip_invalid_points {
            true => InvalidPoints::Skip,
            false => InvalidPoints::Refuse,
        },
        recompute_bounds: given.recompute_bounds,
        estimate_normals,
        radius: given.radius.and_then(|radius| match radius {
            v1::cloud_settings::Radius::EstimateRadius(estimate) => estimate.then_some(Radius::Estimate),
            v1::cloud_settings::Radius::FixedRadius(radius) => Some(Radius::Fixed(radius)),
        }),
        albedo: given.albedo,
    })
}

fn triple<T: Copy>(name: &str, numbers: &[T]) -> Result<[T; 3], JobError> {
    let wrong = |_| JobError::invalid(format!("{name} has {} numbers, must have 3", numbers.len()));
    numbers.try_into().map_err(wrong)
}

fn build_settings(settings: Option<v1::BuildSettings>) -> BuildSettings {
    let (given, default) = (settings.unwrap_or_default(), BuildSettings::default());
    BuildSettings {
        leaf_max: given.leaf_max.unwrap_or(default.leaf_max),
        chunk_levels: given.chunk_levels.unwrap_or(default.chunk_levels),
        nodes_per_page: given.nodes_per_page.unwrap_or(default.nodes_per_page),
        points_per_page: given.points_per_page.unwrap_or(default.points_per_page),
    }
}

pub(super) fn shade_settings(settings: Option<v1::ShadeSettings>) -> ShadeSettings {
    let (given, default) = (settings.unwrap_or_default(), ShadeSettings::default());
    ShadeSettings {
        max_solid_angle: given.max_solid_angle.unwrap_or(default.max_solid_angle),
        raster_resolution: given.raster_resolution.unwrap_or(default.raster_resolution),
        max_dist: given.max_dist.unwrap_or(default.max_dist),
        falloff: given.falloff.unwrap_or(default.falloff),
        bias: given.bias.unwrap_or(default.bias),
        bounces: given.bounces.unwrap_or(default.bounces),
        interpolation: given.interpolation.unwrap_or(default.interpolation),
        hit_sides: match given.hit_sides() {
            v1::HitSides::Both => HitSides::Both,
            v1::HitSides::Front => HitSides::Front,
            v1::HitSides::Back => HitSides::Back,
        },
    }
}

pub(super) fn job(status: JobStatus) -> v1::Job {
    let state = match status.state {
        JobState::Queued => v1::JobState::Queued,
        JobState::Running => v1::JobState::Running,
        JobState::Succeeded => v1::JobState::Succeeded,
        JobState::Failed => v1::JobState::Failed,
        JobState::Cancelled => v1::JobState::Cancelled,
    };
    let event = |event: JobEvent| v1::JobEvent {
        unix_millis: event.unix_millis,
        text: event.text,
    };
    let history = status.history.into_iter().map(event);
    v1::Job {
        job_id: status.id,
        state: state.into(),
        stage: status.stage.into_owned(),
        done: status.done,
        total: status.total,
        error: status.error,
        statistics: Some(statistics(&status.statistics)),
        title: status.title,
        options: Some(v1::JobOptions {
            user: status.options.user,
            labels: status.options.labels.into_iter().collect(),
            priority: status.options.priority,
            after: status.options.after,
            paused: status.options.paused,
        }),
        history: history.collect(),
    }
}

pub(super) fn statistics(statistics: &Statistics) -> v1::Statistics {
    let rows = statistics.rows().into_iter();
    v1::Statistics {
        rows: rows.filter_map(|row| Some((row.name.to_owned(), row.value?))).collect(),
    }
}

pub(super) fn shape(shape: &SceneShape) -> v1::SceneShape {
    let level = |level: &LevelShape| v1::LevelShape {
        inner: level.inner,
        leaves: level.leaves,
        points: level.points,
    };
    v1::SceneShape {
        levels: shape.levels.iter().map(level).collect(),
        occupancy: shape.occupancy.to_vec(),
    }
}

pub(super) fn scene(info: &SceneInfo) -> v1::SceneInfo {
    let bounds = |bounds: &Bounds| v1::Bounds {
        min: bounds.min.to_vec(),
        max: bounds.max.to_vec(),
    };
    v1::SceneInfo {
        build_id: info.build_id.to_string(),
        point_count: info.point_count,
        node_count: info.node_count,
        node_slots: info.node_slots,
        root: info.root.map(|root| root.0),
        bounds: info.bounds.as_ref().map(bounds),
        lattice: info.quantizer.as_ref().map_or_else(Vec::new, |quantizer| {
            let [x, y, z] = quantizer.origin;
            vec![x, y, z, quantizer.edge]
        }),
        radius_max: info.radius_max,
        origin: info.origin.to_vec(),
        settings: Some(v1::BuildSettings {
            leaf_max: Some(info.settings.leaf_max),
            chunk_levels: Some(info.settings.chunk_levels),
            nodes_per_page: Some(info.settings.nodes_per_page),
            points_per_page: Some(info.settings.points_per_page),
        }),
    }
}

pub(super) fn task(task: &TaskInfo) -> v1::Task {
    let settings = &task.settings;
    let pixels = task
        .environment
        .iter()
        .flat_map(|environment| environment.pixels())
        .flatten();
    v1::Task {
        scene: Some(scene(&task.scene)),
        mount_slot: task.mount.slot.into(),
        mount_generation: task.mount.generation.into(),
        settings: Some(v1::ShadeSettings {
            max_solid_angle: Some(settings.max_solid_angle),
            raster_resolution: Some(settings.raster_resolution),
            max_dist: Some(settings.max_dist),
            falloff: Some(settings.falloff),
            bias: Some(settings.bias),
            // Done before: the scene's points carry the others.
            bounces: None,
            interpolation: Some(settings.interpolation),
            hit_sides: Some(wire_hit_sides(settings.hit_sides).into()),
        }),
        environment_width: task.environment.as_ref().map_or(0, |environment| environment.width()),
        environment_height: task.environment.as_ref().map_or(0, |environment| environment.height()),
        environment: pixels.flat_map(|value| value.to_le_bytes()).collect(),
        rays: task.pixel_angle.map(|pixel_angle| v1::RayTracing { pixel_angle }),
    }
}

fn wire_hit_sides(sides: HitSides) -> v1::HitSides {
    match sides {
        HitSides::Both => v1::HitSides::Both,
        HitSides::Front => v1::HitSides::Front,
        HitSides::Back => v1::HitSides::Back,
    }
}

pub(super) fn counters(counters: Option<v1::TileCounters>) -> Counters {
    let given = counters.unwrap_or_default();
    Counters {
        receivers: given.receivers,
        cut_elements: given.cut_elements,
        nodes_visited: given.nodes_visited,
        traversal_bytes: given.traversal_bytes,
        local_hits: given.local_hits,
        shared_hits: given.shared_hits,
        shared_hits_other_job: given.shared_hits_other_job,
        cache_misses: given.cache_misses,
        cpu_nanos: given.cpu_nanos,
        io_nanos: given.io_nanos,
    }
}

pub(super) fn daemon(status: DaemonStatus) -> v1::DaemonStatus {
    let small = |value: u64| u32::try_from(value).unwrap_or(u32::MAX);
    let workers = status
        .workers
        .into_iter()
        .map(|(birth, busy, frames_pinned)| v1::WorkerStatus {
            slot: birth.seat.slot.into(),
            epoch: birth.seat.epoch,
            pid: birth.pid,
            busy,
            frames_pinned,
        });
    let mounts = status.mounts.into_iter().map(|mount| v1::MountStatus {
        scene: mount.path.to_string_lossy().into_owned(),
        build_id: mount.build_id.to_string(),
        pages_loaded: mount.pages_loaded,
    });
    v1::DaemonStatus {
        version: env!("CARGO_PKG_VERSION").into(),
        pid: std::process::id(),
        memory_bytes: status.memory_bytes,
        segment_bytes: status.segment_bytes,
        node_frames: small(status.cache.node.frames),
        node_frames_resident: small(status.cache.node.resident),
        point_frames: small(status.cache.point.frames),
        point_frames_resident: small(status.cache.point.resident),
        workers: workers.collect(),
        mounts: mounts.collect(),
        jobs_queued: small(status.jobs_queued as u64),
        jobs_running: small(status.jobs_running as u64),
    }
}
