"""The pose of a mounted camera is found from a wrong start, states its error, and is refused where views are weak."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.config import Config
from splatbot.frame import Frame
from splatbot.geometry import inverse, se3_exp, se3_log
from splatbot.logs.synthetic import SyntheticLog
from splatbot.mapping.extrinsics import CONSTANTS, ConstantPose, MeasuredPose, fused, locate_in_map
from splatbot.slam import Slam
from splatbot.tracking.nearby_keyframes import pose_distance
from splatbot.tracking.prepare import prepare
from tests.several_cameras import WRONG, frames_of, in_world, side_view, wrist_log

CONFIG = Config()
SIGMA = (0.02, 0.035)


@cache
def mapped() -> tuple[SyntheticLog, Slam]:
    """Map the table top by the first camera alone."""
    log = wrist_log(24, effects="depth_noise")
    slam = Slam(CONFIG)
    for frame in log:
        slam.process(frame)
    return log, slam


def located(T_scene_camera: NDArray[np.float64], frame: Frame, start: NDArray[np.float64]) -> MeasuredPose | str:
    log, slam = mapped()
    T = in_world(log, T_scene_camera) @ start
    return locate_in_map(prepare(frame, CONFIG.tracking), slam.keyframes, T, CONFIG)


@pytest.mark.parametrize("degrees", [0, 35, 60, -80])
def test_a_pose_wrong_by_2_cm_and_2_degrees_is_recovered_from_any_side(degrees: int) -> None:
    log, _ = mapped()
    T = side_view(log, np.radians(degrees), 0.15)
    found = located(T, frames_of(log, [T], [0.0], "table", sigma_depth=0.002)[0], WRONG)
    assert isinstance(found, MeasuredPose), found
    moved, turned = pose_distance(in_world(log, T), found.T_world_camera)
    assert moved < 2e-3
    assert turned < np.radians(0.2)
    error = se3_log(inverse(found.T_world_camera) @ in_world(log, T))
    assert error @ np.linalg.solve(found.covariance, error) < 6 * 5.0**2


def test_a_view_that_the_map_does_not_show_gives_a_reason() -> None:
    log, _ = mapped()
    T = side_view(log, np.pi, 0.0)
    assert "the map" in str(located(T, frames_of(log, [T], [0.0], "table")[0], WRONG))


def test_a_view_of_a_plane_without_texture_is_too_weak() -> None:
    log, _ = mapped()
    T = side_view(log, 0.0)
    frame = frames_of(log, [T], [0.0], "table")[0]
    flat = Frame(0.0, np.full_like(frame.rgb, 128), np.full_like(frame.depth, 1.0), frame.camera)
    found = located(T, flat, np.eye(4))
    assert isinstance(found, str)


def measured(T: NDArray[np.float64], sigma: float = 1e-3) -> MeasuredPose:
    return MeasuredPose(T, sigma**2 * np.eye(6))


def test_an_exact_pose_is_known_at_once_and_does_not_change() -> None:
    pose = ConstantPose(WRONG, (0.0, 0.0))
    assert pose.known
    assert np.array_equal(pose.T_parent_camera, WRONG)


def test_a_pose_is_known_once_eight_frames_from_displaced_starts_agree() -> None:
    pose = ConstantPose(np.eye(4), SIGMA)
    starts = []
    for k in range(CONSTANTS.agreeing):
        assert not pose.known, k
        starts.append(se3_log(pose.start()))
        pose.add(measured(WRONG @ se3_exp(1e-4 * np.sin(k + np.arange(6.0)))))
    assert pose.known
    assert pose_distance(WRONG, pose.T_parent_camera)[0] < 2e-4
    assert len({tuple(np.sign(start)) for start in starts}) == 8
    assert np.allclose(np.mean(starts, axis=0), 0.0, atol=1e-3)


def test_frames_without_a_pose_delay_it_and_give_the_reason() -> None:
    pose = ConstantPose(np.eye(4), SIGMA)
    for k in range(2 * CONSTANTS.agreeing - 1):
        pose.add("the map shows too little of its view" if k % 2 else measured(WRONG))
        assert pose.known == (k == 2 * CONSTANTS.agreeing - 2)
        if k % 2:
            assert pose.reason == "the map shows too little of its view"


def test_a_frame_that_contradicts_the_others_delays_it() -> None:
    pose = ConstantPose(np.eye(4), SIGMA)
    for k in range(CONSTANTS.agreeing + 2):
        pose.add(measured(WRONG @ se3_exp(np.array([0.01, 0, 0, 0, 0, 0])) if k == 2 else WRONG))
        assert not pose.known, k
    assert "contradict" in pose.reason
    pose.add(measured(WRONG))
    assert pose.known


def test_a_pose_far_from_the_given_one_is_refused() -> None:
    pose = ConstantPose(np.eye(4), (0.001, 0.002))
    for _ in range(CONSTANTS.agreeing):
        pose.add(measured(WRONG))
    assert not pose.known
    assert "σ from the given one" in pose.reason
    assert np.array_equal(pose.T_parent_camera, np.eye(4))


def test_the_mean_of_poses_is_that_of_least_squares_and_not_more_accurate_than_one() -> None:
    rng = np.random.default_rng(3)
    twists = 1e-3 * rng.standard_normal((8, 6))
    T, covariance = fused([measured(WRONG @ se3_exp(twist)) for twist in twists])
    assert np.allclose(se3_log(inverse(WRONG) @ T), twists.mean(axis=0), atol=2e-6)
    assert np.allclose(covariance, 1e-6 * np.eye(6))
