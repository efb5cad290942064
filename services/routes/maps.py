"""Maps: which there are, made from recordings, exported, deleted."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path as FilePath
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Path, Request, Response
from starlette.background import BackgroundTask
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.responses import FileResponse

from splatbot.config import Config, with_cameras
from splatbot.errors import InputError
from splatbot.formats import WRITTEN, save_gaussians
from splatbot.layouts import log_kind
from splatbot.logs import Log, open_log
from splatbot.logs.rig import RigLog
from splatbot.protocols import Array
from splatbot.services.arms import known_robot
from splatbot.services.codecs import ZIP, answer, answers, body_of, request_body
from splatbot.services.dependencies import (
    Caller,
    IdempotencyKey,
    Served,
    Service,
    Store,
    etag,
    example,
    problems,
    unchanged,
    version_headers,
)
from splatbot.services.heap import trim_heap
from splatbot.services.library import check_id
from splatbot.services.mapping import check_length, map_recording, map_upload, open_rig, workspace_of
from splatbot.services.problems import MapNotReadyError, TooLargeError
from splatbot.services.recordings import allowed_log
from splatbot.services.robot_mask import RobotMask
from splatbot.services.routes.jobs import accepted, starts
from splatbot.services.schemas import Bounds, FurtherCameraInfo, MapInfo, MapList, MapRequest, RobotMaskInfo, Vector3
from splatbot.services.scratch import Scratch
from splatbot.services.store import ServedMap
from splatbot.workspace import Workspace, find_workspace

router = APIRouter(prefix="/v1/maps", tags=["maps"])

_EXAMPLE: dict[str, Any] = {
    "id": "default",
    "map_version": 12,
    "state": "mapping",
    "detail": None,
    "source": "desk_log",
    "gaussians": 48213,
    "bytes": 3085632,
    "sh_degree": 0,
    "stamp": 1.3,
    "bounds": {"low": [-0.8, -0.5, 0.4], "high": [0.9, 0.4, 1.9]},
    "robot": {"name": "panda", "masked": 118, "refused": 2, "problem": None},
    "cameras": {
        "table": {
            "kind": "fixed",
            "frames": 40,
            "tracked": 33,
            "lost": 7,
            "keyframes": 1,
            "reason": None,
            "pose": {
                "translation": [0.61, -0.12, 0.4],
                "quaternion_wxyz": [0.9, 0.05, -0.42, 0.1],
                "translation_sigma": 0.0012,
                "rotation_sigma": 0.0016,
            },
        }
    },
}
_CREATE = {
    "a synthetic log": {"id": "tabletop", "log": "synthetic:tabletop?frames=8&width=160&height=120"},
    "frames that will be pushed": {
        "id": "robot",
        "robot_base": {"translation": [0.0, 0.5, 0.0], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]},
    },
    "frames of a camera that sees the robot": {
        "id": "wrist",
        "robot": {
            "name": "panda",
            "T_link_camera": {"translation": [0.05, 0.0, 0.05], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]},
            "joint_delay": 0.02,
        },
    },
    "frames of a moving and of a fixed camera": {
        "id": "cell",
        "cameras": {
            "table": {
                "T_world_camera": {"translation": [0.6, -0.1, 0.4], "quaternion_wxyz": [0.9, 0.05, -0.42, 0.1]},
                "translation_sigma": 0.02,
                "rotation_sigma": 0.035,
            }
        },
    },
}
_FILE: dict[int | str, dict[str, Any]] = {200: {"content": {"application/octet-stream": {}}, "description": "the file"}}
_FormatName = Annotated[str, Path(description=f"one of {', '.join(WRITTEN)}", examples=["ply"])]


@router.get("", responses=example({"maps": [_EXAMPLE]}))
def list_maps(store: Store) -> MapList:
    """List all maps."""
    return MapList(maps=[_info(served) for served in store.list()])


@router.post(
    "",
    status_code=202,
    responses=starts("a job maps the recording")
    | {201: {"description": "an empty map, to which frames can be pushed", "model": MapInfo}}
    | problems(403, 409, 415, 422, 429, 503),
    openapi_extra=request_body(MapRequest, _CREATE),
)
def create_map(
    query: Annotated[MapRequest, Depends(body_of(MapRequest))], service: Service, key: IdempotencyKey, caller: Caller
) -> Response:
    """Make a map of a recording, by a job; or, without `log`, an empty one for frames that will be pushed."""
    check_id(query.id)
    base = query.robot_base.matrix("robot_base") if query.robot_base is not None else None
    if query.log is None:
        service.quotas.check_bytes(caller)
        mask, config = _mask_of_stream(service, query), _with_cameras(service.config, query)
        workspace = _scene(query, "synthetic:", base)
        served = service.open_stream(query.id, workspace=workspace, mask=mask, config=config, owner=caller)
        place = {"Location": f"/v1/maps/{query.id}"}
        return Response(_info(served).model_dump_json(), 201, place, media_type="application/json")
    if query.cameras:
        raise InputError("are of pushed frames.", field="cameras", hint="leave out log, or cameras")
    request = query.model_dump_json()
    known = service.jobs.known(key, request)
    if known is not None:
        return accepted(known)
    service.quotas.check_bytes(caller)
    limits = service.settings
    uri = allowed_log(
        query.log, limits.log_roots, camera=query.camera, max_frames=limits.max_frames, max_pixels=limits.max_pixels
    )
    log, mask = _open_masked(query, uri)
    total = check_length(log, limits.max_frames, query.max_frames)
    workspace = _scene(query, log.parts[0].log.uri if isinstance(log, RigLog) else uri, base)
    served = service.store.add(
        query.id, source=log.name, state="mapping", workspace=workspace, mask=mask, awaited=False, owner=caller
    )
    try:
        work = map_recording(service, served, log, total)
        return accepted(
            service.make(served, work, key=key, request=request, abandoned=partial(_forget, service, served))
        )
    except Exception:
        _forget(service, served)  # the queue is full: undo the creation
        raise


@router.post(
    "/{map_id}/upload",
    status_code=202,
    responses=starts("a job unpacks and maps the recording") | problems(403, 409, 413, 415, 422, 429, 503),
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {ZIP: {"schema": {"type": "string", "format": "binary"}}},
        }
    },
)
async def upload_map(
    request: Request,
    service: Service,
    key: IdempotencyKey,
    caller: Caller,
    map_id: Annotated[str, Path(description="of the map to be made", examples=["desk"])],
) -> Response:
    """Make a map of a recording that is sent as a zip of a folder in TUM layout; a job unpacks and maps it."""
    check_id(map_id)
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() != ZIP:
        raise HTTPException(415, "The body is no application/zip.")
    if key is not None and service.jobs.uses(key):
        digest = await _receive(request, FilePath(os.devnull), service.settings.max_upload_bytes)
        if (known := service.jobs.known(key, f"upload {map_id} {digest}")) is not None:
            return accepted(known)
    service.quotas.check_bytes(caller)
    served = service.store.add(map_id, source="an upload", state="mapping", awaited=False, owner=caller)
    scratch = None
    try:
        scratch = Scratch("upload")
        archive = scratch.path / "recording.zip"
        digest = await _receive(request, archive, service.settings.max_upload_bytes)
        work = map_upload(service, served, archive, scratch.discard)
        gone = partial(_forget, service, served, scratch)
        return accepted(service.make(served, work, key=key, request=f"upload {map_id} {digest}", abandoned=gone))
    except BaseException:  # also of a client that has gone: nothing is left of it
        await run_in_threadpool(_forget, service, served, scratch)
        raise


@router.get("/{map_id}", responses=example(_EXAMPLE) | problems(404))
def get_map(served: Served, request: Request, response: Response) -> Any:
    """Describe a map; `state` and `detail` report the progress of mapping."""
    info = _info(served)
    tag = etag(served, f"{info.detail} {info.robot} {info.cameras}")
    if (kept := unchanged(request, served, tag)) is not None:
        return kept
    response.headers.update(version_headers(served, tag))
    return info


@router.delete("/{map_id}", status_code=204, responses=problems(404))
def delete_map(served: Served, service: Service) -> Response:
    """End the map's making, and forget it, on disk too. Answers that are under way keep the state they took."""
    service.remove(served)
    return Response(status_code=204, background=BackgroundTask(trim_heap))


@router.get(
    "/{map_id}/splats.{format}",
    response_class=FileResponse,
    responses=_FILE | problems(404, 422, 503),
)
def export_map(served: Served, request: Request, format: _FormatName) -> Response:
    """Export the map as a file in any format that splatbot writes."""
    if format not in WRITTEN:
        raise InputError(f"is {format[:20]!r}.", field="format", hint=f"use {', '.join(WRITTEN)}")
    snapshot = served.ready
    tag = etag(served, format)
    if (kept := unchanged(request, served, tag)) is not None:
        return kept
    scratch = Scratch("export")
    path = scratch.path / f"{served.id}.{format}"
    try:
        save_gaussians(snapshot.model, path)
    except BaseException:
        scratch.discard()
        raise
    headers = version_headers(served, tag)
    after = BackgroundTask(scratch.discard)
    kind = "application/octet-stream"
    return FileResponse(path, media_type=kind, filename=path.name, headers=headers, background=after)


@router.get(
    "/{map_id}/trajectory",
    response_class=Response,
    responses=answers(
        {
            "map_version": 12,
            "stamps": [0.0, 0.033],
            "T_world_camera": [[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]] * 2,
        },
        npy="T_world_camera (N, 4, 4)",
    )
    | problems(404, 503),
)
def trajectory(served: Served, request: Request) -> Response:
    """Return the path of the first camera in the map's world at the latest version."""
    tag = etag(served, "trajectory " + request.headers.get("accept", ""))
    if (kept := unchanged(request, served, tag)) is not None:
        return kept
    path = served.trajectory
    if path is None:
        raise MapNotReadyError(f"Map {served.id!r} knows no trajectory.", hint="map a log, or push frames")
    body = {"map_version": served.map_version, "stamps": path.stamps, "T_world_camera": path.T_world_camera}
    return answer(request, body, array="T_world_camera", headers=version_headers(served, tag))


async def _receive(request: Request, path: FilePath, most: int) -> str:
    """Write the body to a file as it comes; return its SHA-256."""
    taken, digest = 0, hashlib.sha256()
    with path.open("wb") as file:
        async for chunk in request.stream():
            taken += len(chunk)
            if taken > most:
                hint = "send a shorter recording, or raise SPLATBOT_MAX_UPLOAD_BYTES"
                raise TooLargeError(f"has more than {most} bytes.", field="upload", hint=hint)
            digest.update(chunk)
            await run_in_threadpool(file.write, chunk)
    return digest.hexdigest()


def _forget(service: Service, served: ServedMap, scratch: Scratch | None = None) -> None:
    """Leave nothing of a map whose making never began."""
    service.withdraw(served)
    if scratch is not None:
        scratch.discard()


def _info(served: ServedMap) -> MapInfo:
    snapshot = served.snapshot
    box = _box(served)
    return MapInfo(
        id=served.id,
        map_version=served.map_version,
        state=served.state,
        detail=served.detail,
        source=served.source,
        gaussians=served.gaussians,
        bytes=served.nbytes,
        sh_degree=served.sh_degree,
        stamp=snapshot.stamp if snapshot else 0.0,
        bounds=None if box is None else Bounds(low=box[0], high=box[1]),
        robot=None if served.mask is None else _masked(served.mask),
        cameras={name: _camera_info(served, name, state) for name, state in served.cameras.by_name.items()},
    )


def _box(served: ServedMap) -> tuple[Vector3, Vector3] | None:
    """Return the corners of the box of all means [m]. If None, there are no Gaussians."""
    if not served.gaussians:
        return None
    low, high = served.ready.model.means.aminmax(dim=0) if served.tiles is None else served.tiles.box
    return tuple(low.tolist()), tuple(high.tolist())


def _camera_info(served: ServedMap, name: str, state: Mapping[str, Any]) -> FurtherCameraInfo:
    refused = None if served.mask is None else served.mask.problems.get(name)
    return FurtherCameraInfo.model_validate({**state, "reason": refused or state["reason"]})


def _masked(mask: RobotMask) -> RobotMaskInfo:
    return RobotMaskInfo(name=mask.robot.name, masked=mask.masked, refused=mask.refused, problem=mask.problem)


def _scene(query: MapRequest, uri: str, base: Array | None) -> Workspace | None:
    """Return the scene of a map: base and joint offsets of the request, or those of the recording."""
    known = workspace_of(uri, base)
    return known if query.robot is None else query.robot.with_offsets(known)


def _open_masked(query: MapRequest, uri: str) -> tuple[Log, RobotMask | None]:
    """Open a recording, with the mask of the robot that the request and the recording's scene.yaml describe."""
    if query.robot is None:
        return open_log(uri, camera=query.camera), None
    robot = known_robot(query.robot.name)
    if query.camera is None and log_kind(uri) == "rig":
        rig, further = open_rig(uri, query.robot.workspace)
        return rig, RobotMask(robot, further.pop(""), further=further, log=rig)
    workspace = query.robot.workspace(None if uri.startswith("synthetic:") else find_workspace(uri))
    log = open_log(uri, camera=query.camera, joint_delay=workspace.joint_delay)
    return log, RobotMask(robot, workspace, log=log)


def _mask_of_stream(service: Service, query: MapRequest) -> RobotMask | None:
    """Return the mask of a robot in view of the cameras of pushed frames, which the request describes."""
    robot, cameras = query.robot, query.cameras or {}
    mounts = {name: camera.robot for name, camera in cameras.items() if camera.robot is not None}
    if robot is None:
        if mounts:
            field = f"cameras.{next(iter(mounts))}.robot"
            raise InputError("needs the robot of the map.", field=field, hint="give robot, with its name")
        return None
    workspace = robot.workspace(None)
    further = {name: mount.workspace(workspace) for name, mount in mounts.items()}
    return service.mask_of_stream(query.id, known_robot(robot.name), workspace, further)


def _with_cameras(config: Config, query: MapRequest) -> Config:
    """Return the configuration with the cameras of a request, which replace those of the service."""
    if query.cameras is None:
        return config
    settings = {name: camera.settings() for name, camera in query.cameras.items()}
    return with_cameras(config.model_copy(update={"cameras": {}}), settings)
