"""Scores of trajectories and held-out views against values known beforehand."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from splatbot.evaluation import depth_error, psnr
from splatbot.gaussians import GaussianModel
from splatbot.geometry import se3_exp
from splatbot.logs import open_log
from splatbot.rasterize.views import render_view
from splatbot.results.scoring import N_SHOWN, score_trajectory, score_views, trajectory_metrics
from splatbot.trajectory import Trajectory


@pytest.fixture
def reference(rng: np.random.Generator) -> Trajectory:
    steps = [se3_exp(np.concatenate([rng.normal(0, 0.05, 3), rng.normal(0, 0.02, 3)])) for _ in range(20)]
    poses = np.stack([np.linalg.multi_dot([np.eye(4), *steps[: i + 1]]) for i in range(20)])
    return Trajectory(np.arange(20) / 10.0, poses)


def test_a_rigid_motion_of_the_whole_path_is_no_error_and_the_paths_coincide(reference: Trajectory) -> None:
    T = se3_exp([1.0, -2.0, 0.5, 0.4, -0.3, 0.9])
    score = score_trajectory(Trajectory(reference.stamps, T @ reference.T_world_camera), reference)
    assert score is not None
    assert score.absolute.rmse == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(score.estimate, reference.positions, atol=1e-12)


def test_the_reference_is_cut_to_the_time_of_the_run(reference: Trajectory) -> None:
    score = score_trajectory(reference.select(np.arange(5, 11)), reference)
    assert score is not None
    assert len(score.estimate) == 6
    assert 6 <= len(score.reference) <= 8


def test_there_is_no_score_without_a_reference_or_with_one_of_another_time(reference: Trajectory) -> None:
    later = Trajectory(reference.stamps + 1000.0, reference.T_world_camera)
    empty = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
    for score in (
        score_trajectory(reference, None),
        score_trajectory(reference, later),
        score_trajectory(empty, reference),
    ):
        assert score is None
    assert trajectory_metrics(None)["ate_rmse_m"] is None


def test_a_single_pose_has_no_relative_error(reference: Trajectory) -> None:
    score = score_trajectory(reference.select([3]), reference)
    assert trajectory_metrics(score)["ate_frames"] == 1
    assert trajectory_metrics(score)["rpe_trans_rmse_m"] is None


def test_views_are_scored_over_the_whole_image_and_a_few_are_kept(
    make_log: Callable[..., Path], rng: np.random.Generator
) -> None:
    log = open_log(make_log(8))
    n = 400
    model = GaussianModel.from_activated(
        means=rng.uniform([-0.5, -0.4, 0.9], [0.5, 0.4, 1.2], (n, 3)),
        quats=rng.normal(size=(n, 4)),
        scales=rng.uniform(0.02, 0.08, (n, 3)),
        opacities=rng.uniform(0.5, 0.9, n),
        colors=rng.uniform(0, 1, (n, 3)),
    )
    views = score_views(log, model, {i: np.eye(4) for i in (6, 1, 2, 4, 5)})
    assert [score.index for score in views.scores] == [1, 2, 4, 5, 6]
    assert [view.score.index for view in views.shown] == [1, 4, 6]
    assert len(views.shown) == N_SHOWN
    rendered, depth = (render_view(model, log.camera, np.eye(4), mode) for mode in ("rgb", "depth"))
    for score in views.scores:
        frame = log[score.index]
        difference = rendered.astype(np.float64) - frame.rgb / 255.0
        assert score.psnr_db == pytest.approx(-10 * np.log10(np.mean(difference**2)), abs=1e-4)
        both = (depth > 0) & (frame.depth > 0)
        errors = np.abs(depth.astype(np.float64) - frame.depth)[both]
        assert score.depth_l1_m == pytest.approx(errors.mean(), abs=1e-6)
        assert score.depth_median_m == pytest.approx(np.median(errors), abs=1e-6)
        assert score.coverage == pytest.approx(both.sum() / (frame.depth > 0).sum())
    metrics = views.metrics()
    assert metrics["psnr_holdout_db"] == pytest.approx(
        np.mean([psnr(rendered, log[i].rgb) for i in (1, 2, 4, 5, 6)]), abs=1e-6
    )
    assert metrics["depth_median_m"] == pytest.approx(
        np.median([depth_error(depth, log[i].depth).median or 0.0 for i in (1, 2, 4, 5, 6)]), abs=1e-9
    )


def test_an_empty_map_covers_nothing_and_has_no_depth_error(make_log: Callable[..., Path]) -> None:
    views = score_views(open_log(make_log(2)), GaussianModel.empty(), {0: np.eye(4)})
    metrics = views.metrics()
    assert metrics["depth_l1_m"] is None
    assert metrics["depth_coverage"] == 0.0
    assert metrics["psnr_holdout_db"] is not None
