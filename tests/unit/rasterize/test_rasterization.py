"""The native rasterizer against the float64 reference, and the promises of its interface."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from splatbot.errors import InputError
from splatbot.gaussians.harmonics import rgb_to_sh
from splatbot.rasterize import rasterization
from tests.scenes import (
    FORWARD_BOUND,
    GRADIENT_BOUND,
    NAMES,
    assert_alone_equal_together,
    compare,
    hard_scene,
    one_gaussian,
    relative_l2,
)


@pytest.mark.parametrize("mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_equals_the_float64_reference(seed: int, mode: str) -> None:
    result = compare(hard_scene(seed), mode)
    scale = 5.0 if "D" in mode else 1.0  # depths reach 5 m: the bound is relative to the values
    assert result.forward <= FORWARD_BOUND * scale
    assert result.near_jumps <= 0.01 * result.pixels
    expected = {"means", "quats", "scales", "opacities", "viewmats", "Ks"}
    assert set(result.gradients) == (expected | {"colors", "backgrounds"} if "RGB" in mode else expected)
    assert max(result.gradients.values()) <= GRADIENT_BOUND, result.gradients


@pytest.mark.parametrize("limit", [0.0, 1e-6, 1e-2, 0.3])
def test_pixels_are_closed_at_the_transmittance_that_is_asked_for(limit: float) -> None:
    result = compare(hard_scene(3), "RGB+ED", transmittance_min=limit)
    assert result.forward <= FORWARD_BOUND * 5
    assert result.near_jumps <= 0.01 * result.pixels
    assert max(result.gradients.values()) <= GRADIENT_BOUND, result.gradients


@pytest.mark.parametrize("limit", [-1e-4, 0.5, float("nan")])
def test_a_transmittance_that_closes_nothing_or_everything_is_refused(limit: float) -> None:
    with pytest.raises(InputError, match="transmittance_min"):
        compare(hard_scene(3), "RGB", transmittance_min=limit)


@pytest.mark.parametrize("channels", [1, 2, 4, 5, 8, 9, 19])
@pytest.mark.parametrize("mode", ["RGB", "RGB+ED"])
def test_any_number_of_channels_equals_the_reference(channels: int, mode: str) -> None:
    scene = hard_scene(4, n=150)
    scene.colors = torch.rand(150, channels, generator=torch.Generator().manual_seed(0))
    scene.backgrounds = None
    result = compare(scene, mode)
    assert result.forward <= FORWARD_BOUND * 5
    assert max(result.gradients.values()) <= GRADIENT_BOUND, result.gradients


def test_several_views_with_colours_of_their_own_equal_the_reference() -> None:
    scene = hard_scene(5, n=200, views=3)
    scene.colors = torch.rand(3, 200, 3, generator=torch.Generator().manual_seed(0))
    result = compare(scene, "RGB+ED")
    assert result.forward <= FORWARD_BOUND * 5
    assert max(result.gradients.values()) <= GRADIENT_BOUND, result.gradients


def test_several_views_that_share_colours_equal_the_reference() -> None:
    result = compare(hard_scene(6, n=200, views=2), "RGB")
    assert result.forward <= FORWARD_BOUND
    assert max(result.gradients.values()) <= GRADIENT_BOUND, result.gradients


@pytest.mark.parametrize("mode", ["D", "RGB+ED"])
def test_plane_depth_equals_the_reference(mode: str) -> None:
    scene = hard_scene(7)
    scene.scales[:, 2] *= 0.05
    result = compare(scene, mode, depth_mode="plane")
    assert result.forward <= FORWARD_BOUND * 5
    assert max(result.gradients.values()) <= GRADIENT_BOUND, result.gradients


def test_plane_depth_works_beside_many_channels() -> None:
    scene = hard_scene(8, n=100)
    scene.colors, scene.backgrounds = torch.rand(100, 7), None
    result = compare(scene, "RGB+D", depth_mode="plane")
    assert result.forward <= FORWARD_BOUND * 5
    assert max(result.gradients.values()) <= GRADIENT_BOUND, result.gradients


@pytest.mark.parametrize(
    "wanted", [("viewmats",), ("means",), ("colors",), ("opacities",), ("scales", "quats"), ("backgrounds",), ("Ks",)]
)
def test_gradients_asked_for_alone_equal_those_asked_for_together(wanted: tuple[str, ...]) -> None:
    def gradients(names: tuple[str, ...]) -> dict[str, Tensor | None]:
        scene = hard_scene(9).to(torch.float32)
        for name in names:
            getattr(scene, name).requires_grad_()
        image, alpha, _ = scene.render("RGB+ED")
        ((image**2).sum() + alpha.sum()).backward()
        return {name: getattr(scene, name).grad for name in names_all}

    names_all = tuple(name for name in NAMES if name != "covars")
    assert_alone_equal_together(gradients, names_all, wanted)


def test_gradient_of_alpha_alone_equals_the_reference() -> None:
    exact, native = (hard_scene(10).to(dtype, requires_grad=True) for dtype in (torch.float64, torch.float32))
    _, alpha, meta = exact.reference_leaves("RGB")
    safe = (meta.margins > 2e-5)[..., None]
    (alpha * safe).sum().backward()
    (native.render("RGB")[1] * safe).sum().backward()
    for name in ("means", "quats", "scales", "opacities", "viewmats"):
        assert relative_l2(getattr(native, name).grad, getattr(exact, name).grad) <= GRADIENT_BOUND, name


def test_a_second_backward_through_the_same_render_gives_the_same_gradient() -> None:
    scene = hard_scene(11).to(torch.float32, requires_grad=True)
    image, _, _ = scene.render("RGB+ED")
    first = torch.autograd.grad(image.sum(), scene.means, retain_graph=True)[0]
    hard_scene(12).render("RGB")  # takes memory that the first render may not have given back
    assert torch.equal(first, torch.autograd.grad(image.sum(), scene.means)[0])


def test_float64_poses_are_taken_and_their_gradient_is_float64() -> None:
    scene = hard_scene(13).to(torch.float32)
    scene.viewmats = scene.viewmats.double().requires_grad_()
    scene.render("RGB")[0].sum().backward()
    assert scene.viewmats.grad is not None
    assert scene.viewmats.grad.dtype == torch.float64
    assert scene.viewmats.grad[0, 3].tolist() == [0.0, 0.0, 0.0, 0.0]


def test_degree_0_harmonics_render_as_the_colours_they_stand_for() -> None:
    scene = hard_scene(14)
    want = scene.render("RGB")[0]
    scene.colors = rgb_to_sh(scene.colors)[:, None, :]
    assert torch.allclose(scene.render("RGB", sh_degree=0)[0], want, atol=1e-6)


def test_meta_describes_the_projection() -> None:
    scene = hard_scene(15)
    _, _, meta = scene.render("RGB", packed=False)
    _, _, want = scene.reference("RGB")
    visible = meta["visible_ids"][0]
    assert 0 < len(visible) < len(scene.means)
    assert torch.equal(visible, (meta["radii"][0].amin(-1) > 0).nonzero()[:, 0])
    assert torch.allclose(meta["means2d"][0, visible].double(), want.means2d[0, visible], atol=1e-4, rtol=1e-5)
    assert torch.allclose(meta["depths"][0, visible].double(), want.depths[0, visible], rtol=1e-6)
    conics = torch.linalg.inv(want.covars2d[0, visible])
    packed = torch.stack([conics[:, 0, 0], conics[:, 0, 1], conics[:, 1, 1]], -1)
    assert torch.allclose(meta["conics"][0, visible].double(), packed, rtol=1e-4, atol=1e-6)
    opacity = scene.opacities[visible].double()
    sigmas = (2 * torch.log(255 * opacity)).sqrt().clamp(max=3.33)
    radii = (sigmas[:, None] * want.covars2d[0, visible].diagonal(dim1=-2, dim2=-1).sqrt()).ceil()
    assert (radii - meta["radii"][0, visible]).abs().max() <= 1  # a ceiling may fall on either side
    assert (radii != meta["radii"][0, visible]).double().mean() < 0.01
    assert (meta["width"], meta["height"]) == (75, 53)
    assert (meta["tile_size"], meta["tile_width"], meta["tile_height"]) == (16, 5, 4)
    assert set(meta) >= {"means2d", "radii", "depths", "conics", "opacities", "width", "height"}


def test_radius_clip_leaves_small_gaussians_out() -> None:
    scene = hard_scene(16)
    radii = scene.render("RGB", packed=False)[2]["radii"][0]
    clipped = scene.render("RGB", packed=False, radius_clip=4.0)[2]["radii"][0]
    assert torch.equal(clipped.amax(-1) > 0, radii.amax(-1) > 4)


def test_near_and_far_planes_are_inclusive() -> None:
    scene = one_gaussian(mean=(0.0, 0.0, 2.0))
    for planes, seen in (((2.0, 10.0), True), ((0.01, 2.0), True), ((2.001, 10.0), False), ((0.01, 1.999), False)):
        alpha = scene.render("RGB", near_plane=planes[0], far_plane=planes[1])[1]
        assert bool(alpha.max() > 0.1) is seen, planes


Change = dict[str, Any]


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"means": torch.zeros(3, 2)}, "means"),
        ({"means": torch.zeros(400, 3, dtype=torch.float64)}, "means"),
        ({"quats": torch.zeros(399, 4)}, "quats"),
        ({"scales": torch.zeros(400)}, "scales"),
        ({"opacities": torch.zeros(400, 1)}, "opacities"),
        ({"colors": torch.zeros(3, 400)}, "colors"),
        ({"colors": None}, "colors"),
        ({"viewmats": torch.eye(4)}, "viewmats"),
        ({"viewmats": torch.full((1, 4, 4), float("nan"))}, "viewmats"),
        ({"Ks": torch.zeros(1, 3, 3)}, "Ks"),
        ({"Ks": torch.eye(3).repeat(2, 1, 1)}, "Ks"),
        ({"backgrounds": torch.zeros(1, 4)}, "backgrounds"),
        ({"backgrounds": torch.full((1, 3), float("inf"))}, "backgrounds"),
        ({"width": 0}, "width"),
        ({"height": 2.5}, "height"),
        ({"render_mode": "depth"}, "render_mode"),
        ({"rasterize_mode": "smooth"}, "rasterize_mode"),
        ({"camera_model": "lidar"}, "camera_model"),
        ({"covars": torch.zeros(400, 3)}, "covars"),
        ({"covars": torch.zeros(400, 3, 3), "depth_mode": "plane", "render_mode": "D"}, "covars"),
        ({"quats": None}, "quats"),
        ({"sparse_grad": True, "packed": False}, "sparse_grad"),
        ({"sh_degree": 0}, "colors"),
        ({"sh_degree": 5, "colors": torch.zeros(400, 25, 3)}, "sh_degree"),
        ({"sh_degree": 2, "colors": torch.zeros(400, 4, 3)}, "colors"),
        ({"masks": torch.ones(1, 4, 4, dtype=torch.bool)}, "masks"),
        ({"masks": torch.ones(1, 4, 5)}, "masks"),
        ({"tile_size": 0}, "tile_size"),
        ({"backend": "cuda"}, "backend"),
        ({"distributed": True}, "distributed"),
        ({"rasterise_mode": "classic"}, "rasterise_mode"),
        ({"opacities": torch.zeros(1, 400)}, "opacities"),
        ({"with_eval3d": True}, "with_eval3d"),
        ({"depth_mode": "median"}, "depth_mode"),
        ({"means": [[0.0, 0.0, 0.0]]}, "means"),
    ],
)
def test_unusable_arguments_are_named(change: Change, field: str) -> None:
    arguments = {**vars(hard_scene(17)), **change}
    with pytest.raises(InputError) as caught:
        rasterization(**arguments)
    assert caught.value.field == field


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "colors"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_values_that_are_not_finite_are_rejected_with_their_row(name: str, value: float) -> None:
    scene = hard_scene(18, n=2500)  # more than one block of the projection
    row = 2047
    getattr(scene, name)[row] = value
    with pytest.raises(InputError, match=f"row {row} ") as caught:
        scene.render("RGB")
    assert caught.value.field == name


def test_inputs_are_left_unchanged() -> None:
    scene = hard_scene(19)
    before = scene.to(torch.float32)
    scene.render("RGB+ED")
    for name in NAMES:
        if name != "covars":
            assert torch.equal(getattr(scene, name), getattr(before, name))


def test_strided_inputs_render_as_contiguous_ones() -> None:
    scene = hard_scene(20)
    want = scene.render("RGB")[0]
    scene.means = torch.stack([scene.means, scene.means], -1)[..., 0]
    scene.colors = scene.colors.T.contiguous().T
    assert torch.equal(scene.render("RGB")[0], want)
