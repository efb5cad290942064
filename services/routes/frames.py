"""Frames that clients push into a map."""

from __future__ import annotations

import base64
import binascii
from concurrent.futures import TimeoutError as NotInTime
from typing import Annotated, Any

import cv2
import numpy as np
from fastapi import APIRouter, Depends, Request, Response
from numpy.typing import NDArray
from pydantic import Field, ValidationInfo, field_validator

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.services.codecs import answer, answers, body_of, request_body
from splatbot.services.dependencies import Served, Service, problems
from splatbot.services.problems import BusyError, TooLargeError
from splatbot.services.recordings import checked_image
from splatbot.services.schemas import MAX_JOINTS, CameraIn
from splatbot.services.schemas import Request as Body

router = APIRouter(prefix="/v1/maps", tags=["frames"])

_WAIT_S = 60.0


class FrameRequest(Body):
    """A colour image and the depth registered to it.

    Images are PNG or JPEG files (base64 in JSON, bytes in msgpack), or arrays in msgpack.
    Arrays are rgb (H, W, 3) uint8 and depth (H, W) float32 [m] or uint16.
    """

    stamp: float = Field(
        allow_inf_nan=False, description="[s]; later than the camera's frame before, within a day of the map's newest"
    )
    camera_name: str = Field("", max_length=32, description="further camera of the map; empty: the first one")
    camera: CameraIn = Field(description="pinhole intrinsics of both images")
    rgb: Any = Field(description="PNG or JPEG, or array")
    depth: Any = Field(description="16-bit PNG, or array; 0 where it is not known")
    depth_scale: float = Field(1000.0, gt=0, allow_inf_nan=False, description="units per metre of an integer depth")
    mask: Any = Field(None, description="PNG or bool array; a pixel that is 0 is neither tracked nor mapped")
    depth_delay: float = Field(0.0, ge=-0.1, le=0.1, description="time by which depth is later than `stamp` [s]")
    joints: list[float] | None = Field(
        None, max_length=MAX_JOINTS, description="the robot's joints [rad or m] at `stamp`"
    )
    joint_names: list[str] = Field(
        [], max_length=MAX_JOINTS, description="of `joints`; if empty, they are in the robot's order"
    )
    depth_joints: list[float] | None = Field(
        None, max_length=MAX_JOINTS, description="`joints` at the time of depth, where `depth_delay` is not 0"
    )

    @field_validator("rgb", "depth", "mask", mode="before")
    @classmethod
    def _image(cls, value: Any, info: ValidationInfo) -> Any:
        if value is None and info.field_name == "mask":
            return None
        if isinstance(value, str):
            try:
                return base64.b64decode(value, validate=True)
            except binascii.Error as error:
                raise ValueError("is no base64") from error
        if not isinstance(value, bytes | np.ndarray):
            raise ValueError("is neither an image file nor an array")
        return value


def _png64(image: NDArray[Any]) -> str:
    return base64.b64encode(cv2.imencode(".png", image)[1].tobytes()).decode()


def _example() -> dict[str, Any]:
    ramp = np.tile(np.linspace(0, 255, 32).astype(np.uint8)[None, :, None], (24, 1, 3))
    return {
        "stamp": 0.033,
        "camera_name": "",
        "camera": {"fx": 30.0, "fy": 30.0, "cx": 15.5, "cy": 11.5, "width": 32, "height": 24},
        "rgb": _png64(ramp),
        "depth": _png64(np.full((24, 32), 1000, np.uint16)),
        "depth_scale": 1000.0,
        "joints": [0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8],
    }


_ANSWER = {
    "map_version": 3,
    "index": 7,
    "stamp": 0.033,
    "verdict": "ok",
    "reasons": [],
    "keyframe": True,
    "gaussians": 5120,
    "T_world_camera": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
    "stage_ms": {"prepare": 3.1, "mapping": 12.0},
}
_Body = Annotated[FrameRequest, Depends(body_of(FrameRequest))]


@router.post(
    "/{map_id}/frames",
    response_class=Response,
    responses=answers(_ANSWER) | problems(403, 404, 409, 413, 415, 422, 503),
    openapi_extra=request_body(FrameRequest, {"a small frame of the first camera": _example()}),
)
def push_frame(request: Request, served: Served, service: Service, query: _Body) -> Response:
    """Track a frame and map it; the answer says where the camera was. 503: as many frames wait as may.

    Frames of different cameras may come in any order; of those that wait, the earliest is mapped first. A frame of a
    carried camera is at most 2 ms older than the newest frame of the first camera. It is at most 0.1 s, and twice the
    time between that camera's frames, newer. Otherwise it is refused (409).
    """
    frames = service.stream(served.id)
    service.quotas.check_bytes(served.owner)
    frames.check_camera(query.camera_name)  # before its images are decoded
    pushed = frames.push(_frame(query, service.settings.max_pixels))
    try:
        result = pushed.result(_WAIT_S)
    except NotInTime as error:
        raise BusyError("the frame waits to be mapped.", hint="push frames more slowly") from error
    body = {
        "map_version": service.store.get(served.id).map_version,
        "index": result.index,
        "stamp": result.stamp,
        "verdict": result.verdict,
        "reasons": list(result.reasons),
        "keyframe": bool(result.keyframe),
        "gaussians": int(result.gaussians),
        "T_world_camera": result.T_world_camera,
        "stage_ms": {name: float(ms) for name, ms in result.stage_ms.items()},
    }
    return answer(request, body)


@router.post("/{map_id}/resync", status_code=204, response_class=Response, responses=problems(404, 409))
def resync_frames(served: Served, service: Service) -> Response:
    """Accept any stamp of the next frame, because the clock of the camera was set.

    In the map time goes on: if the clock was set back, later stamps are shifted, also in answers and trajectories.
    """
    service.stream(served.id).resync()
    if served.mask is not None:
        served.mask.history.clear()
    return Response(status_code=204)


@router.post("/{map_id}/end", status_code=202, response_class=Response, responses=problems(404, 409))
def end_frames(served: Served, service: Service) -> Response:
    """End the stream: the map is refined once more, and its state becomes "ended"."""
    service.stream(served.id).end()
    return Response(status_code=202, headers={"Location": f"/v1/maps/{served.id}", "Retry-After": "1"})


def _frame(query: FrameRequest, max_pixels: int) -> Frame:
    camera = Camera(**query.camera.model_dump())
    if camera.width * camera.height > max_pixels:
        raise TooLargeError(f"{camera.width}x{camera.height} has more than {max_pixels} pixels.", field="camera")
    rgb = _decoded(query.rgb, "rgb", cv2.IMREAD_COLOR_RGB, max_pixels)
    depth = _decoded(query.depth, "depth", cv2.IMREAD_UNCHANGED, max_pixels)
    if depth.dtype.kind in "iu":
        depth = depth.astype(np.float32) / np.float32(query.depth_scale)
    joints, depth_joints = _positions(query.joints, "joints"), _positions(query.depth_joints, "depth_joints")
    mask = None if query.mask is None else _decoded(query.mask, "mask", cv2.IMREAD_GRAYSCALE, max_pixels) > 0
    rgb, depth = np.ascontiguousarray(rgb), np.ascontiguousarray(depth)
    return Frame(
        query.stamp,
        rgb,
        depth,
        camera,
        joints=joints,
        joint_names=tuple(query.joint_names),
        mask=mask,
        depth_delay=query.depth_delay,
        source="the pushed frame",
        camera_name=query.camera_name,
        depth_joints=depth_joints,
    )


def _positions(given: list[float] | None, field: str) -> NDArray[np.float64] | None:
    positions = None if given is None else np.array(given, dtype=np.float64)
    if positions is not None and not np.isfinite(positions).all():
        raise InputError("has values that are not finite.", field=field, hint="give radians and metres")
    return positions


def _decoded(value: Any, field: str, flags: int, max_pixels: int) -> NDArray[Any]:
    if isinstance(value, np.ndarray):
        return np.require(value, requirements=["C", "W"])  # arrays of a body are read-only
    data = checked_image(value, max_pixels, field)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None:
        raise InputError("is no image that can be decoded.", field=field, hint="send a whole PNG or JPEG")
    return np.asarray(image)
