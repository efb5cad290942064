"""Arms as their makers describe them: read from the package example-robot-data, planned, and held by the twin."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
import pytest

from splatbot.collision import GaussianCollisionField
from splatbot.planning import GaussianRRTStar
from splatbot.robots.containment import uncovered
from splatbot.robots.description import read_description
from splatbot.robots.maker_meshes import Source
from splatbot.robots.mjcf import to_mjcf
from splatbot.robots.reading import Reading, simplified
from splatbot.robots.robot import RobotModel
from tests.models import uniform_model

_FILES = {
    "ur5": "ur_description/urdf/ur5_robot.urdf",
    "ur10": "ur_description/urdf/ur10_robot.urdf",
    "xarm7": "xarm_description/urdf/xarm7.urdf",
    "so100": "so_arm_description/urdf/so100.urdf",
    "z1": "z1_description/urdf/z1.urdf",
}


def _file(name: str) -> Path:
    return Source("example-robot-data", "robots", "", "", {}).path(_FILES[name])


@cache
def _reading(name: str) -> Reading:
    return read_description(_file(name))


def _compiled(path: Path) -> mujoco.MjModel:
    """Compile the joints and inertias of a URDF by MuJoCo, without its meshes."""
    root = ElementTree.parse(path).getroot()
    for link in root.findall("link"):
        for kind in ("visual", "collision"):
            for e in link.findall(kind):
                link.remove(e)
    for e in [*root.findall("gazebo"), *root.findall("transmission")]:
        root.remove(e)
    text = ElementTree.tostring(root, encoding="unicode")
    extension = (
        '<mujoco><compiler fusestatic="false" balanceinertia="true" boundmass="1e-6" boundinertia="1e-9"/></mujoco>'
    )
    return mujoco.MjModel.from_xml_string(re.sub(r"(<robot[^>]*>)", lambda m: m[1] + extension, text, count=1))


@pytest.mark.parametrize("name", _FILES)
def test_an_arm_moves_as_mujoco_moves_its_urdf(name: str, rng: np.random.Generator) -> None:
    robot, model = _reading(name).robot, _compiled(_file(name))
    data = mujoco.MjData(model)
    address = [model.joint(joint.name).qposadr[0] for joint in robot.joints]
    for q in robot.random(50, rng):
        data.qpos[address] = q
        mujoco.mj_kinematics(model, data)
        T = robot.fk(q)
        for k, joint in enumerate(robot.joints):
            np.testing.assert_allclose(T[k + 1, :3, 3], data.xanchor[model.joint(joint.name).id], atol=1e-6)
            np.testing.assert_allclose(T[k + 1, :3, 2], data.xaxis[model.joint(joint.name).id], atol=1e-6)


def _ball_field() -> GaussianCollisionField:
    """Return a field of balls around the arm."""
    rng = np.random.default_rng(0)
    means = rng.uniform([0.15, -0.6, 0.5], [0.6, 0.6, 0.9], (30, 3))
    return GaussianCollisionField(uniform_model(means, 0.01))


def _certified(robot: RobotModel, rng: np.random.Generator) -> int:
    """Plan between free configurations; return how many of ten paths are found, and certified."""
    planner, done = GaussianRRTStar(_ball_field(), robot, margin=0.002), 0
    free = [q for q in robot.random(400, rng) if not planner.arm.check(planner.field, q[None]).in_collision[0]]
    for start, goal in zip(free[:20:2], free[1:20:2], strict=True):
        answer = planner.plan(start, goal, iterations=2000, budget_ms=1000)
        if answer.path is not None:
            assert answer.path.certificate.certified
            done += 1
    return done


@pytest.mark.long
@pytest.mark.parametrize("name", ["xarm7", "so100"])
def test_an_arm_is_covered_planned_and_held(name: str, rng: np.random.Generator) -> None:
    robot = simplified(_reading(name).robot, may_grow=True)
    assert len(robot.spheres()) <= 256
    assert uncovered(robot.shapes, robot.spheres()) <= 1e-9
    assert _certified(robot, rng) >= 9
    model = mujoco.MjModel.from_xml_string(to_mjcf(robot))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    for _ in range(int(1.0 / model.opt.timestep)):
        mujoco.mj_step(model, data)
    assert np.abs(data.qpos[: len(robot)] - robot.home).max() < 0.05
