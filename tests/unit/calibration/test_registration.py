"""Shift and delay of depth: recovered on synthetic logs with exact motion, and refused without motion or edges."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatbot.calibration.registration import estimate_depth_timing, image_velocity
from splatbot.frame import Frame
from splatbot.geometry import inverse, se3_log
from splatbot.logs.synthetic import SyntheticLog

URI = "synthetic:room?trajectory=turns&frames=30&rate=10&width=320&height=240"


def twists_of(log: SyntheticLog) -> dict[int, np.ndarray]:
    """Return the exact twists of the frames but the first and last, by poses 1/160 s before and after them."""
    path = log._path(16)
    return {
        k: se3_log(inverse(path.T_world_camera[16 * k - 1]) @ path.T_world_camera[16 * k + 1])
        / (path.stamps[16 * k + 1] - path.stamps[16 * k - 1])
        for k in range(1, len(log) - 1)
    }


def test_shift_and_delay_are_recovered_within_three_sigma() -> None:
    log = SyntheticLog(f"{URI}&effects=depth_camera:delay=0.01,right=3,down=-2")
    found = estimate_depth_timing(list(log), twists_of(log))
    for estimate, true in ((found.delay, 0.01), (found.right, -3), (found.down, 2)):
        assert not estimate.refusal
        assert abs(estimate.value - true) < 3 * estimate.sigma
    assert found.delay.sigma < 2e-3


def test_a_log_at_rest_tells_nothing() -> None:
    log = SyntheticLog(URI)
    frames = [log[3]] * 20
    found = estimate_depth_timing(frames, {k: np.zeros(6) for k in range(1, 19)})
    assert found.delay.refusal
    assert found.right.refusal
    assert found.down.refusal


def test_frames_without_depth_tell_nothing() -> None:
    frame: Frame = SyntheticLog(URI)[0]
    blank = replace(frame, depth=np.zeros_like(frame.depth))
    found = estimate_depth_timing([blank] * 20, {k: np.ones(6) for k in range(20)})
    assert found.delay.refusal
    assert found.right.refusal
    assert not image_velocity(blank, np.ones(6)).any()


def test_no_frame_with_a_velocity_tells_nothing() -> None:
    assert estimate_depth_timing(list(SyntheticLog(URI.replace("30", "3"))), {}).delay.refusal
