"""Merged Gaussians have the moments of their members, by closed forms and by samples."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatbot.gaussians import GaussianModel
from splatbot.gaussians.shape import covariances
from splatbot.tiles import MapPart
from splatbot.tiles.merging import merged
from tests.unit.tiles.maps import Array, assert_equal, building


def part_of(means: object, scales: object, opacities: object, colors: object | None = None) -> MapPart:
    n = len(np.asarray(means))
    model = GaussianModel.from_activated(
        means=np.asarray(means),
        quats=np.tile((1.0, 0.0, 0.0, 0.0), (n, 1)),
        scales=np.asarray(scales),
        opacities=np.asarray(opacities),
        colors=np.full((n, 3), 0.5) if colors is None else np.asarray(colors),
    )
    return MapPart(model, torch.arange(n, dtype=torch.int32) + 5)


def pairs(n: int, gap: float, *, scale: float) -> Array:
    """Return n pairs along x that are 100 m apart, each of two means with a gap [m]."""
    means = np.zeros((2 * n, 3))
    means[:, 0] = 100.0 * (np.arange(2 * n) // 2) + gap * (np.arange(2 * n) % 2) + scale
    return means


def test_two_equal_neighbours_become_one_of_their_mean_variance_and_mass() -> None:
    s, gap = 0.1, 0.04
    part = part_of(pairs(8, gap, scale=s), np.full((16, 3), s), np.full(16, 0.3))
    found, edge = merged(part, 8)
    assert len(found) == 8
    assert edge >= 2 * s
    x = found.model.means[:, 0].double().numpy()
    assert x == pytest.approx(100.0 * np.arange(8) + gap / 2 + s, rel=1e-6)
    expected = np.diag([s**2 + (gap / 2) ** 2, s**2, s**2])
    assert covariances(found.model).numpy() == pytest.approx(np.tile(expected, (8, 1, 1)), abs=2e-6)
    area = np.sqrt(s**2 + (gap / 2) ** 2) * s
    assert found.model.opacities.numpy() == pytest.approx(np.full(8, 2 * 0.3 * s**2 / area), rel=1e-4)
    assert found.rows.tolist() == list(range(5, 21, 2))


def test_moments_and_colours_are_those_of_samples_of_the_members() -> None:
    rng = np.random.default_rng(3)
    n = 400
    scales = rng.uniform(0.05, 0.2, (n, 3))
    opacities, colors = rng.uniform(0.001, 0.01, n), rng.uniform(0, 1, (n, 3))
    means = rng.normal(0, 0.3, (n, 3))
    far = np.full((8, 3), 1000.0) * np.arange(1, 9)[:, None]
    found, _ = merged(
        part_of(
            np.concatenate([means, far]),
            np.concatenate([scales, np.full((8, 3), 0.1)]),
            np.append(opacities, np.full(8, 0.5)),
            np.concatenate([colors, np.full((8, 3), 0.5)]),
        ),
        9,
    )
    assert len(found) == 9
    model = found.model.select(found.model.means[:, 0] < 500.0)
    mass = opacities * np.sort(scales, axis=1)[:, 1:].prod(axis=1)
    drawn = rng.choice(n, 400_000, p=mass / mass.sum())
    samples = means[drawn] + scales[drawn] * rng.normal(size=(len(drawn), 3))
    assert model.means[0].numpy() == pytest.approx(samples.mean(axis=0), abs=3e-3)
    assert covariances(model)[0].numpy() == pytest.approx(np.cov(samples.T), abs=2e-3)
    assert model.colors[0].numpy() == pytest.approx(colors[drawn].mean(axis=0), abs=3e-3)


def test_wide_gaussians_and_single_ones_keep_their_bits() -> None:
    part = part_of(pairs(40, 0.01, scale=0.0), np.full((80, 3), 0.01), np.full(80, 0.5))
    part.model.log_scales[::20] = np.log(50.0)
    found, edge = merged(part, 44)
    wide = part.model.scales.amax(1) > 0.5 * edge
    assert int(wide.sum()) == 4
    assert_equal(found.model.select(found.model.scales.amax(1) > 1.0), part.model.select(wide))
    partners = torch.arange(1, 80, 20)
    kept = torch.isin(found.rows, part.rows[partners])
    assert_equal(found.model.select(kept), part.model.select(partners))


def test_no_more_gaussians_remain_than_requested_and_no_keyframe_supports_merged_ones() -> None:
    model = building(3000)
    part = MapPart(model, torch.arange(3000, dtype=torch.int32))
    found, edge = merged(part, 500)
    assert 300 <= len(found) <= 500
    own = torch.isin(found.model.means, model.means).all(dim=1)
    assert (found.model.observations[~own] == 0).all()
    assert len(set(found.rows.tolist())) == len(found)
    assert merged(part, 500, 2 * edge)[1] >= 2 * edge


def test_vanishing_scales_and_opacities_merge_to_finite_values() -> None:
    part = part_of(pairs(8, 1e-12, scale=0.0), np.full((16, 3), 0.1), np.full(16, 0.5))
    part.model.log_scales[:] = -300.0
    part.model.opacity_logits[:] = -300.0
    found, _ = merged(part, 8)
    assert len(found) == 8
    for values in (found.model.means, found.model.quats, found.model.log_scales, found.model.opacity_logits):
        assert torch.isfinite(values).all()


def test_thousands_of_equal_gaussians_become_one() -> None:
    found, _ = merged(part_of(np.ones((3000, 3)), np.full((3000, 3), 0.01), np.full(3000, 0.9)), 8)
    assert len(found) == 1
    assert found.model.means[0].tolist() == [1.0, 1.0, 1.0]
    assert float(found.model.opacities) == pytest.approx(0.99)
