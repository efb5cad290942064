"""Checks of arms against the descriptions of their makers."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mujoco
import numpy as np

from splatbot.collision import GaussianCollisionField
from splatbot.planning import GaussianRRTStar
from splatbot.robots.mjcf import to_mjcf
from splatbot.robots.robot import RobotModel
from splatbot.robots.urdf import parse
from tests.models import uniform_model


def _compiled(path: Path) -> mujoco.MjModel:
    """Compile the joints and inertias of a URDF by MuJoCo, without its meshes."""
    root = parse(path)
    for link in root.findall("link"):
        for kind in ("visual", "collision"):
            for e in link.findall(kind):
                link.remove(e)
        if link.find("inertial") is None:  # which MuJoCo requires of a moving link
            inertia = ElementTree.SubElement(link, "inertial")
            ElementTree.SubElement(inertia, "mass", value="1")
            ElementTree.SubElement(inertia, "inertia", ixx="1", iyy="1", izz="1", ixy="0", ixz="0", iyz="0")
    for e in [*root.findall("gazebo"), *root.findall("transmission")]:
        root.remove(e)
    text = ElementTree.tostring(root, encoding="unicode")
    extension = (
        '<mujoco><compiler fusestatic="false" balanceinertia="true" boundmass="1e-6" boundinertia="1e-9"/></mujoco>'
    )
    return mujoco.MjModel.from_xml_string(re.sub(r"(<robot[^>]*>)", lambda m: m[1] + extension, text, count=1))


def assert_moves_as_mujoco(robot: RobotModel, path: Path, rng: np.random.Generator) -> None:
    """Compare the axes of all joints at 50 configurations with MuJoCo's, within 1 µm."""
    model = _compiled(path)
    data = mujoco.MjData(model)
    address = [model.joint(joint.name).qposadr[0] for joint in robot.joints]
    for q in robot.random(50, rng):
        data.qpos[address] = q
        mujoco.mj_kinematics(model, data)
        T = robot.fk(q)
        for k, joint in enumerate(robot.joints):
            np.testing.assert_allclose(T[k + 1, :3, 3], data.xanchor[model.joint(joint.name).id], atol=1e-6)
            np.testing.assert_allclose(T[k + 1, :3, 2], data.xaxis[model.joint(joint.name).id], atol=1e-6)


def balls() -> GaussianCollisionField:
    """Return a field of balls around the arm."""
    rng = np.random.default_rng(0)
    means = rng.uniform([0.15, -0.6, 0.5], [0.6, 0.6, 0.9], (30, 3))
    return GaussianCollisionField(uniform_model(means, 0.01))


def certified_plans(robot: RobotModel, rng: np.random.Generator) -> int:
    """Plan between free configurations within half a turn; return how many of ten paths are found, and certified."""
    planner, done = GaussianRRTStar(balls(), robot, margin=0.002), 0
    near = rng.uniform(np.maximum(robot.chain.lower, -np.pi), np.minimum(robot.chain.upper, np.pi), (400, len(robot)))
    free = [q for q in near if not planner.arm.check(planner.field, q[None]).in_collision[0]]
    for start, goal in zip(free[:20:2], free[1:20:2], strict=True):
        answer = planner.plan(start, goal, iterations=10_000, budget_ms=5000)
        if answer.path is not None:
            assert answer.path.certificate.certified
            done += 1
    return done


def assert_held_at_home(robot: RobotModel) -> None:
    """Simulate the twin for a second, and require that no joint moves by more than 0.05 rad."""
    model = mujoco.MjModel.from_xml_string(to_mjcf(robot))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    for _ in range(int(1.0 / model.opt.timestep)):
        mujoco.mj_step(model, data)
    assert np.abs(data.qpos[: len(robot)] - robot.home).max() < 0.05
