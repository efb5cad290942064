"""Integers of ellipsoids: containment in float64, and the range of all codes."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.collision.solids import MAX_VALUE, SCALE_FLOOR
from splatbot.formats import enclosing
from splatbot.formats.enclosing import MAX_CODE, MIN_CODE, SCALE_STEPS, Shapes, Solids, decode, enclose, turn_bits
from splatbot.geometry import quat_to_rotation


def solids(rng: np.random.Generator, n: int, low: float, high: float) -> Solids:
    """Return ellipsoids of random scales [m] around the origin."""
    scales = -np.sort(-np.exp(rng.uniform(np.log(low), np.log(high), (n, 3))), axis=1)
    return Solids(rng.normal(size=(n, 3)), quat_to_rotation(rng.normal(size=(n, 4))), scales)


def test_the_bounds_are_those_of_collision_fields() -> None:
    assert enclosing.SCALE_FLOOR == SCALE_FLOOR
    assert enclosing.MAX_VALUE == MAX_VALUE


@pytest.mark.parametrize(("low", "high"), [(SCALE_FLOOR, 0.1), (1e-3, 1e-3), (SCALE_FLOOR, MAX_VALUE)])
def test_points_of_an_ellipsoid_are_in_the_decoded_one(rng: np.random.Generator, low: float, high: float) -> None:
    inner, centres = solids(rng, 300, low, high), np.zeros((300, 3))
    shapes = enclose(inner, centres)
    means, quats, log_scales = (values.astype(np.float64) for values in decode(shapes, centres))
    x = rng.normal(size=(300, 500, 3))
    x /= np.linalg.norm(x, axis=2, keepdims=True)
    points = inner.means[:, None] + np.einsum("nij,nkj->nki", inner.axes * inner.scales[:, None, :], x)
    local = np.einsum("nji,nkj->nki", quat_to_rotation(quats), points - means[:, None])
    assert (np.linalg.norm(local / np.exp(log_scales)[:, None], axis=2) <= 1.0).all()
    assert (np.diff(shapes.scales, axis=1) <= 0).all()
    assert shapes.scales.min() >= MIN_CODE
    assert shapes.scales.max() <= MAX_CODE


def test_axes_grow_by_a_tenth(rng: np.random.Generator) -> None:
    inner = solids(rng, 2000, 5e-4, 2e-2)
    grown = 2.0 ** (enclose(inner, np.round(inner.means, 2)).scales / SCALE_STEPS) / inner.scales
    assert grown.min() > 1.0
    assert 1.05 < grown.mean() < 1.13
    assert grown.max() < 1.6


def test_a_rounder_ellipsoid_has_fewer_bits_of_its_turn() -> None:
    scales = np.array([[0, 0, 0], [0, 0, -12], [0, -12, -12], [0, -60, -120]])
    assert turn_bits(scales).tolist() == [[0, 0, 0], [5, 5, 0], [5, 5, 5], [14, 14, 9]]


def test_known_codes_are_decoded_as_described() -> None:
    shapes = Shapes(np.array([[12, 12, 0]]), np.array([[16, 15, 0]]), np.array([[10, -5, 2]]))
    means, quats, log_scales = decode(shapes, np.array([[1.0, 2.0, 3.0]]))
    x = 1.0 / 32.0  # the middle of interval 16 of 32; that of interval 15 is -x
    quat = np.array([1.0, x, x, 0.0]) / np.sqrt(1 + 2 * x * x)
    assert quats[0] == pytest.approx(quat, abs=1e-7)
    assert np.exp(log_scales[0]) == pytest.approx([2.0, 2.0, 1.0], rel=1e-6)
    offset = quat_to_rotation(quat) @ (10 * 0.16, -5 * 0.16, 2 * 0.16)
    assert means[0] == pytest.approx(np.array([1.0, 2.0, 3.0]) + offset, abs=1e-6)
