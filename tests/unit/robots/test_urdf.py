"""Arms from URDF files, against the toolbox."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatbot.collision import RobotSpheres
from splatbot.errors import FormatError, InputError
from splatbot.protocols import Array
from splatbot.robots.containment import uncovered
from splatbot.robots.store import load_robot, read_robot, robot_names, save_robot
from splatbot.robots.urdf import read_urdf

# Modified neighbours of a UR5's joints: origin and axis as its maker publishes them.
_UR5 = (
    ("shoulder_pan", "0 0 0.089159", "0 0 0", "0 0 1", 0.06, 0.10),
    ("shoulder_lift", "0 0.13585 0", "0 1.570796327 0", "0 1 0", 0.05, 0.40),
    ("elbow", "0 -0.1197 0.425", "0 0 0", "0 1 0", 0.045, 0.36),
    ("wrist_1", "0 0 0.39225", "0 1.570796327 0", "0 1 0", 0.04, 0.10),
    ("wrist_2", "0 0.093 0", "0 0 0", "0 0 1", 0.04, 0.09),
    ("wrist_3", "0 0 0.09465", "0 0 0", "0 1 0", 0.035, 0.06),
)


def ur5(folder: Path) -> Path:
    """Return a UR5 of cylinders."""
    parts = ['<robot name="ur5"><link name="base"/>']
    before = "base"
    for name, xyz, rpy, axis, radius, length in _UR5:
        shape = f'<geometry><cylinder radius="{radius}" length="{length}"/></geometry>'
        parts.append(f'<link name="{name}_link"><collision><origin xyz="0 0 {length / 2}"/>{shape}</collision></link>')
        limits = '<limit lower="-6.283185" upper="6.283185" velocity="3.15" effort="150"/>'
        parts.append(
            f'<joint name="{name}" type="revolute"><parent link="{before}"/><child link="{name}_link"/>'
            f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>{limits}</joint>'
        )
        before = f"{name}_link"
    parts.append(
        f'<link name="tool0"/><joint name="tool" type="fixed"><parent link="{before}"/><child link="tool0"/>'
        '<origin xyz="0 0.0823 0" rpy="-1.570796327 0 0"/></joint></robot>'
    )
    path = folder / "ur5.urdf"
    path.write_text("".join(parts))
    return path


def _puma() -> Path:
    rtbdata = pytest.importorskip("rtbdata")
    return Path(rtbdata.__file__).parent / "xacro/unimation_puma560_description/urdf/puma560_robot.urdf"


def _chained(path: Path, q: Array) -> Array:
    """Compute T_root_tip of a file whose joints are in order, each turned about its own axis (scipy)."""
    T = np.eye(4)
    for joint, angle in zip(ElementTree.parse(path).getroot().findall("joint"), q, strict=True):
        origin, axis = joint.find("origin"), joint.find("axis")
        assert origin is not None
        assert axis is not None
        step = np.eye(4)
        rpy, along = (np.array(str(text).split(), float) for text in (origin.get("rpy"), axis.get("xyz")))
        step[:3, :3] = (Rotation.from_euler("xyz", rpy) * Rotation.from_rotvec(angle * along)).as_matrix()
        step[:3, 3] = np.array(str(origin.get("xyz")).split(), float)
        T = T @ step
    return T


def test_a_ur5_is_where_the_toolboxs_dh_model_has_it(tmp_path: Path, rng: np.random.Generator) -> None:
    rtb = pytest.importorskip("roboticstoolbox")
    robot = read_urdf(ur5(tmp_path), tip="tool0").robot
    dh = rtb.models.DH.UR5()
    q = robot.random(20, rng)
    # The DH frames are turned by half a turn at the base; the tool's place and axis agree.
    ours, theirs = robot.tcp(q), np.array([dh.fkine(row).A for row in q])
    turn = np.diag([-1.0, -1.0, 1.0])
    np.testing.assert_allclose(ours[:, :3, 3], theirs[:, :3, 3] @ turn, atol=5e-4)  # its base is 0.3 mm higher


@pytest.mark.long
def test_a_six_axis_arm_of_the_toolbox_with_meshes_is_read_covered_and_queried(rng: np.random.Generator) -> None:
    reading = read_urdf(_puma(), slack=0.05)
    robot = reading.robot
    assert len(robot) == 6
    assert any("no limit of velocity" in note for note in reading.notes)
    q = robot.random(20, rng)
    expected = np.array([_chained(_puma(), row) for row in q])
    np.testing.assert_allclose(robot.tcp(q), expected, atol=1e-9)
    spheres = robot.spheres()
    assert uncovered(robot.shapes, spheres) <= 0
    arm = RobotSpheres(robot)
    np.testing.assert_allclose(arm.forward(q), robot.fk(q), atol=1e-12)
    assert arm.check(None, q).in_collision.shape == (20,)


def test_an_added_robot_is_found_by_its_name_and_is_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    monkeypatch.setenv("SPLATBOT_ROBOTS", str(tmp_path / "robots"))
    robot = read_urdf(ur5(tmp_path), slack=0.02).robot
    save_robot(robot, tmp_path / "robots" / "ur5.json")
    assert [*robot_names()[:3], robot_names()[-1]] == ["panda", "panda-2f85", "panda-2f140", "ur5"]
    again = load_robot("ur5")
    q = robot.random(20, rng)
    np.testing.assert_array_equal(again.fk(q), robot.fk(q))
    np.testing.assert_array_equal(again.spheres().centers, robot.spheres().centers)
    np.testing.assert_array_equal(again.self_collision_pairs, robot.self_collision_pairs)
    for field in ("lower", "upper", "velocity", "acceleration", "jerk", "effort"):
        np.testing.assert_array_equal(getattr(again.chain, field), getattr(robot.chain, field))
    with pytest.raises(InputError, match=r"robots: panda, panda-2f85, panda-2f140, .*, ur5"):
        load_robot("ur6")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot", "cannot be read"),
        ("<sdf/>", "its root is <sdf>"),
        ('<robot name="r"><link name="a"/></robot>', "no moving joint"),
        (
            '<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="revolute"><parent link="a"/>'
            '<child link="b"/></joint></robot>',
            "j: has no limits of position",
        ),
        (
            '<robot name="r"><link name="a"/><joint name="j" type="revolute"><parent link="a"/>'
            '<child link="c"/></joint></robot>',
            "its child is 'c'",
        ),
        (
            '<robot name="r"><link name="a"/><link name="b"><collision><geometry><mesh filename="no.stl"/></geometry>'
            '</collision></link><joint name="j" type="revolute"><parent link="a"/><child link="b"/>'
            '<limit lower="-1" upper="1"/></joint></robot>',
            "no.stl is not there",
        ),
    ],
)
def test_files_that_cannot_be_used_are_named_with_the_fault(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "r.urdf"
    path.write_text(text)
    with pytest.raises(FormatError, match=message):
        read_urdf(path)


def test_an_attribute_with_an_undeclared_prefix_is_read_as_ros_reads_it(tmp_path: Path) -> None:
    path = ur5(tmp_path)
    plain = read_urdf(path, slack=0.02).robot
    path.write_text(path.read_text().replace("<limit ", '<limit drake:acceleration="2.5" '))
    assert read_urdf(path, slack=0.02).robot.joints[0].velocity == plain.joints[0].velocity


def test_an_added_robot_with_the_name_of_a_shipped_one_is_not_mistaken_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPLATBOT_ROBOTS", str(tmp_path))
    save_robot(read_urdf(ur5(tmp_path), slack=0.02).robot, tmp_path / "ur5e.json")  # before splatbot shipped one
    with pytest.raises(InputError, match=r"ur5e\.json.*is a shipped robot too.*rename the file"):
        load_robot("ur5e")


def test_a_damaged_robot_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "broken.json"
    path.write_text('{"format": "splatbot robot 1"}')
    with pytest.raises(FormatError, match=r"broken\.json: is no robot"):
        read_robot(path)


def test_fingers_off_the_arm_are_fixed_and_reported(tmp_path: Path) -> None:
    text = (
        ur5(tmp_path)
        .read_text()
        .replace(
            "</robot>",
            '<link name="finger"/><joint name="slide" type="prismatic"><parent link="tool0"/><child link="finger"/>'
            '<limit lower="0.01" upper="0.04"/></joint></robot>',
        )
    )
    path = tmp_path / "gripper.urdf"
    path.write_text(text)
    reading = read_urdf(path, tip="tool0")
    assert len(reading.robot) == 6
    assert reading.notes[0] == "slide is not on the arm: held at 0.01"
    assert os.fspath(path).endswith(".urdf")
