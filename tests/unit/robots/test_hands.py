"""Hands as boxes, the Panda's wide one, and hands on arms that users add."""

from __future__ import annotations

from dataclasses import astuple, replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.errors import InputError
from splatbot.geometry import inverse, transform_points
from splatbot.protocols import HasHand
from splatbot.robots.containment import uncovered
from splatbot.robots.hands import attach, find_hand, franka_hand, panda_2f85, panda_2f140
from splatbot.robots.mjcf import to_mjcf
from splatbot.robots.panda import panda
from splatbot.robots.robot import Inertial, RobotModel
from splatbot.robots.store import load_robot, read_robot, save_robot
from splatbot.robots.urdf import read_urdf
from tests.unit.robots.test_urdf import ur5


def test_the_pandas_hand_is_as_published() -> None:
    hand = panda().hand
    assert hand is not None
    assert hand.stroke == 0.08
    assert hand.force == 70.0
    assert hand.tip == pytest.approx(0.0088, abs=1e-4)
    assert hand.pad == pytest.approx(0.0584 + 0.0413 - 0.1034, abs=1e-4)  # where its round end begins
    assert hand.pad_width == pytest.approx(0.0, abs=1e-6)
    assert hand.palm == pytest.approx(0.1034 - 0.066, abs=5e-4)
    assert hand.palm_size == pytest.approx((0.063, 0.204), abs=6e-3)


def test_the_slim_hand_is_as_in_its_data_sheet_and_its_fingers_are_slim_at_their_tips() -> None:
    robot = load_robot("panda-2f85")
    assert robot is panda_2f85()
    hand = robot.hand
    assert hand is not None
    assert hand.stroke == 0.085
    assert 0.145 + hand.tip == pytest.approx(0.163, abs=1e-3)  # from the flange
    assert hand.width == pytest.approx(0.022, abs=1e-4)
    assert hand.pad_width == pytest.approx(0.012, abs=1e-4)
    assert hand.tip - hand.pad == pytest.approx(0.005, abs=1e-4)
    spheres = robot.spheres(0.04)
    at = transform_points(inverse(robot.T_link_tcp), spheres.centers[spheres.link == 7])
    reach = spheres.radii[spheres.link == 7]
    tips = at[:, 2] > 0.0
    assert (at[tips, 2] + reach[tips]).max() < hand.tip + 0.0055  # the spheres contain the maker's meshes, with slack
    assert (np.abs(at[tips, 1]) + reach[tips]).max() < 0.02 + 0.02 + 0.0065


def test_the_wide_hand_opens_by_140_mm_along_y_of_the_tool() -> None:
    robot = load_robot("panda-2f140")
    assert robot is panda_2f140()
    assert isinstance(robot, HasHand)
    assert robot.hand is not None
    assert robot.hand.stroke == pytest.approx(0.14)
    for opening in (0.0, 0.07, 0.14):
        spheres = robot.spheres(opening)
        own = spheres.link == 7
        at = transform_points(inverse(robot.T_link_tcp), spheres.centers[own])
        fingers = at[:, 2] > -0.05
        gap = np.abs(at[fingers, 1]) - spheres.radii[own][fingers]
        assert gap.min() == pytest.approx(opening / 2, abs=0.005)


@pytest.mark.parametrize("robot", [panda(), panda_2f85(), panda_2f140()], ids=lambda robot: robot.name)
def test_its_spheres_cover_its_shapes_and_home_is_free_of_itself(robot: RobotModel) -> None:
    from splatbot.collision import RobotSpheres

    links = robot.spheres(0.0)
    assert uncovered(robot.shapes, links) <= 0
    assert not RobotSpheres(robot).check(None, robot.home[None]).in_collision[0]
    assert len(robot.self_collision_pairs) >= 15


@pytest.mark.long
@pytest.mark.parametrize("name", ["2f85", "2f140"])
def test_a_hand_on_an_added_arm_is_stored_with_it(tmp_path: Path, name: str) -> None:
    arm = read_urdf(ur5(tmp_path), tip="tool0").robot
    robot = attach(arm, find_hand(name))
    panda_with = load_robot(f"panda-{name}")
    assert robot.hand is not None
    assert panda_with.hand is not None
    assert astuple(robot.hand)[:6] == pytest.approx(astuple(panda_with.hand)[:6], abs=1e-9)
    assert robot.hand.palm_size == pytest.approx(panda_with.hand.palm_size, abs=1e-3)
    along = inverse(arm.T_link_tcp) @ robot.T_link_tcp
    np.testing.assert_allclose(along, find_hand(name).T_flange_tcp, atol=1e-12)
    assert uncovered(robot.shapes, robot.spheres(0.0)) <= 0
    save_robot(robot, tmp_path / "arm.json")
    again = read_robot(tmp_path / "arm.json")
    assert again.hand == robot.hand
    for opening in (0.0, 0.03, None):
        ours, theirs = robot.spheres(opening), again.spheres(opening)
        np.testing.assert_array_equal(ours.link, theirs.link)
        np.testing.assert_allclose(ours.centers, theirs.centers, atol=1e-12)
        np.testing.assert_allclose(ours.radii, theirs.radii, atol=1e-12)
    np.testing.assert_array_equal(again.self_collision_pairs, robot.self_collision_pairs)
    with pytest.raises(InputError, match=r"ur5-2f.*: has a gripper"):
        attach(robot, find_hand(name))


def test_a_hand_that_is_not_known_is_refused_with_the_names_of_those_that_are() -> None:
    with pytest.raises(InputError, match=r"gripper: is 'claw'.*grippers: 2f85, 2f140, panda_hand"):
        find_hand("claw")


@pytest.mark.long
def test_frankas_hand_on_another_arm_is_that_of_the_panda(tmp_path: Path) -> None:
    robot, own = attach(read_urdf(ur5(tmp_path), tip="tool0").robot, franka_hand()), panda()
    assert robot.hand == own.hand
    for opening in (0.0, 0.05, None):
        ours, theirs = (_on_the_tool(arm, opening) for arm in (robot, own))
        hand = ours[len(ours) - 2 * len(own.finger_spheres) :]
        np.testing.assert_allclose(hand, theirs[len(theirs) - len(hand) :], atol=1e-9)


def _on_the_tool(robot: RobotModel, opening: float | None) -> NDArray[np.float64]:
    """Return the spheres (S, 4) of the last link in the frame of the tool [m]."""
    spheres = robot.spheres(opening)
    own = spheres.link == len(robot)
    return np.c_[transform_points(inverse(robot.T_link_tcp), spheres.centers[own]), spheres.radii[own]]


@pytest.mark.long
def test_the_mass_of_a_hand_counts_in_the_twin(tmp_path: Path) -> None:
    inertials = tuple(Inertial(2.0, (0.0, 0.0, 0.05), 0.01 * np.eye(3)) for _ in range(7))
    arm = replace(read_urdf(ur5(tmp_path), tip="tool0").robot, inertials=inertials)
    robot = attach(arm, find_hand("2f85"))
    assert robot.inertials[-1].mass == pytest.approx(2.925)
    model = mujoco.MjModel.from_xml_string(to_mjcf(robot))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_kinematics(model, data)
    T = robot.tcp(robot.home)
    np.testing.assert_allclose(data.site("tcp").xpos, T[:3, 3], atol=1e-9)
    assert model.joint("finger1").range[1] == pytest.approx(0.0425)
