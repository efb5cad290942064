"""Tests of splatbot.segmentation.rectangle."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.protocols import Array
from splatbot.segmentation.rectangle import fit_rectangle

SIDES = np.array([0.08, 0.07])
CENTER = np.array([0.68, 0.06])


def two_faces(yaw: float, *, noise: float = 0.0015, outliers: int = 8) -> Array:
    """Sample two faces of a box from above, a part of its top, and strays beyond a corner: (P, 2) [m]."""
    rng = np.random.default_rng(3)
    a = np.stack([rng.uniform(-0.5, 0.5, 900), np.full(900, -0.5)], axis=1)
    b = np.stack([np.full(900, -0.5), rng.uniform(-0.5, 0.5, 900)], axis=1)
    top = rng.uniform(-0.5, 0.1, (300, 2))
    stray = np.array([0.5, -0.5]) + rng.uniform(0.0, 0.25, (outliers, 2))
    local = np.concatenate([a, b, top, stray]) * SIDES
    c, s = np.cos(yaw), np.sin(yaw)
    points = local @ np.array([[c, -s], [s, c]]).T + CENTER
    return np.asarray(points + rng.normal(0.0, noise, points.shape))


@pytest.mark.parametrize("degrees", [0, 10, 38, 45, 52, 89])
def test_two_faces_of_a_box_give_the_distances_of_its_faces(degrees: int) -> None:
    found = fit_rectangle(two_faces(np.radians(degrees)))
    np.testing.assert_allclose(sorted(found.sides), sorted(SIDES), atol=4e-3)
    np.testing.assert_allclose(found.center, CENTER, atol=4e-3)
    turn = np.degrees(found.yaw) - degrees
    assert abs((turn + 45) % 90 - 45) < 3.0


def test_a_disc_has_its_diameter_on_both_sides() -> None:
    angle = np.linspace(0, 2 * np.pi, 500, endpoint=False)
    found = fit_rectangle(0.03 * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    np.testing.assert_allclose(found.sides, 0.06, atol=1e-3)


@pytest.mark.parametrize("count", [1, 2])
def test_few_points_give_finite_sides(count: int) -> None:
    found = fit_rectangle(np.array([[0.1, 0.2], [0.3, 0.2]])[:count])
    assert np.isfinite(found.sides).all()
    assert max(found.sides) == pytest.approx(0.2 * (count - 1), abs=0.005)
