"""Masked pixels do not influence tracking."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.tracking.prepare import prepare
from splatbot.tracking.reference import make_reference
from tests.unit.tracking.test_tracker import Run

Mask = NDArray[np.bool_]


def gripper(frame: Frame, seed: int | None = None) -> tuple[Frame, Mask]:
    """Add a gripper 25 cm in front of the camera at fixed pixels, and return the frame and the mask."""
    mask = np.ones(frame.depth.shape, bool)
    height, width = frame.depth.shape
    mask[height // 2 :, width // 4 : 3 * width // 4] = False
    rng = np.random.default_rng(0 if seed is None else seed)
    rgb, depth = frame.rgb.copy(), frame.depth.copy()
    small = rng.integers(0, 255, (height // 4, width // 4, 3), dtype=np.uint8)
    rgb[~mask] = np.kron(small, np.ones((4, 4, 1), np.uint8))[~mask]
    depth[~mask] = 0.25 + 0.01 * (seed or 0)
    return replace(frame, rgb=rgb, depth=depth), mask


def test_masked_pixels_have_no_depth_no_grey_and_no_reference_points() -> None:
    run = Run()
    frame, mask = gripper(run.frames[0])
    prepared = prepare(replace(frame, mask=mask), run.config)
    assert (prepared.depth[~mask] == 0).all()
    assert np.isnan(prepared.levels[0].gray[~mask]).all()
    reference = make_reference(prepared.levels, np.eye(4), 1200)
    for points in reference.levels:
        assert np.isfinite(points.gray).all()
        assert points.points[:, 2].min() > 0.4


def test_a_gripper_in_view_ruins_tracking_unless_it_is_masked() -> None:
    errors = []
    for masked in (False, True):
        run = Run(width=320)
        frames = [replace(f, mask=m if masked else None) for f, m in (gripper(f) for f in run.frames)]
        first = run.prepare(frames[0])
        run.keyframes = [run.keyframe(first, np.eye(4))]
        estimates = [run.track(frame) for frame in frames[1:]]
        errors.append(max(run.error(e, i)[0] for i, e in enumerate(estimates, 1)))
        if masked:
            assert all(e.verdict == "ok" for e in estimates)
    assert errors[1] < 2e-3 < errors[0]


def test_masked_pixels_change_no_bit_of_the_pose() -> None:
    poses = []
    for seed in (1, 2):
        run = Run(width=320)
        views = [gripper(frame, seed) for frame in run.frames[:4]]
        frames = [replace(frame, mask=mask) for frame, mask in views]
        run.keyframes = [run.keyframe(run.prepare(frames[0]), np.eye(4))]
        poses.append([run.track(frame).T_world_camera for frame in frames[1:]])
    assert np.array_equal(poses[0], poses[1])


@pytest.mark.parametrize("mask", [np.ones((3, 4), bool), np.ones((120, 160), np.uint8), np.ones((120, 160, 1), bool)])
def test_a_mask_of_another_size_or_type_is_refused(mask: Mask) -> None:
    frame = Run().frames[0]
    with pytest.raises(InputError, match=r"mask.*\(120, 160\) bool"):
        replace(frame, mask=mask)
