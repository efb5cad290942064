"""Clicked points lie where the ray meets the surface, by closed form."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.gaussians import GaussianModel
from splatbot.services.viewer.measuring import surface_point


def wall(z: float, opacity: float = 0.99, spacing: float = 0.02) -> GaussianModel:
    """Return a wall of flat Gaussians across the z axis, 2 m wide."""
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-1, 1, spacing), np.arange(-1, 1, spacing)))
    n = len(x)
    return GaussianModel.from_activated(
        means=np.stack([x, y, np.full(n, z)], -1),
        quats=np.tile([1.0, 0, 0, 0], (n, 1)),
        scales=np.tile([spacing, spacing, 1e-3], (n, 1)),
        opacities=np.full(n, opacity),
        colors=np.full((n, 3), 0.5),
    )


@pytest.mark.parametrize("seed", range(10))
def test_the_point_is_the_intersection_of_ray_and_wall(seed: int) -> None:
    rng = np.random.default_rng(seed)
    origin, target = rng.uniform([-0.5, -0.5, -3], [0.5, 0.5, -1]), np.r_[rng.uniform(-0.7, 0.7, 2), 1.0]
    direction = rng.uniform(0.1, 10) * (target - origin)
    point = surface_point(wall(1.0), origin, direction)
    assert point is not None
    np.testing.assert_allclose(point, target, atol=2e-3)


def test_the_nearer_of_two_walls_is_met_unless_it_is_nearly_transparent() -> None:
    def both(opacity: float) -> GaussianModel:
        return GaussianModel.concatenate([wall(1.0, opacity), wall(2.0)])

    for opacity, z in ((0.9, 1.0), (0.02, 2.0)):
        point = surface_point(both(opacity), np.zeros(3), np.array([0.0, 0.0, 1.0]))
        assert point is not None
        assert point[2] == pytest.approx(z, abs=2e-3)


@pytest.mark.parametrize("direction", [(0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (0.9, 0.0, 0.1)])
def test_a_ray_that_meets_nothing_gives_no_point(direction: tuple[float, float, float]) -> None:
    assert surface_point(wall(1.0), np.zeros(3), np.array(direction)) is None
    assert surface_point(GaussianModel.empty(), np.zeros(3), np.array(direction)) is None
