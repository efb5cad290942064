"""The native surfel rasterizer against the float64 reference, analytic planes, and the promises of its interface."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

import splatbot
from splatbot.errors import InputError
from splatbot.gaussians.harmonics import rgb_to_sh
from splatbot.rasterize import rasterization_2dgs
from splatbot.rasterize.native import native
from tests.scenes import FORWARD_BOUND, GRADIENT_BOUND, Scene, assert_alone_equal_together, one_gaussian, relative_l2
from tests.surfels import NAMES, RENDERED, arguments, compare_surfels, hard_surfels, loss, reference, render, wall

pytestmark = pytest.mark.usefixtures("one_torch_thread", "default_kernels")


def assert_equal(scene: Scene, mode: str, **options: Any) -> None:
    result = compare_surfels(scene, mode, **options)
    assert result.near_jumps <= 0.01 * result.pixels
    for name in set(RENDERED) & set(result.forward):
        scale = 5.0 if name in ("distortion", "median") or (name == "colors" and "D" in mode) else 1.0  # depths: 5 m
        assert result.forward[name] <= FORWARD_BOUND * scale, result.forward
    assert max(result.gradients.values()) <= GRADIENT_BOUND, result.gradients


@pytest.mark.parametrize("mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
@pytest.mark.parametrize("distloss", [False, True])
def test_equals_the_float64_reference(mode: str, distloss: bool) -> None:
    assert_equal(hard_surfels(int(distloss)), mode, distloss=distloss)


def test_a_crowd_of_discs_equals_the_float64_reference() -> None:
    assert_equal(hard_surfels(2, n=600), "RGB+ED", distloss=True)


@pytest.mark.parametrize("image", RENDERED)
def test_the_gradient_of_each_image_alone_equals_the_reference(image: str) -> None:
    result = compare_surfels(hard_surfels(3), "RGB+ED", of=(image,), distloss=True)
    if image == "median":  # where a ray hits a disc's plane does not depend on the disc's size
        result.gradients.pop("scales")
    assert max(result.gradients.values()) <= GRADIENT_BOUND, result.gradients


@pytest.mark.parametrize(
    ("channels", "mode"), [(1, "RGB"), (2, "RGB+ED"), (5, "RGB"), (8, "RGB+D"), (9, "RGB"), (19, "RGB+ED")]
)
def test_any_number_of_channels_equals_the_reference(channels: int, mode: str) -> None:
    scene = hard_surfels(4, n=80)
    scene.colors = torch.rand(80, channels, generator=torch.Generator().manual_seed(0))
    scene.backgrounds = torch.rand(1, channels, generator=torch.Generator().manual_seed(1))
    assert_equal(scene, mode)


def test_several_views_with_colours_of_their_own_equal_the_reference() -> None:
    scene = hard_surfels(5, n=60, views=3)
    scene.colors = torch.rand(3, 60, 3, generator=torch.Generator().manual_seed(0))
    assert_equal(scene, "RGB+ED", distloss=True)


def test_several_views_that_share_colours_equal_the_reference() -> None:
    assert_equal(hard_surfels(6, n=80, views=2), "RGB+D")


@pytest.mark.parametrize("isa", native().available_isas())
def test_every_instruction_set_equals_the_reference(isa: str) -> None:
    native().set_isa(isa)
    assert_equal(hard_surfels(7), "RGB+ED", distloss=True)


@pytest.mark.parametrize("depth_mode", ["expected", "median"])
def test_surf_normals_equal_those_of_the_reference_depth(depth_mode: Any) -> None:
    scene = hard_surfels(8)
    scene.opacities = 0.5 + 0.5 * scene.opacities
    exact = scene.to(torch.float64, requires_grad=True)
    want, meta = reference(exact, "RGB+ED", depth_mode=depth_mode)
    single = scene.to(torch.float32, requires_grad=True)
    got, _ = render(single, "RGB+ED", depth_mode=depth_mode)
    safe = meta.margins > 2e-5
    near = torch.nn.functional.max_pool2d((~safe).float()[:, None], 3, stride=1, padding=1)[:, 0] > 0
    difference = (want["surf_normals"] - got["surf_normals"]).abs() * ~near[..., None]
    assert float(difference.detach().max()) <= 1e-4
    loss(want, ~near[..., None], ["surf_normals"]).backward()
    loss(got, ~near[..., None], ["surf_normals"]).backward()
    for name in ("means", "quats"):  # differences of neighbouring depths: two digits fewer than depth itself
        assert relative_l2(getattr(single, name).grad, getattr(exact, name).grad) <= 1e-2, name


@pytest.mark.parametrize(("yaw", "pitch"), [(0.0, 0.0), (0.6, 0.0), (-0.4, 0.7), (1.0, -0.2)])
def test_a_wall_of_discs_has_the_depth_and_the_normal_of_its_plane(yaw: float, pitch: float) -> None:
    cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    about_y = torch.tensor([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]], dtype=torch.float64)
    about_x = torch.tensor([[1.0, 0.0, 0.0], [0.0, cp, -sp], [0.0, sp, cp]], dtype=torch.float64)
    scene = wall(about_y @ about_x)
    images, _ = render(scene, "RGB+ED", distloss=True)
    normal = (about_y @ about_x)[:, 2]
    normal = normal * -torch.sign(normal[2])
    v, u = torch.meshgrid(torch.arange(36) + 0.5, torch.arange(48) + 0.5, indexing="ij")
    rays = torch.stack([(u - 24.0) / 40.0, (v - 18.0) / 40.0, torch.ones_like(u)], -1).double()
    plane = 2.0 * normal[2] / (rays @ normal)
    # Discs seen at a grazing angle are thinner than a pixel: there, the low-pass filter shows their centres' depth.
    steep = (rays @ normal).abs() / rays.norm(dim=-1) > 0.4
    full = ((images["alphas"][0, ..., 0] > 0.9) & steep & (plane > 0.0))[..., None]
    assert float(full.double().mean()) > 0.25
    for depth in (images["colors"][..., 3:], images["median"]):
        assert float(((depth[0] - plane[..., None]).abs() / plane[..., None] * full).max()) <= 1e-5
    facing = images["normals"] / images["alphas"].clamp_min(1e-6)
    assert float(((facing[0] - normal).abs() * full).max()) <= 1e-5
    inside = torch.nn.functional.pad(full[1:-1, 1:-1] & full[2:, 1:-1] & full[:-2, 1:-1], (0, 0, 1, 1, 1, 1))
    inside &= torch.nn.functional.pad(full[1:-1, 2:] & full[1:-1, :-2], (0, 0, 1, 1, 1, 1))
    assert float(((images["surf_normals"][0] - normal).abs() * inside).max()) <= 1e-4
    assert float((images["distortion"][0] * full).abs().max()) <= 1e-5


def test_two_sheets_have_the_distortion_of_their_distance() -> None:
    scene = one_gaussian(scale=(1.0, 1.0, 1.0), opacity=0.5)
    scene.means = torch.tensor([[0.0, 0.0, 3.0], [0.0, 0.0, 2.0]])
    for name in ("quats", "scales", "opacities", "colors"):
        setattr(scene, name, getattr(scene, name).repeat(2, *[1] * (getattr(scene, name).ndim - 1)))
    images, _ = render(scene, "RGB+ED", distloss=True)
    d2 = 0.5 / 40.0**2  # squared slope of the ray through the pixel next to the centre
    front, back = (0.5 * math.exp(-0.5 * d2 * z * z) for z in (2.0, 3.0))
    assert float(images["distortion"][0, 12, 16, 0]) == pytest.approx(2.0 * front * (1.0 - front) * back, rel=1e-5)
    assert float(images["median"][0, 12, 16, 0]) == pytest.approx(
        3.0, rel=1e-6
    )  # 0.5 and a little are left by the first


def test_the_number_of_threads_changes_no_bit() -> None:
    scene = hard_surfels(9, n=6000)

    def everything() -> dict[str, Tensor]:
        leaves = scene.to(torch.float32, requires_grad=True)
        images, _ = render(leaves, "RGB+ED", distloss=True)
        loss(images, torch.ones(()), RENDERED).backward()
        return {n: image.detach() for n, image in images.items()} | {n: getattr(leaves, n).grad for n in NAMES}

    native().set_num_threads(1)
    want = everything()
    for threads in (1, 2, 3):
        native().set_num_threads(threads)
        got = everything()
        for name, value in want.items():
            assert torch.equal(got[name], value), (threads, name)


@pytest.mark.parametrize(
    "wanted", [("viewmats",), ("Ks",), ("means",), ("colors",), ("opacities",), ("scales", "quats"), ("backgrounds",)]
)
def test_gradients_asked_for_alone_equal_those_asked_for_together(wanted: tuple[str, ...]) -> None:
    def gradients(names: tuple[str, ...]) -> dict[str, Tensor | None]:
        scene = hard_surfels(10).to(torch.float32)
        for name in names:
            getattr(scene, name).requires_grad_()
        loss(render(scene, "RGB+ED", distloss=True)[0], torch.ones(()), RENDERED).backward()
        return {name: getattr(scene, name).grad for name in NAMES}

    assert_alone_equal_together(gradients, NAMES, wanted)


def test_gradient_2dgs_is_that_of_moving_the_image_of_a_surfel() -> None:
    scene = one_gaussian(mean=(0.1, -0.05, 2.0), scale=(0.1, 0.2, 1.0)).to(torch.float32, requires_grad=True)
    images, meta = render(scene)
    meta["gradient_2dgs"].retain_grad()
    loss(images, torch.ones(()), ("colors",)).backward()
    # A disc parallel to the image plane keeps its shape as it moves: d loss / d mean = focal / z times it.
    assert scene.means.grad is not None
    assert meta["gradient_2dgs"].grad.shape == (1, 1, 2)
    assert (meta["gradient_2dgs"].grad[0, 0] * 40.0 / 2.0).tolist() == pytest.approx(
        scene.means.grad[0, :2].tolist(), rel=1e-5
    )


def test_meta_describes_the_projections() -> None:
    scene = hard_surfels(11, views=2)
    _, meta = render(scene)
    n, exact = len(scene.means), reference(scene.to(torch.float64))[1]
    assert meta["means2d"].shape == (2, n, 2)
    assert meta["normals"].shape == (2, n, 3)
    seen = torch.zeros(2, n, dtype=torch.bool)
    for i, ids in enumerate(meta["visible_ids"]):
        seen[i, ids] = True
    assert torch.equal(seen, (meta["radii"] > 0).all(-1))
    assert torch.equal(seen, meta["tiles_per_gauss"] > 0)
    assert 0 < int(seen.sum()) < 2 * n
    assert float((meta["means2d"] - exact.means2d)[seen].abs().max()) < 1e-3
    assert float((meta["depths"] - exact.depths)[seen].abs().max()) < 1e-5
    assert float((meta["normals"][seen].norm(dim=-1) - 1).abs().max()) < 1e-6
    assert set(meta) >= {"gradient_2dgs", "opacities", "tile_size", "tile_width", "tile_height", "n_cameras", "width"}


def test_radii_bound_what_a_surfel_touches() -> None:
    for seed in range(20):
        scene = hard_surfels(seed, n=10)
        for i in range(10):
            alone = scene.alone(i)
            images, meta = render(alone)
            y, x = torch.nonzero(images["alphas"][0, ..., 0] > 0, as_tuple=True)
            if len(x) == 0:
                continue
            exact = reference(alone.to(torch.float64))[0]["alphas"][0, ..., 0]
            assert torch.equal(exact > 1.0001 / 255.0, (images["alphas"][0, ..., 0] > 0) & (exact > 1.0001 / 255.0))
            centre, radius = meta["means2d"][0, 0], meta["radii"][0, 0]
            assert float((x + 0.5 - centre[0]).abs().max()) <= int(radius[0])
            assert float((y + 0.5 - centre[1]).abs().max()) <= int(radius[1])


def test_sh_degree_zero_is_the_colour_of_its_coefficients() -> None:
    scene = hard_surfels(12)
    want, _ = render(scene)
    scene.colors = rgb_to_sh(scene.colors)[:, None]
    got, _ = render(scene, sh_degree=0)
    assert float((got["colors"] - want["colors"]).abs().max()) < 1e-5


@pytest.mark.parametrize("degree", range(5))
def test_harmonics_of_every_degree_equal_the_reference(degree: int) -> None:
    scene = hard_surfels(19, views=2)
    scene.colors = torch.randn(150, 25, 3, generator=torch.Generator().manual_seed(0)) * 0.3
    assert_equal(scene, "RGB+ED", sh_degree=degree)


def test_harmonics_of_each_view_equal_the_reference() -> None:
    scene = hard_surfels(21, n=60, views=3)
    scene.colors = torch.randn(3, 60, 16, 3, generator=torch.Generator().manual_seed(0)) * 0.3
    assert_equal(scene, "RGB", sh_degree=3)


def test_coefficients_beyond_the_degree_in_use_receive_no_gradient() -> None:
    scene = hard_surfels(22)
    scene.colors = torch.randn(150, 16, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    render(scene, sh_degree=1)[0]["colors"].sum().backward()
    assert scene.colors.grad is not None
    assert float(scene.colors.grad[:, :4].abs().max()) > 0.0
    assert float(scene.colors.grad[:, 4:].abs().max()) == 0.0


def test_batch_dimensions_are_refused() -> None:
    given = arguments(hard_surfels(20))
    batched: dict[str, Any] = {n: t[None] if isinstance(t, Tensor) else t for n, t in given.items()}
    with pytest.raises(InputError, match="batch"):
        rasterization_2dgs(**batched)


def test_options_without_effect_are_taken_and_have_none() -> None:
    scene = hard_surfels(13)
    want, _ = render(scene)
    got, _ = render(scene, packed=True, tile_size=8, eps2d=1.0)
    assert torch.equal(got["colors"], want["colors"])


def test_radius_clip_leaves_small_surfels_out() -> None:
    scene = one_gaussian(scale=(0.001, 0.001, 0.001))
    assert float(render(scene)[0]["alphas"].max()) > 0.0
    assert float(render(scene, radius_clip=4.0)[0]["alphas"].max()) == 0.0


def test_distortion_and_surf_normals_are_none_unless_asked_for() -> None:
    images = rasterization_2dgs(**arguments(hard_surfels(14)))
    assert images[3] is None
    assert images[4] is None


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"render_mode": "RGBD"}, "render_mode"),
        ({"absgrad": True}, "absgrad"),
        ({"sparse_grad": True}, "sparse_grad"),
        ({"depth_mode": "mean"}, "depth_mode"),
        ({"sh_degree": 5}, "colors"),
    ],
)
def test_what_is_not_supported_is_refused_by_name(options: dict[str, Any], field: str) -> None:
    with pytest.raises(InputError, match=field):
        render(hard_surfels(15), **options)


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "colors"])
def test_a_value_that_is_not_finite_is_named_with_its_row(name: str) -> None:
    scene = hard_surfels(16)
    getattr(scene, name)[123] = math.nan
    with pytest.raises(InputError, match=rf"{name}.*row 123"):
        render(scene)


def test_colours_are_needed_to_render_them() -> None:
    given = arguments(hard_surfels(17)) | {"colors": None}
    with pytest.raises(InputError, match="colors"):
        rasterization_2dgs(**given)
    assert rasterization_2dgs(**given, render_mode="ED")[0].shape[-1] == 1


def test_it_is_a_public_name() -> None:
    assert splatbot.rasterization_2dgs is rasterization_2dgs
