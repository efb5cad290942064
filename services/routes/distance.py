"""How far points are from the map."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from fastapi import APIRouter, Depends, Request, Response
from numpy.typing import NDArray

from splatbot.collision import MahalanobisResult
from splatbot.collision.inputs import spheres
from splatbot.services.codecs import answer, answers, body_of, request_body
from splatbot.services.dependencies import ServedAfterFrames, Settings, problems
from splatbot.services.problems import TooLargeError
from splatbot.services.schemas import DistanceRequest
from splatbot.services.store import ServedMap
from splatbot.services.tiled_fields import REACH, field_around

router = APIRouter(prefix="/v1/maps", tags=["collision"])

_EXAMPLES = {
    "two points": {"points": [[0.1, 0.0, 0.8], [0.1, 0.0, 0.3]]},
    "a thicker surface": {"points": [[0.1, 0.0, 0.8]], "n_sigma": 3.0},
}
_ANSWER = {
    "map_version": 12,
    "n_sigma": 2.0,
    "distance_sigma": [0.4, 31.7],
    "distance_m": [-0.003, 0.216],
    "index": [1042, 977],
    "inside": [True, False],
}
_N_SIGMA = 2.0  # of motions
_VALUES_A_POINT = 8  # its list and three numbers
_Body = Annotated[
    DistanceRequest,
    Depends(body_of(DistanceRequest, array="points", values=lambda s: 100 + _VALUES_A_POINT * s.max_points)),
]


@router.post(
    "/{map_id}/distance",
    response_class=Response,
    responses=answers(_ANSWER, npy="distance_sigma (P,) float32") | problems(404, 413, 415, 422, 503),
    openapi_extra=request_body(DistanceRequest, _EXAMPLES, npy="points (P, 3)"),
)
def distance(request: Request, served: ServedAfterFrames, settings: Settings, query: _Body) -> Response:
    """Return each point's distance to the map in standard deviations and in metres, the Gaussian, and a verdict.

    `distance_sigma` is the Mahalanobis distance to the Gaussian `index`. `distance_m` is the signed distance to the
    surface at `n_sigma` standard deviations. It is null beyond 1 m, and for another `n_sigma` than that of motions, 2.
    In an empty map both are null (infinity in npy and msgpack) and the index is -1. So are `distance_sigma` and `index`
    of a tiled map where `distance_sigma` would exceed `n_sigma`.
    """
    if len(query.points) > settings.max_points:
        raise TooLargeError(
            f"has {len(query.points)} rows, at most {settings.max_points} are answered at once.",
            field="points",
            hint="split the request, or raise SPLATBOT_MAX_POINTS",
        )
    points = query.points.reshape(-1, 3)
    found, metres = _nearest(served, points, query.n_sigma)
    metres[metres >= REACH] = np.inf
    body = {
        "map_version": served.map_version,
        "n_sigma": query.n_sigma,
        "distance_sigma": found.distance,
        "distance_m": metres,
        "index": found.index,
        "inside": found.distance.astype(np.float64) <= query.n_sigma,
    }
    return answer(request, body, array="distance_sigma")


def _nearest(
    served: ServedMap, points: NDArray[np.float64], n_sigma: float
) -> tuple[MahalanobisResult, NDArray[np.float32]]:
    """Return the nearest Gaussians, and the distances (P,) [m] at the standard deviations of motions, or infinity."""
    tiled = None
    if served.tiles is not None:
        tiled = field_around(served.tiles, spheres(points)[0], "points", n_sigma=n_sigma)
    found = (served.field if tiled is None else tiled).mahalanobis(points)
    if n_sigma != _N_SIGMA:
        return found, np.full(len(points), np.inf, np.float32)
    near = served.field.clearance(points, cut=REACH) if tiled is None else tiled.clearance(points)
    return found, near.distance.astype(np.float32)
