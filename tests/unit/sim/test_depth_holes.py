"""Depth holes: the given fraction of pixels, in blobs that differ in every frame."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.sim.effects.base import Effects
from splatbot.sim.effects.depth_holes import DepthHoles
from tests.unit.sim.frames import frame_at


@pytest.mark.parametrize("share", [0.05, 0.4, 0.9])
def test_exactly_the_required_share_is_lost(share: float) -> None:
    after = DepthHoles(share=share).apply(frame_at(), np.random.default_rng(1))
    assert (~after.valid).sum() == round(share * 150 * 200)
    assert (after.depth[after.valid] == 1.0).all()


def test_the_share_is_of_the_pixels_that_had_depth() -> None:
    z = np.ones((150, 200))
    z[:, :100] = 0
    after = DepthHoles(share=0.4).apply(frame_at(z), np.random.default_rng(1))
    assert after.valid.sum() == round(0.6 * 150 * 100)


def test_holes_are_blobs_of_the_size_not_single_pixels() -> None:
    def inner(size: float) -> float:
        """Return the fraction of missing pixels that are 5 px or more from any pixel with depth."""
        lost = (~DepthHoles(size=size).apply(frame_at(), np.random.default_rng(1)).valid).astype(np.uint8)
        return float((cv2.distanceTransform(lost, cv2.DIST_L2, 5) > 5).sum() / lost.sum())

    assert inner(60) > 0.5
    assert inner(10) < 0.05


def test_each_frame_has_its_own_holes_and_keeps_its_colour() -> None:
    effects = Effects([DepthHoles()], seed=2)
    a, b = effects(frame_at(index=0)), effects(frame_at(index=1))
    assert np.mean(a.valid != b.valid) > 0.2
    assert np.array_equal(a.rgb, frame_at().rgb)


def test_a_share_of_zero_touches_nothing() -> None:
    frame = frame_at()
    assert DepthHoles(share=0).apply(frame, np.random.default_rng(1)) is frame


@pytest.mark.parametrize(("field", "value"), [("share", 1.0), ("share", float("nan")), ("size", 0.0)])
def test_arguments_out_of_range_are_named(field: str, value: float) -> None:
    with pytest.raises(InputError) as caught:
        DepthHoles(**{field: value})  # type: ignore[arg-type]
    assert caught.value.field == field
