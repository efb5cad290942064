"""Margins of motions in served maps: the audited error of the surface where the arm moves, or a given number."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from splatbot.collision import GaussianCollisionField
from splatbot.errors import InputError, SplatbotError
from splatbot.planning import GaussianRRTStar, JointGoal, PlanResult, PoseGoal
from splatbot.results.margin import AuditedError, audited_error
from splatbot.results.region_plan import RegionPlan, plan_at_margin, plan_in_region
from splatbot.robots.in_view import reopen_log
from splatbot.services.store import ServedMap

Goal = JointGoal | PoseGoal
Margin = float | Literal["auto"] | None
"""Clearance [m], the audited error, or the default: the audited error where the map has a recording, else 0."""


@dataclass(frozen=True)
class MarginSource:
    """Where a margin comes from.

    Args:
        error: audited error of the map. If None, the margin is a number.
        margin: that number [m]; not used with an error.
        why: description for the answer.
        required: whether the request has the margin "auto", so that its evidence must not be left out.
    """

    error: AuditedError | None
    margin: float
    why: str
    required: bool = False

    @property
    def audited(self) -> bool:
        """Return whether the margin is the audited error of the map."""
        return self.error is not None


def margin_source(served: ServedMap, given: Margin, field: GaussianCollisionField | None = None) -> MarginSource:
    """Return the source of a margin. The audit of a map version takes seconds, once for each kind of field.

    Args:
        served: the map.
        given: the margin of the request.
        field: collision field of the map that is audited; by default that of plans.

    Raises:
        SplatbotError: the margin is "auto" and the map has no recording, or one that cannot be read.
    """
    if isinstance(given, float):
        return MarginSource(None, given, "given")
    if given is None and served.run is None:
        return MarginSource(None, 0.0, "unknown: the map has no recording; 0 is assumed")
    try:
        field = served.field if field is None else field
        error = served.derived.get(("audited error", field.n_sigma, field.gate), lambda: _audit(served, field))
    except SplatbotError as failure:
        if given == "auto":
            raise
        return MarginSource(None, 0.0, f"unknown: the recording cannot be audited ({failure.message}); 0 is assumed")
    return MarginSource(error, 0.0, "audited error of the map where the arm moves", required=given == "auto")


def plan_with_margin(
    source: MarginSource,
    make_planner: Callable[[float], GaussianRRTStar],
    plan: Callable[[GaussianRRTStar], PlanResult],
    start: NDArray[np.float64],
    goal: Goal,
    *,
    confidence: float,
    speed: float,
    acceleration: float | None = None,
) -> RegionPlan:
    """Plan and time a motion; see :func:`splatbot.results.region_plan.plan_in_region`.

    Raises:
        InputError: the audited margins still increase after five plans.
    """
    if source.error is not None:
        ends = np.concatenate([start[None], np.atleast_2d(goal.q)]) if isinstance(goal, JointGoal) else start[None]
        return plan_in_region(
            make_planner, plan, ends, source.error, confidence=confidence, speed=speed, acceleration=acceleration
        )
    return plan_at_margin(make_planner(source.margin), plan, speed=speed, acceleration=acceleration)


def _audit(served: ServedMap, field: GaussianCollisionField) -> AuditedError:
    """Compare the map with the raw depth of its recording.

    Raises:
        InputError: the map has no recording.
    """
    if served.run is None:
        hint = "give the margin in metres, or map a recording"
        raise InputError(f"is not known for map {served.id!r}, which has no recording.", field="margin", hint=hint)
    return audited_error(served.run.path, reopen_log(served.run), field)
