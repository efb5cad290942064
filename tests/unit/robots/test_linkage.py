"""Tests of splatbot.robots.linkage, with another reader of the 2F-85 and its meshes (extra `dev`)."""

from __future__ import annotations

import importlib.metadata
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from splatbot.errors import FormatError
from splatbot.geometry import inverse
from splatbot.protocols import Array
from splatbot.robots.linkage import sweep
from splatbot.robots.sources import SOURCES
from splatbot.robots.store import load_robot
from splatbot.robots.urdf import UrdfReader, parse


@pytest.fixture(scope="module")
def urdf() -> Path:
    """The URDF of the 2F-85 (extra `dev`)."""
    try:
        importlib.metadata.version("airo-models")
    except importlib.metadata.PackageNotFoundError:
        pytest.skip("airo-models is not installed")
    source = SOURCES["2f85"]
    return source.path("urdf/robotiq_2f_85.urdf")


def _pose(e: ElementTree.Element | None) -> Array:
    T = np.eye(4)
    if e is not None:
        T[:3, 3] = [float(x) for x in e.get("xyz", "0 0 0").split()]
        T[:3, :3] = Rotation.from_euler("xyz", [float(x) for x in e.get("rpy", "0 0 0").split()]).as_matrix()
    return T


def _end(joint: ElementTree.Element, end: str) -> str:
    e = joint.find(end)
    assert e is not None
    return str(e.get("link"))


def _points(urdf: Path, angle: float, count: int) -> tuple[dict[str, Array], float]:
    """Sample points (P, 3) of each link with the driven joint at an angle; return them and the gap of the pads [m]."""
    root = ElementTree.fromstring(re.sub("drake:", "drake_", urdf.read_text()))
    at = {"base_link": np.eye(4)}
    left = list(root.findall("joint"))
    while left:
        for j in [j for j in left if _end(j, "parent") in at]:
            left.remove(j)
            mimic, axis = j.find("mimic"), j.find("axis")
            q = (
                0.0
                if j.get("type") == "fixed"
                else angle * float(mimic.get("multiplier", 1) if mimic is not None else 1)
            )
            turn = np.eye(4)
            turn[:3, :3] = Rotation.from_rotvec(
                q * np.array([float(x) for x in (axis.get("xyz", "") if axis is not None else "1 0 0").split()])
            ).as_matrix()
            at[_end(j, "child")] = at[_end(j, "parent")] @ _pose(j.find("origin")) @ turn
    quarter = np.eye(4)
    quarter[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]  # the file opens along x
    found: dict[str, Array] = {}
    for link in root.findall("link"):
        for k, e in enumerate([*link.findall("visual"), *link.findall("collision")]):
            name = str(link.get("name"))
            geometry = e.find("geometry")
            assert geometry is not None
            box, file = geometry.find("box"), geometry.find("mesh")
            if box is not None:
                mesh = trimesh.creation.box([float(x) for x in str(box.get("size")).split()])
            else:
                assert file is not None
                mesh = trimesh.load(urdf.parent / str(file.get("filename")), force="mesh")
                mesh.apply_scale([float(x) for x in file.get("scale", "1 1 1").split()])
            T = quarter @ at[name] @ _pose(e.find("origin"))
            points = trimesh.sample.sample_surface(mesh, count, seed=k)[0] @ T[:3, :3].T + T[:3, 3]
            found[name] = np.concatenate([found.get(name, np.zeros((0, 3))), points])
    pads = [found[f"{side}_inner_finger_pad"][:, 1] for side in ("left", "right")]
    low, high = sorted(pads, key=lambda y: float(y.mean()))
    return found, float(high.min() - low.max())


@pytest.mark.long
def test_no_point_of_a_million_on_the_2f85_is_outside_of_the_spheres_at_any_opening(urdf: Path) -> None:
    robot = load_robot("ur5e-2f85")
    last, T_flange_link = len(robot), inverse(load_robot("ur5e").T_link_tcp)
    for angle in np.random.default_rng(0).uniform(0.012, 0.8, 40):  # 85 mm, the documented stroke, to closed
        points, gap = _points(urdf, float(angle), 1150)
        spheres = robot.spheres(min(gap, 0.085))
        own = spheres.link == last
        centers = spheres.centers[own] @ T_flange_link[:3, :3].T + T_flange_link[:3, 3]
        for link, p in points.items():
            apart = np.linalg.norm(p[:, None] - centers, axis=2) - spheres.radii[own]
            assert apart.min(axis=1).max() <= 1e-6, (link, angle)


def test_the_2f85_opens_as_in_its_data_sheet_and_its_pads_move_towards_the_flange(urdf: Path) -> None:
    swept = sweep(UrdfReader(urdf, parse(urdf)))
    assert swept.opening.max() == pytest.approx(0.085, abs=1.5e-3)
    assert swept.opening.min() == pytest.approx(0.0, abs=2e-3)
    assert swept.tip.max() - swept.tip[np.argmax(swept.opening)] == pytest.approx(0.014, abs=1e-3)


_TWO_DRIVEN = """<robot name="two"><link name="a"/><link name="b"/><link name="c"/>
<joint name="j" type="revolute"><parent link="a"/><child link="b"/><limit lower="0" upper="1"/></joint>
<joint name="k" type="revolute"><parent link="a"/><child link="c"/><limit lower="0" upper="1"/></joint></robot>"""
_TURNING = """<robot name="one"><link name="a"/><link name="b">
<collision><geometry><box size="0.01 0.01 0.05"/></geometry></collision></link>
<joint name="j" type="revolute"><parent link="a"/><child link="b"/><limit lower="0" upper="1"/></joint></robot>"""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (_TWO_DRIVEN, "has 2 driven joints: j, k.*mimic one"),
        (_TURNING, "moves no link in a straight line"),
        (_TURNING.replace('<limit lower="0" upper="1"/>', ""), "j: has no limits"),
    ],
)
def test_a_gripper_that_is_no_parallel_linkage_is_refused(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "hand.urdf"
    file.write_text(text)
    with pytest.raises(FormatError, match=message):
        sweep(UrdfReader(file, parse(file)))
