"""Distances of certified paths from measured points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from experiments.measured_clearance import PathClearance, main, measure, nearest_point, open_scene, report
from splatbot.cli import main as splatbot
from splatbot.collision import RobotSpheres
from splatbot.robots.panda import panda


def test_the_nearest_point_is_that_of_all_distances(rng: np.random.Generator) -> None:
    arm, points = RobotSpheres(panda()), rng.uniform(-1, 1, (300, 3))
    moving = arm.spheres.link > 0
    for _ in range(3):
        ends = panda().random(2, rng)
        q = ends[0] + np.linspace(0.0, 0.2, 21)[:, None] * (ends[1] - ends[0])
        away = np.linalg.norm(arm.centers(q)[:, moving, None] - points, axis=3) - arm.spheres.radii[moving, None]
        gap, index = nearest_point(arm, q, cKDTree(points), cut=0.5)
        assert gap == pytest.approx(away.min(), abs=1e-12)
        assert index == away.min(axis=(0, 1)).argmin()
    assert nearest_point(arm, q, cKDTree(points + 10.0), cut=0.5) == (0.5, 300)


def test_a_point_that_only_the_base_touches_is_left_out() -> None:
    arm = RobotSpheres(panda())
    of_base = arm.centers(np.asarray(panda().home)[None])[0, arm.spheres.link == 0]
    low = of_base[np.argmin(of_base[:, 2])][None]
    assert nearest_point(arm, np.asarray(panda().home)[None], cKDTree(low), cut=0.5)[0] > 0.0


def test_the_report_counts_contacts_and_paths_nearer_than_the_margin() -> None:
    paths = [PathClearance(0.010, gap, outside) for gap, outside in ((0.012, 0.0), (0.007, 0.004), (-0.002, 0.020))]
    text = report([*paths, PathClearance(0.010, 0.004, 0.001)], tried=9)
    assert "4 paths of 9 problems, margin 10.0 mm" in text
    assert "in contact with a measured point: 1 of 4 (5 to 70 %)" in text
    assert "nearer than the margin: 3 of 4 (30 to 95 %)" in text
    assert "nearer by 6.0 mm in the median, 12.0 mm at most" in text
    assert "outside of the map by more than the margin: 1 of 4" in text
    assert "less the distance of point and map: 1 of 4" in text  # the last: 4 mm of 10 mm, with a point 1 mm outside


@pytest.mark.long
def test_paths_keep_the_margin_less_the_distance_of_point_and_map(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    assert splatbot(["map", "synthetic:tabletop?frames=8&width=160&height=120", "--out", str(run), "--quiet"]) == 0
    scene = open_scene(run)
    found, tried = measure(scene, 3)
    assert len(found) == 3 <= tried
    assert len(scene.points) > 10_000
    for path in found:
        assert path.gap > path.margin - path.outside - 1e-4
    capsys.readouterr()


def test_without_runs_the_usage_is_printed() -> None:
    with pytest.raises(SystemExit, match="RUN"):
        main([])
