"""Joining of maps: planes in closed form are fused once, and an object that is gone leaves Gaussians and keyframes."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.gaussians import GaussianModel
from splatbot.mapping.depth_fusion import DepthNoiseModel
from splatbot.mapping.joining import covered, join_models, without_contradicted
from splatbot.mapping.keyframes import Keyframe
from splatbot.tracking.features import Features
from splatbot.tracking.reference import Reference
from tests.rgbd import CAMERA, small_config

NOISE = DepthNoiseModel(0.001, 0.002)
MAPPING = small_config().mapping


def _plane(z: float, half: float = 0.2, shift: float = 0.0, spacing: float = 0.02) -> GaussianModel:
    """Return discs of 1 cm on a square of the plane at a depth [m], which face the camera at the origin."""
    side = np.arange(-half, half + 1e-9, spacing)
    x, y = np.meshgrid(side + shift, side)
    means = np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=1)
    model = GaussianModel.from_activated(
        means=means,
        quats=np.tile([1.0, 0.0, 0.0, 0.0], (len(means), 1)),
        scales=np.tile([0.01, 0.01, 0.001], (len(means), 1)),
        opacities=np.full(len(means), 0.9),
        colors=np.full((len(means), 3), 0.5),
    )
    model.observations.fill_(5)
    model.uncertainty.fill_(0.001)
    return model


def _keyframe(depth: NDArray[np.float32], number: int = 0, x: float = 0.0) -> Keyframe:
    T = np.eye(4)
    T[0, 3] = x
    rgb = torch.zeros(*depth.shape, 3, dtype=torch.uint8)
    return Keyframe(number, CAMERA, rgb, torch.from_numpy(depth), T, Features.none(), Reference(T, ()))


def _depth(z: float) -> NDArray[np.float32]:
    return np.full((CAMERA.height, CAMERA.width), z, np.float32)


def test_the_same_surface_is_kept_once_and_only_new_surface_is_added() -> None:
    a, b = _plane(1.0), _plane(1.002, shift=0.2)
    joined = join_models(a, b, [_keyframe(_depth(1.0), n, 0.01 * n) for n in range(4)], MAPPING, NOISE)
    assert (joined.kept, joined.removed) == (len(a), 0)
    outside = int((b.means[:, 0] > 0.2 + 0.021).sum())  # farther from the last disc of A than its reach of 2 σ
    assert joined.added == outside
    assert joined.added + joined.covered == len(b)
    assert joined.overlap == joined.covered / len(b)
    assert len(joined.model) == joined.kept + joined.added


def test_surface_that_the_later_depth_sees_through_is_removed() -> None:
    a = GaussianModel.concatenate([_plane(1.0), _plane(0.6, half=0.05)])
    behind = [_keyframe(_depth(1.0), n, 0.01 * n) for n in range(5)]
    joined = join_models(a, GaussianModel.empty(), behind, MAPPING, NOISE)
    assert joined.removed == len(_plane(0.6, half=0.05))
    assert bool((joined.model.means[:, 2] > 0.9).all())


def test_surface_that_the_later_depth_does_not_see_stays() -> None:
    a = _plane(1.0)
    unknown = [_keyframe(_depth(0.0), n) for n in range(5)]
    hidden = [_keyframe(_depth(0.5), n) for n in range(5)]
    for keyframes in (unknown, hidden):
        assert join_models(a, GaussianModel.empty(), keyframes, MAPPING, NOISE).kept == len(a)


def test_a_disc_covers_points_within_2_sigma_across_and_the_gap_along_its_normal() -> None:
    disc = _plane(1.0, half=0.0)

    def is_covered(x: float, z: float) -> bool:
        point = _plane(z, half=0.0, shift=x)
        return bool(covered(point, disc)[0])

    gap = 0.01 + 3 * np.hypot(0.001, 0.001)  # [m]
    assert is_covered(0.0199, 1.0)
    assert not is_covered(0.0201, 1.0)
    assert is_covered(0.0, 1.0 + gap - 1e-4)
    assert not is_covered(0.0, 1.0 + gap + 1e-4)


def test_an_earlier_keyframe_loses_the_pixels_of_an_object_that_is_gone() -> None:
    depth = _depth(1.0)
    depth[40:80, 60:100] = 0.6
    earlier, later = _keyframe(depth), [_keyframe(_depth(1.0), n, 0.02 * n) for n in range(1, 4)]
    found = without_contradicted(earlier, later)
    assert found.static_mask is not None
    assert not found.static_mask[44:76, 64:96].any()
    assert found.static_mask[:30].all()
    assert float(found.depth[60, 80]) == 0.0
    assert float(found.depth[10, 10]) == 1.0
    assert without_contradicted(earlier, [_keyframe(depth, n) for n in (1, 2)]) is earlier
