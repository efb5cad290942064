"""Parallel grippers of users: Franka's own description as the known answer, boxes with exact sizes, and refusals."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest

from splatbot.cli import main
from splatbot.errors import FormatError, InputError
from splatbot.geometry import inverse, transform_points
from splatbot.robots.hand_reader import read_hand
from splatbot.robots.hands import Hand, attach, find_hand
from splatbot.robots.store import load_robot
from splatbot.robots.urdf import parse

# A palm of 20 mm height, fingers of 12 x 8 x 40 mm above it, 10 mm apart when closed, with 30 mm of travel.
_BOXES = """<robot name="boxes">
  <link name="palm"><collision><origin xyz="0 0 0.01"/><geometry><box size="0.06 0.12 0.02"/></geometry></collision>
    <inertial><mass value="0.4"/></inertial></link>
  <link name="left"><collision><origin xyz="0 0.004 0.02"/><geometry><box size="0.012 0.008 0.04"/></geometry>
    </collision><inertial><mass value="0.05"/></inertial></link>
  <link name="right"><collision><origin xyz="0 -0.004 0.02"/><geometry><box size="0.012 0.008 0.04"/></geometry>
    </collision><inertial><mass value="0.05"/></inertial></link>
  <joint name="slide" type="prismatic"><parent link="palm"/><child link="left"/><origin xyz="0 0.005 0.02"/>
    <axis xyz="0 1 0"/><limit lower="0" upper="0.03" effort="45" velocity="0.08"/></joint>
  <joint name="slide2" type="prismatic"><parent link="palm"/><child link="right"/><origin xyz="0 -0.005 0.02"/>
    <axis xyz="0 -1 0"/><limit lower="0" upper="0.03" effort="45" velocity="0.08"/><mimic joint="slide"/></joint>
</robot>"""


def _file(folder: Path, text: str = _BOXES) -> Path:
    path = folder / "gripper.urdf"
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def boxes(tmp_path_factory: pytest.TempPathFactory) -> Hand:
    """The gripper of boxes, read once."""
    return read_hand(_file(tmp_path_factory.mktemp("hand"))).hand


def _turned(text: str) -> str:
    """Return the gripper of boxes with fingers along x, whose joints have values below 0 and open towards 0."""
    for old, new in (
        ("0.06 0.12 0.02", "0.12 0.06 0.02"), ("0 0.004 0.02", "0.004 0 0.02"), ("0 -0.004 0.02", "-0.004 0 0.02"),
        ("0.012 0.008 0.04", "0.008 0.012 0.04"), ("0 0.005 0.02", "0.035 0 0.02"), ("0 -0.005 0.02", "-0.035 0 0.02"),
        ('axis xyz="0 1 0"', 'axis xyz="1 0 0"'), ('axis xyz="0 -1 0"', 'axis xyz="-1 0 0"'),
        ('lower="0" upper="0.03"', 'lower="-0.03" upper="0"'),
    ):  # fmt: skip
        assert old in text
        text = text.replace(old, new)
    return text


@pytest.mark.long
@pytest.mark.parametrize("text", [_BOXES, _turned(_BOXES)], ids=["along y", "along x, closing below 0"])
def test_a_gripper_of_boxes_has_the_sizes_of_its_file(tmp_path: Path, text: str) -> None:
    reading = read_hand(_file(tmp_path, text))
    hand, box = reading.hand, reading.hand.box
    assert box is not None
    assert (hand.name, hand.force, hand.speed) == ("boxes", 45.0, 0.08)
    assert hand.mass == pytest.approx(0.5)
    assert hand.stroke == pytest.approx(0.035)
    assert box.stroke == pytest.approx(0.07)
    assert (box.width, box.thickness) == pytest.approx((0.012, 0.008), abs=1e-9)
    assert hand.T_flange_tcp[2, 3] + box.tip == pytest.approx(0.06)
    assert box.palm == pytest.approx(hand.T_flange_tcp[2, 3] - 0.02)
    assert sorted(box.palm_size) == pytest.approx([0.06, 0.12])
    assert any("10.0 mm" in note for note in reading.notes)


@pytest.mark.parametrize("opening", [0.01, 0.04, 0.07])
def test_its_fingers_lie_in_the_spheres_at_every_opening(boxes: Hand, opening: float) -> None:
    arm = attach(load_robot("ur5e"), boxes)
    spheres, flange = arm.spheres(opening), load_robot("ur5e").T_link_tcp
    own = spheres.link == len(arm)
    rng = np.random.default_rng(0)
    for side in (1.0, -1.0):
        corner = rng.uniform([-0.006, 0.0, 0.02], [0.006, 0.008, 0.06], (5000, 3))
        corner[:, 1] = side * (corner[:, 1] + opening / 2)
        at = transform_points(flange, corner)
        far = np.linalg.norm(at[:, None] - spheres.centers[own][None], axis=2) - spheres.radii[own]
        assert far.min(axis=1).max() <= 0


@pytest.mark.long
def test_frankas_description_of_its_hand_gives_the_hand_that_is_shipped(tmp_path: Path) -> None:
    pytest.importorskip("collada")
    cmeel = pytest.importorskip("cmeel", reason="example-robot-data is not installed")
    folder = Path(cmeel.__file__).parents[1] / "cmeel.prefix/share/example-robot-data/robots/panda_description"
    if not folder.is_dir():
        pytest.skip("example-robot-data is not installed")
    root = parse(folder / "urdf/panda.urdf")
    kept = {"panda_hand", "panda_leftfinger", "panda_rightfinger"}
    for e in list(root):
        child = e.find("child")
        if (e.tag == "link" and e.get("name") not in kept) or (
            e.tag == "joint" and (child is None or child.get("link") not in kept - {"panda_hand"})
        ):
            root.remove(e)
    text = ElementTree.tostring(root, encoding="unicode")
    text = text.replace("package://example-robot-data/robots/panda_description", str(folder))
    hand, shipped = read_hand(_file(tmp_path, text)).hand, find_hand("panda_hand")
    ours, theirs = hand.box, shipped.box
    assert ours is not None
    assert theirs is not None
    assert hand.stroke == pytest.approx(0.04, abs=1e-3)
    assert hand.T_flange_tcp[2, 3] + ours.tip == pytest.approx(shipped.T_flange_tcp[2, 3] + theirs.tip, abs=2e-3)
    assert ours.width == pytest.approx(theirs.width, abs=4e-3)
    assert ours.thickness == pytest.approx(theirs.thickness, abs=4e-3)
    assert ours.palm == pytest.approx(theirs.palm, abs=2e-3)
    assert ours.palm_size == pytest.approx(theirs.palm_size, abs=2e-3)


@pytest.mark.parametrize(
    ("change", "error"),
    [
        (('name="slide2" type="prismatic"', 'name="slide2" type="fixed"'),
         r"no parallel gripper.*slide \(prismatic\).*--gripper 2f85"),
        (('type="prismatic"', 'type="revolute"'), r"no parallel gripper.*slide \(revolute\), slide2 \(revolute\)"),
        (('axis xyz="0 -1 0"', 'axis xyz="-1 0 0"'), "do not move along one line"),
        (('axis xyz="0 1 0"', 'axis xyz="0 0 1"'), "do not move along one line"),
        (('lower="0" upper="0.03"', ""), "slide: has no limits"),
        (('lower="0" upper="0.03"', 'lower="-0.02" upper="0.03"'), r"overlap by 30\.0 mm"),
        (("<box", "<torus"), "has a <torus>"),
    ],
)  # fmt: skip
def test_what_is_no_parallel_gripper_is_refused(tmp_path: Path, change: tuple[str, str], error: str) -> None:
    assert change[0] in _BOXES
    with pytest.raises(FormatError, match=error):
        read_hand(_file(tmp_path, _BOXES.replace(*change)))


def test_fingers_that_open_along_the_z_axis_are_refused(tmp_path: Path) -> None:
    text = _BOXES.replace('axis xyz="0 1 0"', 'axis xyz="0 0 1"').replace('axis xyz="0 -1 0"', 'axis xyz="0 0 -1"')
    with pytest.raises(FormatError, match="do not open across the z axis"):
        read_hand(_file(tmp_path, text))


def test_a_shipped_arm_gets_a_gripper_of_the_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SPLATBOT_ROBOTS", str(tmp_path / "robots"))
    assert main(["robot", "add", "ur5e", "--gripper", str(_file(tmp_path)), "--name", "lab"]) == 0
    assert "all of it is inside" in capsys.readouterr().out
    robot, arm = load_robot("lab"), load_robot("ur5e")
    assert robot.hand is not None
    assert robot.hand.stroke == pytest.approx(0.07)
    np.testing.assert_array_equal(robot.chain.upper, arm.chain.upper)
    drawn = np.concatenate([mesh.vertices for mesh in robot.visual if mesh.link == len(robot)])
    palm = transform_points(arm.T_link_tcp, np.array([[0.03, 0.06, 0.0], [-0.03, -0.06, 0.02]]))
    assert np.linalg.norm(drawn - palm[:, None], axis=2).min(axis=1).max() < 1e-3  # pictures show the palm
    T = inverse(arm.T_link_tcp) @ robot.T_link_tcp
    assert T[2, 3] == pytest.approx(0.05)
    assert main(["robot", "add", "ur5e", "--name", "other"]) == 2
    assert "attach a hand with --gripper" in capsys.readouterr().err
    words = ["robot", "add", "ur5e", "--gripper", "2f85", "--name", "other", "--slack", "0.01"]
    assert main(words) == 2
    assert "--slack: is fixed for a shipped arm" in capsys.readouterr().err


def test_a_gripper_that_does_not_exist_is_refused_before_the_arm_is_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_hand(tmp_path / "absent.urdf")
