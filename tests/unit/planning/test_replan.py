"""Paths that outlive changes of the map, and those that are repaired."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.bench.tabletop import tabletop
from splatbot.collision import GaussianCollisionField
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.planning import GaussianRRTStar, PlanStatus, Replanner
from splatbot.robots.panda import panda
from tests.unit.planning.test_rrt_star import LEFT, RIGHT
from tests.unit.planning.toys import Slider, ball_world, cause_of

START, GOAL = np.array([-0.8, 0.0]), np.array([0.8, 0.0])


def _with_ball(model: GaussianModel, at: list[float], sigma: float) -> tuple[GaussianModel, NDArray[np.bool_]]:
    """Return the model with one more round Gaussian, and the rows that changed."""
    ball = ball_world()
    ball.means[:] = ball.means.new_tensor([at])
    ball.log_scales[:] = float(np.log(sigma))
    later = GaussianModel.concatenate([model, ball])
    return later, np.arange(len(later)) >= len(model)


@pytest.fixture
def replanner() -> Replanner:
    """A slider with a path around a ball."""
    found = Replanner(GaussianRRTStar(GaussianCollisionField(ball_world()), Slider(2)))
    assert found.plan(START, GOAL, budget_ms=100)
    return found


def _later(replanner: Replanner, at: list[float], sigma: float) -> GaussianCollisionField:
    return replanner.planner.field.updated(*_with_ball(ball_world(), at, sigma))


def _side(replanner: Replanner) -> float:
    """Return 1 if the path passes above the ball, else -1."""
    assert replanner.path is not None
    return float(np.sign(replanner.path.at([0.5])[0, 1]))


def test_a_path_far_from_what_is_new_stands_on_the_new_version(replanner: Replanner) -> None:
    before = replanner.path
    assert before is not None
    update = replanner.update(_later(replanner, [0.0, -0.8 * _side(replanner), 0.0], 0.05))
    after = update.result.unwrap()
    assert update.kept
    np.testing.assert_array_equal(after.waypoints, before.waypoints)
    assert after.certificate.map_version == before.certificate.map_version + 1
    assert after.certificate.clearance == pytest.approx(before.certificate.clearance)


def test_later_searches_are_on_the_later_map(replanner: Replanner) -> None:
    later = _later(replanner, [0.0, -0.3 * _side(replanner), 0.0], 0.1)
    assert replanner.update(later).kept
    path = replanner.plan(GOAL, [0.0, -0.7 * _side(replanner)], budget_ms=100).unwrap()
    assert path.certificate.map_version == later.map_version
    assert not replanner.planner.arm.check(later, path.at(np.linspace(0, 1, 4001))).in_collision.any()


def test_what_comes_close_lowers_the_promised_clearance_and_no_more(replanner: Replanner) -> None:
    # The path is taut around the ball, so a second one must come nearer than that to matter.
    careful = Replanner(GaussianRRTStar(GaussianCollisionField(ball_world()), Slider(2)))
    assert careful.plan([-0.8, 0.6], [0.8, 0.6], budget_ms=100)
    update = careful.update(_later(careful, [0.0, 0.7, 0.0], 0.02))
    assert update.kept
    after = update.result.unwrap()
    along = after.at(np.linspace(0, 1, 2001))
    clearance = careful.planner.arm.clearance(careful.planner.field, along).distance.min()
    assert update.clearance_before > after.certificate.clearance
    assert clearance - 2e-3 < after.certificate.clearance <= clearance


def test_what_disappears_leaves_a_path_as_it_is(replanner: Replanner) -> None:
    empty = GaussianModel.empty()
    later = replanner.planner.field.updated(empty, np.zeros(0, np.bool_))
    update = replanner.update(later)
    assert update.kept
    assert len(later) == 0


def test_a_path_that_is_in_the_way_is_repaired_with_what_is_left_of_the_tree(replanner: Replanner) -> None:
    before = replanner.path
    assert before is not None
    side = _side(replanner)
    later = _later(replanner, [0.0, 0.3 * side, 0.0], 0.1)
    update = replanner.update(later, budget_ms=200)
    after = update.result.unwrap()
    assert not update.kept
    assert _side(replanner) == -side
    planner = replanner.planner
    assert not planner.arm.check(later, after.at(np.linspace(0, 1, 4001))).in_collision.any()
    assert after.certificate.map_version == later.map_version
    q, parent, cost = planner.tree()
    child = np.flatnonzero(parent >= 0)
    assert len(child) == len(q) - 1
    ends = q[parent[child]], q[child]
    assert not planner.arm.certify(later, *ends, eps=planner.eps / 2).in_collision.any()
    np.testing.assert_allclose(cost[child], cost[parent[child]] + np.linalg.norm(ends[1] - ends[0], axis=1), rtol=1e-12)


def test_a_repair_begins_where_the_arm_is(replanner: Replanner) -> None:
    assert replanner.path is not None
    here = replanner.path.at([0.2])[0]
    update = replanner.update(_later(replanner, [0.0, 0.3 * _side(replanner), 0.0], 0.1), start=here, budget_ms=200)
    path = update.result.unwrap()
    np.testing.assert_array_equal(path.waypoints[[0, -1]], [here, GOAL])
    _, parent, cost = replanner.planner.tree()
    root = int(np.flatnonzero(parent < 0)[0])
    assert cost[root] == 0.0


def test_a_goal_that_is_now_in_the_map_is_reported(replanner: Replanner) -> None:
    update = replanner.update(_later(replanner, [0.8, 0.0, 0.0], 0.05))
    assert update.result.status is PlanStatus.GOAL_IN_COLLISION
    assert cause_of(update.result).gaussian == 1
    with pytest.raises(InputError, match="plan first"):
        replanner.update(replanner.planner.field)


def test_repeated_changes_leave_every_path_free_of_the_map_it_is_for() -> None:
    rng = np.random.default_rng(0)
    model = tabletop().gaussians(10_000)
    field = GaussianCollisionField(model)
    replanner = Replanner(GaussianRRTStar(field, panda()))
    assert replanner.plan(LEFT, RIGHT, budget_ms=500)
    repaired = 0
    for _ in range(8):
        path = replanner.path
        assert path is not None
        arm = replanner.planner.arm
        at = arm.centers(path.at([rng.uniform(0.4, 0.6)]))[0, -1] + rng.normal(0, 0.05, 3)
        later = field.updated(*_with_ball(model, at.tolist(), 0.02))
        update = replanner.update(later, budget_ms=300)
        repaired += not update.kept
        if not update.result:  # the ball is in the start or the goal
            assert replanner.plan(LEFT, RIGHT, budget_ms=50) or replanner.planner.field is later
            break
        along = update.result.unwrap().at(np.linspace(0, 1, 1001))
        assert not arm.check(later, along).in_collision.any()
        assert update.result.unwrap().certificate.certified
    assert repaired


def test_without_a_path_there_is_nothing_to_update() -> None:
    planner = GaussianRRTStar(GaussianCollisionField(ball_world()), Slider(2))
    with pytest.raises(InputError, match="plan first"):
        Replanner(planner).update(planner.field)
