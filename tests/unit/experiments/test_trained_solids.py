"""The collision field of a trained map against ellipsoids in float64."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from experiments.trained_solids import Ellipsoids, judge, main, point_distances
from splatbot.cli import main as splatbot
from splatbot.gaussians import GaussianModel
from tests.unit.collision.oracle import random_gaussians, separation, signed_distances


def test_distances_are_those_of_the_oracle(rng: np.random.Generator) -> None:
    points, axes = rng.uniform(-0.2, 0.2, (2000, 3)), np.exp(rng.uniform(-9, -2, (2000, 3)))
    assert np.abs(point_distances(points, axes) - np.maximum(signed_distances(points, axes), 0.0)).max() < 1e-12


def test_the_gap_of_a_drawn_sphere_is_that_of_the_separation_test(rng: np.random.Generator) -> None:
    solids = Ellipsoids.of(random_gaussians(1, rng), 2.0)
    spheres, gaps = solids.spheres(500, rng)
    local = (spheres[:, :3] - solids.centres[0]) @ solids.rotations[0]
    distances = signed_distances(local, np.broadcast_to(solids.axes, local.shape))
    assert np.abs(distances - spheres[:, 3] - gaps).max() < 1e-12
    clear = np.abs(gaps) > 1e-6
    apart = separation(local, np.broadcast_to(solids.axes, local.shape), spheres[:, 3]) > 1.0
    assert np.array_equal(apart[clear], gaps[clear] > 0)


def test_distances_to_the_nearest_of_many_are_those_to_all_of_them(rng: np.random.Generator) -> None:
    solids = Ellipsoids.of(random_gaussians(60, rng), 2.0)
    points = rng.uniform(-1, 1, (200, 3))
    local = np.einsum("nji,pnj->pni", solids.rotations, points[:, None] - solids.centres)
    wanted = np.maximum(signed_distances(local, solids.axes), 0.0).min(axis=1)
    near = wanted < 0.09
    assert near.any()
    assert np.abs(solids.distances(points)[near] - wanted[near]).max() < 1e-12


@pytest.mark.long
def test_no_sphere_that_touches_a_trained_map_is_free_in_its_field(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    log = "synthetic:tabletop?frames=6&width=160&height=120"
    assert splatbot(["map", log, "--out", str(run), "--quiet"]) == 0
    assert splatbot(["train", str(run), "--iterations", "60"]) == 0
    trained, mapped = (GaussianModel.load(run / name) for name in ("map.ply", "map.mapped.ply"))
    assert (trained.log_scales != mapped.log_scales).any()
    for n_sigma in (1.0, 2.0, 3.0):
        verdict = judge(trained, n_sigma, 3000)
        assert verdict.touching > 1500
        assert verdict.false_free == 0
        assert verdict.widest < 1e-4
    capsys.readouterr()


@pytest.mark.long
def test_the_command_prints_the_counts_of_a_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    random_gaussians(300, np.random.default_rng(0)).save(tmp_path / "map.ply")
    main([str(tmp_path / "map.ply")])
    printed = capsys.readouterr().out
    assert "3 sigma, 300 ellipsoids" in printed
    assert printed.count("    0 of these are free in the field") == 3
