"""Harmonics, covariances, antialiasing and intrinsics: the kernels against the float64 reference and closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y
from torch import Tensor

from splatbot.errors import InputError
from splatbot.rasterize import rasterization
from splatbot.rasterize.harmonics import harmonics_basis
from tests.scenes import FORWARD_BOUND, GRADIENT_BOUND, Scene, compare, hard_scene, one_gaussian, relative_l2


def with_harmonics(scene: Scene, coefficients: int, seed: int = 0) -> Scene:
    """Return the scene with random coefficients, some of whose colours fall below 0."""
    generator = torch.Generator().manual_seed(seed)
    scene.colors = 0.6 * torch.randn(len(scene.means), coefficients, 3, generator=generator)
    return scene


def with_covars(scene: Scene) -> Scene:
    """Return the same Gaussians by their covariances."""
    w, x, y, z = torch.nn.functional.normalize(scene.quats.double(), dim=-1).unbind(-1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    M = torch.stack(rows, -1).reshape(-1, 3, 3) * scene.scales.double()[:, None, :]
    scene.covars = (M @ M.mT).float()
    scene.quats = scene.scales = None  # type: ignore[assignment]
    return scene


def test_the_basis_is_that_of_scipy_with_the_signs_of_3dgs() -> None:
    directions = torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64), dim=-1)
    colatitude = np.arccos(directions[:, 2].numpy())
    longitude = np.arctan2(directions[:, 1].numpy(), directions[:, 0].numpy())
    basis = harmonics_basis(directions, 4).numpy()
    for degree in range(5):
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), colatitude, longitude)
            want = value.real if order == 0 else math.sqrt(2) * (value.real if order > 0 else value.imag)
            assert basis[:, degree * degree + degree + order] == pytest.approx(want, abs=1e-12), (degree, order)


@pytest.mark.parametrize("mode", ["RGB", "RGB+ED"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_harmonics_equal_the_reference(degree: int, mode: str) -> None:
    scene = with_harmonics(hard_scene(30 + degree, views=2), 25 if degree > 1 else 4)
    result = compare(scene, mode, sh_degree=degree)
    assert result.forward <= FORWARD_BOUND * 5
    assert {"colors", "means", "viewmats"} <= set(result.gradients)
    assert max(result.gradients.values()) <= GRADIENT_BOUND, result.gradients


def test_harmonics_of_each_view_equal_the_reference() -> None:
    scene = hard_scene(36, n=150, views=2)
    scene.colors = 0.5 * torch.randn(2, 150, 9, 3, generator=torch.Generator().manual_seed(1))
    result = compare(scene, "RGB", sh_degree=2)
    assert result.forward <= FORWARD_BOUND
    assert max(result.gradients.values()) <= GRADIENT_BOUND, result.gradients


@pytest.mark.parametrize("wanted", [("viewmats",), ("means",), ("colors",), ("opacities",)])
def test_gradients_of_harmonics_asked_for_alone_equal_those_asked_for_together(wanted: tuple[str, ...]) -> None:
    def gradients(names: tuple[str, ...]) -> dict[str, Tensor]:
        scene = with_harmonics(hard_scene(37, n=200, views=2), 16).to(torch.float32)
        for name in names:
            getattr(scene, name).requires_grad_()
        (scene.render("RGB+ED", sh_degree=3)[0] ** 2).sum().backward()
        return {name: getattr(scene, name).grad for name in names}

    together = gradients(("means", "quats", "scales", "opacities", "colors", "viewmats"))
    for name, alone in gradients(wanted).items():
        assert torch.equal(alone, together[name]), name


def test_unused_coefficients_receive_no_gradient_and_change_nothing() -> None:
    scene = with_harmonics(hard_scene(38), 16)
    image = scene.render("RGB", sh_degree=1)[0]
    scene.colors[:, 4:] = 7.0
    scene.colors.requires_grad_()
    again = scene.render("RGB", sh_degree=1)[0]
    assert torch.equal(again, image)
    again.sum().backward()
    assert scene.colors.grad is not None
    assert float(scene.colors.grad[:, 4:].abs().max()) == 0.0
    assert float(scene.colors.grad[:, :4].abs().max()) > 0.0


def test_a_coefficient_that_is_not_finite_is_named_with_its_row() -> None:
    scene = with_harmonics(hard_scene(39, n=2000), 9)
    scene.colors[1500, 8, 2] = float("nan")
    with pytest.raises(InputError, match="row 1500 ") as caught:
        scene.render("RGB", sh_degree=2)
    assert caught.value.field == "colors"


@pytest.mark.parametrize("mode", ["RGB", "RGB+ED"])
def test_covariances_equal_the_reference(mode: str) -> None:
    scene = with_covars(hard_scene(40, views=2))
    result = compare(scene, mode)
    assert result.forward <= FORWARD_BOUND * 5
    assert "covars" in result.gradients
    assert "quats" not in result.gradients
    assert max(result.gradients.values()) <= GRADIENT_BOUND, result.gradients


def test_covariances_render_as_the_quaternions_and_scales_they_are_made_of() -> None:
    want = hard_scene(41).render("RGB+ED")[0]
    got = with_covars(hard_scene(41)).render("RGB+ED")[0]
    assert float(((got - want).abs() > 1e-4).double().mean()) < 1e-3  # a pixel at a jump may fall on either side


def test_the_lower_triangle_of_a_covariance_is_not_read() -> None:
    scene = with_covars(hard_scene(42))
    want = scene.render("RGB")[0]
    assert scene.covars is not None
    scene.covars = scene.covars.triu().requires_grad_()
    image = scene.render("RGB")[0]
    assert torch.equal(image, want)
    image.sum().backward()
    assert scene.covars.grad is not None
    assert float(scene.covars.grad.tril(-1).abs().max()) == 0.0


@pytest.mark.parametrize("of_covar", [False, True])
def test_antialiasing_equals_the_reference(of_covar: bool) -> None:
    scene = hard_scene(43, views=2)
    scene.scales *= 0.5  # most footprints near a pixel, where the factor matters
    if of_covar:
        scene = with_covars(scene)
    result = compare(scene, "RGB+ED", rasterize_mode="antialiased")
    assert result.forward <= FORWARD_BOUND * 5
    assert max(result.gradients.values()) <= GRADIENT_BOUND, result.gradients


def test_antialiasing_keeps_the_total_brightness_of_a_small_gaussian() -> None:
    def total(scale: float, mode: str) -> float:
        scene = one_gaussian(mean=(0.025, 0.025, 2.0), scale=(scale, scale, scale), opacity=0.9)  # on a pixel's centre
        return float(scene.render("RGB", rasterize_mode=mode)[1].sum())

    # At 40 px and 2 m, 0.02 m is 0.4 px: the blur of 0.3 px² triples its area. The cut at 1/255 costs a few percent.
    sharp = 0.9 * 2 * math.pi * 0.4**2
    assert total(0.02, "antialiased") == pytest.approx(sharp, rel=0.06)
    assert total(0.02, "classic") > 2.0 * sharp
    assert total(1e-5, "antialiased") > 0.0  # held at 0.005, which 0.9 x 0.005 > 1/255 shows


def test_antialiased_opacities_are_those_of_the_meta() -> None:
    scene = one_gaussian(scale=(0.02, 0.02, 0.02), opacity=0.9)
    meta = scene.render("RGB", rasterize_mode="antialiased", packed=False)[2]
    assert float(meta["opacities"]) == pytest.approx(0.9 * 0.16 / 0.46, rel=1e-4)


def test_gradients_of_the_intrinsics_equal_central_differences() -> None:
    scene = hard_scene(44, n=80).to(torch.float64)
    weights = torch.randn(1, 53, 75, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    weights *= (scene.reference_leaves("RGB")[2].margins > 1e-3)[..., None]
    native = scene.to(torch.float32)
    native.Ks = scene.Ks.clone().requires_grad_()
    (native.render("RGB")[0] * weights.float()).sum().backward()
    assert native.Ks.grad is not None
    assert native.Ks.grad.dtype == torch.float64
    for entry in ((0, 0, 0), (0, 1, 1), (0, 0, 2), (0, 1, 2)):
        values = []
        for step in (1e-6, -1e-6):
            moved = scene.to(torch.float64)
            moved.Ks[entry] += step
            values.append(float((moved.reference_leaves("RGB")[0] * weights).sum()))
        slope = (values[0] - values[1]) / 2e-6
        assert float(native.Ks.grad[entry]) == pytest.approx(slope, rel=1e-3, abs=1e-4), entry
    assert float(native.Ks.grad[0, 2].abs().max()) == 0.0


def test_a_scene_ten_kilometres_from_the_origin_renders_as_well_as_one_around_it() -> None:
    near = hard_scene(45)
    far = near.to(torch.float32)
    shift = torch.tensor([10_000.0, -3_000.0, 2_000.0])
    far.means = near.means + shift
    far.viewmats = near.viewmats.double()
    far.viewmats[:, :3, 3] -= far.viewmats[:, :3, :3] @ shift.double()
    far.viewmats = far.viewmats.float()
    with_harmonics(far, 9)
    result = compare(far, "RGB", sh_degree=2)
    assert result.forward <= FORWARD_BOUND
    # The pose turns about the world's origin, 10 km away: the rest of its gradient is the lever times rounding.
    assert max(v for k, v in result.gradients.items()) <= GRADIENT_BOUND, result.gradients
    exact = far.reference("RGB", sh_degree=2)[2].means2d
    meta = rasterization(**vars(far), sh_degree=2, packed=False)[2]
    seen = meta["visibility"]
    assert float((meta["means2d"].double() - exact)[seen].abs().max()) <= 1e-3  # [px]


def test_gradients_are_found_for_every_leaf_kind_of_camera() -> None:
    scene = hard_scene(46, n=60)
    scene.viewmats = scene.viewmats.double().requires_grad_()
    scene.Ks = scene.Ks.clone().requires_grad_()
    exact = hard_scene(46, n=60).to(torch.float64, requires_grad=True)
    safe = (exact.reference_leaves("RGB")[2].margins > 2e-5)[..., None]
    (scene.render("RGB")[0] * safe).sum().backward()
    (exact.reference_leaves("RGB")[0] * safe).sum().backward()
    assert exact.viewmats.grad is not None
    assert exact.Ks.grad is not None
    assert relative_l2(scene.viewmats.grad, exact.viewmats.grad) <= GRADIENT_BOUND
    assert relative_l2(scene.Ks.grad, exact.Ks.grad) <= GRADIENT_BOUND


@pytest.mark.parametrize(
    "change",
    [torch.diag(torch.tensor([2.0, 2.0, 2.0])), torch.diag(torch.tensor([1.0, 1.0, -1.0])),
     torch.tensor([[1.0, 0.3, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])],
    ids=["scaled", "mirrored", "sheared"],
)  # fmt: skip
def test_a_camera_that_is_no_rigid_transform_is_refused(change: Tensor) -> None:
    scene = hard_scene(0)
    scene.viewmats = scene.viewmats.clone()
    scene.viewmats[0, :3, :3] = change @ scene.viewmats[0, :3, :3]
    with pytest.raises(InputError, match=r"viewmats: row 0 scales, shears or mirrors"):
        scene.render("RGB")


def test_a_camera_that_an_optimiser_left_rigid_within_a_thousandth_renders() -> None:
    scene = hard_scene(0)
    scene.viewmats = scene.viewmats + 3e-4
    assert bool(scene.render("RGB")[0].isfinite().all())
