"""Pictures of the map."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Depends, Query, Request, Response
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.rasterize.views import default_view, depth_limits, render_view, to_png
from splatbot.services.codecs import body_of, request_body
from splatbot.services.dependencies import (
    Served,
    ServedAfterFrames,
    Settings,
    etag,
    problems,
    unchanged,
    version_headers,
)
from splatbot.services.problems import TooLargeError
from splatbot.services.schemas import Mode, Pose, RenderRequest
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import ServedMap

router = APIRouter(prefix="/v1/maps", tags=["views"])

_PNG: dict[int | str, dict[str, Any]] = {
    200: {
        "content": {"image/png": {}},
        "description": "PNG; X-Map-Version and ETag name the state that was drawn, X-Pixel-Error the size of its "
        "merged details [px]: 0 for a map in memory",
    }
}
_EXAMPLES: dict[str, Any] = {
    "default view": {"mode": "rgb"},
    "depth at a pose": {
        "mode": "depth",
        "camera": {"fx": 525, "fy": 525, "cx": 319.5, "cy": 239.5, "width": 640, "height": 480},
        "translation": [0.0, 0.0, -0.2],
        "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0],
        "depth_range_m": [0.3, 2.0],
    },
}
_MAX_SIDE = 16_384  # [px]
_Body = Annotated[RenderRequest, Depends(body_of(RenderRequest))]


@router.get("/{map_id}/render", response_class=Response, responses=_PNG | problems(404, 413, 422, 503))
def render_default(
    served: Served,
    settings: Settings,
    request: Request,
    mode: Annotated[Mode, Query(examples=["rgb"])] = "rgb",
    width: Annotated[int, Query(ge=1, examples=[640])] = 640,
    height: Annotated[int, Query(ge=1, examples=[480])] = 480,
    fov_deg: Annotated[float, Query(ge=1e-3, lt=180, examples=[60.0])] = 60.0,
) -> Response:
    """Render the whole map for a browser, along the world's z axis with 90 % of it in view."""
    check_size(width, height, settings)
    tag = etag(served, f"{mode} {width} {height} {fov_deg}")
    if (kept := unchanged(request, served, tag)) is not None:
        return kept
    camera, pose = default_view(served.overview(), width=width, height=height, fov_deg=fov_deg)
    return _png(served, tag, camera, pose, mode, None)


@router.post(
    "/{map_id}/render",
    response_class=Response,
    responses=_PNG | problems(404, 413, 415, 422, 503),
    openapi_extra=request_body(RenderRequest, _EXAMPLES),
)
def render(served: ServedAfterFrames, settings: Settings, request: _Body) -> Response:
    """Render the map for a given camera and pose."""
    camera = pose = None
    if request.camera is not None:
        check_size(request.camera.width, request.camera.height, settings)
        camera = Camera(**request.camera.model_dump())
    if request.T_world_camera is not None:
        pose = np.asarray(request.T_world_camera, dtype=np.float64)
    elif request.translation is not None and request.quaternion_wxyz is not None:
        pose = Pose(translation=request.translation, quaternion_wxyz=request.quaternion_wxyz).matrix("quaternion_wxyz")
    if camera is None or pose is None:
        camera, pose = _completed(served, camera, pose)
    tag = etag(served, request.model_dump_json())
    return _png(served, tag, camera, pose, request.mode, request.depth_range_m)


def _completed(
    served: ServedMap, camera: Camera | None, pose: NDArray[np.float64] | None
) -> tuple[Camera, NDArray[np.float64]]:
    """Return a camera and its pose; those that are missing show the whole map."""
    if camera is None:
        usual, at = default_view(served.overview())
        return usual, at if pose is None else pose
    _, at = default_view(served.overview(), width=camera.width, height=camera.height, fov_deg=_fov_deg(camera))
    return camera, at


def _png(
    served: ServedMap,
    tag: str,
    camera: Camera,
    T_world_camera: NDArray[np.float64],
    mode: Mode,
    depth_range: tuple[float, float] | None,
) -> Response:
    model, pixel_error = served.in_view(camera, T_world_camera)
    view = render_view(model, camera, T_world_camera, mode)
    headers = version_headers(served, tag) | {"X-Pixel-Error": f"{pixel_error:.4g}"}
    if mode == "depth":
        depth_range = depth_range or depth_limits(view)
        headers["X-Depth-Range-M"] = "{:.4f} {:.4f}".format(*depth_range)
    return Response(to_png(view, mode, depth_range=depth_range), media_type="image/png", headers=headers)


def check_size(width: int, height: int, settings: ServiceSettings) -> None:
    """Refuse a view of more pixels than one may cost, or with a longer side than is drawn.

    Raises:
        TooLargeError: it is.
    """
    if max(width, height) > _MAX_SIDE:
        hint = f"ask for at most {_MAX_SIDE} columns and rows"
        raise TooLargeError(
            f"{width}x{height} has a side of more than {_MAX_SIDE} pixels.", field="width, height", hint=hint
        )
    if width * height > settings.max_pixels:
        raise TooLargeError(
            f"{width}x{height} has more than {settings.max_pixels} pixels.",
            field="width, height",
            hint="ask for a smaller view, or raise SPLATBOT_MAX_PIXELS",
        )


def _fov_deg(camera: Camera) -> float:
    return float(np.degrees(2 * np.arctan(0.5 * camera.width / camera.fx)))
