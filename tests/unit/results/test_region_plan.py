"""The margin of a plan is the audited error of the region of its motion."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.errors import InputError
from splatbot.planning import GaussianRRTStar, PlanResult
from splatbot.results.margin import AuditedError
from splatbot.results.region_plan import RegionPlan, plan_in_region
from splatbot.robots.panda import panda
from tests.unit.collision.oracle import gaussians

FAR = GaussianCollisionField(gaussians([[0.0, 0.0, 3.0]], 0.01))
START, GOAL = np.array(panda().home), np.array([0.9, -0.3, 0.1, -2.0, 0.2, 1.8, 0.5])


def _error(at: np.ndarray, error: float, elsewhere: float) -> AuditedError:
    """Return 2,000 points near ``at`` with one error, and 2,000 far below with another [m]."""
    rng = np.random.default_rng(0)
    near, far = at + rng.normal(size=(2000, 3)) * 0.01, [0.0, 0.0, -5.0] + rng.normal(size=(2000, 3)) * 0.01
    return AuditedError(np.concatenate([near, far]), np.repeat([error, elsewhere], 2000))


def _planned(error: AuditedError, confidence: float = 0.999) -> RegionPlan:
    def plan(planner: GaussianRRTStar) -> PlanResult:
        return planner.plan(START, GOAL, iterations=50)

    return plan_in_region(
        lambda margin: GaussianRRTStar(FAR, panda(), margin=margin),
        plan,
        np.stack([START, GOAL]),
        error,
        confidence=confidence,
    )


def _tool(share: float) -> np.ndarray:
    arm = RobotSpheres(panda())
    return np.asarray(arm.centers(((1 - share) * START + share * GOAL)[None])[0, -1])


def test_errors_far_from_the_motion_do_not_count() -> None:
    found = _planned(_error(_tool(0.0), 0.004, 0.05))
    assert found.planner.margin == 0.004
    assert found.error == 0.004
    assert found.points == 2000


def test_errors_between_the_ends_raise_the_margin_to_cover_the_path() -> None:
    ends = _error(_tool(0.0), 0.002, 0.002)
    middle = _tool(0.5) + np.random.default_rng(1).normal(size=(500, 3)) * 0.005
    error = AuditedError(np.r_[ends.points, middle], np.r_[ends.error, np.full(500, 0.012)])
    found = _planned(error)
    assert found.trajectory is not None
    assert found.planner.margin == 0.012
    assert found.trajectory.certificate.margin == 0.012


def test_too_few_points_for_the_confidence_take_the_error_of_the_whole_map() -> None:
    error = _error(_tool(0.0), 0.004, 0.03)
    few = AuditedError(error.points[1500:], error.error[1500:])
    assert _planned(few, 0.999).planner.margin == 0.03
    assert _planned(few, 0.9).planner.margin == 0.004


def test_a_quantile_is_the_error_of_a_point_and_a_wrong_confidence_is_refused() -> None:
    error = AuditedError(np.zeros((4, 3)), np.array([0.0, 0.001, 0.002, 0.01]))
    assert error.quantile(0.999) == 0.01
    assert error.quantile(0.25) == 0.001
    assert AuditedError(np.zeros((0, 3)), np.zeros(0)).quantile(0.999) == 0.0
    with pytest.raises(InputError, match="confidence"):
        _planned(error, 1.5)
