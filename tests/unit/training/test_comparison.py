"""Comparison of two maps: equal maps, changed ones, other frames, and the poses of each map's own run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from splatbot.evaluation.image import psnr
from splatbot.gaussians import GaussianModel
from splatbot.rasterize.views import render_rgbd
from splatbot.training.comparison import compare_around, compare_recorded, doubts, summary
from splatbot.training.datasets.base import TrainingView
from splatbot.training.map_views import MapViews
from splatbot.training.options import TrainingOptions
from tests.unit.training.rendered import CAMERA, rendered_data, true_model


def recorded() -> MapViews:
    data = rendered_data(8)
    return MapViews(data, *data.split(4), TrainingOptions(iterations=1), "photographs")


def moved(model: GaussianModel, x: float) -> GaussianModel:
    return replace(model, means=model.means + torch.tensor([x, 0, 0]))


def test_equal_maps_differ_in_nothing() -> None:
    views = list(compare_recorded(true_model(), true_model(), recorded(), None, 2))
    means = summary(views)
    assert [view.scores["psnr_db"] for view in views] == [np.inf, np.inf]
    assert means["psnr_db"] is None
    assert means["ssim"] == pytest.approx(1)
    assert means["overlap"] == 1
    assert means["depth_difference"] == 0
    assert means["psnr_a_db"] == means["psnr_b_db"] == pytest.approx(55, abs=15)
    assert doubts(means) == []


def test_a_darker_map_scores_as_its_images_do() -> None:
    model = true_model()
    darker = replace(model, sh=model.sh - 0.2)
    (view,) = compare_recorded(model, darker, recorded(), None, 1)
    assert view.scores["psnr_db"] == psnr(view.b.rgb, view.a.rgb) < 35
    assert view.scores["psnr_b_db"] < view.scores["psnr_a_db"]  # type: ignore[operator]
    assert view.recorded is not None
    np.testing.assert_allclose(view.a.rgb, view.recorded, atol=3)


def test_a_map_of_another_place_does_not_overlap() -> None:
    means = summary(compare_around(true_model(), moved(true_model(), 50.0), 3))
    assert "psnr_a_db" not in means
    (text,) = doubts(means)
    assert "do not overlap" in text


def test_a_map_of_another_size_is_not_in_the_same_frame() -> None:
    model = true_model()
    larger = replace(model, means=0.3 * model.means, log_scales=model.log_scales + np.log(2.0))
    (text,) = doubts(
        summary(compare_around(replace(model, log_scales=model.log_scales + 1), larger, 3)) | {"overlap": 1}
    )
    assert "not in one frame" in text


def test_a_map_is_scored_from_the_poses_of_its_own_run() -> None:
    views, shift = recorded(), 0.05
    data = views.data
    T = [view.T_world_camera.copy() for view in data.views]
    for pose in T:
        pose[0, 3] += shift
    shifted = tuple(replace(view, T_world_camera=pose) for view, pose in zip(data.views, T, strict=True))
    of_b = replace(views, data=replace(data, views=shifted))
    b = moved(true_model(), shift)
    (alone,) = compare_recorded(true_model(), b, views, None, 1)
    (posed,) = compare_recorded(true_model(), b, views, of_b, 1)
    assert posed.scores["psnr_b_db"] > 40 > alone.scores["psnr_b_db"]  # type: ignore[operator]
    assert posed.scores["psnr_db"] == alone.scores["psnr_db"]


def test_maps_are_scored_against_measured_depth_where_it_is() -> None:
    views, model = recorded(), true_model()
    away = 0.02  # [m]

    def with_depth(view: TrainingView) -> TrainingView:
        depth = render_rgbd(model, view.camera, view.T_world_camera)[2] + np.float32(away)
        depth[:, : CAMERA.width // 2] = 0  # nothing is measured there
        return replace(view, read_depth=depth.copy)

    measured = replace(views, held_out=tuple(map(with_depth, views.held_out)))
    (view,) = compare_recorded(model, moved(model, 50.0), measured, None, 1)
    assert view.scores["depth_error_a"] == pytest.approx(away, rel=1e-3)
    assert view.scores["measured_a"] == pytest.approx((view.a.depth[:, CAMERA.width // 2 :] > 0).mean())
    assert view.scores["depth_error_b"] is None
    assert view.scores["measured_b"] == 0


def test_masked_pixels_do_not_count_against_the_recording() -> None:
    views = recorded()
    everything = np.ones((CAMERA.height, CAMERA.width), np.bool_)
    masked = tuple(replace(view, read_mask=everything.copy) for view in views.held_out)
    (view,) = compare_recorded(true_model(), true_model(), replace(views, held_out=masked), None, 1)
    assert view.scores["psnr_a_db"] is None
    assert summary([view])["psnr_a_db"] is None
