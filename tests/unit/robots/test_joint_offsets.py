"""Arms that report other joint positions than their true ones, against the manufacturer's model at the true ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from splatbot.collision import RobotSpheres
from splatbot.errors import FormatError, InputError
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.planning import MotionRefusedError, time_path
from splatbot.protocols import Array
from splatbot.robots.appearance import appearance
from splatbot.robots.joint_offsets import robot_in_scene
from splatbot.robots.mjcf import to_mjcf
from splatbot.robots.panda import panda
from splatbot.robots.robot import RobotModel
from splatbot.robots.store import load_robot
from splatbot.services.motion_gate import MotionGate, MotionRequest
from splatbot.services.store import MapStore
from splatbot.workspace import Workspace
from tests.unit.planning.test_timing import path_of

OFFSETS = np.array([0.3, -0.02, 0.01, 0.015, -0.03, 0.02, 0.01])
SCENE = Workspace(T_world_base=np.eye(4), joint_offsets=OFFSETS, offsets_of="panda")


def ball_at(point: Array) -> Snapshot:
    """Return the map of one ball of 1 cm [m]."""
    model = GaussianModel.from_activated(
        means=[point], quats=[[1.0, 0, 0, 0]], scales=[[0.005] * 3], opacities=[0.9], colors=[[1.0, 0, 0]]
    )
    return Snapshot(model, 1)


def sliding() -> RobotModel:
    """Return a Panda whose second joint slides by 0.2 m."""
    joints = list(panda().joints)
    joints[1] = replace(joints[1], prismatic=True, lower=-0.1, upper=0.1)
    return replace(panda(), joints=tuple(joints))


@pytest.mark.parametrize("robot", [panda(), sliding(), load_robot("panda-2f85")], ids=["panda", "sliding", "2f85"])
def test_its_links_are_where_the_manufacturers_model_has_them_at_the_true_positions(robot: RobotModel) -> None:
    found = robot_in_scene(robot, SCENE)
    q = found.random(20, np.random.default_rng(1))
    np.testing.assert_allclose(found.fk(q), robot.fk(q + OFFSETS), atol=1e-12)
    spheres, plain = RobotSpheres(found).forward(q[0]), RobotSpheres(robot).forward(q[0] + OFFSETS)
    np.testing.assert_allclose(spheres[0], plain[0], atol=1e-9)
    np.testing.assert_array_equal(found.self_collision_pairs, robot.self_collision_pairs)


def test_mujoco_moves_its_twin_by_reported_positions_to_the_true_poses() -> None:
    model = mujoco.MjModel.from_xml_string(to_mjcf(robot_in_scene(panda(), SCENE)))
    data = mujoco.MjData(model)
    data.qpos[:7] = panda().home
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(data.site("tcp").xpos, panda().tcp(panda().home + OFFSETS)[:3, 3], atol=1e-9)


def test_it_looks_like_the_robot() -> None:
    for robot in (panda(), load_robot("panda-2f85")):
        for found, expected in zip(appearance(robot_in_scene(robot, SCENE)), appearance(robot), strict=True):
            np.testing.assert_array_equal(found.triangles, expected.triangles)


def test_reported_and_true_positions_keep_the_limits_of_the_manufacturer() -> None:
    found, chain = robot_in_scene(panda(), SCENE).chain, panda().chain
    for at in (found.lower, found.lower + OFFSETS, found.upper, found.upper + OFFSETS):
        assert (at >= chain.lower - 1e-12).all()
        assert (at <= chain.upper + 1e-12).all()
    np.testing.assert_allclose(found.upper - found.lower, chain.upper - chain.lower - np.abs(OFFSETS))
    np.testing.assert_array_equal(found.velocity, chain.velocity)


def test_a_scene_without_offsets_leaves_the_robot_and_one_of_another_robot_is_refused() -> None:
    for scene in (None, Workspace(), Workspace(joint_offsets=np.zeros(7))):
        assert robot_in_scene(panda(), scene) is panda()
    with pytest.raises(InputError, match="joint_offsets: has 6 values") as raised:
        robot_in_scene(panda(), Workspace(joint_offsets=np.full(6, 0.01), offsets_of="panda"))
    assert "panda has 7 joints" in str(raised.value.hint)
    with pytest.raises(InputError, match=r"panda_joint4 is 3\.1, more than its range"):
        robot_in_scene(panda(), replace(SCENE, joint_offsets=np.array([0, 0, 0, 3.1, 0, 0, 0])))


@pytest.mark.parametrize("name", ["iiwa14", "iiwa14-2f85", "xarm7", "ur5e"])
def test_offsets_of_an_arm_are_refused_for_another_one_of_any_number_of_joints(name: str) -> None:
    with pytest.raises(InputError, match="joint_offsets: are those of panda, not " + name.removesuffix("-2f85")):
        robot_in_scene(load_robot(name), SCENE)


def test_offsets_of_an_arm_apply_with_every_hand_on_it() -> None:
    for name, arm in (("panda-2f85", "panda"), ("panda-2f140", "panda"), ("xarm7-panda_hand", "xarm7")):
        robot = load_robot(name)
        found = robot_in_scene(robot, replace(SCENE, offsets_of=arm))
        np.testing.assert_allclose(found.fk(robot.home), robot.fk(robot.home + OFFSETS), atol=1e-12)


def test_offsets_of_an_unnamed_arm_are_refused_with_the_line_to_add(tmp_path: Path) -> None:
    replace(SCENE, offsets_of="").save(tmp_path / "scene.yaml")
    with pytest.raises(InputError, match="offsets_of: does not name the arm") as raised:
        robot_in_scene(load_robot("panda-2f85"), Workspace.load(tmp_path / "scene.yaml"))
    assert "add offsets_of: panda if" in str(raised.value.hint)
    with (tmp_path / "scene.yaml").open("a") as file:
        file.write("offsets_of: panda\n")
    scene = Workspace.load(tmp_path / "scene.yaml")
    np.testing.assert_allclose(robot_in_scene(panda(), scene).fk(panda().home), panda().fk(panda().home + OFFSETS))
    scene.save(tmp_path / "scene.yaml")
    assert Workspace.load(tmp_path / "scene.yaml").offsets_of == "panda"
    (tmp_path / "scene.yaml").write_text("offsets_of: 3\n")
    with pytest.raises(FormatError, match="offsets_of: is 3"):
        Workspace.load(tmp_path / "scene.yaml")


def test_a_motion_that_is_free_at_the_reported_positions_alone_does_not_pass_the_gate() -> None:
    start = panda().home - np.array([0.05, 0, 0, 0, 0, 0, 0])
    motion = time_path(path_of(np.stack([start, panda().home])), RobotSpheres(panda()), None)
    store = MapStore()
    ball = ball_at(panda().tcp(panda().home + OFFSETS)[:3, 3])
    for name, scene in (("plain", Workspace(T_world_base=np.eye(4))), ("offset", SCENE)):
        store.add(name, source="a", state="static", snapshot=ball, workspace=scene)
    gate = MotionGate(store)

    def certify(name: str) -> Array:
        request = MotionRequest(motion, "panda", name, store.get(name).generation)
        return gate.certify(request, panda()).arm.forward(panda().home)[0]

    np.testing.assert_allclose(certify("plain")[-1], panda().fk(panda().home)[-1], atol=1e-9)
    with pytest.raises(MotionRefusedError, match="not certified as free"):
        certify("offset")
