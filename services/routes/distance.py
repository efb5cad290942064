"""How far points are from the map."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from fastapi import APIRouter, Body

from splatbot.services.dependencies import Served, Settings, example, problems
from splatbot.services.problems import TooLargeError
from splatbot.services.schemas import DistanceAnswer, DistanceRequest

router = APIRouter(prefix="/v1/maps", tags=["collision"])

_BODY = Body(
    openapi_examples={
        "two points": {"value": {"points": [[0.1, 0.0, 0.8], [0.1, 0.0, 0.3]]}},
        "a thicker surface": {"value": {"points": [[0.1, 0.0, 0.8]], "n_sigma": 3.0}},
    }
)
_ANSWER = {"map_version": 12, "n_sigma": 2.0, "distance": [0.4, 31.7], "index": [1042, 977], "inside": [True, False]}


@router.post("/{map_id}/distance", responses=example(_ANSWER) | problems(404, 413, 422, 503))
def distance(served: Served, settings: Settings, request: Annotated[DistanceRequest, _BODY]) -> DistanceAnswer:
    """How many standard deviations each point is from the nearest Gaussian, which that is, and whether it is inside."""
    if len(request.points) > settings.max_points:
        raise TooLargeError(
            f"has {len(request.points)} rows, at most {settings.max_points} are answered at once.",
            field="points",
            hint="split the request, or raise SPLATBOT_MAX_POINTS",
        )
    found = served.field.mahalanobis(np.asarray(request.points, dtype=np.float64).reshape(-1, 3))
    return DistanceAnswer(
        map_version=found.map_version,
        n_sigma=request.n_sigma,
        distance=[d if np.isfinite(d) else None for d in found.distance.tolist()],
        index=found.index.tolist(),
        inside=(found.distance <= request.n_sigma).tolist(),
    )
