"""Merging under the cap: moments are kept, only the alike are merged, and the picture stays."""

from __future__ import annotations

import numpy as np
import torch

from splatbot.gaussians import GaussianModel
from splatbot.gaussians.shape import covariances
from splatbot.mapping.insertion import new_gaussians, view_of
from splatbot.mapping.merge import merge_similar
from splatbot.mapping.prune import best_supported
from tests.rgbd import CAMERA, small_config
from tests.unit.mapping.conftest import MakeKeyframe


def pair(**changes: torch.Tensor) -> GaussianModel:
    """Make two discs side by side on a plane."""
    model = GaussianModel.from_activated(
        means=[[0.0, 0.0, 1.0], [0.008, 0.002, 1.0]],
        quats=[[1.0, 0, 0, 0], [1.0, 0, 0, 0.3]],
        scales=[[0.01, 0.008, 0.001], [0.012, 0.009, 0.001]],
        opacities=[0.8, 0.6],
        colors=[[0.5, 0.4, 0.3], [0.55, 0.42, 0.3]],
    )
    for name, value in changes.items():
        getattr(model, name)[1] = value
    return model


def test_a_merged_pair_has_the_mean_and_covariance_of_the_mixture() -> None:
    model = pair()
    merged, rows = merge_similar(model, 1)
    assert rows.tolist() == [0]
    scales = model.scales.double().numpy()
    weights = model.opacities.double().numpy() * scales[:, 0] * scales[:, 1]
    weights /= weights.sum()
    means, spreads = model.means.double().numpy(), covariances(model).double().numpy()
    mean = weights @ means
    spread = sum(w * (C + np.outer(m - mean, m - mean)) for w, C, m in zip(weights, spreads, means, strict=True))
    np.testing.assert_allclose(merged.means[0], mean, atol=1e-7)
    np.testing.assert_allclose(covariances(merged)[0], spread, atol=2e-9)
    np.testing.assert_allclose(merged.colors[0], weights @ model.colors.numpy(), atol=1e-6)


def test_gaussians_that_differ_in_color_orientation_size_or_observation_are_not_merged() -> None:
    for changes in (
        {"sh": torch.tensor([[1.5, 0.0, 0.0]])},
        {"quats": torch.tensor([0.7, 0.7, 0.0, 0.0])},
        {"log_scales": torch.tensor([-2.5, -2.5, -5.0])},
        {"means": torch.tensor([0.0, 0.0, 1.005])},
        {"observations": torch.tensor(0)},
    ):
        assert len(merge_similar(pair(**changes), 1)[0]) == 2, changes


def test_no_more_are_merged_than_required_and_none_of_an_empty_map(make_keyframe: MakeKeyframe) -> None:
    keyframe = make_keyframe()
    model = new_gaussians(keyframe, keyframe.depth > 0, small_config().mapping)
    merged, rows = merge_similar(model, 100)
    assert len(merged) == len(rows) == len(model) - 100
    assert len(merge_similar(GaussianModel.empty(), 5)[0]) == 0


def test_merging_a_third_of_a_wall_changes_its_view_less_than_dropping_it(make_keyframe: MakeKeyframe) -> None:
    keyframe = make_keyframe()
    model = new_gaussians(keyframe, keyframe.depth > 0, small_config().mapping)
    excess = len(model) // 3
    before = view_of(model, CAMERA, np.eye(4))

    def change(smaller: GaussianModel) -> float:
        return float((view_of(smaller, CAMERA, np.eye(4)).rgb - before.rgb).abs().mean())

    merged, _ = merge_similar(model, excess)
    assert len(merged) < len(model) - 0.8 * excess
    assert change(merged) < 0.35 * change(model.select(best_supported(model, len(merged))))
