"""Exposure is estimated against the map and corrected in keyframes, and small differences remain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from splatbot.frame import Frame
from splatbot.mapping.exposure import ExposureFit, exposure_of, in_exposure_of_map
from splatbot.mapping.insertion import ModelView
from splatbot.slam import Slam
from tests.rgbd import small_config, tabletop


def exposed(rgb: NDArray[np.uint8], gain: float, offset: float = 0.0) -> NDArray[np.uint8]:
    return np.clip(np.rint(gain * rgb.astype(float) + offset), 0, 255).astype(np.uint8)


def scene() -> tuple[ModelView, NDArray[np.uint8], torch.Tensor]:
    """Return an exact view of the map, and color and depth of a frame."""
    frame = tabletop()[0][0]
    rgb, depth = torch.from_numpy(frame.rgb.copy()), torch.from_numpy(frame.depth.copy())
    return ModelView(rgb.float() / 255, depth, (depth > 0).float()), frame.rgb, depth


@pytest.mark.parametrize(("gain", "offset"), [(1.3, 0.0), (0.5, 0.0), (0.8, 20.0), (1.0, -12.0), (2.0, 0.0)])
def test_gain_and_offset_are_estimated_from_pixels_that_are_not_clipped(gain: float, offset: float) -> None:
    view, rgb, depth = scene()
    found = exposure_of(torch.from_numpy(exposed(rgb, gain, offset)), depth, view)
    assert found.gain == pytest.approx(gain, rel=0.04)
    assert found.offset == pytest.approx(offset / 255, abs=0.012)


def test_an_object_that_is_not_in_the_map_does_not_change_the_exposure() -> None:
    view, rgb, depth = scene()
    other = exposed(rgb, 1.4)
    other[30:70, 20:80] = (230, 20, 20)
    assert exposure_of(torch.from_numpy(other), depth, view).gain == pytest.approx(1.4, rel=0.03)


def test_the_blur_of_a_map_is_no_change_of_exposure() -> None:
    view, rgb, depth = scene()
    smooth = torch.nn.functional.avg_pool2d(view.rgb.permute(2, 0, 1)[None], 5, 1, 2)[0].permute(1, 2, 0)
    frame = torch.from_numpy(rgb.copy())
    assert in_exposure_of_map(frame, depth, ModelView(smooth, view.depth, view.alpha)) is frame


def test_a_map_that_shows_nothing_of_the_image_leaves_it_alone() -> None:
    view, rgb, depth = scene()
    bright = torch.from_numpy(exposed(rgb, 2.0))
    for unseen in (replace(view, alpha=torch.zeros_like(depth)), replace(view, depth=depth + 1)):
        assert exposure_of(bright, depth, unseen) == ExposureFit()
        assert in_exposure_of_map(bright, depth, unseen) is bright
    black = torch.zeros_like(bright)
    assert in_exposure_of_map(black, depth, view) is black


@pytest.mark.parametrize("gain", [0.5, 2.0])
def test_colors_are_corrected_and_clipped_pixels_take_the_color_of_the_map(gain: float) -> None:
    view, rgb, depth = scene()
    back = in_exposure_of_map(torch.from_numpy(exposed(rgb, gain)), depth, view).numpy()
    off = np.abs(back.astype(int) - rgb.astype(int))[depth.numpy() > 0]
    assert off.mean() < 3
    assert np.percentile(off, 99) <= 8


def test_a_map_keeps_its_colours_when_the_exposure_doubles() -> None:
    frames, _ = tabletop()
    shown = []
    for gain in (1.0, 2.0):
        slam = Slam(small_config(mapping__keyframe_translation=0.005))
        for i, frame in enumerate(frames):
            slam.process(frame if i < 5 else brightened(frame, gain))
        assert sum(result.keyframe for result in slam.results[5:]) >= 2
        shown.append(slam.snapshot().model.colors.mean())
    assert shown[1] == pytest.approx(float(shown[0]), abs=0.01)


def brightened(frame: Frame, gain: float) -> Frame:
    return replace(frame, rgb=exposed(frame.rgb, gain))
