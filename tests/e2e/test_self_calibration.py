"""A simulated Panda calibrates itself: camera pose and joint offsets from its own map, without a board."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatbot.cli import main
from splatbot.logs.record import record
from splatbot.logs.scenes.tabletop import tabletop
from splatbot.robots.panda import panda
from splatbot.sim.wrist import T_PANDA_CAMERA, WristLog
from splatbot.workspace import Workspace
from tests.swept_arm import START, T_SCENE_BASE

OFFSETS = np.array([0.0, 0.010, 0.0, -0.010, 0.0, 0.0, 0.0])  # [rad] to be added to the measured joints
FRAMES, RATE = 200, 10.0
SWING = np.array([0.35, 0.2, 0.35, 0.25, 0.5, 0.3, 0.7])  # [rad]
PERIOD_S = np.array([11.0, 9.0, 7.5, 8.3, 6.1, 7.1, 5.3])


@pytest.mark.long
@pytest.mark.timeout(600)
def test_joint_offsets_of_10_mrad_and_the_camera_on_the_arm_are_found_while_it_looks_around(tmp_path: Path) -> None:
    joints = START + SWING * np.sin(2 * np.pi * np.arange(FRAMES)[:, None] / RATE / PERIOD_S)
    log = WristLog(panda(), joints, tabletop().surfaces, T_scene_base=T_SCENE_BASE, rate=RATE)
    measured = (replace(log[k], joints=joints[k] - OFFSETS) for k in range(FRAMES))
    folder, run = tmp_path / "log", tmp_path / "run"
    record(measured, folder)
    Workspace(T_link_camera=T_PANDA_CAMERA).save(folder / "scene.yaml")  # masks the hand; not read by the calibration
    assert main(["map", str(folder), "--robot", "panda", "--out", str(run), "--no-report", "--quiet"]) == 0
    assert main(["calibrate", "hand-eye", str(run), "--robot", "panda", "--out", str(run / "scene.yaml")]) == 0
    found = Workspace.load(run / "scene.yaml")
    assert found.joint_offsets is not None
    assert found.T_link_camera is not None
    # The first joint turns the base and the last one the camera, both unknown: their offsets have no effect here.
    np.testing.assert_allclose(found.joint_offsets[1:6], OFFSETS[1:6], atol=1e-3)
    assert np.linalg.norm(found.T_link_camera[:3, 3] - T_PANDA_CAMERA[:3, 3]) < 1e-3
