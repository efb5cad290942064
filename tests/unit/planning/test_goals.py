"""Poses and regions as goals."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.bench.tabletop import tabletop
from splatbot.collision import GaussianCollisionField
from splatbot.geometry import pose_from_quat, so3_log
from splatbot.planning import GaussianRRTStar, GoalError, JointGoal, PlanStatus, PoseGoal
from splatbot.robots.panda import panda
from splatbot.robots.store import load_robot
from tests.unit.planning.test_rrt_star import LEFT, RIGHT
from tests.unit.planning.toys import Slider, ball_world, cause_of


@pytest.fixture(scope="module")
def planner() -> GaussianRRTStar:
    """The Panda before the table."""
    return GaussianRRTStar(GaussianCollisionField(tabletop().gaussians(20_000)), panda())


def test_a_pose_is_reached_exactly_in_one_of_its_postures(planner: GaussianRRTStar) -> None:
    T = panda().tcp(RIGHT)
    path = planner.plan(LEFT, PoseGoal(T), budget_ms=60_000, iterations=1000).unwrap()
    reached = panda().tcp(path.waypoints[-1])
    np.testing.assert_allclose(reached, T, atol=2e-6)
    assert path.cost <= planner.plan(LEFT, JointGoal(RIGHT), budget_ms=60_000, iterations=1000).unwrap().cost * 1.5


def test_the_end_of_a_path_to_a_region_lies_in_it(planner: GaussianRRTStar) -> None:
    T = panda().tcp(RIGHT)
    box, turn = np.array([0.05, 0.03, 0.0]), np.array([0.0, 0.0, np.pi])
    path = planner.plan(LEFT, PoseGoal(T, position=box, angle=turn), budget_ms=60_000, iterations=1000).unwrap()
    off = np.linalg.inv(T) @ panda().tcp(path.waypoints[-1])
    assert (np.abs(off[:3, 3]) <= box + 2e-6).all()
    assert (np.abs(so3_log(off[:3, :3])) <= turn + 2e-6).all()


def test_the_base_may_stand_anywhere() -> None:
    T_world_base = pose_from_quat([0.4, -0.3, 0.2], [0.9, 0.1, -0.2, 0.3])
    far = ball_world()
    far.means += 50.0
    planner = GaussianRRTStar(GaussianCollisionField(far), panda(), T_world_base=T_world_base)
    T = T_world_base @ panda().tcp(RIGHT)
    path = planner.plan(LEFT, PoseGoal(T), budget_ms=60_000, iterations=1000).unwrap()
    np.testing.assert_allclose(T_world_base @ panda().tcp(path.waypoints[-1]), T, atol=2e-6)


def test_a_pose_behind_a_full_turn_is_reached_the_short_way() -> None:
    robot = load_robot("ur5e")
    far = ball_world()
    far.means += 50.0
    planner = GaussianRRTStar(GaussianCollisionField(far), robot)
    goal = robot.home + 0.2
    for seed in range(5):
        path = planner.plan(robot.home, PoseGoal(robot.tcp(goal)), budget_ms=60_000, iterations=200, seed=seed).unwrap()
        assert (np.abs(path.waypoints[-1] - robot.home) <= np.pi + 1e-9).all()
        assert path.cost < 1.0


def test_a_pose_out_of_reach_has_no_solution_and_says_by_how_much(planner: GaussianRRTStar) -> None:
    T = panda().tcp(RIGHT)
    T[0, 3] = 3.0
    result = planner.plan(LEFT, PoseGoal(T), budget_ms=100)
    assert result.status is PlanStatus.NO_IK_SOLUTION
    assert "mm" in result.reason


def test_a_pose_in_the_table_names_what_the_arm_would_touch(planner: GaussianRRTStar) -> None:
    T = panda().tcp(RIGHT)
    T[2, 3] = 0.0
    result = planner.plan(LEFT, PoseGoal(T), budget_ms=100)
    assert result.status is PlanStatus.GOAL_IN_COLLISION
    assert cause_of(result).link >= 0
    assert cause_of(result).depth > 0


def test_poses_that_make_no_sense_are_refused(planner: GaussianRRTStar) -> None:
    T = panda().tcp(RIGHT)
    for goal in (
        PoseGoal(2 * T),
        PoseGoal(np.full((4, 4), np.nan)),
        PoseGoal(T[:3]),
        PoseGoal(T, position=(-1.0, 0, 0)),
        PoseGoal(T, angle=(np.nan, 0, 0)),
        PoseGoal(T, postures=0),
    ):
        with pytest.raises(GoalError):
            planner.plan(LEFT, goal)
    with pytest.raises(GoalError, match="no tool"):
        GaussianRRTStar(GaussianCollisionField(ball_world()), Slider(2)).plan([-0.8, 0.0], PoseGoal(T))
