"""How synthetic cameras move: exact poses, each path with the property it is named for."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.geometry import Array, inverse, so3_log
from splatbot.logs.scenes import SCENES
from splatbot.logs.trajectories import TRAJECTORIES, MotionOptions, Stage, make_path

STAGE = Stage(eye=(0.0, -0.8, 0.5), target=(0.0, 0.0, 0.0), ahead=0.4)
LONG = MotionOptions(duration=300 / 30)


def poses(name: str, *, stage: Stage = STAGE, motion: MotionOptions = LONG, frames: int = 301) -> Array:
    path = make_path(name, stage, motion)
    return np.array([path(i / motion.rate) for i in range(frames)])


def angle(T_a: Array, T_b: Array) -> float:
    return float(np.degrees(np.linalg.norm(so3_log((inverse(T_a) @ T_b)[:3, :3]))))


@pytest.mark.parametrize("name", TRAJECTORIES)
def test_every_pose_is_a_rigid_transform_and_the_same_each_time(name: str) -> None:
    T = poses(name)
    assert T.dtype == np.float64
    R = T[:, :3, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-14)
    assert np.array_equal(T, poses(name))


@pytest.mark.parametrize("name", sorted(set(TRAJECTORIES) - {"steps", "arm_stops"}))
def test_motion_is_smooth(name: str) -> None:
    step = np.diff(poses(name)[:, :3, 3], axis=0)
    assert np.linalg.norm(step, axis=1).max() < 0.02
    assert np.linalg.norm(np.diff(step, axis=0), axis=1).max() < 2e-3


def test_pure_rotation_leaves_the_camera_centre_where_it_is() -> None:
    T = poses("rotation")
    assert np.array_equal(T[:, :3, 3], np.broadcast_to(T[0, :3, 3], (301, 3)))
    assert max(angle(T[0], T_i) for T_i in T) > 30


def test_every_step_is_8_cm_and_5_degrees() -> None:
    T = poses("steps", frames=60)
    np.testing.assert_allclose(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1), 0.08, rtol=1e-9)
    np.testing.assert_allclose([angle(a, b) for a, b in pairwise(T)], 5.0, rtol=1e-9)


@pytest.mark.parametrize("rate", [10.0, 30.0])
def test_steps_are_per_frame_at_any_rate(rate: float) -> None:
    T = poses("steps", motion=MotionOptions(duration=1.0, rate=rate), frames=5)
    np.testing.assert_allclose(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1), 0.08, rtol=1e-9)


def test_a_loop_ends_where_it_began_after_several_metres() -> None:
    T = poses("loop", stage=SCENES["room"].stage)
    np.testing.assert_allclose(T[-1], T[0], atol=1e-12)
    assert np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1).sum() > 5.0
    assert angle(T[0], T[150]) > 150  # no view of the start on the way


def test_laps_lead_over_the_same_poses_every_20_seconds() -> None:
    T = poses("laps", frames=1300)
    np.testing.assert_allclose(T[600:1200], T[:600], atol=1e-12)


def test_an_arm_that_stops_is_still_at_its_views_and_moves_between_them() -> None:
    speed = 30 * np.linalg.norm(np.diff(poses("arm_stops")[:, :3, 3], axis=0), axis=1)
    assert np.mean(speed < 1e-9) == pytest.approx(0.25, abs=0.05)  # 0.4 s of every 1.6 s, less a frame
    assert 0.2 < speed.max() < 0.6


def test_forward_keeps_its_heading_and_turns_back_before_the_end() -> None:
    stage = SCENES["corridor"].stage
    T = poses("forward", stage=stage, frames=1400)
    way = T[:, 1, 3] - T[0, 1, 3]
    assert np.ptp(T[:, [0, 2], 3], axis=0).max() < 1e-12
    assert way.max() == pytest.approx(stage.ahead, abs=1e-3)
    assert 30 * np.diff(way).max() == pytest.approx(0.5, abs=1e-3)
    assert np.array_equal(T[:, :3, :3], np.broadcast_to(T[0, :3, :3], (1400, 3, 3)))


def test_a_hand_trembles_within_its_band_and_by_its_seed() -> None:
    T = poses("handheld", frames=3000)
    spectrum = np.abs(np.fft.rfft(T[:, 0, 3] * np.hanning(3000))) ** 2
    frequency = np.fft.rfftfreq(3000, 1 / 30)
    assert spectrum[frequency > 6.5].sum() < 1e-6 * spectrum.sum()
    other = poses("handheld", motion=MotionOptions(10.0, seed=1), frames=100)
    assert np.abs(other[:, :3, 3] - T[:100, :3, 3]).max() > 0.01


@pytest.mark.parametrize(("name", "stage"), [("spiral", STAGE), ("orbit", SCENES["corridor"].stage)])
def test_a_path_that_does_not_exist_or_fit_is_named_with_those_that_do(name: str, stage: Stage) -> None:
    with pytest.raises(InputError) as caught:
        make_path(name, stage, LONG)
    assert caught.value.field == "trajectory"
    assert "forward" in (caught.value.hint or "")
