"""Collision checks of configurations against the map and the arm itself."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Depends, Request, Response

from splatbot.robots.joints import suspect_degrees_in_rows
from splatbot.services.codecs import answer, answers, body_of, request_body
from splatbot.services.dependencies import ServedAfterFrames, Settings, problems
from splatbot.services.problems import TooLargeError
from splatbot.services.robots_in_maps import arm_in
from splatbot.services.schemas import BASE_EXAMPLE, CollisionsRequest
from splatbot.services.tiled_fields import field_around

router = APIRouter(prefix="/v1/maps", tags=["collision"])

_HOME = [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]
_EXAMPLES = {
    "one configuration": {"q": [_HOME], "base": BASE_EXAMPLE},
    "with clearance and gradients": {
        "q": [_HOME, [0.4, *_HOME[1:]]],
        "base": BASE_EXAMPLE,
        "margin": 0.02,
        "gradient": True,
    },
}
_ANSWER = {
    "map_version": 12,
    "in_collision": [False],
    "link": [-1],
    "other": [-1],
    "clearance": [0.13],
    "clearance_link": [7],
    "gaussian": [977],
    "gradient": [[0.0, -0.02, 0.0, 0.1, 0.0, 0.05, 0.0]],
}
_VALUES_A_ROW = 20  # its list and up to 15 joints
_Body = Annotated[
    CollisionsRequest,
    Depends(body_of(CollisionsRequest, array="q", values=lambda s: 100 + _VALUES_A_ROW * s.max_configurations)),
]


@router.post(
    "/{map_id}/collisions",
    response_class=Response,
    responses=answers(_ANSWER, npy="in_collision (C,) bool") | problems(404, 413, 415, 422, 503),
    openapi_extra=request_body(CollisionsRequest, _EXAMPLES, npy="q (C, 7) for a Panda in a map that knows its base"),
)
def collisions(request: Request, served: ServedAfterFrames, settings: Settings, query: _Body) -> Response:
    """Check each configuration: verdict, colliding link, its partner (`other`; -1 is the map), and clearance.

    "No" is certain for the map's ellipsoids at two standard deviations. `clearance` is the least distance [m] of the
    arm's spheres from them, beyond the margin; null where the map is empty. It is null beyond 1 m from a
    tiled map, too.
    """
    if len(query.q) > settings.max_configurations:
        hint = "split the request, or raise SPLATBOT_MAX_CONFIGURATIONS"
        raise TooLargeError(f"has more than {settings.max_configurations} rows.", field="q", hint=hint)
    model, arm = arm_in(served, query.robot, query.base, query.margin, query.opening)
    suspect_degrees_in_rows(query.q, model.chain, "q")
    tiled = None
    if served.tiles is not None:
        room = float(arm.spheres.radii.max()) + arm.margin
        tiled = field_around(served.tiles, arm.centers(query.q).reshape(-1, 3), "q", room=room)
    field, cut = (served.field, np.inf) if tiled is None else (tiled.field, tiled.reach)
    verdict, clearance = arm.check(field, query.q), arm.clearance(field, query.q, cut=cut)
    body: dict[str, Any] = {
        "map_version": served.map_version,
        "in_collision": verdict.in_collision,
        "link": verdict.link,
        "other": verdict.other,
        "clearance": clearance.distance,
        "clearance_link": clearance.link,
        "gaussian": clearance.index if tiled is None else tiled.rows_of(clearance.index),
    }
    if query.gradient:
        body["gradient"] = clearance.gradient
    return answer(request, body, array="in_collision")
