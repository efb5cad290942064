"""Many views of the map in one call, as images or as arrays."""

from __future__ import annotations

import base64
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Depends, Request, Response

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.rasterize.views import render_view, to_png
from splatbot.services.codecs import MSGPACK, NPY, answer, answers, body_of, request_body
from splatbot.services.dependencies import ServedAfterFrames, Settings, problems
from splatbot.services.problems import TooLargeError
from splatbot.services.routes.render import check_size
from splatbot.services.schemas import ViewsRequest

router = APIRouter(prefix="/v1/maps", tags=["views"])

_CAMERA = {"fx": 200.0, "fy": 200.0, "cx": 79.5, "cy": 59.5, "width": 160, "height": 120}
_EXAMPLES = {
    "two cameras": {
        "modes": ["rgb", "depth"],
        "views": [
            {"camera": _CAMERA, "pose": {"translation": [0.0, 0.0, -0.2]}},
            {"camera": _CAMERA, "pose": {"translation": [0.1, 0.0, -0.2], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}},
        ],
    }
}
_ANSWER = {"map_version": 12, "views": [{"rgb": "iVBORw0KGgo...", "depth": "iVBORw0KGgo..."}], "pixel_error": [0.0]}
_Body = Annotated[ViewsRequest, Depends(body_of(ViewsRequest))]


@router.post(
    "/{map_id}/views",
    response_class=Response,
    responses=answers(_ANSWER, npy="of one mode and one size: (N, H, W[, 3])") | problems(404, 413, 415, 422, 503),
    openapi_extra=request_body(ViewsRequest, _EXAMPLES),
)
def views(request: Request, served: ServedAfterFrames, settings: Settings, query: _Body) -> Response:
    """Render the view of each camera.

    JSON holds PNGs in base64. msgpack and npy hold arrays: rgb uint8, depth float32 [m] (0: nothing there), normal
    float32, alpha float32. `pixel_error` [px] is the size of merged details in each view of a tiled map, else 0.
    """
    if len(query.views) * len(query.modes) > settings.max_views:
        hint = "split the request, or raise SPLATBOT_MAX_VIEWS"
        raise TooLargeError(f"are more than {settings.max_views}.", field="views", hint=hint)
    accepted = request.headers.get("accept", "")
    if NPY in accepted and (len(query.modes) > 1 or len({(v.camera.width, v.camera.height) for v in query.views}) > 1):
        raise InputError("are not one array.", field="views", hint="ask for one mode and one size, or for msgpack")
    as_arrays = NPY in accepted or MSGPACK in accepted
    drawn: list[dict[str, Any]] = []
    errors: list[float] = []
    for number, view in enumerate(query.views):
        check_size(view.camera.width, view.camera.height, settings)
        camera, pose = Camera(**view.camera.model_dump()), view.pose.matrix(f"views.{number}.pose")
        model, pixel_error = served.in_view(camera, pose)
        errors.append(pixel_error)
        images: dict[str, Any] = {}
        for mode in query.modes:
            image = render_view(model, camera, pose, mode)
            if as_arrays:
                images[mode] = (255.0 * image + 0.5).astype(np.uint8) if mode == "rgb" else image
            else:
                images[mode] = base64.b64encode(to_png(image, mode)).decode()
        drawn.append(images)
    body: dict[str, Any] = {"map_version": served.map_version, "views": drawn, "pixel_error": errors}
    if NPY in accepted:
        body["array"] = np.stack([images[query.modes[0]] for images in drawn])
    return answer(request, body, array="array")
