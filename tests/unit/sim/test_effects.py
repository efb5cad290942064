"""Sensor effects: pure, seeded per frame, and reported; depth noise has the published size."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.sim.effects.base import Effects
from splatbot.sim.effects.depth_noise import DepthNoise, tilts
from tests.unit.sim.frames import CAMERA, frame_at


@pytest.mark.parametrize("z", [0.4, 1.0, 2.5])
def test_noise_has_the_published_deviation_and_no_bias(z: float) -> None:
    noisy = DepthNoise(step=0).apply(frame_at(z), np.random.default_rng(1)).depth.astype(np.float64)
    sigma = 0.0012 + 0.0019 * (z - 0.4) ** 2
    n = noisy.size
    assert noisy.mean() == pytest.approx(z, abs=5 * sigma / np.sqrt(n))
    assert noisy.std() == pytest.approx(sigma, rel=5 / np.sqrt(2 * n))


@pytest.mark.parametrize("z", [0.5, 1.0, 2.0, 3.0])
@pytest.mark.parametrize("tilt", [0, 30, 50, 65, 75, 80])
def test_noise_of_a_tilted_wall_is_that_of_the_published_fit_within_a_tenth(z: float, tilt: int) -> None:
    """Nguyen, Izadi, Lovell 2012, eq. 3; a lens so long that the wall has one depth and one angle."""
    camera = Camera(60_000.0, 60_000.0, 99.5, 74.5, 200, 150)
    wall = z / (1.0 - np.tan(np.radians(tilt)) * (np.arange(200) - 99.5) / 60_000.0)
    depth = np.repeat(wall[None].astype(np.float32), 150, axis=0)
    frame = Frame(0.0, np.zeros((150, 200, 3), np.uint8), depth, camera)
    noise = DepthNoise(step=0, edge_loss=0).apply(frame, np.random.default_rng(1)).depth.astype(np.float64) - depth
    theta = np.radians(tilt)
    published = 0.0012 + 0.0019 * (z - 0.4) ** 2 + 0.0001 / np.sqrt(z) * theta**2 / (np.pi / 2 - theta) ** 2
    assert noise.std() == pytest.approx(published, rel=0.1)
    assert abs(noise.mean()) < 5 * published / np.sqrt(noise.size)


def test_an_edge_does_not_pass_for_a_steep_wall() -> None:
    z = np.where(np.arange(200) < 100, 1.0, 1.5)[None, :].repeat(150, axis=0)
    assert tilts(CAMERA, z.astype(np.float32))[75, 95:105].max() < np.radians(5)


def test_depth_comes_in_steps() -> None:
    noisy = DepthNoise(step=0.005).apply(frame_at(1.0), np.random.default_rng(1)).depth
    np.testing.assert_allclose(noisy / 0.005, np.rint(noisy / 0.005), atol=1e-4)
    assert len(np.unique(noisy)) > 1


def test_holes_lie_along_edges_only() -> None:
    z = np.where(np.arange(200) < 100, 1.0, 1.5)[None, :].repeat(150, axis=0)
    lost = DepthNoise(edge_loss=0.5, edge_reach=2).apply(frame_at(z), np.random.default_rng(1)).depth == 0
    assert lost[:, 98:102].mean() == pytest.approx(0.5, abs=0.1)
    assert not lost[:, :98].any()
    assert not lost[:, 102:].any()
    assert not (DepthNoise(edge_loss=0).apply(frame_at(z), np.random.default_rng(1)).depth == 0).any()


def test_missing_depth_stays_missing_and_is_no_edge() -> None:
    z = np.ones((150, 200))
    z[40:60, 40:60] = 0
    noisy = DepthNoise().apply(frame_at(z), np.random.default_rng(1))
    assert np.array_equal(noisy.valid, z > 0)


def test_a_very_near_depth_never_becomes_missing_or_negative() -> None:
    noisy = DepthNoise(strength=10).apply(frame_at(0.002), np.random.default_rng(1))
    assert noisy.valid.all()


def test_apply_is_a_pure_function_of_frame_and_generator() -> None:
    frame = frame_at(1.0)
    before = frame.depth.copy()
    a = DepthNoise().apply(frame, np.random.default_rng(5))
    b = DepthNoise().apply(frame, np.random.default_rng(5))
    c = DepthNoise().apply(frame, np.random.default_rng(6))
    assert np.array_equal(a.depth, b.depth)
    assert not np.array_equal(a.depth, c.depth)
    assert np.array_equal(frame.depth, before)
    assert (a.stamp, a.index, a.camera) == (frame.stamp, frame.index, frame.camera)
    assert np.array_equal(a.rgb, frame.rgb)


@pytest.mark.parametrize("change", [{"strength": -1.0}, {"step": float("nan")}, {"edge_loss": 1.5}])
def test_arguments_out_of_range_are_named(change: dict[str, Any]) -> None:
    with pytest.raises(InputError) as caught:
        replace(DepthNoise(), **change)
    assert caught.value.field == next(iter(change))


def test_a_frame_does_not_depend_on_those_before_it() -> None:
    frames = [frame_at(1.0, i) for i in range(3)]
    run = list(Effects([DepthNoise()], seed=3).over(frames))
    assert np.array_equal(Effects([DepthNoise()], seed=3)(frames[2]).depth, run[2].depth)
    assert not np.array_equal(run[1].depth, run[2].depth)
    assert not np.array_equal(Effects([DepthNoise()], seed=4)(frames[2]).depth, run[2].depth)


def test_without_effects_a_frame_passes_untouched() -> None:
    frame = frame_at(1.0)
    assert Effects([])(frame) is frame


def test_the_account_says_which_were_on_why_and_what_they_cost() -> None:
    effects = Effects([DepthNoise(why="the demo's sensor")])
    assert effects.report()[0]["ms_per_frame"] is None
    effects(frame_at(1.0))
    (row,) = effects.report()
    assert (row["name"], row["why"], row["frames"]) == ("depth_noise", "the demo's sensor", 1)
    assert row["ms_per_frame"] > 0
