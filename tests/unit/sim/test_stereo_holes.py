"""Holes of stereo cameras: as wide as the datasheet's formula, and at the positions of the two-camera geometry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatbot.camera import Camera
from splatbot.frame import Frame
from splatbot.sim.effects.stereo_holes import StereoHoles

RNG = np.random.default_rng(0)
HFOV = np.radians(69.0)
CAMERA = Camera(320 / np.tan(HFOV / 2), 320 / np.tan(HFOV / 2), 319.5, 119.5, 640, 240)


def frame_of(depth: object, rgb: object = 120) -> Frame:
    z = np.broadcast_to(np.asarray(depth, np.float32), (240, 640)).copy()
    color = np.broadcast_to(np.asarray(rgb, np.uint8), (240, 640, 3)).copy()
    return Frame(0.0, color, z, CAMERA)


@pytest.mark.parametrize("z", [0.3, 0.5, 1.0, 2.0])
@pytest.mark.parametrize("baseline", [0.05, 0.055, 0.095])
def test_the_share_of_holes_on_a_wall_is_the_datasheets_band_within_a_tenth(z: float, baseline: float) -> None:
    """Intel 337029, section 4.5: DBR = B / (2 Z tan(HFOV/2)) of the image, along the left border."""
    lost = StereoHoles(baseline=baseline, scatter=0.0).apply(frame_of(z), RNG).depth == 0
    assert lost.mean() == pytest.approx(baseline / (2 * z * np.tan(HFOV / 2)), rel=0.1)
    assert not lost[:, int(lost[0].sum()) :].any()


def test_what_fails_at_random_leaves_the_fill_rate_that_was_required() -> None:
    """The fraction refers to the pixels right of the band, as the fill rate refers to the inner part of the image."""
    depth = StereoHoles(scatter=0.03).apply(frame_of(1.0), RNG).depth
    filled = (depth[24:-24, 64:-64] > 0).mean()
    assert 1.0 - filled == pytest.approx(0.03, rel=0.1)


def test_a_near_thing_throws_a_shadow_to_its_left_as_wide_as_the_difference_of_disparities() -> None:
    z = np.full((240, 640), 2.0)
    z[:, 300:500] = 0.8
    lost = StereoHoles(scatter=0.0).apply(frame_of(z), RNG).depth[100] == 0
    band = int(np.argmin(lost))
    shadow = np.flatnonzero(lost[band:]) + band
    assert shadow.max() == 299
    assert len(shadow) == pytest.approx(0.05 * CAMERA.fx * (1 / 0.8 - 1 / 2.0), abs=2)


def test_a_steep_wall_is_not_taken_for_its_own_shadow() -> None:
    slant = 0.5 + 0.004 * np.arange(640)  # away to the right: the right eye sees less of it, but all of it
    lost = StereoHoles(scatter=0.0).apply(frame_of(slant), RNG).depth[100] == 0
    band = int(np.argmin(lost))
    assert not lost[band:].any()


def test_dark_and_glaring_pixels_fail_only_if_required() -> None:
    shades = np.repeat(np.linspace(0, 255, 640).astype(np.uint8)[None, :, None], 3, axis=2)
    frame = frame_of(50.0, shades)
    assert StereoHoles(scatter=0.0).apply(frame, RNG).valid.all()
    lost = StereoHoles(scatter=0.0, dark=40, bright=250).apply(frame, RNG).depth[0] == 0
    assert np.array_equal(lost, (shades[0, :, 0] < 40) | (shades[0, :, 0] >= 250))


def test_pixels_without_depth_hide_nothing() -> None:
    z = np.full((240, 640), 2.0)
    z[:, 300:400] = 0.0
    frame = frame_of(z)
    only_band = StereoHoles(scatter=0.0).apply(replace(frame), RNG).depth == 0
    assert np.array_equal(only_band[:, 100:], frame.depth[:, 100:] == 0)
