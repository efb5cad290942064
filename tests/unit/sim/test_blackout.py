"""Blackout: the given number of black frames, from the given frame on."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.sim.effects.blackout import Blackout
from tests.unit.sim.frames import frame_at

RNG = np.random.default_rng(0)


def test_n_frames_are_black_and_without_depth_and_the_others_untouched() -> None:
    effect = Blackout(at=10, n=15)
    for i in range(40):
        frame = frame_at(index=i)
        after = effect.apply(frame, RNG)
        if 10 <= i < 25:
            assert not after.rgb.any()
            assert not after.depth.any()
            assert (after.stamp, after.index) == (frame.stamp, i)
        else:
            assert after is frame


def test_depth_can_outlive_the_light() -> None:
    effect = Blackout(at=0, depth="kept")
    after = effect.apply(frame_at(), RNG)
    assert not after.rgb.any()
    assert after.valid.all()
    assert not effect.blanks_depth
    assert Blackout().blanks_depth


@pytest.mark.parametrize("change", [{"at": -1}, {"n": -1}, {"depth": "half"}])
def test_arguments_out_of_range_are_named(change: dict[str, Any]) -> None:
    with pytest.raises(InputError) as caught:
        Blackout(**change)
    assert caught.value.field == next(iter(change))
