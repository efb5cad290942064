"""`splatbot bench training` in its quick form."""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatbot.bench.training import BENCHMARK, TrainingBenchSettings
from splatbot.bench.training.sweep import simulated_data
from splatbot.errors import InputError


@pytest.mark.long
def test_each_strategy_has_its_figures_and_the_plot_is_drawn(tmp_path: Path) -> None:
    results = BENCHMARK.run(TrainingBenchSettings(out=tmp_path, quick=True))
    with (tmp_path / "training.csv").open() as file:
        rows = list(csv.DictReader(file))
    cases = {row["case"] for row in rows}
    assert cases == {"(default)", "strategy default", "strategy absgrad", "strategy fixed"}  # the default is mcmc
    for case in cases:
        assert results.find(case, "PSNR") > 15  # type: ignore[operator]
        assert results.find(case, "Gaussians") > 100  # type: ignore[operator]
    plot = cv2.imread(str(tmp_path / "training.png"))
    assert plot is not None
    assert plot.std() > 1


def test_simulated_points_lie_where_the_images_show_them() -> None:
    data = simulated_data("synthetic:tabletop?frames=3&width=160&height=120", 2)
    view = data.views[0]
    assert (view.camera.width, view.camera.height) == (80, 60)
    image = view.read()
    p = (data.points - view.T_world_camera[:3, 3]) @ view.T_world_camera[:3, :3]
    uv = view.camera.project(p).round().astype(int)
    inside = (p[:, 2] > 0) & (uv >= 0).all(axis=1) & (uv < [80, 60]).all(axis=1)
    shown = image[uv[inside, 1], uv[inside, 0]].astype(float)
    assert np.median(np.abs(shown - data.point_colors[inside])) < 12


def test_wrong_settings_are_named() -> None:
    with pytest.raises(InputError, match="minutes"):
        TrainingBenchSettings(minutes=0).validate()
    with pytest.raises(InputError, match="scale"):
        TrainingBenchSettings(scale=0).validate()
