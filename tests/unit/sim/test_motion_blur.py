"""Motion blur: close to the mean of many renderings during the exposure."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.errors import InputError
from splatbot.geometry import se3_exp
from splatbot.logs import open_log
from splatbot.logs.synthetic import SyntheticLog
from splatbot.logs.trajectories import MotionOptions, make_path
from splatbot.sim.effects.motion_blur import MotionBlur
from splatbot.sim.effects.warping import pose_at
from splatbot.trajectory import Trajectory
from tests.unit.sim.frames import frame_at

RNG = np.random.default_rng(0)


def rendered(log: SyntheticLog, trajectory: str, t: float, exposure: float) -> NDArray[np.float64]:
    """Return the mean of 17 renderings during the exposure."""
    path = make_path(trajectory, log.kind.stage, MotionOptions(2.0))
    times = t + exposure * ((np.arange(17) + 0.5) / 17 - 0.5)
    return np.mean([log.scene.render(log.camera, path(float(s)))[0].astype(float) for s in times], axis=0)


@pytest.mark.parametrize(
    ("scene", "trajectory", "exposure"), [("wall", "rotation", 0.04), ("wall", "arm", 0.12), ("tabletop", "arm", 0.12)]
)
def test_it_comes_near_to_the_mean_of_rendered_sub_exposures(scene: str, trajectory: str, exposure: float) -> None:
    log = open_log(f"synthetic:{scene}?trajectory={trajectory}&frames=61&width=320&height=240")
    assert isinstance(log, SyntheticLog)
    frame = log[20]
    blurred = MotionBlur(exposure=exposure).along(log.ground_truth).apply(frame, RNG)
    exact = rendered(log, trajectory, frame.stamp, exposure)[8:-8, 8:-8]
    error, sharp = (np.abs(image[8:-8, 8:-8] - exact).mean() for image in (blurred.rgb, frame.rgb))
    assert sharp > 3  # there is something to blur
    assert error < 0.25 * sharp
    assert np.array_equal(blurred.depth, frame.depth)


def test_a_sideways_step_edge_becomes_a_ramp_as_wide_as_the_motion() -> None:
    """At 1 m, 0.5 m/s for 0.02 s are 10 mm, which 200 px of focal length make 2 px; ten times that: 20 px."""
    stamps = np.array([0.0, 1.0])
    path = Trajectory(stamps, np.array([se3_exp([5.0 * t, 0, 0, 0, 0, 0]) for t in stamps]))
    edge = np.where(np.arange(200) < 100, 0, 200)[None, :, None]
    row = MotionBlur(exposure=0.02).along(path).apply(frame_at(rgb=edge, index=10), RNG).rgb[75, :, 0].astype(float)
    np.testing.assert_allclose(row, np.interp(np.arange(200), [89.5, 109.5], [0, 200]), atol=12)


def test_a_camera_at_rest_or_an_instant_exposure_touches_nothing() -> None:
    still = Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))
    moving = Trajectory(np.arange(3.0), np.array([se3_exp([t, 0, 0, 0, 0, 0]) for t in np.arange(3.0)]))
    frame = frame_at()
    assert MotionBlur().along(still).apply(frame, RNG) is frame
    assert MotionBlur(exposure=0).along(moving).apply(frame, RNG) is frame


def test_poses_between_the_stamps_and_beyond_the_ends_have_a_constant_twist() -> None:
    twist = np.array([0.3, -0.1, 0.2, 0.4, 0.1, -0.2])
    path = Trajectory(np.arange(3.0), np.array([se3_exp(t * twist) for t in range(3)]))
    for t in (-0.5, 0.25, 1.0, 1.75, 2.5):
        np.testing.assert_allclose(pose_at(path, t), se3_exp(t * twist), atol=1e-12)


def test_without_a_path_it_says_what_it_lacks() -> None:
    with pytest.raises(InputError, match="how the camera moves"):
        MotionBlur().apply(frame_at(), RNG)


@pytest.mark.parametrize(("field", "value"), [("exposure", -1.0), ("samples", 1)])
def test_arguments_out_of_range_are_named(field: str, value: float) -> None:
    with pytest.raises(InputError) as caught:
        MotionBlur(**{field: value})  # type: ignore[arg-type]
    assert caught.value.field == field
