"""Confirmed space: counts of views equal those of numpy, and cells are those of all confirmed points."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot._native import count_measurements
from splatbot.camera import Camera
from splatbot.collision.confirmed import CONSTANTS, confirmed_cells, confirmed_near
from splatbot.collision.visibility import DepthView, measured_depths, passing_distance
from splatbot.geometry import inverse, se3_exp
from splatbot.protocols import Array

CAMERA = Camera(60.0, 62.0, 39.5, 29.7, 80, 60)
FLOOR, QUAD = 0.001, 0.002


def noisy_views(rng: np.random.Generator, count: int) -> list[DepthView]:
    """Return views of a wall at about 1 m, with noise, holes, NaN, infinite and flying pixels."""
    views: list[DepthView] = []
    for _ in range(count):
        depth = (1.0 + 0.003 * rng.normal(size=(60, 80))).astype(np.float32)
        for value in (0.0, np.nan, np.inf, 0.6):
            depth[rng.random(depth.shape) < 0.03] = value
        views.append((depth, CAMERA, se3_exp(rng.normal(0.0, 0.02, 6))))
    return views


def counted(points: Array, owner: np.ndarray, views: list[DepthView]) -> np.ndarray:
    """Count by numpy: views that agree, that pass, and that measure (P, 3)."""
    counts = np.zeros((len(points), 3), np.int32)
    for number, view in enumerate(views):
        rows, measured, own = measured_depths(points, *view)
        other = owner[rows] != number
        rows, measured, own = rows[other], measured[other], own[other]
        tolerance = CONSTANTS.agreement_sigma * (FLOOR + QUAD * own**2)
        counts[rows[np.abs(measured - own) <= tolerance], 0] += 1
        counts[rows[measured - own > passing_distance(own)], 1] += 1
        counts[rows, 2] += 1
    return counts


def test_counts_of_views_equal_those_of_numpy(rng: np.random.Generator) -> None:
    views = noisy_views(rng, 4)
    points = rng.uniform((-1.2, -1.2, -0.2), (1.2, 1.2, 1.6), (50_000, 3))
    points[:20_000, 2] = 1.0 + 0.01 * rng.normal(size=20_000)
    points[0], points[1, 0] = np.nan, 1e300
    owner = rng.integers(0, 4, len(points)).astype(np.int32)
    counts = np.zeros((len(points), 3), np.int32)
    for number, (depth, camera, T) in enumerate(views):
        k = (camera.fx, camera.fy, camera.cx, camera.cy)
        sigma, through = CONSTANTS.agreement_sigma, passing_distance(np.array([0.0, 1.0]))
        count_measurements(
            depth, k, inverse(T), points, owner, number,
            (sigma * FLOOR, sigma * QUAD), (through[0], through[1] - through[0]), counts,
        )  # fmt: skip
    expected = counted(points, owner, views)
    assert expected.sum(axis=0).min() > 1000
    assert (counts != expected).any(axis=1).sum() <= 1  # a product may be rounded otherwise
    assert not counts[:2].any()


def test_arrays_that_do_not_fit_are_refused(rng: np.random.Generator) -> None:
    depth, _, T = noisy_views(rng, 1)[0]
    with pytest.raises(ValueError, match="differ in length"):
        count_measurements(
            depth, (1.0, 1.0, 0.0, 0.0), T, np.zeros((3, 3)), np.zeros(2, np.int32), 0, (0.0, 0.0), (0.0, 0.0),
            np.zeros((3, 3), np.int32),
        )  # fmt: skip


def test_cells_are_those_of_all_confirmed_points(rng: np.random.Generator) -> None:
    views, edge = noisy_views(rng, 5), 0.01
    low, high = np.array([-0.31, -0.2, 0.55]), np.array([0.3, 0.22, 1.2])

    def inside(points: Array) -> np.ndarray:
        return np.asarray(((points > low + 0.1) & (points < high)).all(axis=1))

    cells = confirmed_cells(views, low, high, floor=FLOOR, quad=QUAD, edge=edge, inside=inside, agreeing_views=1)
    every = confirmed_near(
        views, low, high, floor=FLOOR, quad=QUAD, spacing=1e-6, most=10**7, inside=inside, agreeing_views=1
    )
    expected = {tuple(cell) for cell in np.floor(every / edge).astype(int).tolist()}
    found = [tuple(cell) for cell in cells.tolist()]
    assert len(found) == len(set(found))
    assert set(found) <= expected  # one point of a cell and view is tried, and not each
    assert len(found) > 0.95 * len(expected)
    assert len(expected) > 500


def test_without_points_there_are_no_cells() -> None:
    views: list[DepthView] = [(np.zeros((60, 80), np.float32), CAMERA, np.eye(4))] * 2
    cells = confirmed_cells(
        views, -np.ones(3), np.ones(3), floor=FLOOR, quad=QUAD, edge=0.004, inside=lambda p: np.ones(len(p), np.bool_)
    )
    assert cells.shape == (0, 3)
