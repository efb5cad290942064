"""Completion adds Gaussians for confirmed depth that the collision field misses, and for nothing else."""

from __future__ import annotations

import numpy as np
import torch

from splatbot.collision import GaussianCollisionField
from splatbot.gaussians import GaussianModel
from splatbot.geometry import transform_points
from splatbot.mapping.completion import missing_gaussians
from splatbot.mapping.depth_fusion import DepthNoiseModel
from splatbot.mapping.keyframes import Keyframe
from tests.rgbd import CAMERA, Array, small_config
from tests.unit.mapping.conftest import MakeKeyframe

CONFIG = small_config()
NOISE = DepthNoiseModel.of(CONFIG.tracking)


def _moved(x: float) -> Array:
    T = np.eye(4)
    T[0, 3] = x
    return T


def _views(make: MakeKeyframe) -> list[Keyframe]:
    return [make(_moved(0.03 * k), number=k) for k in range(4)]


def _points(keyframe: Keyframe) -> Array:
    v, u = np.nonzero(keyframe.depth.numpy())
    z = keyframe.depth.numpy()[v, u].astype(np.float64)
    rays = np.c_[(u - CAMERA.cx) / CAMERA.fx * z, (v - CAMERA.cy) / CAMERA.fy * z, z]
    return transform_points(keyframe.T_world_camera, rays)


def _missing(model: GaussianModel, keyframes: list[Keyframe]) -> GaussianModel:
    return missing_gaussians(model, keyframes, CONFIG.mapping, NOISE)


def test_after_completion_the_field_is_at_every_point_that_three_keyframes_measured(
    make_keyframe: MakeKeyframe,
) -> None:
    views = _views(make_keyframe)
    added = _missing(GaussianModel.empty(), views)
    field = GaussianCollisionField(added)
    for view in views:
        inner = view.depth.numpy()[5:-5, 20:-20]
        points = _points(view).reshape(*view.depth.shape, 3)[5:-5, 20:-20].reshape(-1, 3)
        assert field.clearance(points).distance.max() < 0.006  # 3 mm or 1.5 σ of 3 mm, and the spacing of the grid
        assert len(points) == inner.size
    assert len(_missing(added, views)) == 0
    assert (added.observations > 0).all()


def test_a_hole_is_filled_and_the_rest_is_left_alone(make_keyframe: MakeKeyframe) -> None:
    views = _views(make_keyframe)
    whole = _missing(GaussianModel.empty(), views)
    inside = (whole.means[:, :2] - torch.tensor([0.05, 0.0])).norm(dim=1) < 0.06
    kept = whole.select((~inside).nonzero()[:, 0])
    added = _missing(kept, views)
    hole = np.c_[0.05 + 0.02 * np.cos(np.arange(6)), 0.02 * np.sin(np.arange(6)), np.ones(6)]
    assert GaussianCollisionField(kept).clearance(hole).distance.max() > 0.01
    assert GaussianCollisionField(GaussianModel.concatenate([kept, added])).clearance(hole).distance.max() < 0.006
    assert ((added.means[:, :2] - torch.tensor([0.05, 0.0])).norm(dim=1) < 0.08).all()


def test_depth_that_one_keyframe_measured_or_that_others_saw_through_adds_nothing(make_keyframe: MakeKeyframe) -> None:
    views = _views(make_keyframe)
    whole = _missing(GaussianModel.empty(), views)
    views[1].depth[40:60, 60:90] = 0.7  # a hand in one frame
    assert len(_missing(whole, views)) == 0
    assert len(_missing(GaussianModel.empty(), views[:2])) == 0
