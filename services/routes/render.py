"""Pictures of the map."""

from __future__ import annotations

import hashlib
import secrets
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Body, Query, Request, Response
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.geometry import pose_from_quat
from splatbot.rasterize.views import default_view, depth_limits, render_view, to_png
from splatbot.services.dependencies import Served, Settings, problems
from splatbot.services.problems import TooLargeError
from splatbot.services.schemas import Mode, RenderRequest
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import ServedMap

router = APIRouter(prefix="/v1/maps", tags=["views"])

# Version 3 of a map in this process is not version 3 in the next: tags of different processes must differ.
_PROCESS = secrets.token_hex(4)

_PNG: dict[int | str, dict[str, Any]] = {
    200: {"content": {"image/png": {}}, "description": "PNG; X-Map-Version and ETag name the state that was drawn"}
}
_BODY = Body(
    openapi_examples={
        "default view": {"value": {"mode": "rgb"}},
        "depth at a pose": {
            "value": {
                "mode": "depth",
                "camera": {"fx": 525, "fy": 525, "cx": 319.5, "cy": 239.5, "width": 640, "height": 480},
                "translation": [0.0, 0.0, -0.2],
                "quat_wxyz": [1.0, 0.0, 0.0, 0.0],
                "depth_range_m": [0.3, 2.0],
            }
        },
    }
)


@router.get("/{map_id}/render", response_class=Response, responses=_PNG | problems(404, 413, 422, 503))
def render_default(
    served: Served,
    settings: Settings,
    request: Request,
    mode: Annotated[Mode, Query(examples=["rgb"])] = "rgb",
    width: Annotated[int, Query(ge=1, examples=[640])] = 640,
    height: Annotated[int, Query(ge=1, examples=[480])] = 480,
    fov_deg: Annotated[float, Query(gt=0, lt=180, examples=[60.0])] = 60.0,
) -> Response:
    """The map seen whole, for a browser: from where 90 % of it is in view, along the world's z axis."""
    _check_size(width, height, settings)
    tag = _tag(served, f"{mode} {width} {height} {fov_deg}")
    if tag in request.headers.get("if-none-match", ""):
        return Response(status_code=304, headers=_headers(served, tag))
    camera, pose = default_view(served.ready.model, width=width, height=height, fov_deg=fov_deg)
    return _png(served, tag, camera, pose, mode, None)


@router.post("/{map_id}/render", response_class=Response, responses=_PNG | problems(404, 413, 422, 503))
def render(served: Served, settings: Settings, request: Annotated[RenderRequest, _BODY]) -> Response:
    """The map seen by a given camera from a given pose."""
    model = served.ready.model
    if request.camera is not None:
        _check_size(request.camera.width, request.camera.height, settings)
        camera = Camera(**request.camera.model_dump())
        _, pose = default_view(model, width=camera.width, height=camera.height, fov_deg=_fov_deg(camera))
    else:
        camera, pose = default_view(model)
    if request.T_world_camera is not None:
        pose = np.asarray(request.T_world_camera, dtype=np.float64)
    elif request.translation is not None and request.quat_wxyz is not None:
        pose = _pose(request.translation, request.quat_wxyz)
    tag = _tag(served, request.model_dump_json())
    return _png(served, tag, camera, pose, request.mode, request.depth_range_m)


def _png(
    served: ServedMap,
    tag: str,
    camera: Camera,
    T_world_camera: NDArray[np.float64],
    mode: Mode,
    depth_range: tuple[float, float] | None,
) -> Response:
    view = render_view(served.ready.model, camera, T_world_camera, mode)
    headers = _headers(served, tag)
    if mode == "depth":
        depth_range = depth_range or depth_limits(view)
        headers["X-Depth-Range-M"] = "{:.4f} {:.4f}".format(*depth_range)
    return Response(to_png(view, mode, depth_range=depth_range), media_type="image/png", headers=headers)


def _headers(served: ServedMap, tag: str) -> dict[str, str]:
    return {"X-Map-Version": str(served.map_version), "ETag": tag, "Cache-Control": "no-cache"}


def _tag(served: ServedMap, view: str) -> str:
    key = f"{_PROCESS} {served.id} {served.map_version} {view}"
    return f'"{hashlib.sha256(key.encode()).hexdigest()[:20]}"'


def _check_size(width: int, height: int, settings: ServiceSettings) -> None:
    if width * height > settings.max_pixels:
        raise TooLargeError(
            f"{width}x{height} has more than {settings.max_pixels} pixels.",
            field="width, height",
            hint="ask for a smaller view, or raise SPLATBOT_MAX_PIXELS",
        )


def _fov_deg(camera: Camera) -> float:
    return float(np.degrees(2 * np.arctan(0.5 * camera.width / camera.fx)))


def _pose(translation: tuple[float, ...], quat_wxyz: tuple[float, ...]) -> NDArray[np.float64]:
    try:
        return pose_from_quat(translation, quat_wxyz)
    except ValueError as error:
        raise InputError(f"{error}.", field="quat_wxyz", hint="use (1, 0, 0, 0) for no rotation") from error
