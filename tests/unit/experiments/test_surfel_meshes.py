"""Meshes of trained surfels and Gaussians against the truth."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.surfel_meshes import main, measure, seen_points, true_surface
from splatbot.evaluation.surface import score_mesh
from splatbot.logs.synthetic import SyntheticLog

LOG = "synthetic:tabletop?frames=16&width=160&height=120&arc=100"


def test_the_points_that_views_see_lie_on_the_true_surface() -> None:
    log = SyntheticLog("synthetic:tabletop?frames=2&width=64&height=48")
    true, seen = true_surface(log), seen_points(log)
    score = score_mesh(true, true, seen, tolerance=1e-3)
    assert len(seen) > 50
    assert score.completeness_m < 5e-4  # depth images are rounded to millimetres
    assert np.isfinite(true[0]).all()


@pytest.mark.long
def test_meshes_of_surfels_are_more_accurate_and_more_complete_than_those_of_gaussians(
    capsys: pytest.CaptureFixture[str],
) -> None:
    found = {m.kind: m for m in measure(LOG, 300, 2000, ["depth"])}
    gaussians, surfels = found["gaussians"], found["surfels"]
    print(gaussians, surfels, sep="\n")
    assert surfels.score.accuracy_m < 0.85 * gaussians.score.accuracy_m
    assert surfels.score.completeness_m < 0.9 * gaussians.score.completeness_m
    assert surfels.score.f_score > gaussians.score.f_score + 0.05
    assert surfels.psnr_db > gaussians.psnr_db - 1.0
    capsys.readouterr()


@pytest.mark.long
def test_the_command_prints_a_line_for_each_mesh(capsys: pytest.CaptureFixture[str]) -> None:
    main(["--iterations", "2", "--max-gaussians", "300", "--log", "synthetic:tabletop?frames=9&width=64&height=48"])
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.startswith("surfels (300") for line in lines) == 3
    assert sum(line.startswith("gaussians (300") for line in lines) == 2
