"""Median depth and normals against the reference's weights."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from splatbot.errors import InputError
from splatbot.rasterize.normals import facing_axes
from splatbot.rasterize.reference import reference_rotations
from tests.scenes import Scene, hard_scene, one_gaussian, relative_l2


def exact_weights(scene: Scene) -> Tensor:
    """Blend weights (C, H, W, N) in float64: each Gaussian has a colour channel of its own."""
    alone = scene.to(torch.float64)
    alone.colors, alone.backgrounds = torch.eye(len(scene.means), dtype=torch.float64), None
    return alone.reference_leaves("RGB")[0]


def exact_median(scene: Scene) -> tuple[Tensor, Tensor]:
    """Return the ids (C, H, W), or -1, and the distance of the transmittances from one half."""
    weights = exact_weights(scene)
    exact = scene.to(torch.float64)
    ids, margins = [], []
    for c in range(len(weights)):
        depth = exact.means @ exact.viewmats[c, 2, :3] + exact.viewmats[c, 2, 3]
        order = torch.argsort(depth.float(), stable=True)
        left = 1.0 - weights[c][..., order].cumsum(-1)
        below = left <= 0.5
        ids.append(torch.where(below.any(-1), order[below.double().argmax(-1)], -1))
        margins.append((left - 0.5).abs().amin(-1))
    return torch.stack(ids), torch.stack(margins)


@pytest.mark.parametrize("seed", [0, 1])
def test_median_depth_is_that_of_the_gaussian_that_takes_transmittance_to_one_half(seed: int) -> None:
    scene = hard_scene(seed, n=60, views=2)
    want, margin = exact_median(scene)
    image, _, meta = scene.render("RGB+MD")
    assert torch.equal(image[..., :3], scene.render("RGB")[0])
    safe = margin > 1e-5
    assert float(safe.double().mean()) > 0.99
    assert torch.equal(meta["median_ids"][safe].long(), want[safe])
    assert bool((want >= 0).any())
    assert bool((want < 0).any())
    depth = torch.einsum("nj,cj->cn", scene.means, scene.viewmats[:, 2, :3]) + scene.viewmats[:, 2, 3, None]
    exact = torch.stack([torch.where(w >= 0, d[w.clamp_min(0)], 0.0) for w, d in zip(want, depth, strict=True)])
    assert float((image[..., 3] - exact)[safe].abs().max()) < 1e-5


def test_median_depth_alone_is_the_same() -> None:
    scene = hard_scene(2)
    assert torch.equal(scene.render("MD")[0], scene.render("RGB+MD")[0][..., 3:])


def test_the_gradient_of_median_depth_goes_to_the_depth_of_its_gaussians() -> None:
    leaves = hard_scene(3).to(torch.float32, requires_grad=True)
    image, _, meta = leaves.render("MD")
    weight = torch.randn(image.shape, generator=torch.Generator().manual_seed(0))
    (image * weight).sum().backward()
    ids = meta["median_ids"][0].long()
    per_gaussian = torch.zeros(400).index_add(0, ids[ids >= 0], weight[0, ..., 0][ids >= 0])
    want = per_gaussian[:, None] * leaves.viewmats[0, 2, :3].detach()
    assert relative_l2(leaves.means.grad, want) < 1e-6
    assert leaves.viewmats.grad is not None
    assert float(leaves.viewmats.grad[0, 2, 3]) == pytest.approx(float(per_gaussian.sum()), rel=1e-5)
    assert float(leaves.viewmats.grad[0, :2].abs().max()) == 0.0


def test_median_depth_of_the_nearer_of_two_opaque_walls() -> None:
    scene = one_gaussian(mean=(0.0, 0.0, 3.0), scale=(10.0, 10.0, 0.01), opacity=0.9)
    scene.means = torch.tensor([[0.0, 0.0, 3.0], [0.0, 0.0, 2.0]])
    scene.quats, scene.scales = scene.quats.repeat(2, 1), scene.scales.repeat(2, 1)
    scene.opacities, scene.colors = torch.tensor([0.9, 0.3]), scene.colors.repeat(2, 1)
    assert float(scene.render("MD")[0][0, 12, 16, 0]) == pytest.approx(3.0)  # 0.3 leaves 0.7
    scene.opacities[1] = 0.6
    assert float(scene.render("MD")[0][0, 12, 16, 0]) == pytest.approx(2.0)
    scene.opacities[:] = torch.tensor([0.2, 0.2])
    assert float(scene.render("MD")[0].abs().max()) == 0.0


def test_an_empty_scene_has_no_median_depth() -> None:
    image, _, meta = hard_scene(4, n=0).render("RGB+MD")
    assert float(image[..., 3].abs().max()) == 0.0
    assert int(meta["median_ids"].max()) == -1


def test_median_depth_over_planes_is_refused() -> None:
    with pytest.raises(InputError, match="median"):
        hard_scene(4, n=10).render("MD", depth_mode="plane")


def test_normals_are_blended_shortest_axes_in_the_world_frame_that_face_the_camera() -> None:
    scene = hard_scene(5, n=60, views=2)
    exact = scene.to(torch.float64)
    axes = reference_rotations(exact.quats)
    shortest = axes[torch.arange(60), :, scene.scales.argmin(-1)]
    centers = -torch.linalg.solve(exact.viewmats[:, :3, :3], exact.viewmats[:, :3, 3:])[..., 0]
    away = ((exact.means - centers[:, None]) * shortest).sum(-1, keepdim=True) > 0
    want = torch.einsum("chwn,cnj->chwj", exact_weights(scene), torch.where(away, -shortest, shortest))
    image, _, meta = scene.render("RGB+ED", return_normals=True)
    assert torch.equal(image, scene.render("RGB+ED")[0])
    assert float((meta["normals"] - want).abs().max()) < 2e-5


def test_the_gradient_of_normals_equals_the_float64_reference() -> None:
    scene = hard_scene(6, n=60)
    normals = facing_axes(scene.means, scene.quats, scene.scales, scene.viewmats)
    flipped = (normals[0] * reference_rotations(scene.quats)[torch.arange(60), :, scene.scales.argmin(-1)]).sum(-1)
    weight = torch.randn(1, 53, 75, 3, generator=torch.Generator().manual_seed(0))
    exact = scene.to(torch.float64, requires_grad=True)
    shortest = reference_rotations(exact.quats)[torch.arange(60), :, scene.scales.argmin(-1)]
    exact.colors, exact.backgrounds = shortest * flipped.sign().double()[:, None], None
    image, _, meta = exact.reference_leaves("RGB")
    safe = (meta.margins > 2e-5)[..., None]
    (image * (weight * safe).double()).sum().backward()
    leaves = scene.to(torch.float32, requires_grad=True)
    (leaves.render("RGB", return_normals=True)[2]["normals"] * weight * safe).sum().backward()
    for name in ("means", "quats", "scales", "opacities", "viewmats"):
        assert relative_l2(getattr(leaves, name).grad, getattr(exact, name).grad) < 1e-4, name


def test_normals_of_an_orthographic_view_face_its_plane() -> None:
    scene = hard_scene(7, n=50)
    normals = facing_axes(scene.means, scene.quats, scene.scales, scene.viewmats, parallel=True)
    assert float((normals @ scene.viewmats[0, 2, :3]).max()) <= 0.0
