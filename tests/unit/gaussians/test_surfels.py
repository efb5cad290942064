"""Surfels as Gaussians without thickness."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from splatbot.gaussians import GaussianModel
from splatbot.gaussians.shape import covariances, shortest_axes
from splatbot.gaussians.surfels import as_surfels, holds_surfels
from tests.models import random_model


def test_a_disc_is_its_gaussian_without_the_shortest_axis(rng: np.random.Generator) -> None:
    model = random_model(90, rng)
    model.log_scales += torch.from_numpy(rng.normal(size=(90, 3)).astype(np.float32))
    before = model.clone()
    discs = as_surfels(model)
    assert set(model.log_scales.argmin(1).tolist()) == {0, 1, 2}
    values, vectors = np.linalg.eigh(covariances(before).double().numpy())  # ascending
    flat = np.einsum("nij,nj,nkj->nik", vectors[:, :, 1:], values[:, 1:], vectors[:, :, 1:])
    np.testing.assert_allclose(covariances(discs).double().numpy(), flat, atol=1e-5 * values.max())
    along = np.abs((shortest_axes(discs).double().numpy() * vectors[:, :, 0]).sum(axis=1))
    assert along.min() > 1 - 1e-5
    assert torch.equal(model.log_scales, before.log_scales)  # the input stays


def test_a_file_keeps_surfels_and_one_thick_gaussian_makes_a_map_of_gaussians(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    discs = as_surfels(random_model(20, rng))
    assert holds_surfels(discs)
    assert as_surfels(discs) is discs
    discs.save(tmp_path / "map.ply")
    loaded = GaussianModel.load(tmp_path / "map.ply")
    assert holds_surfels(loaded)
    assert torch.equal(loaded.log_scales, discs.log_scales)
    loaded.log_scales[7, 2] = -9.0
    assert not holds_surfels(loaded)
    assert not holds_surfels(GaussianModel.empty())
    assert len(as_surfels(GaussianModel.empty())) == 0


def test_a_scale_of_zero_in_a_file_of_another_program_is_a_surfel() -> None:
    model = GaussianModel.from_activated(
        means=np.zeros((2, 3)),
        quats=np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)),
        scales=np.tile([0.1, 0.2, 0.0], (2, 1)),
        opacities=np.full(2, 0.5),
        colors=np.zeros((2, 3)),
    )
    assert holds_surfels(model)
