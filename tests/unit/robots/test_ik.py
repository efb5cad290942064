"""Inverse kinematics against the Robotics Toolbox: solutions, success rate, limits, order and filter."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from splatbot.bench.tabletop import tabletop
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.errors import InputError
from splatbot.geometry import so3_log
from splatbot.planning.ik import CONSTANTS as IK
from splatbot.planning.ik import nearest_turns, solve_ik
from splatbot.protocols import Array
from splatbot.robots.panda import panda
from splatbot.robots.robot import RobotModel
from splatbot.robots.store import load_robot

toolbox: Any = pytest.importorskip("roboticstoolbox")

NEAR_LIMIT = 1e-3  # [rad] between a joint and its limit


def elementary_transforms(robot: RobotModel) -> Any:
    """Return the robot as the toolbox's elementary transform sequence."""
    ET, parts = toolbox.ET, []
    for k, joint in enumerate(robot.joints):
        parts.append(ET.SE3(joint.T_before_joint))
        parts.append(ET.tz(jindex=k) if joint.prismatic else ET.Rz(jindex=k))
    return toolbox.ETS([*parts, ET.SE3(robot.T_link_tcp)])


def toolbox_reaches(ets: Any, robot: RobotModel, T: Array, starts: Array) -> bool:
    """Return whether the toolbox' Levenberg-Marquardt solver reaches a pose within the limits from any start."""
    middle = (robot.chain.lower + robot.chain.upper) / 2
    for start in starts:
        q = np.asarray(ets.ik_LM(T, q0=start, tol=1e-8, ilimit=60, slimit=1, joint_limits=False)[0])
        q = q - 2 * np.pi * np.round((q - middle) / (2 * np.pi))
        if robot.within_limits(q) and max(pose_error(ets.fkine(q).A, T)) <= 1e-4:
            return True
    return False


def pose_error(T: Array, T_goal: Array) -> tuple[float, float]:
    """Return the distance [m] and the angle [rad] between two poses."""
    angle = float(np.linalg.norm(so3_log(T_goal[:3, :3] @ T[:3, :3].T)))
    return float(np.linalg.norm(T_goal[:3, 3] - T[:3, 3])), angle


def reachable(robot: RobotModel, count: int, rng: np.random.Generator, share_near_limits: float) -> Array:
    """Return random configurations (count, J) of which a share of the joints is at NEAR_LIMIT from a limit."""
    q, chain = robot.random(count, rng), robot.chain
    at_lower = rng.random(q.shape) < 0.5
    at_limit = np.where(at_lower, chain.lower + NEAR_LIMIT, chain.upper - NEAR_LIMIT)
    return np.asarray(np.where(rng.random(q.shape) < share_near_limits, at_limit, q))


@pytest.mark.parametrize("share_near_limits", [0.0, 0.5])
def test_every_pose_that_the_toolbox_reaches_is_reached(share_near_limits: float) -> None:
    robot, rng = panda(), np.random.default_rng(21)
    ets, seeds = elementary_transforms(robot), 32
    starts = np.concatenate([robot.home[None], robot.random(seeds - 1, np.random.default_rng(0))])
    ours, theirs = [], []
    for q in reachable(robot, 250, rng, share_near_limits):
        T = robot.tcp(q)
        answer = solve_ik(robot, T, seeds=seeds)
        assert robot.within_limits(answer.q).all()
        for solution in answer.q:
            assert max(pose_error(ets.fkine(solution).A, T)) <= IK.max_error
        ours.append(len(answer.q) > 0)
        theirs.append(toolbox_reaches(ets, robot, T, starts))
    assert sum(ours) >= sum(theirs)
    assert not (np.array(theirs) & ~np.array(ours)).any()


def test_solutions_reach_the_pose_within_limits_nearest_to_the_posture_first(rng: np.random.Generator) -> None:
    robot = panda()
    found = 0
    for q in robot.random(5, rng):
        T = robot.tcp(q)
        near = robot.random(1, rng)[0]
        answer = solve_ik(robot, T, near=near, seeds=16)
        found += len(answer.q) > 0
        for solution in answer.q:
            assert max(pose_error(robot.tcp(solution), T)) < 2e-6
        assert robot.within_limits(answer.q).all()
        away = np.linalg.norm(answer.q - near, axis=1)
        assert (np.diff(away) >= 0).all()
        assert answer.reached >= len(answer.q)
        assert answer.tried == 16
    assert found == 5


def test_solutions_are_distinct() -> None:
    q = solve_ik(panda(), panda().tcp(panda().home), seeds=64, apart=0.2).q
    assert len(q) > 2
    gap = np.abs(q[:, None] - q[None]).max(axis=-1) + np.eye(len(q))
    assert gap.min() > 0.2


def test_one_seed_follows_the_branch_of_the_posture() -> None:
    robot = panda()
    near = robot.home + 0.05
    q = solve_ik(robot, robot.tcp(robot.home), near=near, seeds=1).q
    assert len(q) == 1
    assert np.abs(q[0] - near).max() < 0.15


@pytest.mark.parametrize("seed", range(3))
def test_joints_that_turn_twice_take_the_turn_nearest_to_the_posture(seed: int) -> None:
    robot = load_robot("ur5e")
    chain = robot.chain
    assert (chain.upper - chain.lower > 2 * np.pi).any()
    for q in robot.random(5, np.random.default_rng(seed)):
        answer = solve_ik(robot, robot.tcp(q), seeds=16)
        assert len(answer.q)
        for solution in answer.q:
            assert max(pose_error(robot.tcp(solution), robot.tcp(q))) < 2e-6
            for turns in (-1, 1):
                other = solution + 2 * np.pi * turns
                nearer = np.abs(other - robot.home) < np.abs(solution - robot.home) - 1e-9
                assert not (nearer & (other >= chain.lower) & (other <= chain.upper)).any()
        assert robot.within_limits(answer.q).all()


def test_a_full_turn_stays_within_limits_and_leaves_slides_alone() -> None:
    robot = load_robot("ur5e")
    lower, prismatic = robot.chain.lower.copy(), robot.chain.prismatic.copy()
    lower[0], prismatic[1] = -1.0, True
    chain = replace(robot.chain, lower=lower, prismatic=prismatic)
    q, near = np.array([6.0, 6.0, 3.0, -6.0, 3.0, 0.0]), np.full(6, -3.0)
    turned = nearest_turns(q, near, chain)
    np.testing.assert_allclose(turned, [6.0 - 2 * np.pi, 6.0, 3.0, -6.0, 3.0 - 2 * np.pi, 0.0])
    lower[0] = -0.2  # now a full turn back would leave the limits
    assert nearest_turns(q, near, replace(chain, lower=lower))[0] == 6.0


def test_configurations_that_collide_are_left_out() -> None:
    robot = panda()
    arm, field = RobotSpheres(robot), GaussianCollisionField(tabletop().gaussians(5000))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.diag([1.0, -1.0, -1.0]), [0.45, -0.15, 0.25]
    every = solve_ik(robot, T, seeds=24)
    free = solve_ik(robot, T, seeds=24, free=lambda q: ~arm.check(field, q).in_collision)
    assert 0 < len(free.q) <= len(every.q)
    assert not arm.check(field, free.q).in_collision.any()


def test_equal_arguments_give_equal_solutions() -> None:
    T = panda().tcp(panda().home)
    np.testing.assert_array_equal(solve_ik(panda(), T, seeds=6).q, solve_ik(panda(), T, seeds=6).q)


def test_a_pose_out_of_reach_has_no_solution() -> None:
    T = np.eye(4)
    T[:3, 3] = [3.0, 0, 0]
    assert solve_ik(panda(), T, seeds=3).q.shape == (0, 7)


def test_a_pose_that_is_not_rigid_is_refused() -> None:
    with pytest.raises(InputError, match="T_base_tcp"):
        solve_ik(panda(), np.ones((4, 4)))


def test_a_posture_of_another_arm_is_refused() -> None:
    with pytest.raises(InputError, match="7 joints"):
        solve_ik(panda(), np.eye(4), near=np.zeros(6))
