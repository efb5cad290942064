"""Inverse kinematics: what it finds is right, within limits, ordered and filtered."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.bench.tabletop import tabletop
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.errors import InputError
from splatbot.robots.ik import pose_error, solve_ik
from splatbot.robots.panda import panda

pytest.importorskip("roboticstoolbox")


def test_solutions_reach_the_pose_within_limits_nearest_to_the_posture_first(rng: np.random.Generator) -> None:
    robot = panda()
    found = 0
    for q in robot.random(5, rng):
        T = robot.tcp(q)
        near = robot.random(1, rng)[0]
        answer = solve_ik(robot, T, near=near, seeds=16)
        found += len(answer.q) > 0
        for solution in answer.q:
            assert np.abs(pose_error(robot.tcp(solution), T)).max() < 2e-6
        assert robot.within_limits(answer.q).all()
        away = np.linalg.norm(answer.q - near, axis=1)
        assert (np.diff(away) >= 0).all()
        assert answer.reached >= len(answer.q)
    assert found == 5


def test_configurations_that_collide_are_left_out() -> None:
    robot = panda()
    arm, field = RobotSpheres(robot), GaussianCollisionField(tabletop().gaussians(5000))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.diag([1.0, -1.0, -1.0]), [0.45, -0.15, 0.25]
    every = solve_ik(robot, T, seeds=24)
    free = solve_ik(robot, T, seeds=24, free=lambda q: ~arm.check(field, q).in_collision)
    assert 0 < len(free.q) <= len(every.q)
    assert not arm.check(field, free.q).in_collision.any()


def test_the_same_question_has_the_same_answer() -> None:
    T = panda().tcp(panda().home)
    np.testing.assert_array_equal(solve_ik(panda(), T, seeds=6).q, solve_ik(panda(), T, seeds=6).q)


def test_what_is_out_of_reach_has_no_solution() -> None:
    T = np.eye(4)
    T[:3, 3] = [3.0, 0, 0]
    assert solve_ik(panda(), T, seeds=3).q.shape == (0, 7)


def test_a_pose_that_is_not_rigid_is_refused() -> None:
    with pytest.raises(InputError, match="T_base_tcp"):
        solve_ik(panda(), np.ones((4, 4)))
