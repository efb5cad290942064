"""Whether configurations of an arm touch the map or themselves."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Request, Response

from splatbot.services.codecs import answer, body_of, gives, takes
from splatbot.services.dependencies import Asked, Settings, problems
from splatbot.services.problems import TooLargeError
from splatbot.services.robots_in_maps import arm_in
from splatbot.services.schemas import BASE_EXAMPLE, CollisionsRequest

router = APIRouter(prefix="/v1/maps", tags=["collision"])

_HOME = [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]
_EXAMPLES = {
    "one configuration": {"q": [_HOME], "base": BASE_EXAMPLE},
    "with room and gradients": {
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


@router.post(
    "/{map_id}/collisions",
    response_class=Response,
    responses=gives(_ANSWER, npy="in_collision (C,) bool") | problems(404, 413, 415, 422, 503),
    openapi_extra=takes(CollisionsRequest, _EXAMPLES, npy="q (C, 7) for a Panda in a map that knows its base"),
)
def collisions(
    request: Request,
    served: Asked,
    settings: Settings,
    asked: Annotated[CollisionsRequest, Depends(body_of(CollisionsRequest, array="q"))],
) -> Response:
    """For each configuration: does it touch, with which link (`other`: another link, -1: the map), how much room.

    "No" is certain for the map's ellipsoids at two standard deviations. `clearance` is the least distance [m] of the
    arm's spheres from them, beyond the margin; null where the map is empty.
    """
    if len(asked.q) > settings.max_configurations:
        hint = "split the request, or raise SPLATBOT_MAX_CONFIGURATIONS"
        raise TooLargeError(f"has more than {settings.max_configurations} rows.", field="q", hint=hint)
    _, arm = arm_in(served, asked.robot, asked.base, asked.margin, asked.opening)
    field = served.field
    verdict, room = arm.check(field, asked.q), arm.clearance(field, asked.q)
    body: dict[str, Any] = {
        "map_version": verdict.map_version,
        "in_collision": verdict.in_collision,
        "link": verdict.link,
        "other": verdict.other,
        "clearance": room.distance,
        "clearance_link": room.link,
        "gaussian": room.index,
    }
    if asked.gradient:
        body["gradient"] = room.gradient
    return answer(request, body, array="in_collision")
