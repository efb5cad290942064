"""The reference against central differences and closed forms: the oracle of the kernels must itself hold."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.scenes import NAMES, Scene, hard_scene, one_gaussian

STEP = 1e-6


def central_difference(scene: Scene, name: str, index: tuple[int, ...], weights: Tensor, mode: str) -> float:
    """Return the slope of the weighted image along one entry of one input."""
    values = []
    for sign in (1.0, -1.0):
        moved = scene.to(torch.float64)
        getattr(moved, name)[index] += sign * STEP
        values.append(float((moved.reference(mode)[0] * weights).sum()))
    return (values[0] - values[1]) / (2 * STEP)


@pytest.mark.parametrize("mode", ["RGB", "D", "RGB+ED"])
def test_gradients_equal_central_differences(mode: str) -> None:
    scene = hard_scene(seed=3, n=60).to(torch.float64, requires_grad=True)
    image, _, meta = scene.reference_leaves(mode)
    generator = torch.Generator().manual_seed(0)
    # A pixel within the step's reach of a jump has no derivative.
    weights = torch.randn(image.shape, generator=generator, dtype=torch.float64) * (meta.margins > 1e-3)[..., None]
    (image * weights).sum().backward()
    checked = 0
    for name in NAMES:
        leaf = getattr(scene, name)
        if leaf is None or leaf.grad is None:
            continue
        flat = leaf.grad.abs().flatten()
        for k in flat.topk(min(4, len(flat))).indices.tolist():
            index = tuple(int(i) for i in torch.unravel_index(torch.tensor(k), leaf.shape))
            if name == "viewmats" and index[1] == 3:
                continue
            slope = central_difference(scene, name, index, weights, mode)
            assert float(leaf.grad[index]) == pytest.approx(slope, rel=2e-5, abs=2e-6), (name, index)
            checked += 1
    assert checked >= 16


def test_one_gaussian_has_the_closed_form() -> None:
    sigma, z, opacity, focal = 0.05, 2.0, 0.8, 40.0
    scene = one_gaussian(scale=(sigma, sigma, sigma), mean=(0.0, 0.0, z), opacity=opacity)
    image, alpha, _ = scene.reference("RGB+D")
    variance = (focal * sigma / z) ** 2 + 0.3
    dx, dy = 16.5 - 16.0, 14.5 - 12.0  # the centre of pixel (16, 14) from the principal point
    expected = opacity * math.exp(-0.5 * (dx * dx + dy * dy) / variance)
    assert float(alpha[0, 14, 16, 0]) == pytest.approx(expected, rel=1e-6)
    assert image[0, 14, 16].tolist() == pytest.approx(
        [expected, 0.5 * expected, 0.25 * expected, z * expected], rel=1e-6
    )


def test_plane_depth_is_that_of_the_ray_meeting_the_plane() -> None:
    angle = math.radians(50.0)
    quat = (math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0)  # about y: the disc's normal leans to the side
    scene = one_gaussian(scale=(0.2, 0.2, 1e-4), quat=quat, opacity=0.9)
    depth, _, _ = scene.reference("ED", depth_mode="plane")
    normal = torch.tensor([math.sin(angle), 0.0, math.cos(angle)], dtype=torch.float64)
    for x in (15, 16):
        ray = torch.tensor([(x + 0.5 - 16.0) / 40.0, 0.5 / 40.0, 1.0], dtype=torch.float64)
        exact = float(normal[2] * 2.0 / (normal @ ray))
        assert float(depth[0, 12, x, 0]) == pytest.approx(exact, abs=1e-3)  # linear in the pixel: to first order
        assert abs(exact - 2.0) > 0.02, "the plane's slope must show"


def test_margins_tell_how_near_a_jump_is() -> None:
    scene: Any = one_gaussian(opacity=0.8)
    _, alpha, meta = scene.reference("RGB")
    at = float(alpha[0, 12, 16, 0])
    assert float(meta.margins[0, 12, 16]) == pytest.approx(min(abs(at * 255 - 1), abs(at / 0.99 - 1)), rel=1e-6)
