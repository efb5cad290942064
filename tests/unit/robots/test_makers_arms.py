"""Arms as their makers describe them: read from the package example-robot-data, planned, and held by the twin."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

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


@pytest.mark.long
def test_an_added_arm_of_small_parts_is_covered_planned_and_held(rng: np.random.Generator) -> None:
    robot = simplified(_reading("so100").robot, may_grow=True)
    assert len(robot.spheres()) <= 256
    assert uncovered(robot.shapes, robot.spheres()) <= 1e-9
    assert certified_plans(robot, rng) >= 9
    assert_held_at_home(robot)
