"""`splatbot robot`."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.unit.cli.conftest import RunCommand
from tests.unit.robots.test_urdf import ur5


def test_a_robot_is_added_checked_listed_and_described(
    run: RunCommand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPLATBOT_ROBOTS", str(tmp_path / "robots"))
    added = run("robot", "add", ur5(tmp_path))
    assert added.code == 0
    assert "ur5: 6 joints" in added.out
    assert "all of it is inside" in added.out
    names = run("robot", "list").out.split()
    assert names[:3] == ["panda", "panda-2f85", "panda-2f140"]
    assert names[-1] == "ur5"
    assert {"ur5e", "ur5e-2f85", "xarm7", "iiwa14", "so100"} <= set(names)
    info = run("robot", "info", "ur5").out
    assert "shoulder_pan" in info
    assert "base, shoulder_pan_link, shoulder_lift_link, elbow_link, wrist_1_link, wrist_2_link, wrist_3_link" in info
    refused = run("robot", "mjcf", "ur5")
    assert refused.code == 2
    assert "has no inertias" in refused.err


def test_every_value_of_the_description_has_its_unit(run: RunCommand) -> None:
    info = run("robot", "info", "panda").out
    (first,) = [line for line in info.splitlines() if "panda_joint1 " in line]
    assert "-2.8973 .. +2.8973 rad, at most 2.175 rad/s, 15 rad/s², 87 Nm" in first  # Franka's data sheet
    assert next(line for line in info.splitlines() if " home " in line).endswith(" rad")


def test_the_panda_is_written_for_mujoco(run: RunCommand, tmp_path: Path) -> None:
    assert run("robot", "mjcf", "panda", "--out", tmp_path / "panda.xml").code == 0
    assert "panda_joint7" in (tmp_path / "panda.xml").read_text()


def test_a_robot_that_is_not_there_is_named(run: RunCommand) -> None:
    answer = run("robot", "info", "nobody")
    assert answer.code == 2
    assert "there is no robot 'nobody'" in answer.err


@pytest.mark.long
def test_a_name_is_replaced_only_on_purpose_and_a_hand_is_attached(
    run: RunCommand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPLATBOT_ROBOTS", str(tmp_path / "robots"))
    file = ur5(tmp_path)
    assert run("robot", "add", file, "--tip", "tool0", "--gripper", "2f85").code == 0
    assert run("robot", "list").out.split()[-1] == "ur5-2f85"
    info = run("robot", "info", "ur5-2f85").out
    assert "opens 0.085 m" in info
    assert "m in the frame of wrist_3; z is the approach, fingers close along y" in info
    assert "last link with its hand" in run("robot", "info", "panda").out
    again = run("robot", "add", file, "--tip", "tool0", "--gripper", "2f85")
    assert again.code == 2
    assert "exists" in again.err
    assert "--overwrite" in again.err
    assert run("robot", "add", file, "--name", "ur5-2f85", "--overwrite").code == 0
    assert "gripper                            none" in run("robot", "info", "ur5-2f85").out
    refused = run("robot", "add", file, "--name", "panda")
    assert refused.code == 2
    assert "no name of an added robot" in refused.err
    claw = run("robot", "add", file, "--gripper", "claw")
    assert claw.code == 2
    assert "grippers: 2f85, 2f140" in claw.err
