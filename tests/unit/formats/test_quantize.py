"""Quantisation: the error is at most half a step, and neighbours stay neighbours."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.formats.quantize import from_smallest_three, from_steps, morton_order, to_smallest_three, to_steps


@pytest.mark.parametrize("steps", [1, 255, 1023, 65535])
@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-3.0, 7.5), (1000.0, 1000.001)])
def test_a_value_inside_is_at_most_half_a_step_away(
    steps: int, low: float, high: float, rng: np.random.Generator
) -> None:
    values = np.concatenate([rng.uniform(low, high, 1000), [low, high]])
    codes = to_steps(values, low, high, steps)
    assert codes.max() <= steps
    back = from_steps(codes, low, high, steps)
    assert np.abs(back - values).max() <= 0.5 * (high - low) / steps + 1e-12 * abs(high)
    assert back[-2:] == pytest.approx([low, high], rel=1e-15)


def test_values_outside_become_the_ends_and_an_empty_range_its_value() -> None:
    assert to_steps([-9.0, 9.0], 0.0, 1.0, 255).tolist() == [0, 255]
    codes = to_steps([2.0, 2.0], 2.0, 2.0, 255)
    assert from_steps(codes, 2.0, 2.0, 255).tolist() == [2.0, 2.0]


def test_columns_have_their_own_ranges() -> None:
    low, high = np.array([0.0, -1.0]), np.array([1.0, 1.0])
    codes = to_steps([[0.5, -1.0], [1.0, 1.0]], low, high, 10)
    assert codes.tolist() == [[5, 0], [10, 10]]


def test_the_smallest_three_components_determine_a_rotation(rng: np.random.Generator) -> None:
    quats = rng.normal(size=(2000, 4))
    quats[:4] = np.eye(4)
    quats[4:8] = -np.eye(4)
    quats[8] = 0.5  # four equal components
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    largest, others = to_smallest_three(quats)
    assert np.abs(others).max() <= 1.0 + 1e-12
    back = from_smallest_three(largest, others)
    assert np.abs(np.abs((back * quats).sum(axis=1)) - 1).max() < 1e-12
    step = 0.01
    noisy = from_smallest_three(largest, others + np.sqrt(2) * rng.uniform(-step, step, others.shape))
    distance = np.minimum(np.linalg.norm(noisy - quats, axis=1), np.linalg.norm(noisy + quats, axis=1))
    assert distance.max() <= 1.05 * 2 * np.sqrt(3) * step


def test_morton_order_keeps_neighbours_together(rng: np.random.Generator) -> None:
    points = rng.uniform(0, 1, (4096, 3)).astype(np.float32)
    order = morton_order(points)
    assert sorted(order.tolist()) == list(range(4096))
    extents = [np.ptp(points[order[i : i + 64]], axis=0).max() for i in range(0, 4096, 64)]
    assert np.median(extents) < 0.5  # a 64th of the unit cube has a side of 0.25
    assert morton_order(np.zeros((3, 3), np.float32)).tolist() == [0, 1, 2]
