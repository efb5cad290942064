"""Readout time and bias: recovered from projections with noise, refused where features do not determine them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from splatbot.calibration.motion import View, match_pairs
from splatbot.calibration.readout import RowModel, estimate_rows
from splatbot.camera import Camera
from splatbot.geometry import inverse, se3_exp
from splatbot.tracking.features import Features

CAMERA = Camera(525.0, 525.0, 319.5, 239.5, 640, 480)
RATE, FRAMES, NOISE = 30.0, 40, 0.4  # [Hz], [1], [px]


def shaken(t: float) -> np.ndarray:
    """Return a pose of a camera that turns to and fro by up to 100 °/s and sways by 40 cm."""
    w = 2 * np.pi * 0.9
    turn = 0.3 * np.array([0.7 * np.sin(w * t + 1), np.sin(w * t), 0.5 * np.sin(0.7 * w * t)])
    return se3_exp([0.4 * np.sin(0.6 * w * t), 0.3 * np.cos(0.5 * w * t), 0.1 * np.sin(w * t), *turn])


def views_of(path: Callable[[float], np.ndarray], readout: float, bias: float) -> list[View]:
    """Project random points by the pose of the row that sees them: the row is a fixed point, exact to half a row."""
    rng = np.random.default_rng(0)
    points = np.stack([rng.uniform(-4, 4, 900), rng.uniform(-3, 3, 900), rng.uniform(1.2, 4, 900)], axis=1)
    descriptors = rng.integers(0, 256, (900, 32), np.uint8)
    rows, views = np.arange(-100, 601), []
    for k in range(FRAMES):
        poses = np.array([inverse(path(k / RATE + (row / 479 - 0.5) * readout)) for row in rows])
        row = np.full(900, 240)
        for _ in range(6):
            T = poses[row + 100]
            seen = np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]
            pixels = CAMERA.project(np.where(seen[:, 2:] > 0.3, seen, [0.0, 0.0, 1.0]))
            row = np.clip(np.rint(pixels[:, 1]), -100, 600).astype(np.intp)
        kept = (seen[:, 2] > 0.3) & (np.abs(pixels - [320, 240]) < [315, 235]).all(1)
        pixels = pixels[kept] + NOISE * rng.standard_normal((int(kept.sum()), 2))
        rays = np.stack([(pixels[:, 0] - 319.5) / 525, (pixels[:, 1] - 239.5) / 525, np.ones(len(pixels))], axis=1)
        found, scales = rays * (seen[kept, 2:] - bias), np.ones(len(pixels), np.float32)
        views.append(View(k / RATE, Features(pixels.astype(np.float32), descriptors[kept], found, scales)))
    return views


def estimate(path: Callable[[float], np.ndarray], readout: float, bias: float) -> RowModel:
    views = views_of(path, readout, bias)
    return estimate_rows(views, match_pairs(views, CAMERA), CAMERA)


@pytest.mark.parametrize(("readout", "bias"), [(0.03, 0.02), (0.0, -0.01)])
def test_readout_and_bias_are_recovered_within_three_sigma(readout: float, bias: float) -> None:
    found = estimate(shaken, readout, bias)
    assert not found.readout.refusal
    assert not found.bias.refusal
    assert abs(found.readout.value - readout) < 3 * found.readout.sigma
    assert abs(found.bias.value - bias) < 3 * found.bias.sigma
    assert found.readout.sigma < 1e-3


def test_a_camera_at_rest_tells_neither() -> None:
    found = estimate(lambda t: np.eye(4), 0.03, 0.02)
    assert found.readout.refusal
    assert found.bias.refusal


def test_a_rotation_alone_tells_no_bias() -> None:
    def turning(t: float) -> np.ndarray:
        T = shaken(t)
        T[:3, 3] = 0
        return T

    found = estimate(turning, 0.03, 0.02)
    assert not found.readout.refusal
    assert found.bias.refusal


def test_views_without_matches_tell_neither() -> None:
    empty = [View(k / RATE, Features.none()) for k in range(FRAMES)]
    found = estimate_rows(empty, match_pairs(empty, CAMERA), CAMERA)
    assert found.readout.refusal
    assert found.bias.refusal
    assert not found.twists
