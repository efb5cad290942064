"""Frames of shipped robots' links, against the descriptions of their makers."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatbot.protocols import Array
from splatbot.robots.arms import ARMS, description_of
from splatbot.robots.link_frames import link_frames
from splatbot.robots.maker_meshes import Source
from splatbot.robots.panda import panda
from splatbot.robots.store import load_robot, robot_names


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
    frames = link_frames(robot)
    assert frames is not None
    T_base = np.linalg.inv(expected[frames.names[0]])
    for frame, T, T_base_link in zip(frames.names, frames.T_frame_link, robot.fk(q), strict=True):
        np.testing.assert_allclose(T_base @ expected[frame] @ T, T_base_link, atol=1e-6)


def test_every_shipped_robot_has_a_frame_for_each_link_and_an_added_one_has_no_names() -> None:
    for name in robot_names():
        robot = load_robot(name)
        frames = link_frames(robot)
        assert frames is not None
        assert len(frames.names) == len(set(frames.names)) == len(frames.T_frame_link) == len(robot) + 1
    assert link_frames(replace(panda(), name="panda-mine")) is None


@pytest.mark.parametrize("prefix", ["", "left_", "left/"])
def test_names_have_the_prefix_of_the_joints(prefix: str) -> None:
    frames = link_frames(panda(), [f"{prefix}{name}" for name in panda().chain.names])
    assert frames is not None
    assert frames.names == tuple(f"{prefix}panda_link{k}" for k in range(8))


@pytest.mark.parametrize("names", [(), ("a",), tuple("abcdefg"), ("x_panda_joint1", *panda().chain.names[1:])])
def test_joints_with_other_names_give_no_prefix(names: tuple[str, ...]) -> None:
    frames = link_frames(panda(), names)
    assert frames is not None
    assert frames.names[0] == "panda_link0"
