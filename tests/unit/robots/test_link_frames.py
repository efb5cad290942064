"""Frames of robots' links in TF, against the descriptions of their makers."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatbot.errors import FormatError, InputError
from splatbot.protocols import Array
from splatbot.robots.arms import ARMS, description_of
from splatbot.robots.link_frames import LinkFrames
from splatbot.robots.maker_meshes import Source
from splatbot.robots.mjcf_reader import read_mjcf
from splatbot.robots.panda import panda
from splatbot.robots.store import load_robot, read_robot, robot_names, save_robot
from splatbot.robots.urdf import read_urdf


def matrix(translation: Array, rotation: Rotation) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation.as_matrix(), translation
    return T


def frames_of_urdf(text: bytes, positions: dict[str, float]) -> dict[str, Array]:
    """Compute the poses of all links as robot_state_publisher does, from origins and axes of joints."""
    joints = {}
    for joint in ElementTree.fromstring(text.replace(b"drake:", b"")).findall("joint"):
        parent, child, origin, axis = (joint.find(tag) for tag in ("parent", "child", "origin", "axis"))
        assert parent is not None
        assert child is not None
        values = {} if origin is None else origin.attrib
        xyz, rpy = (np.array(values.get(key, "0 0 0").split(), float) for key in ("xyz", "rpy"))
        along = np.array(["1", "0", "0"] if axis is None else axis.attrib["xyz"].split(), float)
        angle = positions.get(joint.attrib["name"], 0.0)
        turn = Rotation.from_rotvec(along / np.linalg.norm(along) * angle if angle else np.zeros(3))
        joints[child.attrib["link"]] = (
            parent.attrib["link"],
            matrix(xyz, Rotation.from_euler("xyz", rpy)) @ matrix(np.zeros(3), turn),
        )

    def pose(link: str) -> Array:
        if link not in joints:
            return np.eye(4)
        parent, T = joints[link]
        return pose(parent) @ T

    return {link: pose(link) for link in joints} | {parent: pose(parent) for parent, _ in joints.values()}


PANDA = Source(
    "example-robot-data",
    "robots/panda_description/urdf",
    "franka_ros by Franka Emika",
    "Apache-2.0",
    {"description": ("panda.urdf",)},
)


@pytest.mark.parametrize("name", ["panda", *(name for name in ARMS if name != "xarm6")])  # that is a file of macros
def test_links_of_shipped_arms_are_where_their_makers_description_has_them(name: str) -> None:
    path = description_of(PANDA if name == "panda" else ARMS[name].source)
    robot = load_robot(name)
    q = robot.random(1, np.random.default_rng(1))[0]
    expected = frames_of_urdf(path.read_bytes(), dict(zip(robot.chain.names, q, strict=True)))
    frames = robot.link_frames
    assert frames is not None
    T_base = np.linalg.inv(expected[frames.names[0]] @ frames.T_frame_link[0])
    for frame, T, T_base_link in zip(frames.names, frames.T_frame_link, robot.fk(q), strict=True):
        np.testing.assert_allclose(T_base @ expected[frame] @ T, T_base_link, atol=1e-6)


def test_every_shipped_robot_has_a_frame_for_each_link() -> None:
    for name in shipped():
        robot = load_robot(name)
        frames = robot.link_frames
        assert frames is not None
        assert len(frames.names) == len(set(frames.names)) == len(frames.T_frame_link) == len(robot) + 1


def shipped() -> list[str]:
    return [name for name in robot_names() if name.partition("-")[0] in ("panda", *ARMS)]


AXES = {"shoulder": "0 0 1", "slide": "0.6 0 0.8", "wrist": "0 -1 0"}


def arm_on_a_cart(folder: Path) -> Path:
    """Write an arm whose joints have skew axes and whose base is turned on a cart, with a camera mast next to it."""
    shape = '<collision><geometry><box size="0.05 0.05 0.4"/></geometry></collision>'
    parts = ['<robot name="cart"><link name="world"/>', *(f'<link name="{n}">{shape}</link>' for n in ("cart", "foot"))]
    parts.append('<joint name="a" type="fixed"><parent link="world"/><child link="cart"/></joint>')
    parts.append(
        '<joint name="b" type="fixed"><parent link="cart"/><child link="foot"/><origin xyz="0.3 0.1 0.5" '
        'rpy="0 0.2 3"/></joint><link name="mast"/><joint name="c" type="fixed"><parent link="cart"/>'
        '<child link="mast"/></joint>'
    )
    before = "foot"
    for name, axis in AXES.items():
        kind = "prismatic" if name == "slide" else "revolute"
        parts.append(
            f'<link name="{name}_link">{shape}</link><joint name="{name}" type="{kind}"><parent link="{before}"/>'
            f'<child link="{name}_link"/><origin xyz="0.05 0.02 0.3" rpy="0.3 -0.2 0.1"/><axis xyz="{axis}"/>'
            '<limit lower="-0.5" upper="0.5" velocity="1" effort="10"/></joint>'
        )
        before = f"{name}_link"
    path = folder / "cart.urdf"
    path.write_text("".join([*parts, "</robot>"]))
    return path


def poses_on_the_cart(q: Array) -> dict[str, Array]:
    """Compute the poses of links in the world with scipy from the numbers of :func:`arm_on_a_cart`."""
    T = matrix(np.array([0.3, 0.1, 0.5]), Rotation.from_euler("xyz", [0.0, 0.2, 3.0]))
    found = {"foot": T}
    for (name, axis), value in zip(AXES.items(), q, strict=True):
        T = T @ matrix(np.array([0.05, 0.02, 0.3]), Rotation.from_euler("xyz", [0.3, -0.2, 0.1]))
        along = value * np.array(axis.split(), float)
        slide = name == "slide"
        T = T @ matrix(along if slide else np.zeros(3), Rotation.from_rotvec(np.zeros(3) if slide else along))
        found[f"{name}_link"] = T
    return found


def test_an_added_robot_keeps_the_links_of_its_urdf_and_their_places_in_its_file(tmp_path: Path) -> None:
    save_robot(read_urdf(arm_on_a_cart(tmp_path), slack=0.05).robot, tmp_path / "cart.json")
    robot = read_robot(tmp_path / "cart.json")
    frames, q = robot.link_frames, np.array([0.4, -0.3, 0.2])
    assert frames is not None
    assert frames.names == ("foot", "shoulder_link", "slide_link", "wrist_link")
    expected = poses_on_the_cart(q)
    for name, T, T_root_link in zip(frames.names, frames.T_frame_link, robot.fk(q), strict=True):
        np.testing.assert_allclose(expected[name] @ T, T_root_link, atol=1e-12)


_MJCF = """
<mujoco model="bot">
  <compiler angle="degree"/>
  <worldbody>
    <body name="stand" pos="0.2 0 0.5" euler="0 0 90">
      <geom type="box" size=".08 .08 .05"/>
      <body name="shoulder" pos="0 0 .1" euler="10 0 20">
        <joint name="pan" axis="0 1 1" pos="0.01 0 0.02" ref="25" range="-90 120"/>
        <geom type="capsule" fromto="0 0 0 0 0 .3" size=".05"/>
        <body name="bracket" pos="0 0 .2" euler="40 0 0">
          <body name="fore" pos="0 0 .1" euler="10 20 30">
            <joint name="slide" type="slide" axis="0 0.6 -0.8" ref="0.03" range="-.1 .2"/>
            <geom type="sphere" size=".03"/>
            <body name="wrist" pos=".1 0 .1"><joint name="roll" axis="1 0 0" range="-90 90"/>
              <geom type="sphere" size=".03"/>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def test_a_robot_from_mjcf_has_the_bodies_of_its_joints_as_links_where_mujoco_has_them(tmp_path: Path) -> None:
    (tmp_path / "bot.xml").write_text(_MJCF)
    save_robot(read_mjcf(tmp_path / "bot.xml").robot, tmp_path / "bot.json")
    robot = read_robot(tmp_path / "bot.json")
    frames = robot.link_frames
    assert frames is not None
    assert frames.names == ("stand", "shoulder", "fore", "wrist")
    model = mujoco.MjModel.from_xml_string(_MJCF)
    data = mujoco.MjData(model)
    bodies = [data.body(name) for name in frames.names]
    for q in robot.random(5, np.random.default_rng(1)):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        T_world = [matrix(body.xpos, Rotation.from_matrix(body.xmat.reshape(3, 3))) for body in bodies]
        T_world_base = T_world[0] @ frames.T_frame_link[0]
        for T_frame, T, T_base_link in zip(T_world, frames.T_frame_link, robot.fk(q), strict=True):
            np.testing.assert_allclose(T_frame @ T, T_world_base @ T_base_link, atol=1e-9)


def test_a_robot_of_an_earlier_version_loads_without_names(tmp_path: Path) -> None:
    path = tmp_path / "mine.json"
    save_robot(panda(), path)
    document = json.loads(path.read_text())
    del document["link_frames"]
    path.write_text(json.dumps(document))
    assert read_robot(path).link_frames is None
    document["link_frames"] = [{"name": "a", "T_frame_link": np.eye(4).tolist()}]
    path.write_text(json.dumps(document))
    with pytest.raises(FormatError, match="names 1 links for 7 joints"):
        read_robot(path)


def test_a_robot_with_another_hand_or_name_keeps_its_links() -> None:
    for robot in (load_robot("panda-2f85"), replace(panda(), name="lab")):
        assert robot.link_frames is panda().link_frames


def test_a_prefix_stands_before_every_name_and_names_differ() -> None:
    frames = panda().link_frames
    assert frames is not None
    assert frames.prefixed("left/").names == tuple(f"left/panda_link{k}" for k in range(8))
    np.testing.assert_array_equal(frames.prefixed("left/").T_frame_link, frames.T_frame_link)
    with pytest.raises(InputError, match="repeats one of a, a"):
        LinkFrames(("a", "a"), np.tile(np.eye(4), (2, 1, 1)))
    with pytest.raises(InputError, match=r"is \(2, 4, 4\)"):
        LinkFrames(("a",), np.tile(np.eye(4), (2, 1, 1)))
