"""The connection to a daemon."""

from __future__ import annotations

import pathlib
from typing import Callable, Dict, Iterable, Iterator, List, NamedTuple, Optional, Sequence, Tuple, Union

import grpc
import numpy as np

from .v1 import jobs_pb2, jobs_pb2_grpc, types_pb2

# Receivers in one message of a stream: below the daemon's limit of 4 MiB.
_RECEIVERS_PER_MESSAGE = 100_000
_MESSAGE_BYTES_MAX = 32 << 20

_REASONS = {
    grpc.StatusCode.INVALID_ARGUMENT: "INVALID",
    grpc.StatusCode.NOT_FOUND: "NOT_FOUND",
    grpc.StatusCode.ALREADY_EXISTS: "EXISTS",
    grpc.StatusCode.ABORTED: "BUSY",
    grpc.StatusCode.FAILED_PRECONDITION: "PRECONDITION",
    grpc.StatusCode.RESOURCE_EXHAUSTED: "EXHAUSTED",
    grpc.StatusCode.DATA_LOSS: "CORRUPT",
    grpc.StatusCode.UNAUTHENTICATED: "UNAUTHENTICATED",
    grpc.StatusCode.PERMISSION_DENIED: "DENIED",
    grpc.StatusCode.UNAVAILABLE: "UNAVAILABLE",
    grpc.StatusCode.DEADLINE_EXCEEDED: "DEADLINE",
}


class Error(Exception):
    """The daemon refused, a job did not succeed, or the connection is lost.

    `reason` is one of INVALID, NOT_FOUND, EXISTS, BUSY, PRECONDITION, EXHAUSTED, CORRUPT, UNAUTHENTICATED, DENIED, UNAVAILABLE,
    DEADLINE, INTERNAL, and FAILED or CANCELLED for a job.
    """

    def __init__(self, reason: str, text: str):
        super().__init__(f"{reason}: {text}")
        self.reason = reason
        self.text = text


class Shaded(NamedTuple):
    """What receivers got, in their order."""

    irradiance: np.ndarray
    """(N, 3) float32, W/m2."""
    occlusion: np.ndarray
    """(N,) float32, 0 open, 1 closed."""
    bent_normal: np.ndarray
    """(N, 3) float32, unit or zero."""


class Client:
    """A connection to one daemon; a context manager. Safe to share between threads.

    `address` is `unix:/path/to/jobs.sock`, the path alone, or `host:port`. TCP needs `ca`, `cert` and `key` (PEM files), and
    `token_file` where the daemon asks for a token; without `ca` it is plain, which a daemon serves on loopback only.
    """

    def __init__(
        self,
        address: str,
        *,
        ca: Optional[str] = None,
        cert: Optional[str] = None,
        key: Optional[str] = None,
        token_file: Optional[str] = None,
        timeout: float = 30.0,
    ):
        self._timeout = timeout
        self._metadata: List[Tuple[str, str]] = []
        options = [
            ("grpc.max_receive_message_length", _MESSAGE_BYTES_MAX),
            ("grpc.max_send_message_length", _MESSAGE_BYTES_MAX),
        ]
        if address.startswith("/"):
            address = "unix:" + address
        if address.startswith("unix:"):
            # Otherwise the path becomes the authority, which Rust's HTTP/2 refuses.
            options.append(("grpc.default_authority", "localhost"))
        if token_file is not None:
            token = pathlib.Path(token_file).read_text().strip()
            self._metadata.append(("authorization", f"Bearer {token}"))
        if ca is None:
            self._channel = grpc.insecure_channel(address, options)
        else:
            read = lambda path: pathlib.Path(path).read_bytes() if path else None
            credentials = grpc.ssl_channel_credentials(read(ca), read(key), read(cert))
            self._channel = grpc.secure_channel(address, credentials, options)
        self._jobs = jobs_pb2_grpc.JobServiceStub(self._channel)
        self._scenes = jobs_pb2_grpc.SceneServiceStub(self._channel)
        self._shade = jobs_pb2_grpc.ShadeServiceStub(self._channel)
        self._daemon = jobs_pb2_grpc.DaemonServiceStub(self._channel)

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connection; jobs go on."""
        self._channel.close()

    def _call(self, method: Callable, request: object):
        try:
            return method(request, timeout=self._timeout, metadata=self._metadata)
        except grpc.RpcError as error:
            raise _error(error) from None

    # Jobs

    def submit_build(
        self,
        job_id: str,
        inputs: Sequence[str],
        output: str,
        *,
        overwrite: bool = False,
        spacing: Optional[float] = None,
        points: Optional[int] = None,
        **options: object,
    ) -> jobs_pb2.Job:
        """Submits a build. The same id with the same task is the same job. For `options` see `submit_shade`."""
        task = jobs_pb2.BuildTask(inputs=list(inputs), output=output, overwrite=overwrite)
        if spacing is not None:
            task.spacing = spacing
        if points is not None:
            task.points = points
        return self._submit(jobs_pb2.SubmitJobRequest(job_id=job_id, build=task), options)

    def submit_shade(
        self,
        job_id: str,
        scene: str,
        gbuffer: str,
        output: str,
        *,
        overwrite: bool = False,
        environment: str = "",
        settings: Optional[Dict[str, float]] = None,
        **options: object,
    ) -> jobs_pb2.Job:
        """Submits a picture.

        `settings`: max_solid_angle, raster_resolution, max_dist, falloff, bias, bounces, interpolation, hit_sides. `options`: user, labels (a dict), priority,
        after (ids of jobs that must succeed first), paused, attach.
        """
        task = jobs_pb2.ShadeTask(
            scene=scene,
            gbuffer=gbuffer,
            output=output,
            overwrite=overwrite,
            environment=environment,
            settings=_settings(settings),
        )
        return self._submit(jobs_pb2.SubmitJobRequest(job_id=job_id, shade=task), options)

    def _submit(self, request: jobs_pb2.SubmitJobRequest, options: Dict[str, object]) -> jobs_pb2.Job:
        request.attach = bool(options.pop("attach", False))
        request.options.CopyFrom(jobs_pb2.JobOptions(**options))
        return self._call(self._jobs.SubmitJob, request)

    def job(self, job_id: str) -> jobs_pb2.Job:
        """The job as it stands."""
        return self._call(self._jobs.GetJob, jobs_pb2.GetJobRequest(job_id=job_id))

    def jobs(self, limit: int = 0) -> List[jobs_pb2.Job]:
        """The jobs that the daemon remembers, newest first."""
        return list(self._call(self._jobs.ListJobs, jobs_pb2.ListJobsRequest(limit=limit)).jobs)

    def watch(self, job_id: str, *, cancel_on_disconnect: bool = False) -> Iterator[jobs_pb2.Job]:
        """The job now and whenever it changes, to its end."""
        request = jobs_pb2.WatchJobRequest(job_id=job_id, cancel_on_disconnect=cancel_on_disconnect)
        try:
            yield from self._jobs.WatchJob(request, metadata=self._metadata)
        except grpc.RpcError as error:
            raise _error(error) from None

    def wait(self, job_id: str, progress: Optional[Callable[[jobs_pb2.Job], None]] = None) -> Dict[str, float]:
        """Follows a job to its end; returns its statistics by name, or raises what it failed of."""
        job = None
        for job in self.watch(job_id):
            if progress is not None:
                progress(job)
        if job is None:
            raise Error("UNAVAILABLE", f"nothing was told of job {job_id!r}")
        if job.state == jobs_pb2.JOB_STATE_SUCCEEDED:
            return dict(job.statistics.rows)
        reason = "CANCELLED" if job.state == jobs_pb2.JOB_STATE_CANCELLED else "FAILED"
        raise Error(reason, job.error or f"job {job_id!r} was cancelled")

    def cancel(self, job_id: str, reason: str = "") -> jobs_pb2.Job:
        """Stops a job; one that has ended stays as it is."""
        return self._call(self._jobs.CancelJob, jobs_pb2.CancelJobRequest(job_id=job_id, reason=reason))

    def pause(self, job_id: str, reason: str = "") -> jobs_pb2.Job:
        """Lets a job rest; its finished tiles are kept."""
        return self._call(self._jobs.PauseJob, jobs_pb2.PauseJobRequest(job_id=job_id, reason=reason))

    def resume(self, job_id: str) -> jobs_pb2.Job:
        """Lets a paused job go on."""
        return self._call(self._jobs.ResumeJob, jobs_pb2.ResumeJobRequest(job_id=job_id))

    def retry(self, job_id: str) -> jobs_pb2.Job:
        """Puts a job that failed or was cancelled back in line."""
        return self._call(self._jobs.RetryJob, jobs_pb2.RetryJobRequest(job_id=job_id))

    # Scenes and the daemon

    def scene(self, path: str) -> types_pb2.SceneInfo:
        """Opens and describes a scene."""
        return self._call(self._scenes.GetScene, jobs_pb2.GetSceneRequest(scene=path))

    def warm_scene(self, path: str) -> Tuple[int, int]:
        """Reads and verifies a scene, so that the system has it at hand; returns pages and bytes."""
        answer = self._call(self._scenes.WarmScene, jobs_pb2.WarmSceneRequest(scene=path))
        return answer.pages, answer.bytes

    def drop_scene(self, path: str) -> bool:
        """Closes a scene; whether it was open."""
        return self._call(self._scenes.DropScene, jobs_pb2.DropSceneRequest(scene=path)).dropped

    def status(self) -> jobs_pb2.DaemonStatus:
        """The daemon's account of itself."""
        return self._call(self._daemon.GetStatus, jobs_pb2.GetStatusRequest())

    def shutdown(self) -> None:
        """Asks the daemon to finish what is leased and to exit."""
        self._call(self._daemon.Shutdown, jobs_pb2.ShutdownRequest())

    # Live shading

    def shade_points(
        self,
        scene: str,
        positions: np.ndarray,
        normals: np.ndarray,
        *,
        settings: Optional[Dict[str, float]] = None,
        environment: str = "",
    ) -> Shaded:
        """Shades N receivers; `positions` and `normals` are (N, 3), world space. A zero normal is a hole and stays 0."""
        receivers = _receivers(positions, normals)
        blocks = (receivers[i : i + _RECEIVERS_PER_MESSAGE] for i in range(0, len(receivers), _RECEIVERS_PER_MESSAGE))
        values = list(self._stream(scene, blocks, settings, environment))
        return _shaded(np.concatenate(values) if values else np.zeros((0, 7), np.float32))

    def shade_stream(
        self,
        scene: str,
        blocks: Iterable[Tuple[np.ndarray, np.ndarray]],
        *,
        settings: Optional[Dict[str, float]] = None,
        environment: str = "",
    ) -> Iterator[Shaded]:
        """Shades blocks of receivers as they come, each at most 170,000; yields parts of them, in order, as they are done.

        `blocks` is asked for the next one only as fast as the daemon shades and the result is read.
        """
        packed = (_receivers(positions, normals) for positions, normals in blocks)
        for values in self._stream(scene, packed, settings, environment):
            yield _shaded(values)

    def _stream(
        self,
        scene: str,
        blocks: Iterable[np.ndarray],
        settings: Optional[Dict[str, float]],
        environment: str,
    ) -> Iterator[np.ndarray]:
        def requests() -> Iterator[jobs_pb2.ShadePointsRequest]:
            start = jobs_pb2.ShadePointsStart(scene=scene, settings=_settings(settings), environment=environment)
            yield jobs_pb2.ShadePointsRequest(start=start)
            for block in blocks:
                yield jobs_pb2.ShadePointsRequest(receivers=block.tobytes())

        try:
            for answer in self._shade.ShadePoints(requests(), metadata=self._metadata):
                yield np.frombuffer(answer.values, "<f4").reshape(-1, 7)
        except grpc.RpcError as error:
            raise _error(error) from None


def _receivers(positions: np.ndarray, normals: np.ndarray) -> np.ndarray:
    positions, normals = np.asarray(positions, "<f4"), np.asarray(normals, "<f4")
    if positions.ndim != 2 or positions.shape[1] != 3 or positions.shape != normals.shape:
        raise ValueError(f"positions {positions.shape} and normals {normals.shape} must both be (N, 3)")
    return np.ascontiguousarray(np.hstack([positions, normals]))


def _shaded(values: np.ndarray) -> Shaded:
    return Shaded(values[:, 0:3], values[:, 3], values[:, 4:7])


def _settings(settings: Optional[Dict[str, float]]) -> types_pb2.ShadeSettings:
    return types_pb2.ShadeSettings(**(settings or {}))


def _error(error: Union[grpc.RpcError, grpc.Call]) -> Error:
    return Error(_REASONS.get(error.code(), "INTERNAL"), error.details() or "")
