"""Hard cases of the surfel rasterizer, each with an error bound (see docs/stability.md)."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from tests.scenes import FORWARD_BOUND, GRADIENT_BOUND, Scene, hard_scene, one_gaussian
from tests.surfels import NAMES, RENDERED, compare_surfels, hard_surfels, loss, reference, render

pytestmark = pytest.mark.usefixtures("one_torch_thread")


def assert_within_bounds(
    scene: Scene, mode: str = "RGB+ED", *, forward: float = FORWARD_BOUND, gradient: float = GRADIENT_BOUND
) -> None:
    result = compare_surfels(scene, mode, distloss=True)
    assert result.near_jumps <= 0.02 * result.pixels
    depth = max(1.0, float(scene.viewmats[..., 2, 3].abs().max()), float(scene.means[:, 2].abs().max()))
    assert max(result.forward[n] for n in ("alphas", "normals")) <= forward, result.forward
    assert max(result.forward[n] for n in ("colors", "distortion", "median")) <= forward * depth, result.forward
    assert max(result.gradients.values()) <= gradient, result.gradients


def images_and_gradients(scene: Scene) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Return images and gradients, and check that all are finite."""
    leaves = scene.to(torch.float32, requires_grad=True)
    images, _ = render(leaves, "RGB+ED", distloss=True)
    loss(images, torch.ones(()), RENDERED).backward()
    gradients = {n: getattr(leaves, n).grad for n in NAMES if getattr(leaves, n) is not None}
    for name, value in (images | gradients).items():
        assert torch.isfinite(value).all(), name
    return {n: image.detach() for n, image in images.items()}, gradients


def test_a_disc_seen_exactly_edge_on_is_the_low_pass_filter_at_its_centre() -> None:
    half = math.sqrt(0.5)
    scene = one_gaussian(scale=(0.2, 0.3, 1.0), quat=(half, half, 0.0, 0.0), opacity=0.8)  # normal along y
    images, gradients = images_and_gradients(scene)
    v, u = torch.meshgrid(torch.arange(24) + 0.5 - 12.0, torch.arange(32) + 0.5 - 16.0, indexing="ij")
    alpha = 0.8 * torch.exp(-(u * u + v * v))
    alpha[alpha < 1 / 255] = 0.0
    assert float((images["alphas"][0, ..., 0] - alpha).abs().max()) <= 1e-6
    assert float((images["colors"][0, ..., 3] - 2.0)[alpha > 0].abs().max()) <= 1e-6
    assert float(gradients["scales"].abs().max()) == 0.0  # only the filter is seen
    assert float(gradients["means"].abs().max()) > 0.0


def test_discs_nearly_edge_on() -> None:
    scene = hard_surfels(3)
    scene.quats = torch.tensor([1.0, 1.0, 0.0, 0.0]).repeat(150, 1) + 1e-3 * scene.quats
    assert_within_bounds(scene)


@pytest.mark.parametrize("ratio", [1e3, 1e5])
def test_needles(ratio: float) -> None:
    scene = hard_scene(2, n=150)
    scene.scales = torch.tensor([0.3, 0.3 / ratio, 1.0]).repeat(150, 1)
    # An error of the centre by 1e-7 of its distance is one of 1e-7 x length / width standard deviations.
    assert_within_bounds(scene, forward=1e-3, gradient=2e-2)


@pytest.mark.parametrize("size", [0.0, 1e-6, 1e3, 1e6])
def test_discs_of_no_size_and_of_any(size: float) -> None:
    scene = hard_surfels(4)
    scene.scales = torch.full_like(scene.scales, size)
    if size <= 1e-6:
        assert_within_bounds(scene)
        assert float(images_and_gradients(scene)[1]["scales"].abs().max()) == 0.0
    else:
        images_and_gradients(scene)
        exact = reference(scene.to(torch.float64))[0]["alphas"]
        differs = (render(scene)[0]["alphas"] - exact).abs() > 1e-4  # a horizon seen from within a disc may jump
        assert float(differs.double().mean()) <= 0.02


def test_negative_scales_count_as_positive() -> None:
    scene = hard_surfels(5)
    want, gradients = images_and_gradients(scene)
    scene.scales = -scene.scales
    got, turned = images_and_gradients(scene)
    assert torch.equal(got["colors"], want["colors"])
    assert torch.equal(turned["scales"], -gradients["scales"])


def test_opacity_zero_shows_nothing_and_receives_no_gradient() -> None:
    scene = hard_surfels(6)
    scene.opacities = torch.zeros(150)
    scene.backgrounds = None
    images, gradients = images_and_gradients(scene)
    assert all(float(image.abs().max()) == 0.0 for image in images.values())
    assert all(float(g.abs().max()) == 0.0 for g in gradients.values())


@pytest.mark.parametrize("opacity", [0.99, 1.0 - 2.0**-24, 1.0])
def test_opaque_discs_are_capped_and_their_gradient_gated(opacity: float) -> None:
    scene = hard_surfels(7)
    scene.opacities = torch.full((150,), opacity)
    assert_within_bounds(scene)
    alone = one_gaussian(opacity=opacity, scale=(10.0, 10.0, 10.0))
    assert float(render(alone)[0]["alphas"].max()) == pytest.approx(0.99, abs=1e-5)


@pytest.mark.parametrize("z", [-2.0, 0.0, 0.00999])
def test_discs_behind_or_before_the_near_plane_are_not_seen(z: float) -> None:
    images, gradients = images_and_gradients(one_gaussian(mean=(0.0, 0.0, z), scale=(1.0, 1.0, 1.0)))
    assert float(images["alphas"].max()) == 0.0
    assert all(float(g.abs().max()) == 0.0 for g in gradients.values())


def test_a_disc_at_the_near_plane_is_seen() -> None:
    scene = one_gaussian(mean=(0.0, 0.0, 0.01), scale=(0.1, 0.1, 0.1))
    assert float(images_and_gradients(scene)[0]["alphas"].min()) > 0.7


def test_a_disc_that_passes_the_camera_has_no_mirror_image() -> None:
    """A floor below the camera, from before it to behind: rays above the horizon would hit it behind the camera."""
    half = math.sqrt(0.5)
    scene = one_gaussian(mean=(0.0, 0.5, 1.0), scale=(5.0, 5.0, 1.0), quat=(half, half, 0.0, 0.0))
    images, _ = images_and_gradients(scene)
    assert float(images["alphas"][0, :12].max()) == 0.0
    below = torch.arange(12, 24) + 0.5 - 12.0
    depth = 0.5 * 40.0 / below
    shown = images["alphas"][0, 12:, 16, 0] > 0.0
    assert int(shown.sum()) >= 10
    assert float(((images["colors"][0, 12:, 16, 3] - depth) / depth)[shown].abs().max()) <= 1e-5
    assert_within_bounds(scene)


def test_discs_across_the_near_plane() -> None:
    scene = hard_surfels(8)
    scene.viewmats[0, 2, 3] = 0.3  # the camera stands among them
    assert_within_bounds(scene)


def test_equal_depths_are_blended_in_order_of_index() -> None:
    scene = hard_surfels(9)
    scene.means[:, :2] = 0.02 * scene.means[:, :2]
    scene.means[:, 2] = 0.0
    scene.viewmats = torch.eye(4)[None]
    scene.viewmats[0, 2, 3] = 2.5
    assert_within_bounds(scene)


def test_a_hundred_thousand_discs_in_one_pixel() -> None:
    g = torch.Generator().manual_seed(0)
    n = 100_000
    scene = Scene(
        means=torch.rand(n, 3, generator=g) * torch.tensor([1e-3, 1e-3, 1.0]) + torch.tensor([0.0, 0.0, 2.0]),
        quats=torch.randn(n, 4, generator=g),
        scales=torch.full((n, 3), 1e-2),
        opacities=torch.full((n,), 0.0045),
        colors=torch.rand(n, 3, generator=g),
        viewmats=torch.eye(4)[None],
        Ks=torch.tensor([[[40.0, 0.0, 0.5], [0.0, 40.0, 0.5], [0.0, 0.0, 1.0]]]),
        width=2,
        height=1,
    )
    got = render(scene, "RGB+ED")[0]
    want = reference(scene.to(torch.float64), "RGB+ED")[0]
    assert float(want["alphas"].max()) > 0.99
    for name in ("colors", "alphas", "normals", "median"):
        assert float((got[name] - want[name]).abs().max()) <= 1e-4, name
    images_and_gradients(scene)


@pytest.mark.parametrize("norm", [1e-20, 1e18])
def test_quaternions_of_any_norm(norm: float) -> None:
    scene = hard_surfels(10)
    scene.quats = scene.quats / scene.quats.norm(dim=-1, keepdim=True)
    want = render(scene)[0]["colors"]
    scene.quats = scene.quats * norm
    assert float((render(scene)[0]["colors"] - want).abs().max()) <= 1e-5


def test_zero_quaternions_are_no_rotation_and_receive_no_gradient() -> None:
    scene = hard_surfels(11)
    scene.quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(150, 1)
    want = render(scene)[0]["colors"]
    scene.quats = torch.zeros(150, 4)
    images, gradients = images_and_gradients(scene)
    assert torch.equal(images["colors"][..., :3], want)
    assert float(gradients["quats"].abs().max()) == 0.0


def test_ten_kilometres_from_the_origin() -> None:
    scene = hard_surfels(12)
    away = torch.tensor([1e4, -3e3, 2e3])
    scene.means = scene.means + away
    scene.viewmats[0, :3, 3] -= scene.viewmats[0, :3, :3] @ away
    assert_within_bounds(scene, "RGB")


def test_harmonics_ten_kilometres_from_the_origin() -> None:
    scene = hard_surfels(12)
    scene.colors = torch.randn(150, 16, 3, generator=torch.Generator().manual_seed(0)) * 0.3
    away = torch.tensor([1e4, -3e3, 2e3])
    scene.means = scene.means + away
    scene.viewmats[0, :3, 3] -= scene.viewmats[0, :3, :3] @ away
    result = compare_surfels(scene, "RGB", sh_degree=3)
    assert result.near_jumps <= 0.02 * result.pixels
    assert max(result.forward[n] for n in ("colors", "alphas")) <= FORWARD_BOUND, result.forward
    assert max(result.gradients.values()) <= GRADIENT_BOUND, result.gradients


def test_a_principal_point_outside_the_image() -> None:
    scene = hard_surfels(13)
    scene.Ks[0, 0, 2], scene.Ks[0, 1, 2] = -30.0, 90.0
    assert_within_bounds(scene)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (8191, 3)])
def test_odd_images(width: int, height: int) -> None:
    scene = hard_surfels(14, n=40)
    scene.width, scene.height = width, height
    scene.Ks = torch.tensor([[[0.8 * width, 0.0, 0.5 * width], [0.0, 50.0, 0.5 * height], [0.0, 0.0, 1.0]]])
    # A pixel is magnified with the image: in 8191 px a float has 2^-11 px left, of a thin disc that is more than 1e-5.
    assert_within_bounds(scene, forward=1e-5 if width == 1 else 1e-4)


def test_no_surfels_show_the_background() -> None:
    scene = hard_surfels(15)
    for name in ("means", "quats", "scales", "opacities", "colors"):
        setattr(scene, name, getattr(scene, name)[:0])
    images, gradients = images_and_gradients(scene)
    assert scene.backgrounds is not None
    assert torch.equal(images["colors"][0, ..., :3], scene.backgrounds[0].expand(scene.height, scene.width, 3))
    assert float(images["median"].abs().max()) == 0.0
    assert float(gradients["viewmats"].abs().max()) == 0.0
