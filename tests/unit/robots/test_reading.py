"""Descriptions that labs have: wrong units, fingers, two arms, macros, MuJoCo models."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

from splatbot.errors import FormatError, InputError
from splatbot.robots.containment import uncovered
from splatbot.robots.description import read_description
from splatbot.robots.mjcf import to_mjcf
from splatbot.robots.panda import panda
from splatbot.robots.reading import simplified
from splatbot.robots.shapes import Capsule
from tests.unit.robots.test_urdf import ur5

_LIMIT = '<limit lower="-2" upper="2" velocity="1" effort="10"/>'


def _mesh_arm(folder: Path, unit: float, scale: str = "") -> Path:
    """Return an arm of two links of 0.3 m, whose meshes have ``unit`` metres."""
    for name in ("lower", "upper"):
        box = trimesh.creation.box((0.08 / unit, 0.08 / unit, 0.3 / unit))
        box.apply_translation((0, 0, 0.15 / unit))
        box.export(folder / f"{name}.stl")
    links = "".join(
        f'<link name="{name}"><{kind}><geometry><mesh filename="{name}.stl"{scale}/></geometry></{kind}></link>'
        for name, kind in (("lower", "collision"), ("upper", "visual"))
    )
    path = folder / "arm.urdf"
    path.write_text(
        f'<robot name="arm"><link name="base"/>{links}<link name="tip"/>'
        f'<joint name="a" type="revolute"><parent link="base"/><child link="lower"/><axis xyz="0 1 0"/>{_LIMIT}</joint>'
        f'<joint name="b" type="revolute"><parent link="lower"/><child link="upper"/><origin xyz="0 0 0.3"/>'
        f'<axis xyz="0 1 0"/>{_LIMIT}</joint><joint name="c" type="fixed"><parent link="upper"/><child link="tip"/>'
        '<origin xyz="0 0 0.3"/></joint></robot>'
    )
    return path


@pytest.mark.long
def test_visual_geometry_is_covered_as_collision_geometry_is(tmp_path: Path) -> None:
    robot = read_description(_mesh_arm(tmp_path, 1.0)).robot
    assert [shape.link for shape in robot.shapes] == [1, 2]
    assert robot.slack == pytest.approx(0.02 * 0.6)
    assert uncovered(robot.shapes, robot.spheres()) <= 0
    assert set(robot.spheres().link.tolist()) == {1, 2}


def test_meshes_in_millimetres_are_refused_with_the_scale_to_give(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r'lower \(lower\.stl\): is 321 m long.*scale="0\.001 0\.001 0\.001"'):
        read_description(_mesh_arm(tmp_path, 1e-3))
    robot = read_description(_mesh_arm(tmp_path, 1e-3, ' scale="0.001 0.001 0.001"')).robot
    assert np.ptp(robot.shapes[0].triangles().reshape(-1, 3), axis=0).max() == pytest.approx(0.3)


def test_meshes_in_inches_and_meshes_that_are_scaled_twice_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="compare the unit of the mesh"):
        read_description(_mesh_arm(tmp_path, 0.0254))
    with pytest.raises(FormatError, match=r"longer than 0\.321 mm.*scaled twice"):
        read_description(_mesh_arm(tmp_path, 1.0, ' scale="0.001 0.001 0.001"'))


def test_a_mirrored_mesh_keeps_its_inside(tmp_path: Path) -> None:
    robot = read_description(_mesh_arm(tmp_path, 1.0, ' scale="-1 1 1"')).robot
    corners = robot.shapes[0].triangles().reshape(-1, 3)
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    assert robot.shapes[0].depth(middle[None])[0] == pytest.approx(0.04, abs=1e-6)


def test_too_small_a_slack_for_a_large_surface_is_refused_before_the_work(tmp_path: Path) -> None:
    path = _mesh_arm(tmp_path, 1.0)
    path.write_text(path.read_text().replace("0 0 0.3", "0 0 30").replace('.stl"', '.stl" scale="100 100 100"'))
    with pytest.raises(FormatError, match=r"m² of surface, too much for spheres within 20 mm.*--slack 0\."):
        read_description(path, slack=0.02)
    assert read_description(path).robot.slack == pytest.approx(1.2)


def test_an_arm_with_too_many_spheres_gets_a_larger_slack_or_is_refused(tmp_path: Path) -> None:
    robot = read_description(ur5(tmp_path)).robot
    robot = replace(robot, shapes=(Capsule(6, (0.0, 0.0, 0.0), (0.0, 0.0, 2.0), 0.01),), slack=1e-4)
    assert len(robot.spheres()) > 512
    with pytest.raises(InputError, match=r"ur5: needs \d+ spheres within 0\.1 mm, above 640"):
        simplified(robot, may_grow=False)
    simple = simplified(robot, may_grow=True)
    assert len(simple.spheres()) <= 512
    assert simple.slack > robot.slack


def _with_branches(folder: Path, *branches: int) -> Path:
    """Return a UR5 whose flange carries branches of moving joints."""
    parts = []
    for b, count in enumerate(branches):
        before = "tool0"
        for k in range(count):
            name = f"branch{b}_{k}"
            parts.append(
                f'<link name="{name}"/><joint name="{name}_joint" type="revolute"><parent link="{before}"/>'
                f'<child link="{name}"/>{_LIMIT}</joint>'
            )
            before = name
    path = folder / "branches.urdf"
    path.write_text(ur5(folder).read_text().replace("</robot>", "".join(parts) + "</robot>"))
    return path


def test_the_arm_ends_before_its_fingers(tmp_path: Path) -> None:
    reading = read_description(_with_branches(tmp_path, 2, 2, 1))
    assert len(reading.robot) == 6
    assert sum("is not on the arm" in note for note in reading.notes) == 5
    T = reading.robot.tcp(np.zeros(6))
    expected = read_description(ur5(tmp_path), tip="tool0").robot.tcp(np.zeros(6))
    np.testing.assert_allclose(T, expected, atol=1e-12)


def test_two_arms_are_refused_until_one_is_chosen(tmp_path: Path) -> None:
    path = _with_branches(tmp_path, 5, 5)
    with pytest.raises(FormatError, match=r"has several arms.*branch0_0, branch1_0.*--tip"):
        read_description(path)
    assert len(read_description(path, tip="branch1_4").robot) == 11


def test_macros_of_xacro_are_expanded_and_their_absence_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("xacro")
    text = ur5(tmp_path).read_text().replace("150", "${100 + 50}")
    path = tmp_path / "ur5.urdf.xacro"
    path.write_text(text.replace("<robot ", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" '))
    assert read_description(path).robot.joints[0].effort == 150
    path.write_text(path.read_text().replace("100 + 50", "unknown_value"))
    with pytest.raises(FormatError, match=r"ur5\.urdf\.xacro: cannot be expanded.*unknown_value"):
        read_description(path)
    monkeypatch.setitem(sys.modules, "xacro", None)
    with pytest.raises(FormatError, match="pip install xacro"):
        read_description(path)


_MJCF = """
<mujoco model="bot">
  <compiler angle="degree"/>
  <asset><mesh name="cone" vertex="0 0 0  .1 0 0  0 .1 0  0 0 .1"/></asset>
  <worldbody>
    <geom type="plane" size="1 1 .1"/>
    <body name="table" pos="1 1 0"><geom type="box" size=".4 .4 .4"/></body>
    <body name="stand" pos="0.2 0 0.5" euler="0 0 90">
      <geom type="cylinder" size=".08 .05"/>
      <body name="shoulder" pos="0 0 .1">
        <joint name="pan" axis="0 0 1" pos="0.01 0 0" range="-170 170"/>
        <joint name="lift" axis="0 1 1" ref="20" range="-90 120"/>
        <geom type="capsule" fromto="0 0 0 0 0 .3" size=".05"/>
        <body name="fore" pos="0 0 .3" euler="10 20 30">
          <joint name="slide" type="slide" axis="0 0 -1" range="-.1 .2"/>
          <geom type="mesh" mesh="cone"/><geom type="ellipsoid" size=".05 .04 .03" contype="0" conaffinity="0"/>
          <body name="wrist" pos=".1 0 .1"><joint name="roll" axis="1 0 0"/>
            <geom type="sphere" size=".03"/><site name="tool" pos=".05 0 0" euler="0 90 0"/>
            <body name="left"><joint name="l" type="slide" axis="0 1 0" range="0 .03"/><geom size=".01"/></body>
            <body name="right"><joint name="r" type="slide" axis="0 -1 0" range="0 .03"/><geom size=".01"/></body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator><position joint="pan" forcerange="-30 40"/></actuator>
  <keyframe><key name="home" qpos="0.3 0.2 0.05 0.1 0 0"/></keyframe>
</mujoco>
"""


def test_a_mujoco_model_is_read_as_mujoco_moves_it(tmp_path: Path, rng: np.random.Generator) -> None:
    path = tmp_path / "bot.xml"
    path.write_text(_MJCF)
    reading = read_description(path)
    robot = reading.robot
    assert robot.name == "bot"
    assert robot.chain.names == ("pan", "lift", "slide", "roll")
    assert robot.joints[0].effort == 40
    np.testing.assert_allclose(robot.home, [0.3, 0.2, 0.05, 0.1])
    assert any("roll turns without end" in note for note in reading.notes)
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    base = model.body("stand").id
    for q in robot.random(20, rng):
        data.qpos[:4] = q
        mujoco.mj_forward(model, data)
        R, p = data.xmat[base].reshape(3, 3), data.xpos[base]
        T = robot.tcp(q)
        np.testing.assert_allclose(T[:3, 3], R.T @ (data.site("tool").xpos - p), atol=1e-9)
        np.testing.assert_allclose(T[:3, :3], R.T @ data.site("tool").xmat.reshape(3, 3), atol=1e-9)
        # Every geom of the model lies in the spheres, except those that the base does not carry.
        s = robot.spheres()
        F = robot.fk(q)[s.link]
        at = np.einsum("sij,sj->si", F[:, :3, :3], s.centers) + F[:, :3, 3]
        for body in ("stand", "shoulder", "fore", "wrist", "left", "right"):
            for g in np.flatnonzero(model.geom_bodyid == model.body(body).id):
                middle = R.T @ (data.geom_xpos[g] - p)
                if body not in ("left", "right"):  # which the model's reference posture fixes
                    assert (np.linalg.norm(at - middle, axis=1) < s.radii).any()
    assert uncovered(robot.shapes, robot.spheres()) <= 0
    assert robot.link_frames is None
    assert any("TF cannot mask the robot" in note for note in reading.notes)
    assert any("no mass" in note for note in reading.notes)  # two joints of one body: nothing is between them


def test_the_panda_that_is_written_for_mujoco_is_read_again_as_it_was(tmp_path: Path, rng: np.random.Generator) -> None:
    path = tmp_path / "panda.xml"
    path.write_text(to_mjcf(panda()))
    robot = read_description(path).robot
    assert robot.chain.names == panda().chain.names
    np.testing.assert_allclose(robot.chain.lower, panda().chain.lower, atol=1e-9)
    np.testing.assert_allclose(robot.chain.effort, panda().chain.effort, atol=1e-9)
    np.testing.assert_allclose(robot.home, panda().home, atol=1e-9)
    q = panda().random(20, rng)
    np.testing.assert_allclose(robot.tcp(q), panda().tcp(q), atol=1e-9)
    for ours, theirs in zip(robot.inertials[:7], panda().inertials, strict=False):
        assert ours.mass == pytest.approx(theirs.mass)
        turned = robot.fk(q[0])[1, :3, :3].T @ panda().fk(q[0])[1, :3, :3]
        assert np.abs(turned - np.eye(3)).max() < 1e-9  # the same frames
        np.testing.assert_allclose(ours.center, theirs.center, atol=1e-9)
        np.testing.assert_allclose(ours.inertia, theirs.inertia, atol=1e-4)  # MuJoCo balances inertias


def test_mujoco_models_that_are_no_arm_are_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "bot.xml"
    path.write_text(_MJCF.replace('range="-.1 .2"', ""))
    with pytest.raises(FormatError, match="slide: has no limits of position"):
        read_description(path)
    path.write_text('<mujoco><worldbody><body><geom size="1"/></body></worldbody></mujoco>')
    with pytest.raises(FormatError, match="no moving joint"):
        read_description(path)
    path.write_text("<mujoco><worldbody><body><joint/></body></worldbody></mujoco>")
    with pytest.raises(FormatError, match=r"bot\.xml: cannot be read"):
        read_description(path)
    path.write_text(_MJCF)
    with pytest.raises(FormatError, match="there is no body or site 'hand'"):
        read_description(path, tip="hand")
