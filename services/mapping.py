"""Mapping jobs: a recording becomes a map while it is served."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from splatbot.config import Config, with_cameras, with_sensor
from splatbot.errors import InputError, LogError, MapNotFoundError
from splatbot.logs import Log, open_log
from splatbot.logs.rig import RigLog
from splatbot.robots.in_view import has_tf
from splatbot.services.jobs import JobCancelled, JobHandle, Work
from splatbot.services.problems import disk_error
from splatbot.services.recordings import allowed_log, unpack
from splatbot.services.robot_mask import MaskedSource
from splatbot.services.runtime import Runtime
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import ServedMap
from splatbot.slam import FrameResult
from splatbot.workspace import Workspace, find_workspace


def check_length(log: Log, settings_max: int, wanted: int | None) -> int:
    """Return the number of frames of a log to map.

    Raises:
        InputError: more than the service maps.
    """
    total = len(log) if wanted is None else min(len(log), wanted)
    if total > settings_max:
        hint = "give max_frames, or raise SPLATBOT_MAX_FRAMES"
        raise InputError(f"has {total} frames, at most {settings_max} are mapped.", field="log", hint=hint)
    return total


def map_recording(runtime: Runtime, served: ServedMap, log: Log, total: int) -> Work:
    """Return the work of a job that maps the first ``total`` frames of a log into ``served``.

    Raises:
        ConfigError: a file of the log states an unknown setting of the sensor, or a value out of range.
    """
    config = config_of(log, runtime.config)
    return lambda handle: _map(runtime, served, log, total, config, handle)


def map_upload(runtime: Runtime, served: ServedMap, archive: Path, discard: Callable[[], None]) -> Work:
    """Return the work of a job that unpacks an uploaded recording, maps it, and calls ``discard`` at the end."""

    def work(handle: JobHandle) -> dict[str, Any]:
        try:
            try:
                log = _unpacked(runtime.settings, archive, handle)
                total = check_length(log, runtime.settings.max_frames, None)
                config = config_of(log, runtime.config)
            except (InputError, OSError, JobCancelled) as error:
                with suppress(MapNotFoundError):  # deleted meanwhile
                    runtime.store.set_state(served.id, "failed", _reason(error), generation=served.generation)
                raise
            return _map(runtime, served, log, total, config, handle)
        finally:
            discard()

    return work


def _unpacked(settings: ServiceSettings, archive: Path, handle: JobHandle) -> Log:
    folder = archive.with_suffix("")
    shown = -1

    def progress(share: float) -> None:
        nonlocal shown
        handle.check()
        if round(100 * share) != shown:
            shown = round(100 * share)
            handle.report(0.0, f"unpacking, {shown} % done")

    home = unpack(
        archive,
        folder,
        max_bytes=settings.max_unpacked_bytes,
        max_pixels=settings.max_pixels,
        max_frames=settings.max_frames,
        progress=progress,
    )
    archive.unlink()
    return open_log(
        allowed_log(str(home), [str(folder)], max_frames=settings.max_frames, max_pixels=settings.max_pixels)
    )


def _reason(error: Exception) -> str:
    if isinstance(error, InputError):
        return error.message
    return disk_error(error).message if isinstance(error, OSError) else "the job was cancelled"


def workspace_of(uri: str, robot_base: Any) -> Workspace | None:
    """Return the scene of a recording; a base of the request replaces all of it but the joint offsets."""
    known = None if uri.startswith("synthetic:") else find_workspace(uri)
    if robot_base is None:
        return known
    arm = known or Workspace()
    return Workspace(T_world_base=robot_base, joint_offsets=arm.joint_offsets, offsets_of=arm.offsets_of)


def open_rig(
    uri: str, describe_first: Callable[[Workspace | None], Workspace] = lambda known: known or Workspace()
) -> tuple[RigLog, dict[str, Workspace]]:
    """Open the recordings of several cameras, each with the joints of its own ``scene.yaml``.

    Args:
        uri: the file of the rig.
        describe_first: returns the workspace of the first camera for that of its ``scene.yaml``.

    Returns:
        The log, and the workspaces of its cameras by name: of further ones those with a mount on the robot, or with TF.

    Raises:
        LogError: the log is damaged.
        FormatError: a ``scene.yaml`` is damaged.
    """
    found: list[Workspace] = []

    def open_one(address: str, camera: str | None) -> Log:
        known = find_workspace(address)
        found.append((known or Workspace()) if found else describe_first(known))
        return open_log(address, camera=camera, joint_delay=found[-1].joint_delay)

    log = RigLog(uri, open_one)
    by_name = zip(("", *log.cameras), found, log.parts, strict=True)
    return log, {
        name: one for name, one, part in by_name if not name or one.T_link_camera is not None or has_tf(part.log)
    }


def config_of(log: Log, config: Config) -> Config:
    """Return the configuration with the cameras and the calibrated sensor that the files of a log state.

    Raises:
        ConfigError: a file has an unknown key, or a value out of range.
    """
    calibration = log.calibration
    return with_sensor(with_cameras(config, log.cameras, file=log.uri), calibration.sensor, file=calibration.file)


def _map(
    runtime: Runtime, served: ServedMap, log: Log, total: int, config: Config, handle: JobHandle
) -> dict[str, Any]:
    from splatbot.slam import Slam

    recorded = (log.read(i) for i in range(total) if not handle.cancelled.is_set())
    frames = recorded if served.mask is None else MaskedSource(recorded, served.mask)
    tracked = 0

    def on_result(result: FrameResult) -> None:
        nonlocal tracked
        tracked += result.verdict != "lost"
        if handle.cancelled.is_set():
            mapping.stop()
        else:
            handle.report((result.index + 1) / total, f"frame {result.index + 1} of {total}")

    mapping = runtime.mapping(served, frames, Slam(config), on_result=on_result)
    mapping.run()
    try:
        made = runtime.store.get(served.id, generation=served.generation)
    except MapNotFoundError as error:
        raise JobCancelled from error
    runtime.save(made)
    if handle.cancelled.is_set():
        raise JobCancelled
    if served.mask is not None and not served.mask.masked:
        raise LogError(served.mask.problem or "no frame was mapped.", field="joints")
    if made.state == "failed":
        raise LogError(made.detail or "mapping failed.", field="log")
    return {"map": made.id, "map_version": made.map_version, "frames": total, "tracked": tracked}
