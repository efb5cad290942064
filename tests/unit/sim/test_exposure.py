"""Exposure: gain and offset from the given frame on, or a drift over time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.sim.effects.exposure import Exposure
from tests.unit.sim.frames import frame_at

RNG = np.random.default_rng(0)
RAMP = np.linspace(0, 255, 200).astype(np.uint8)[None, :, None]


def test_a_step_doubles_the_values_from_its_frame_on() -> None:
    effect = Exposure(step=2, at=40)
    before, after = (effect.apply(frame_at(index=i, rgb=RAMP), RNG) for i in (39, 40))
    assert np.array_equal(before.rgb, frame_at(rgb=RAMP).rgb)
    np.testing.assert_array_equal(after.rgb, np.minimum(2 * before.rgb.astype(int), 255))
    assert np.array_equal(after.depth, before.depth)


def test_a_step_with_an_end_is_over_then() -> None:
    effect = Exposure(step=0.5, offset=10, at=3, until=5)
    values = [int(effect.apply(frame_at(index=i, rgb=100), RNG).rgb[0, 0, 0]) for i in range(7)]
    assert values == [100, 100, 100, 60, 60, 100, 100]


def test_a_drift_doubles_per_second() -> None:
    effect = Exposure(step=1, drift=1.0)
    values = [int(effect.apply(frame_at(index=i, rgb=30), RNG).rgb[0, 0, 0]) for i in (0, 30, 60)]
    assert values == [30, 60, 120]


def test_a_gain_of_one_touches_nothing() -> None:
    frame = frame_at()
    assert Exposure(step=1).apply(frame, RNG) is frame


@pytest.mark.parametrize(
    "change", [{"step": -1.0}, {"offset": float("inf")}, {"drift": float("nan")}, {"at": -1}, {"until": 3, "at": 3}]
)
def test_arguments_out_of_range_are_named(change: dict[str, Any]) -> None:
    with pytest.raises(InputError) as caught:
        Exposure(**change)
    assert caught.value.field == next(iter(change))
