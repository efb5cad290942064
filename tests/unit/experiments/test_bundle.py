"""Bundle adjustment recovers exact poses from perturbed ones and keeps their scale."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from experiments.bundle import bundle_adjusted, main, umeyama_scale
from splatbot.errors import InputError
from splatbot.evaluation import absolute_error
from splatbot.geometry import se3_exp
from splatbot.logs import open_log
from splatbot.trajectory import Trajectory


def test_the_scale_is_that_of_the_initial_poses(rng: np.random.Generator) -> None:
    positions = rng.normal(size=(20, 3))
    turned = positions @ se3_exp([0, 0, 0, 0.3, -0.2, 0.9])[:3, :3].T
    assert umeyama_scale(positions, 2.5 * turned + 4.0) == pytest.approx(2.5)


@pytest.mark.long
def test_poses_of_rendered_images_are_found_from_worse_ones(tmp_path: Path, rng: np.random.Generator) -> None:
    log = open_log("synthetic:tabletop?trajectory=arm&frames=12&seed=1")
    assert log.ground_truth is not None
    worse = np.array([T @ se3_exp(rng.normal(0, 2e-3, 6)) for T in log.ground_truth.T_world_camera])
    found, pixels = bundle_adjusted([log[k] for k in range(12)], worse, tmp_path)
    assert pixels < 1.0
    before, after = (absolute_error(log.ground_truth, Trajectory(log.ground_truth.stamps, T)) for T in (worse, found))
    assert after.rmse < 0.5 * before.rmse


def test_without_colmap_the_error_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(InputError, match="pycolmap"):
        bundle_adjusted([], np.zeros((0, 4, 4)), tmp_path)


def test_without_a_log_and_a_run_the_usage_is_printed() -> None:
    with pytest.raises(SystemExit, match="LOG RUN"):
        main(["log"])
