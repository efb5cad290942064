"""How far points are from the map."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from fastapi import APIRouter, Depends, Request, Response

from splatbot.services.codecs import answer, answers, body_of, request_body
from splatbot.services.dependencies import ServedAfterFrames, Settings, problems
from splatbot.services.problems import TooLargeError
from splatbot.services.schemas import DistanceRequest

router = APIRouter(prefix="/v1/maps", tags=["collision"])

_EXAMPLES = {
    "two points": {"points": [[0.1, 0.0, 0.8], [0.1, 0.0, 0.3]]},
    "a thicker surface": {"points": [[0.1, 0.0, 0.8]], "n_sigma": 3.0},
}
_ANSWER = {"map_version": 12, "n_sigma": 2.0, "distance": [0.4, 31.7], "index": [1042, 977], "inside": [True, False]}
_VALUES_A_POINT = 8  # its list and three numbers
_Body = Annotated[
    DistanceRequest,
    Depends(body_of(DistanceRequest, array="points", values=lambda s: 100 + _VALUES_A_POINT * s.max_points)),
]


@router.post(
    "/{map_id}/distance",
    response_class=Response,
    responses=answers(_ANSWER, npy="distance (P,) float32") | problems(404, 413, 415, 422, 503),
    openapi_extra=request_body(DistanceRequest, _EXAMPLES, npy="points (P, 3)"),
)
def distance(request: Request, served: ServedAfterFrames, settings: Settings, query: _Body) -> Response:
    """Return each point's Mahalanobis distance to the nearest Gaussian, that Gaussian's row, and a verdict.

    In an empty map the distance is null (infinity in npy and msgpack) and the index -1.
    """
    if len(query.points) > settings.max_points:
        raise TooLargeError(
            f"has {len(query.points)} rows, at most {settings.max_points} are answered at once.",
            field="points",
            hint="split the request, or raise SPLATBOT_MAX_POINTS",
        )
    found = served.field.mahalanobis(query.points.reshape(-1, 3))
    body = {
        "map_version": found.map_version,
        "n_sigma": query.n_sigma,
        "distance": found.distance,
        "index": found.index,
        "inside": found.distance.astype(np.float64) <= query.n_sigma,
    }
    return answer(request, body, array="distance")
