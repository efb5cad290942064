"""Hulls enclose their members at 2 and more standard deviations; points on the members are the oracle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from splatbot.collision.hulls import Hulls, enclosing_hulls
from splatbot.gaussians import GaussianModel
from splatbot.geometry import quat_to_rotation
from tests.models import random_model, uniform_model


def flat_model(n: int, rng: np.random.Generator) -> GaussianModel:
    """Return thin discs of a few millimetres, 5 m from the origin, as a depth camera gives them."""
    model = random_model(n, rng)
    means = torch.tensor([5.0, -3.0, 4.0]) + 0.01 * model.means
    return replace(model, means=means, log_scales=torch.tensor([[3e-3, 2e-3, 1e-6]]).log().repeat(n, 1))


def farthest(model: GaussianModel, groups: NDArray[np.int64], hulls: Hulls, n_sigma: float) -> float:
    """Return the largest distance of points on the members from the means of their hulls, in standard deviations."""
    directions = np.random.default_rng(1).normal(size=(400, 3))
    ball = n_sigma * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    roots = quat_to_rotation(model.quats.double().numpy()) * model.scales.double().numpy()[:, None, :]
    points = model.means.double().numpy()[:, None] + np.einsum("nij,pj->npi", roots, ball)
    local = np.einsum("nji,npj->npi", quat_to_rotation(hulls.quats)[groups], points - hulls.means[groups][:, None])
    return float(np.linalg.norm(local / hulls.scales[groups][:, None], axis=2).max())


@pytest.mark.parametrize("make", [random_model, flat_model])
@pytest.mark.parametrize("n_sigma", [2.0, 3.0, 10.0])
def test_points_on_the_members_are_inside_their_hull(make: object, n_sigma: float) -> None:
    model = make(600, np.random.default_rng(0))  # type: ignore[operator]
    groups = np.arange(600) // 6
    hulls = enclosing_hulls(model, groups, 100)
    assert farthest(model, groups, hulls, n_sigma) <= n_sigma


def test_the_hull_of_one_gaussian_is_that_gaussian() -> None:
    model = random_model(50, np.random.default_rng(2))
    hulls = enclosing_hulls(model, np.arange(50), 50)
    np.testing.assert_allclose(hulls.means, model.means.numpy())
    np.testing.assert_allclose(np.sort(hulls.scales, 1), np.sort(model.scales.numpy(), 1), rtol=2e-3)


def test_the_hull_of_two_equal_balls_is_a_quarter_longer_than_both_at_most() -> None:
    model = uniform_model(np.array([[-0.2, 0, 0], [0.2, 0, 0]]))
    hulls = enclosing_hulls(model, np.zeros(2, np.int64), 1)
    across, _, along = np.sort(2 * hulls.scales[0])  # at two standard deviations
    assert 0.4 <= along <= 0.501
    assert 0.2 <= across <= 0.25
    np.testing.assert_allclose(hulls.means, 0, atol=1e-7)


def test_a_gaussian_without_thickness_gets_the_floor_of_the_field() -> None:
    model = replace(uniform_model(np.zeros((2, 3))), log_scales=torch.full((2, 3), 1e-9).log())
    hulls = enclosing_hulls(model, np.zeros(2, np.int64), 1)
    assert (hulls.scales >= 5e-5).all()
