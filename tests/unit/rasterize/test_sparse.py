"""Parts of an image equal the whole bit for bit; the front Gaussian is the one that the reference blends first."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from splatbot.errors import InputError
from splatbot.rasterize import (
    Gaussians,
    Viewpoints,
    contributing_gaussians,
    rasterize_pixels,
    rasterize_tiles,
    visible_gaussians,
)
from tests.scenes import NAMES, Scene, hard_scene
from tests.unit.rasterize.test_median import exact_weights

PIXELS = torch.tensor([[0, 0], [74, 52], [31, 15], [32, 16], [40, 20], [41, 20], [40, 20], [5, 50]])


def render_pixels(scene: Scene, pixels: Tensor = PIXELS, **options: Any) -> tuple[Tensor, Tensor, Any]:
    return rasterize_pixels(scene.gaussians(), scene.viewpoints, pixels, **options)


@pytest.mark.parametrize("mode", ["RGB", "RGB+ED", "D", "RGB+MD"])
def test_pixels_are_bit_for_bit_those_of_the_whole_picture(mode: str) -> None:
    scene = hard_scene(0, views=2)
    image, alpha, _ = scene.render(mode)
    colors, alphas, _ = render_pixels(scene, render_mode=mode)
    x, y = PIXELS.unbind(-1)
    assert torch.equal(colors, image[:, y, x])
    assert torch.equal(alphas, alpha[:, y, x])


def test_each_view_may_have_pixels_of_its_own() -> None:
    scene = hard_scene(1, views=2)
    own = torch.stack([PIXELS, PIXELS.flip(0)])
    colors, _, _ = render_pixels(scene, own, camera_model="fisheye")
    image = scene.render("RGB", camera_model="fisheye")[0]
    for c in range(2):
        assert torch.equal(colors[c], image[c, own[c, :, 1], own[c, :, 0]])


def test_gradients_of_pixels_are_those_of_the_whole_picture() -> None:
    def gradients(sparse: bool) -> dict[str, Tensor | None]:
        leaves = hard_scene(2).to(torch.float32, requires_grad=True)
        if sparse:
            colors, alphas, _ = render_pixels(leaves, render_mode="RGB+ED")
        else:
            image, alpha, _ = leaves.render("RGB+ED")
            x, y = PIXELS.unbind(-1)
            colors, alphas = image[:, y, x], alpha[:, y, x]
        ((colors**2).sum() + alphas.sum()).backward()
        return {name: getattr(leaves, name).grad for name in NAMES if getattr(leaves, name) is not None}

    want, got = gradients(False), gradients(True)
    for name, value in want.items():
        assert value is not None
        assert torch.allclose(got[name], value, rtol=1e-5, atol=1e-7), name  # type: ignore[arg-type]


@pytest.mark.parametrize("size", [16, 10])
def test_tiles_are_bit_for_bit_those_of_the_whole_picture(size: int) -> None:
    scene = hard_scene(3)
    columns, rows = -(-75 // size), -(-53 // size)
    tiles = torch.tensor([[0, 0], [columns - 1, rows - 1], [2, 1]])
    colors, alphas, _ = rasterize_tiles(scene.gaussians(), scene.viewpoints, tiles, size)
    image, alpha, _ = scene.render("RGB")
    for i, (column, row) in enumerate(tiles.tolist()):
        part = slice(row * size, (row + 1) * size), slice(column * size, (column + 1) * size)
        want = image[0][part]
        assert torch.equal(colors[0, i, : want.shape[0], : want.shape[1]], want)
        assert torch.equal(alphas[0, i, : want.shape[0], : want.shape[1]], alpha[0][part])
        assert float(colors[0, i, want.shape[0] :].abs().sum() + colors[0, i, :, want.shape[1] :].abs().sum()) == 0.0


@pytest.mark.parametrize("k", [1, 3, 200])
def test_contributors_are_the_front_gaussians_with_their_blend_weights(k: int) -> None:
    scene = hard_scene(4, n=120, views=2)
    weights = exact_weights(scene)
    exact = scene.to(torch.float64)
    found = contributing_gaussians(scene.gaussians(), scene.viewpoints, PIXELS, k=k)
    assert found.ids.shape == (2, len(PIXELS), k)
    for c in range(2):
        depth = exact.means @ exact.viewmats[c, 2, :3] + exact.viewmats[c, 2, 3]
        order = torch.argsort(depth.float(), stable=True)
        for p, (x, y) in enumerate(PIXELS.tolist()):
            w = weights[c, y, x]
            front = order[w[order] > 0][:k]
            ids = found.ids[c, p][: len(front)]
            assert torch.equal(ids, front)
            assert torch.allclose(found.weights[c, p, : len(front)].double(), w[front], atol=1e-5)
            assert bool((found.ids[c, p, len(front) :] == -1).all())
            assert float(found.weights[c, p, len(front) :].abs().sum()) == 0.0


def test_gaussians_behind_a_closed_pixel_do_not_contribute() -> None:
    n = 50  # opacity 0.95 each: the transmittance is 1.25e-4 after three and would fall below 1e-4 at the fourth
    gaussians = Gaussians(
        torch.stack([torch.zeros(n), torch.zeros(n), torch.linspace(1.0, 2.0, n)], dim=1),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1),
        torch.full((n, 3), 0.2),
        torch.full((n,), 0.95),
        torch.ones(n, 3),
    )
    K = torch.tensor([[[60.0, 0.0, 16.5], [0.0, 60.0, 16.5], [0.0, 0.0, 1.0]]])
    found = contributing_gaussians(gaussians, Viewpoints(torch.eye(4)[None], K, 33, 33), torch.tensor([[16, 16]]), k=20)
    assert found.ids[0, 0].tolist() == [0, 1, 2] + 17 * [-1]
    assert found.weights[0, 0, :3].tolist() == pytest.approx([0.95, 0.95 * 0.05, 0.95 * 0.05**2], rel=1e-3)


def test_the_weights_of_all_contributors_sum_to_alpha() -> None:
    scene = hard_scene(5)
    found = contributing_gaussians(scene.gaussians(), scene.viewpoints, PIXELS, k=400)
    alpha = scene.render("RGB")[1][:, PIXELS[:, 1], PIXELS[:, 0], 0]
    assert torch.allclose(found.weights.sum(-1), alpha, atol=1e-5)


@pytest.mark.parametrize(
    "options", [{}, {"camera_model": "ortho"}, {"camera_model": "fisheye", "with_ut": True}, {"radius_clip": 3.0}]
)
def test_visible_are_those_that_a_render_projects(options: dict[str, Any]) -> None:
    scene = hard_scene(6, views=2)
    want = scene.render("RGB", **options)[2]["visibility"]
    got = visible_gaussians(scene.gaussians(), scene.viewpoints, **options)
    assert torch.equal(got, want)
    assert 0 < int(got.sum()) < got.numel()


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"pixels": torch.tensor([[75, 0]])}, "pixels"),
        ({"pixels": torch.tensor([[0.0, 0.0]])}, "pixels"),
        ({"pixels": torch.zeros(3, 4, 2, dtype=torch.int64)}, "pixels"),
        ({"masks": torch.ones(1)}, "masks"),
    ],
)
def test_pixels_that_make_no_sense_are_refused(change: dict[str, Any], field: str) -> None:
    with pytest.raises(InputError) as caught:
        render_pixels(hard_scene(7, n=10), **change)
    assert caught.value.field == field


def test_batch_dimensions_are_refused() -> None:
    scene = hard_scene(7, n=10)
    scene.viewmats = torch.eye(4)[None, None]
    with pytest.raises(InputError) as caught:
        render_pixels(scene)
    assert caught.value.field == "viewmats"


def test_a_non_finite_input_is_named_by_visibility_too() -> None:
    scene = hard_scene(8, n=10)
    scene.scales[3, 1] = torch.nan
    with pytest.raises(InputError, match="row 3"):
        visible_gaussians(scene.gaussians(), scene.viewpoints)
