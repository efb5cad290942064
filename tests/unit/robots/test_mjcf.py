"""The MuJoCo model of a robot, from the same source as its kinematics."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.robots.mjcf import to_mjcf
from splatbot.robots.panda import panda
from splatbot.robots.robot import RobotModel

mujoco = pytest.importorskip("mujoco")


def test_mujoco_puts_the_tool_and_the_links_where_the_robot_does(rng: np.random.Generator) -> None:
    model = mujoco.MjModel.from_xml_string(to_mjcf(panda()))
    data = mujoco.MjData(model)
    for q in panda().random(20, rng):
        data.qpos[:7] = q
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(data.site("tcp").xpos, panda().tcp(q)[:3, 3], atol=1e-9)
        np.testing.assert_allclose(data.body("link5").xmat.reshape(3, 3), panda().fk(q)[5, :3, :3], atol=1e-9)


def test_limits_and_masses_are_the_robots() -> None:
    model = mujoco.MjModel.from_xml_string(to_mjcf(panda()))
    np.testing.assert_allclose(model.jnt_range[:7], np.c_[panda().chain.lower, panda().chain.upper], atol=1e-9)
    np.testing.assert_allclose(model.actuator_forcerange[:7, 1], panda().chain.effort)
    for k, inertial in enumerate(panda().inertials):
        assert model.body(f"link{k}").mass[0] == pytest.approx(inertial.mass)


def test_it_holds_its_home_against_gravity_and_touches_nothing() -> None:
    model = mujoco.MjModel.from_xml_string(to_mjcf(panda()))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    for _ in range(500):
        mujoco.mj_step(model, data)
    assert data.ncon == 0
    assert np.abs(data.qpos[:7] - panda().home).max() < 0.02
    assert np.abs(data.qpos[7:9] - 0.04).max() < 2e-3


def test_a_robot_without_inertias_cannot_be_written() -> None:
    p = panda()
    bare = RobotModel("bare", p.joints, p.shapes, p.T_link_tcp, p.home)
    with pytest.raises(InputError, match="bare: has no inertias"):
        to_mjcf(bare)
