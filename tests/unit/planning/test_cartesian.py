"""Straight lines of the tool."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.errors import InputError
from splatbot.geometry import so3_exp, so3_log
from splatbot.planning import GoalError, PlanStatus, StartError, time_path
from splatbot.planning.cartesian import along, straight_line
from splatbot.robots.panda import panda
from tests.unit.collision.oracle import gaussians

START = np.array([0.0, -0.3, 0.0, -2.2, 0.0, 2.0, np.pi / 4])
ARM = RobotSpheres(panda(), opening=0.0)


def test_the_tool_goes_straight_and_turns_evenly(field: GaussianCollisionField) -> None:
    T = panda().tcp(START)
    end = along(T, 0.10)
    end[:3, :3] = end[:3, :3] @ so3_exp([0.0, 0.0, 0.4])
    answer = straight_line(ARM, field, START, end)
    assert answer
    assert answer.path is not None
    assert answer.path.certificate.certified
    dense = panda().tcp(np.concatenate([answer.path.at(np.linspace(0, 1, 300))]))
    offset = dense[:, :3, 3] - T[:3, 3]
    unit = T[:3, 2]
    assert np.linalg.norm(offset - (offset @ unit)[:, None] * unit, axis=1).max() < 1e-3
    np.testing.assert_allclose(dense[-1], end, atol=2e-5)
    angles = [float(np.linalg.norm(so3_log(T[:3, :3].T @ R))) for R in dense[:, :3, :3]]
    np.testing.assert_allclose(angles, 4.0 * np.linalg.norm(offset, axis=1), atol=5e-3)


def test_every_configuration_of_a_certified_line_is_free_and_it_can_be_timed(field: GaussianCollisionField) -> None:
    end = along(panda().tcp(START), 0.15)
    answer = straight_line(ARM, field, START, end)
    assert answer.path is not None
    q = answer.path.at(np.linspace(0, 1, 1000))
    clearance = ARM.clearance(field, q, cut=0.05).distance
    assert not ARM.check(field, q).in_collision.any()
    assert answer.path.certificate.clearance <= min(0.05, clearance.min()) + 1e-9
    assert answer.path.certificate.clearance > 0
    trajectory = time_path(answer.path, ARM, field)
    assert trajectory.certificate.certified
    tool = panda().tcp(trajectory.sampled(200.0).position)[:, :3, 3] - panda().tcp(START)[:3, 3]
    unit = panda().tcp(START)[:3, 2]
    assert np.linalg.norm(tool - (tool @ unit)[:, None] * unit, axis=1).max() < 3e-3


def test_there_and_back_again_is_the_same_line(field: GaussianCollisionField) -> None:
    forth = straight_line(ARM, field, START, along(panda().tcp(START), 0.12))
    assert forth.path is not None
    back = straight_line(ARM, field, forth.path.waypoints[-1], panda().tcp(START))
    assert back.path is not None
    np.testing.assert_allclose(back.path.waypoints[-1], START, atol=1e-3)


def test_something_in_the_way_ends_the_line_before_it_and_is_named() -> None:
    T = panda().tcp(START)
    plate = T[:3, 3] + 0.10 * T[:3, 2]
    plate_field = GaussianCollisionField(gaussians(plate, 0.01))
    answer = straight_line(ARM, plate_field, START, along(T, 0.15))
    assert answer.status is PlanStatus.GOAL_IN_COLLISION
    assert answer.cause is not None
    assert answer.cause.gaussian == 0
    assert 0.2 < answer.share < 0.7
    assert answer.path is not None
    assert not ARM.check(plate_field, answer.path.at(np.linspace(0, 1, 200))).in_collision.any()
    # The attached object reaches farther, so that the line ends earlier.
    held = RobotSpheres(panda(), opening=0.0, attached=[[0.0, 0.0, 0.107 + 0.1034 + 0.03, 0.02]])
    assert straight_line(held, plate_field, START, along(T, 0.15)).share < answer.share


def test_a_line_out_of_reach_ends_where_the_arm_is_stretched() -> None:
    T = panda().tcp(START)
    far = T.copy()
    far[:3, 3] += [0.9, 0.0, 0.3]
    answer = straight_line(ARM, None, START, far)
    assert answer.status is PlanStatus.NO_IK_SOLUTION
    assert 0.0 < answer.share < 1.0
    assert "limit" in answer.reason


def test_an_approach_of_no_length_is_done() -> None:
    answer = straight_line(ARM, None, START, panda().tcp(START))
    assert answer
    assert answer.path is not None
    np.testing.assert_allclose(answer.path.waypoints[-1], START, atol=1e-6)


def test_what_makes_no_sense_is_named() -> None:
    with pytest.raises(StartError, match="7 joints"):
        straight_line(ARM, None, START[:5], np.eye(4))
    with pytest.raises(GoalError, match="rigid"):
        straight_line(ARM, None, START, np.ones((4, 4)))
    with pytest.raises(InputError, match="off_line"):
        straight_line(ARM, None, START, np.eye(4), off_line=0.0)
