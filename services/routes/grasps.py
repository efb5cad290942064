"""Grasps of an object in the map."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from fastapi import APIRouter, Depends, Request, Response

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.grasping.affordance import BoxHint, Hint, NameHint, ObservedView, PixelHint, PointHint, find_target
from splatbot.grasping.language import LanguageAffordance
from splatbot.grasping.options import GraspOptions
from splatbot.grasping.spatial import SpatialAffordance
from splatbot.grasping.summary import summary
from splatbot.results.margin import CONSTANTS as MARGIN
from splatbot.services.codecs import answer, answers, body_of, request_body
from splatbot.services.dependencies import ServedAfterFrames, Service, problems
from splatbot.services.margins import MarginSource, margin_source
from splatbot.services.plan_obstacles import check_unknown, plan_obstacles
from splatbot.services.robots_in_maps import base_in, objects_in, robot_in
from splatbot.services.schemas import GraspsRequest
from splatbot.services.topics import GRASPS

router = APIRouter(prefix="/v1/maps", tags=["grasping"])

_BASE = {"translation": [0.0, 0.0, 0.0], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}
_EXAMPLES = {
    "by its name": {"target": "largest box", "base": _BASE},
    "by a point, the hand alone": {"point": [0.5, 0.0, 0.08], "base": _BASE, "hand_only": True, "samples": 100},
}
_ANSWER = {
    "map_version": 12,
    "target": {"label": "box", "backend": "words", "score": 0.9, "gaussians": 540, "notes": []},
    "grasps": [{"total": 0.81, "width_m": 0.04, "approach": "top", "terms": {"closure": 0.9}}],
    "doubtful": [],
    "best_rejected": None,
    "rejected": {},
    "candidates": 2100,
    "notes": [],
    "seconds": {"contacts": 0.05},
    "margin_m": 0.0,
    "arm_margin_m": 0.006,
    "margin_source": "audited error of the map where the arm moves",
    "unknown_space": "free",
    "measured_surface": True,
}
_Body = Annotated[GraspsRequest, Depends(body_of(GraspsRequest))]


@router.post(
    "/{map_id}/grasps",
    response_class=Response,
    responses=answers(_ANSWER) | problems(404, 415, 422, 503),
    openapi_extra=request_body(GraspsRequest, _EXAMPLES),
)
def grasps(request: Request, served: ServedAfterFrames, service: Service, query: _Body) -> Response:
    """Rank grasps of one object with each term of their scores; no grasp is a problem with the reasons.

    Words match names, colours, shapes, sizes and places; an ambiguous description is refused.
    """
    robot, base = robot_in(served, query.robot), base_in(served, query.base)
    check_unknown(served, query.unknown, query.base)
    objects = objects_in(served, base, as_known=query.base is None)
    found = find_target(_hint(query), objects.scene, [LanguageAffordance(), SpatialAffordance()])
    sampler = objects.sampler(robot, hand_only=query.hand_only, min_observations=query.min_observations)
    alone = query.hand_only and query.margin is None
    source = MarginSource(None, 0.0, "no arm") if alone else margin_source(served, query.margin, sampler.field)
    sampler.margin = source.margin
    if source.error is not None:
        means = objects.scene.model.means.detach().double().numpy()
        sampler.arm_margin = source.error.in_region(means[found.rows]).quantile(MARGIN.confidence)
    measured = False
    if not query.hand_only:
        most = max(sampler.margin, sampler.arm_margin)
        around = plan_obstacles(served, robot, base, robot.home, policy=query.unknown, margin=source)
        sampler.agree_with_plans(around.field(most), around.unknown_field(most))
        measured = around.covers_measured
    options = GraspOptions(
        friction=query.friction,
        samples=query.samples,
        wanted=query.wanted,
        approach=query.approach,
        min_confidence=query.min_confidence,
        accept_implied=query.accept_implied,
        seed=query.seed,
    )
    result = objects.with_notes(sampler.sample(found, options))
    result.unwrap()
    service.store.tell(served, GRASPS, result)
    said = {
        "margin_m": sampler.margin,
        "arm_margin_m": max(sampler.margin, sampler.arm_margin),
        "margin_source": source.why,
        "unknown_space": query.unknown,
        "measured_surface": measured,
    }
    return answer(request, summary(result) | said | {"map_version": served.map_version})


def _hint(query: GraspsRequest) -> Hint:
    if query.target is not None:
        return NameHint(query.target)
    if query.point is not None:
        return PointHint(np.array(query.point))
    if query.picture is None:
        raise InputError("is missing.", field="target", hint="give one of target, point and picture")
    picture = query.picture
    view = ObservedView(Camera(**picture.camera.model_dump()), picture.pose.matrix("picture.pose"))
    if picture.pixel is not None:
        return PixelHint(*picture.pixel, view)
    assert picture.box is not None
    return BoxHint(*picture.box, view)
