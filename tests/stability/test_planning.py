"""Planning where it is hard: limits, singular postures, needle's eyes, contact, far from the origin, large trees."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.bench.tabletop import tabletop
from splatbot.collision import GaussianCollisionField
from splatbot.gaussians import GaussianModel
from splatbot.planning import GaussianRRTStar, PlanStatus, PoseGoal
from splatbot.protocols import Array
from splatbot.robots.panda import panda
from tests.unit.planning.test_rrt_star import LEFT, RIGHT
from tests.unit.planning.toys import RADIUS, Slider, around_the_ball, ball_world, cause_of


def _balls(means: Array, scales: Array) -> GaussianCollisionField:
    """Return Gaussians along the axes, given by their semi-axes (N, 3) at two sigma."""
    n = len(means)
    return GaussianCollisionField(
        GaussianModel.from_activated(
            means=np.asarray(means, np.float64),
            quats=np.tile([1.0, 0, 0, 0], (n, 1)),
            scales=np.asarray(scales) / 2,
            opacities=np.full(n, 0.9),
            colors=np.full((n, 3), 0.5),
        )
    )


@pytest.fixture(scope="module")
def planner() -> GaussianRRTStar:
    """The Panda before the table."""
    return GaussianRRTStar(GaussianCollisionField(tabletop().gaussians(20_000)), panda())


def test_goals_at_the_joints_limits_are_reached_exactly(planner: GaussianRRTStar) -> None:
    rng = np.random.default_rng(0)
    chain = panda().chain
    q = panda().random(4000, rng)
    joint, side = rng.integers(0, 7, len(q)), rng.integers(0, 2, len(q)).astype(bool)
    q[np.arange(len(q)), joint] = np.where(side, chain.upper[joint], chain.lower[joint])
    q = q[~planner.arm.check(planner.field, q).in_collision]
    q = q[planner.arm.clearance(planner.field, q, cut=0.05).distance > 0.03][:12]
    assert len(q) == 12
    for start, goal in zip(q[:6], q[6:], strict=True):
        path = planner.plan(start, goal, budget_ms=60_000, iterations=2000).unwrap()
        np.testing.assert_array_equal(path.waypoints[[0, -1]], [start, goal])
        assert panda().within_limits(path.waypoints).all()


def test_poses_of_singular_postures_are_reached() -> None:
    far = ball_world()
    far.means += 50.0
    planner = GaussianRRTStar(GaussianCollisionField(far), panda())
    stretched = np.array([0.3, 0.4, 0.0, -0.07, 0.0, 1.9, 0.8])  # the elbow is at its limit, nearly straight
    wrist = np.array([0.3, 0.2, 0.0, -2.0, 0.0, 2.2, 0.8])  # shoulder and wrist turn about parallel axes
    for q in (stretched, wrist):
        assert not planner.arm.check(planner.field, q[None]).in_collision[0]
        path = planner.plan(RIGHT, PoseGoal(panda().tcp(q)), budget_ms=500).unwrap()
        np.testing.assert_allclose(panda().tcp(path.waypoints[-1]), panda().tcp(q), atol=3e-6)


def test_a_start_that_is_the_goal_is_a_path_of_no_length(planner: GaussianRRTStar) -> None:
    for goal in (LEFT, np.stack([RIGHT, LEFT])):
        path = planner.plan(LEFT, goal, budget_ms=28).unwrap()
        assert path.cost == 0.0
        np.testing.assert_array_equal(path.waypoints, [LEFT, LEFT])
        np.testing.assert_array_equal(path.at([0.0, 0.5, 1.0]), [LEFT] * 3)


@pytest.mark.parametrize("room", [0.02, 0.005])
def test_a_needles_eye_with_five_millimetres_of_room_is_passed(room: float) -> None:
    half = RADIUS + room / 2  # of the gap between the tips of two long ellipsoids, which reach beyond the limits
    field = _balls(
        np.array([[0.0, half + 0.6, 0.0], [0.0, -half - 0.6, 0.0]]), np.array([[0.03, 0.6, 0.1], [0.03, 0.6, 0.1]])
    )
    planner = GaussianRRTStar(field, Slider(2))
    start, goal = np.array([-0.7, 0.5]), np.array([0.7, 0.45])
    result = planner.plan(start, goal, budget_ms=10_000, iterations=20_000)
    path = result.unwrap()
    along = path.at(np.linspace(0, 1, 20_001))
    assert not planner.arm.check(field, along).in_collision.any()
    through = along[np.argmin(np.abs(along[:, 0]))]
    assert abs(through[1]) <= room / 2 + 1e-5
    assert 0.0 < path.certificate.clearance <= room / 2 + 1e-5
    shortest = np.linalg.norm(start - [0.0, room / 2]) + np.linalg.norm(goal - [0.0, room / 2])
    assert path.cost < 1.02 * shortest


def test_an_arm_that_nearly_touches_can_leave(planner: GaussianRRTStar) -> None:
    field = _balls(np.zeros((1, 3)), np.full((1, 3), 0.2))
    slider = GaussianRRTStar(field, Slider(2))
    for room in (1e-3, 3e-4):
        start = np.array([-(0.2 + RADIUS + room), 0.0])
        result = slider.plan(start, [0.8, 0.1], budget_ms=2000, iterations=2000)
        path = result.unwrap()
        assert path.certificate.eps < slider.eps
        assert not slider.arm.check(field, path.at(np.linspace(0, 1, 4001))).in_collision.any()


def test_a_robot_inside_the_map_is_told_by_what_and_how_deep() -> None:
    model = ball_world()
    model.log_scales[:] = float(np.log(2.0))  # all within one Gaussian
    planner = GaussianRRTStar(GaussianCollisionField(model), panda())
    result = planner.plan(LEFT, RIGHT)
    assert result.status is PlanStatus.START_STATE_IN_COLLISION
    assert cause_of(result).gaussian == 0
    assert cause_of(result).depth > 2.0
    slider = GaussianRRTStar(GaussianCollisionField(ball_world()), Slider(2))
    result = slider.plan([0.0, 0.0], [0.8, 0.0])
    assert cause_of(result).depth == pytest.approx(0.22, abs=1e-4)


def test_maps_and_bases_a_kilometre_away_are_planned_in_as_well() -> None:
    model = ball_world()
    model.means += 1000.0
    T_world_base = np.eye(4)
    T_world_base[:3, 3] = 1000.0
    planner = GaussianRRTStar(GaussianCollisionField(model), Slider(2), T_world_base=T_world_base)
    path = planner.plan([-0.8, 0.0], [0.8, 0.0], budget_ms=10_000, iterations=2000).unwrap()
    assert path.cost < 1.02 * around_the_ball(0.8)
    assert not planner.arm.check(planner.field, path.at(np.linspace(0, 1, 4001))).in_collision.any()


def test_a_joint_that_cannot_move_stays_where_it_is() -> None:
    slider = Slider(3)
    slider.chain.lower[2] = slider.chain.upper[2] = 0.125
    planner = GaussianRRTStar(GaussianCollisionField(ball_world()), slider)
    path = planner.plan([-0.8, 0.0, 0.125], [0.8, 0.0, 0.125], budget_ms=10_000, iterations=4000).unwrap()
    assert (path.waypoints[:, 2] == 0.125).all()
    assert path.cost < 1.02 * around_the_ball(0.8)
    assert len(planner.tree()[0]) > 100


@pytest.mark.long
def test_a_tree_of_a_hundred_thousand_nodes_keeps_its_promises() -> None:
    planner = GaussianRRTStar(GaussianCollisionField(ball_world()), Slider(2))
    result = planner.plan([-0.8, 0.0], [0.8, 0.0], budget_ms=120_000, iterations=400_000)
    q, parent, cost = planner.tree()
    assert result.nodes == len(q) > 100_000
    assert planner.nbytes < 20e6
    child = np.flatnonzero(parent >= 0)
    assert len(child) == len(q) - 1
    np.testing.assert_allclose(
        cost[child], cost[parent[child]] + np.linalg.norm(q[child] - q[parent[child]], axis=1), rtol=1e-12
    )
    some = child[:: len(child) // 20_000 + 1]
    edges = planner.arm.certify(planner.field, q[parent[some]], q[some], eps=planner.eps / 2)
    assert not edges.in_collision.any()
    shortest = around_the_ball(0.8)
    assert shortest * (1 - 1e-9) < result.unwrap().cost < 1.003 * shortest
