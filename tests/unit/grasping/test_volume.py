"""Enclosed volume of oriented points, and the friction load of a weight, against formulas."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.grasping.score import friction_load
from splatbot.grasping.volume import enclosed_volume, winding_numbers
from splatbot.robots.panda import panda


def _box(size: tuple[float, float, float], at: tuple[float, float, float], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Sample points on a box uniformly; return them with their normals."""
    rng = np.random.default_rng(0)
    half = np.asarray(size) / 2
    areas = np.repeat([half[1] * half[2], half[0] * half[2], half[0] * half[1]], 2)
    face = rng.choice(6, count, p=areas / areas.sum())
    points = rng.uniform(-1, 1, (count, 3)) * half
    normals = np.zeros((count, 3))
    rows = np.arange(count)
    sign = np.where(face % 2, 1.0, -1.0)
    points[rows, face // 2], normals[rows, face // 2] = sign * half[face // 2], sign
    return points + at, normals


def _ball(radius: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    normals = np.random.default_rng(0).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return radius * normals, normals


def test_volume_and_centre_of_a_box_and_a_ball_agree_with_formulas() -> None:
    box = enclosed_volume(*_box((0.10, 0.06, 0.04), (3.0, -2.0, 1.0), 2000))
    np.testing.assert_allclose(box.center, [3.0, -2.0, 1.0], atol=2e-3)
    assert box.size == pytest.approx(0.10 * 0.06 * 0.04, rel=0.15)
    ball = enclosed_volume(*_ball(0.035, 1500))
    np.testing.assert_allclose(ball.center, 0.0, atol=2e-3)
    assert ball.size == pytest.approx(4 / 3 * np.pi * 0.035**3, rel=0.15)


def test_a_hammers_middle_is_near_its_head_not_in_the_middle_of_its_box() -> None:
    handle, head = (0.16, 0.025, 0.025), (0.035, 0.07, 0.045)
    parts = [_box(handle, (0.0, 0.0, 0.0), 900), _box(head, (0.0975, 0.0, 0.0), 900)]
    points, normals = (np.concatenate(column) for column in zip(*parts, strict=True))
    volumes = np.prod([handle, head], axis=1)
    true = volumes[1] * 0.0975 / volumes.sum()
    found = enclosed_volume(points, normals)
    assert found.center[0] == pytest.approx(true, abs=4e-3)
    assert abs((points[:, 0].min() + points[:, 0].max()) / 2 - true) > 0.015
    assert found.size == pytest.approx(volumes.sum(), rel=0.15)


def test_a_volume_without_a_bottom_is_found_and_a_single_face_encloses_nothing() -> None:
    points, normals = _box((0.08, 0.06, 0.10), (0.0, 0.0, 0.0), 2400)
    standing = normals[:, 2] > -0.5
    found = enclosed_volume(points[standing], normals[standing])
    np.testing.assert_allclose(found.center, 0.0, atol=0.012)
    top = normals[:, 2] > 0.5
    noise = np.random.default_rng(0).normal(0, 1e-3, (top.sum(), 3))
    face = enclosed_volume(points[top] + noise, normals[top])
    assert face.size < 0.08 * 0.06 * 1e-3
    np.testing.assert_allclose(face.center, [0.0, 0.0, 0.05], atol=6e-3)
    assert enclosed_volume(points[top], normals[top]).size == 0.0  # exactly flat


def test_winding_numbers_are_one_within_and_none_outside() -> None:
    points, normals = _ball(0.1, 3000)
    places = np.array([[0.0, 0.0, 0.0], [0.05, 0.0, 0.02], [0.2, 0.0, 0.0], [0.0, -0.3, 0.1]])
    areas = np.full(len(points), 4 * np.pi * 0.1**2 / len(points))
    np.testing.assert_allclose(winding_numbers(places, points, normals, areas, softened=0.002), [1, 1, 0, 0], atol=0.05)


def test_loads_on_the_rim_of_the_limit_surface_take_all_friction_and_half_of_them_half() -> None:
    """f and tau on the ellipsoid of both pads, f = w and tau = w d; so the share of w is 1."""
    hand, mu = panda().hand, 0.4
    assert hand is not None
    f_most = 2 * mu * hand.force
    tau_most = f_most * 2 / 3 * hand.width / 2  # of a disc that presses evenly: 2/3 mu N r
    for turn in np.linspace(0.0, 1.5, 7):
        f, tau = f_most * np.cos(turn), tau_most * np.sin(turn)
        aside = np.array([tau / f])
        np.testing.assert_allclose(friction_load(f, aside, hand, mu), 1.0, rtol=1e-9)
        np.testing.assert_allclose(friction_load(f / 2, aside, hand, mu), 0.5, rtol=1e-9)
