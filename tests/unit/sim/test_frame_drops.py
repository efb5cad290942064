"""Frame drops: the given rate, decided per frame, alone or in bursts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.sim.effects.base import Effects
from splatbot.sim.effects.depth_noise import DepthNoise
from splatbot.sim.effects.frame_drops import FrameDrops
from tests.unit.sim.frames import frame_at


@pytest.mark.parametrize("burst", [1, 5])
def test_the_required_share_is_lost(burst: int) -> None:
    kept = Effects([FrameDrops(rate=0.3, burst=burst)], seed=1).kept(10_000)
    sigma = np.sqrt(0.3 * 0.7 * burst / 10_000)
    assert 1 - len(kept) / 10_000 == pytest.approx(0.3, abs=4 * sigma)


def test_a_burst_is_lost_as_a_whole() -> None:
    lost = np.setdiff1d(np.arange(1000), Effects([FrameDrops(rate=0.3, burst=4)], seed=1).kept(1000))
    assert len(lost) > 100
    groups, sizes = np.unique(lost // 4, return_counts=True)
    assert len(groups) < 250
    assert (sizes == 4).all()


def test_what_is_lost_depends_on_the_seed_alone() -> None:
    def lost(seed: int, count: int = 200) -> list[int]:
        return Effects([FrameDrops()], seed=seed).kept(count)

    assert lost(1) == lost(1)
    assert lost(1) != lost(2)
    assert lost(1)[: len(lost(1, 100))] == lost(1, 100)


def test_a_stream_goes_on_without_the_lost_frames_and_the_rest_is_unchanged() -> None:
    frames = [frame_at(index=i) for i in range(20)]
    with_drops = list(Effects([DepthNoise(), FrameDrops(rate=0.3)], seed=1).over(frames))
    without = list(Effects([DepthNoise()], seed=1).over(frames))
    assert 5 < len(with_drops) < 20
    for frame in with_drops:
        assert np.array_equal(frame.depth, without[frame.index].depth)
        assert frame.stamp == frames[frame.index].stamp


@pytest.mark.parametrize("change", [{"rate": 1.0}, {"rate": -0.1}, {"burst": 0}])
def test_arguments_out_of_range_are_named(change: dict[str, Any]) -> None:
    with pytest.raises(InputError) as caught:
        FrameDrops(**change)
    assert caught.value.field == next(iter(change))
