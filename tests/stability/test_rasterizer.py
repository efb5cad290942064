"""Hard cases of the rasterizer, each with an error bound against the float64 reference (see docs/stability.md)."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from splatbot.errors import InputError
from tests.scenes import FORWARD_BOUND, GRADIENT_BOUND, NAMES, Scene, compare, hard_scene, one_gaussian, pinhole


def assert_within_bounds(
    scene: Scene, mode: str = "RGB", *, forward: float = FORWARD_BOUND, gradient: float = GRADIENT_BOUND
) -> None:
    result = compare(scene, mode)
    assert result.near_jumps <= 0.02 * result.pixels
    assert result.forward <= forward
    assert max(result.gradients.values()) <= gradient, result.gradients


def gradients(scene: Scene, mode: str = "RGB+ED") -> dict[str, Tensor]:
    leaves = scene.to(torch.float32, requires_grad=True)
    image, alpha, _ = leaves.render(mode)
    (image.sum() + alpha.sum()).backward()
    return {name: getattr(leaves, name).grad for name in NAMES if getattr(leaves, name) is not None}


@pytest.mark.parametrize("sigma_px", [0.1, 1e-2, 1e-4])
def test_gaussians_smaller_than_a_pixel(sigma_px: float) -> None:
    scene = hard_scene(1)
    scene.scales = torch.full_like(scene.scales, sigma_px * 2.5 / 60.0) * (
        0.5 + 0.5 * torch.rand(400, 3, generator=torch.Generator().manual_seed(0))
    )
    assert_within_bounds(scene)


@pytest.mark.parametrize("ratio", [1e3, 1e5])
def test_needles(ratio: float) -> None:
    scene = hard_scene(2)
    scene.scales = torch.tensor([0.3, 0.3 / ratio, 0.3 / ratio]).repeat(400, 1)
    assert_within_bounds(scene)


def test_discs_seen_edge_on() -> None:
    scene = hard_scene(3)
    scene.scales = torch.tensor([0.2, 0.2, 2e-6]).repeat(400, 1)
    scene.quats = torch.tensor([1.0, 1.0, 0.0, 0.0]).repeat(400, 1) + 1e-3 * scene.quats
    assert_within_bounds(scene)


def test_opacity_zero_shows_nothing_and_receives_no_gradient() -> None:
    scene = hard_scene(4)
    scene.backgrounds = None
    scene.opacities = torch.zeros(400)
    image, alpha, meta = scene.render("RGB+ED")
    assert float(image.abs().max()) == 0.0
    assert float(alpha.max()) == 0.0
    assert len(meta["visible_ids"][0]) == 0
    assert all(float(g.abs().max()) == 0.0 for g in gradients(scene).values())


@pytest.mark.parametrize("opacity", [0.99, 0.999, 1.0 - 2.0**-24, 1.0])
def test_opaque_gaussians_are_capped_and_their_gradient_gated(opacity: float) -> None:
    scene = hard_scene(5)
    scene.opacities = torch.full((400,), opacity)
    assert_within_bounds(scene)
    alone = one_gaussian(opacity=opacity, scale=(10.0, 10.0, 10.0))
    assert float(alone.render("RGB")[1].max()) == pytest.approx(0.99, abs=1e-5)


def test_gaussians_behind_and_at_the_near_plane() -> None:
    scene = hard_scene(6)
    depth = torch.cat([torch.linspace(-3.0, 0.0, 200), 0.01 + torch.tensor([-1e-3, -1e-6, 1e-6, 1e-3]).repeat(50)])
    scene.means[:200, 2] = torch.linspace(-8.0, -2.6, 200)
    scene.viewmats = torch.eye(4)[None].clone()
    scene.means[:, 2] += 2.5
    scene.means[:200, 2] = depth[:200]
    scene.means[200:250, :2] *= 1e-3
    scene.means[200:250, 2] = depth[200:250]
    scene.scales[200:250] = 1e-4
    result = compare(scene, "RGB")
    assert result.forward <= FORWARD_BOUND
    assert max(result.gradients.values()) <= GRADIENT_BOUND, result.gradients
    got = gradients(scene, "RGB")
    assert float(got["means"][:200].abs().max()) == 0.0


def test_a_gaussian_on_the_near_plane_before_a_short_lens_renders_finite() -> None:
    scene = one_gaussian(mean=(0.0, 0.0, 0.01), scale=(1.0, 1.0, 1.0))
    scene.Ks = pinhole(scene.width, scene.height, focal=1.0)
    image, alpha, _ = scene.render("RGB+ED")
    assert bool(torch.isfinite(image).all())
    assert 0.75 < float(alpha.min()) < float(alpha.max()) <= 0.8
    assert all(bool(torch.isfinite(g).all()) for g in gradients(scene).values())
    assert_within_bounds(scene)


def test_off_screen_gaussians_cost_nothing_and_receive_no_gradient() -> None:
    scene = hard_scene(7)
    scene.backgrounds = None
    scene.means[:, 0] += 40.0
    image, _, meta = scene.render("RGB+ED")
    assert float(image.abs().max()) == 0.0
    assert meta["n_isects"] == [0]
    assert all(float(g.abs().max()) == 0.0 for g in gradients(scene).values())


def test_gaussians_at_the_edge_of_the_field_of_view() -> None:
    scene = hard_scene(8)
    scene.means[:, 0] = torch.linspace(-4.0, 4.0, 400)  # from within, over the image's edge, past the clamped slope
    scene.means[:, 2] = -1.0
    scene.scales = 0.3 + 0.3 * torch.rand(400, 3, generator=torch.Generator().manual_seed(0))
    assert_within_bounds(scene)


@pytest.mark.parametrize("norm", [1e-20, 1e-6, 1e6, 1e20])
def test_quaternions_of_any_norm_are_directions(norm: float) -> None:
    scene = hard_scene(9)
    unit = torch.nn.functional.normalize(scene.quats, dim=-1)
    scene.quats = unit
    want = scene.render("RGB")[0]
    scene.quats = unit * norm
    assert float((scene.render("RGB")[0] - want).abs().max()) <= FORWARD_BOUND
    assert_within_bounds(scene)


def test_a_zero_quaternion_counts_as_no_rotation_and_receives_no_gradient() -> None:
    scene = hard_scene(10)
    scene.quats[::3] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    want = scene.render("RGB")[0]
    scene.quats[::3] = 0.0
    assert torch.equal(scene.render("RGB")[0], want)
    got = gradients(scene)
    assert float(got["quats"][::3].abs().max()) == 0.0
    assert all(bool(torch.isfinite(g).all()) for g in got.values())
    assert_within_bounds(scene)


@pytest.mark.parametrize("mode", ["RGB", "ED", "RGB+ED"])
def test_an_empty_scene_shows_the_background(mode: str) -> None:
    scene = hard_scene(11, n=0)
    image, alpha, meta = scene.render(mode)
    assert float(alpha.abs().max()) == 0.0
    if "RGB" in mode:
        assert scene.backgrounds is not None
        assert torch.equal(image[..., :3], scene.backgrounds[:, None, None].expand(1, 53, 75, 3))
    if "ED" in mode:
        assert float(image[..., -1].abs().max()) == 0.0
    assert meta["means2d"].shape == (0, 2)
    got = gradients(scene, mode)
    assert got["means"].shape == (0, 3)
    assert float(got["viewmats"].abs().max()) == 0.0


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (33, 17), (32, 16)])
def test_images_of_any_size(size: tuple[int, int]) -> None:
    scene = hard_scene(12, n=60)
    scene.width, scene.height = size
    scene.Ks = pinhole(*size, focal=60.0)
    assert_within_bounds(scene)


def test_an_image_of_8191_pixels() -> None:
    scene = hard_scene(12, n=60)
    scene.width, scene.height = 8191, 3
    scene.Ks = pinhole(8191, 3, focal=60.0)
    scene.means[:, 0] = torch.linspace(-150.0, 150.0, 60)
    # A float32 pixel coordinate of 8191 is known to 5e-4 px; image and gradients can be no better.
    assert_within_bounds(scene, forward=1e-3, gradient=1e-2)


def test_a_hundred_thousand_gaussians_in_one_pixel() -> None:
    n = 100_000
    g = torch.Generator().manual_seed(0)
    scene = one_gaussian(size=(3, 3))
    scene.means = torch.cat([0.001 * torch.randn(n, 2, generator=g), 1.0 + torch.rand(n, 1, generator=g)], 1)
    scene.quats = torch.randn(n, 4, generator=g)
    scene.scales = 1.0 + torch.rand(n, 3, generator=g)
    scene.opacities = 0.006 + 0.004 * torch.rand(n, generator=g)
    scene.colors = torch.rand(n, 3, generator=g)
    result = compare(scene, "RGB+D")
    assert result.near_jumps <= 2
    assert result.forward <= 2e-5  # 1000 Gaussians are blended until the pixel closes
    # Focal lengths and the principal point get the difference of sums that nearly cancel.
    assert result.gradients.pop("Ks") <= 1e-3
    assert max(result.gradients.values()) <= 2e-4, result.gradients


def test_gaussians_of_one_depth_are_blended_in_the_order_of_their_indices() -> None:
    scene = one_gaussian(scale=(1.0, 1.0, 1.0), opacity=0.9)
    n = 3000
    scene.means = scene.means.repeat(n, 1)
    scene.quats, scene.scales = scene.quats.repeat(n, 1), scene.scales.repeat(n, 1)
    scene.opacities = torch.full((n,), 0.9)
    scene.colors = torch.zeros(n, 3)
    scene.colors[0, 0] = scene.colors[1, 1] = scene.colors[2, 2] = 1.0
    image, _, _ = scene.render("RGB")
    center = image[0, 12, 16].double()
    alpha = float(center[0])
    want = torch.tensor([alpha, alpha * (1 - alpha), alpha * (1 - alpha) ** 2], dtype=torch.float64)
    assert alpha == pytest.approx(0.9, rel=1e-3)
    assert torch.allclose(center, want, rtol=1e-5)
    assert_within_bounds(scene)


def test_focal_lengths_that_differ_and_a_principal_point_outside_the_image() -> None:
    scene = hard_scene(13)
    scene.Ks = torch.tensor([[[90.0, 0.0, -20.0], [0.0, 40.0, 70.0], [0.0, 0.0, 1.0]]])
    assert_within_bounds(scene)


def test_plane_depth_of_a_disc_seen_edge_on_stays_within_the_disc() -> None:
    half = 0.5**0.5
    for tilt in (0.0, 1e-6, 1e-3, 0.05):
        scene = one_gaussian(quat=(half, half + tilt, 0.0, 0.0), scale=(0.1, 0.1, 1e-5), opacity=0.99)
        depth, alpha, _ = scene.render("ED", depth_mode="plane")
        seen = alpha[..., 0] > 0
        # Twice the disc's own spread in depth (0.1 m), over an extent of 3.33 standard deviations.
        assert float((depth[..., 0][seen] - 2.0).abs().max()) <= 2 * 0.1 * 3.34
        want = scene.reference("ED", depth_mode="plane")[0]
        assert float((depth.double() - want)[seen].abs().max()) <= 2e-4


@pytest.mark.parametrize("sigma", [1e-6, 1e-3, 1.0, 1e3])
def test_standard_deviations_from_a_micrometre_to_a_kilometre(sigma: float) -> None:
    generator = torch.Generator().manual_seed(0)
    scene = hard_scene(14)
    scene.scales = sigma * (0.5 + 0.5 * torch.rand(400, 3, generator=generator))
    scene.opacities = 0.02 + 0.3 * torch.rand(400, generator=generator)  # a huge one is its opacity at every pixel
    assert_within_bounds(scene, forward=2e-5)


@pytest.mark.parametrize("ratio", [1e2, 1e3])
def test_needles_given_as_covariances(ratio: float) -> None:
    scene = hard_scene(15)
    axes = torch.linalg.qr(torch.randn(400, 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64))[0]
    M = axes * torch.tensor([0.3, 0.3 / ratio, 0.3 / ratio], dtype=torch.float64)
    scene.covars, scene.quats, scene.scales = (M @ M.mT).float(), None, None  # type: ignore[assignment]
    assert_within_bounds(scene, forward=1e-4, gradient=1e-3)


@pytest.mark.parametrize("sigma_px", [1e-3, 0.1, 10.0])
def test_antialiasing_where_the_blur_is_all_there_is_and_where_it_is_nothing(sigma_px: float) -> None:
    scene = hard_scene(16)
    scene.opacities = 0.9 + 0.1 * scene.opacities
    scene.scales = torch.full_like(scene.scales, sigma_px * 2.5 / 60.0)
    scene.scales[:, 1] *= 0.1
    result = compare(scene, "RGB", rasterize_mode="antialiased")
    assert result.forward <= FORWARD_BOUND
    assert max(result.gradients.values()) <= GRADIENT_BOUND, result.gradients


def test_forward_and_backward_count_a_gaussian_in_the_same_pixels() -> None:
    """With colours of 1, the gradients to the colours of the sum of the image sum to the sum of alpha, jumps or not."""
    generator = torch.Generator().manual_seed(0)
    scene = hard_scene(17, n=3000)
    scene.opacities = 0.0039 + 4e-5 * torch.rand(3000, generator=generator)  # every alpha is within 2 % of 1/255
    scene.opacities[:1000] = 0.99 + 0.01 * torch.rand(1000, generator=generator)
    scene.scales = 0.05 + 0.3 * torch.rand(3000, 3, generator=generator)
    scene.colors, scene.backgrounds = torch.ones(3000, 1, requires_grad=True), None
    image, alpha, meta = scene.render("RGB")
    image.sum().backward()
    assert scene.colors.grad is not None
    total = float(alpha.double().sum())
    assert float(scene.colors.grad.double().sum()) == pytest.approx(total, rel=2e-6)
    counted = meta["contributions"][0] > 0
    assert torch.equal(counted, scene.colors.grad[:, 0] > 0)


@pytest.mark.parametrize("name", ["covars", "colors"])
def test_covariances_and_harmonics_that_are_not_finite_are_named(name: str) -> None:
    scene = hard_scene(18, n=1500)
    scene.covars, scene.quats, scene.scales = torch.eye(3).repeat(1500, 1, 1), None, None  # type: ignore[assignment]
    scene.colors = torch.zeros(1500, 25, 3)
    getattr(scene, name)[1234, 2, 2] = float("inf")
    with pytest.raises(InputError, match="row 1234 ") as caught:
        scene.render("RGB", sh_degree=4)
    assert caught.value.field == name
