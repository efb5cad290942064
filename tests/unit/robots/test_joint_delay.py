"""The delay of joint states, seen in the images of a static camera."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatbot.cli import main
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.logs.base import DerivedLog
from splatbot.logs.record import record
from splatbot.robots.joint_delay import estimate_joint_delay
from splatbot.robots.panda import panda
from splatbot.sim.wrist import WristLog
from splatbot.workspace import Workspace
from tests.swept_arm import T_BASE_STATIC_CAMERA, static_log, sweep

SCENE = Workspace(T_link_camera=T_BASE_STATIC_CAMERA, camera_link=0)
NAMES = tuple(reversed(panda().chain.names))


class Late(DerivedLog):
    """A log whose joint states at time t show the arm at t - delay, with its joints in another order."""

    def __init__(self, log: WristLog, delay: float) -> None:
        super().__init__(log)
        self._delay = delay

    def _decode(self, index: int) -> Frame:
        frame = self._log[index]
        q = sweep(np.array([frame.stamp - self._delay]))[0]
        return replace(frame, joints=q[::-1].copy(), joint_names=NAMES)


@pytest.fixture(scope="module")
def log() -> WristLog:
    return static_log(12.0)


@pytest.mark.long
def test_the_delay_is_found_within_its_own_uncertainty(log: WristLog) -> None:
    delay = -0.04
    found = estimate_joint_delay(Late(log, delay), panda(), SCENE)
    assert found.estimate.refusal == ""
    assert abs(found.estimate.value - delay) < max(0.005, 2 * found.estimate.sigma)
    assert found.estimate.sigma < 0.01


@pytest.mark.long
def test_a_minute_of_motion_gives_the_same_delay() -> None:
    found = estimate_joint_delay(Late(static_log(60.0, rate=10.0), 0.1), panda(), SCENE)
    assert found.estimate.refusal == ""
    assert abs(found.estimate.value - 0.1) < max(0.005, 2 * found.estimate.sigma)


def test_frames_too_far_apart_determine_no_delay() -> None:
    with pytest.raises(InputError, match="between frames"):
        estimate_joint_delay(static_log(30.0, rate=1.0), panda(), SCENE)


@pytest.mark.long
def test_a_camera_whose_place_is_wrong_and_an_arm_at_rest_determine_no_delay(log: WristLog) -> None:
    moved = T_BASE_STATIC_CAMERA.copy()
    moved[:3, 3] += [0.0, 0.4, 0.3]
    wrong = estimate_joint_delay(Late(log, 0.0), panda(), replace(SCENE, T_link_camera=moved))
    assert "overlap" in wrong.estimate.refusal
    still = static_log(4.0, moves=False)
    assert estimate_joint_delay(still, panda(), SCENE).estimate.refusal
    with pytest.raises(InputError, match="static camera"):
        estimate_joint_delay(log, panda(), replace(SCENE, camera_link=-1))
    with pytest.raises(InputError, match="3 frames with joints"):
        estimate_joint_delay(static_log(0.6), panda(), SCENE)


@pytest.mark.long
def test_the_command_writes_the_delay_that_masks_read(
    log: WristLog, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = record(Late(log, 0.1), tmp_path / "sweep", ground_truth=log.ground_truth)
    assert (folder / "joints.txt").read_text().startswith("# stamp panda_joint7 panda_joint6")
    SCENE.save(folder / "scene.yaml")
    out = folder / "scene.yaml"
    assert main(["calibrate", "joint-delay", str(folder), "--robot", "panda", "--out", str(out)]) == 0
    told = capsys.readouterr().out
    assert "joint_delay" in told
    assert f"written: {out}" in told
    saved = Workspace.load(out)
    assert saved.joint_delay == pytest.approx(0.1, abs=0.01)
    assert saved.T_link_camera is not None
    np.testing.assert_allclose(saved.T_link_camera, T_BASE_STATIC_CAMERA, atol=1e-5)
    plain = record(log, tmp_path / "plain")
    SCENE.save(plain / "scene.yaml")
    assert main(["calibrate", "joint-delay", str(plain), "--robot", "panda", "--out", str(plain / "scene.yaml")]) == 0
    assert "without a delay" in capsys.readouterr().out
    assert Workspace.load(plain / "scene.yaml").joint_delay == 0.0
    (folder / "scene.yaml").unlink()
    assert main(["calibrate", "joint-delay", str(folder), "--robot", "panda", "--quiet"]) == 2
    assert "T_link_camera" in capsys.readouterr().err
