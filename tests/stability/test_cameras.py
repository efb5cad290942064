"""Hard cases of cameras other than the plain pinhole, each with an error bound (see docs/stability.md)."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from splatbot.geometry import se3_exp
from splatbot.rasterize.cameras import pinhole_limit
from splatbot.rasterize.reference import Projector, ReferenceView
from splatbot.rasterize.reference_cameras import fisheye_points, pinhole_points, unscented_projector
from tests.cameras import AFFINE, before, distorted_pinhole
from tests.scenes import (
    FORWARD_BOUND,
    GRADIENT_BOUND,
    NAMES,
    Scene,
    compare,
    hard_scene,
    one_gaussian,
    pinhole,
    two_roundings,
)

CAMERAS: dict[str, tuple[Projector, dict[str, Any]]] = {
    "ortho": (AFFINE["ortho"], {"camera_model": "ortho"}),
    "fisheye": (AFFINE["fisheye"], {"camera_model": "fisheye"}),
    "unscented pinhole": (unscented_projector(pinhole_points, seen=before), {"with_ut": True}),
    "unscented fisheye": (unscented_projector(fisheye_points), {"camera_model": "fisheye", "with_ut": True}),
}


def assert_within_bounds(scene: Scene, camera: str, *, gradient: float = GRADIENT_BOUND) -> None:
    project, options = CAMERAS[camera]
    result = compare(scene, "RGB", project=project, **options)
    assert result.near_jumps <= 0.02 * result.pixels
    assert result.forward <= FORWARD_BOUND
    assert max(result.gradients.values()) <= gradient, result.gradients


def gradients(scene: Scene, **options: Any) -> dict[str, Tensor]:
    leaves = scene.to(torch.float32, requires_grad=True)
    image, alpha, _ = leaves.render("RGB+ED", **options)
    (image.sum() + alpha.sum()).backward()
    return {name: getattr(leaves, name).grad for name in NAMES if getattr(leaves, name) is not None}


@pytest.mark.parametrize("camera", CAMERAS)
def test_needles_and_specks_through_every_camera(camera: str) -> None:
    scene = hard_scene(1, n=200)
    scene.scales[:100] = torch.tensor([0.3, 3e-6, 3e-6])
    scene.scales[100:] = 1e-6
    if camera == "ortho":
        scene.Ks[:, :2, :2] *= 0.4
    assert_within_bounds(scene, camera, gradient=two_roundings(GRADIENT_BOUND))


@pytest.mark.parametrize("camera", CAMERAS)
def test_every_camera_with_unequal_focal_lengths_and_its_principal_point_outside_the_image(camera: str) -> None:
    scene = hard_scene(2, n=200)
    scene.Ks = torch.tensor([[[30.0, 0.0, -12.0], [0.0, 47.0, 70.0], [0.0, 0.0, 1.0]]])
    scene.means += torch.tensor([1.5, -0.8, 0.0])
    assert_within_bounds(scene, camera)


@pytest.mark.parametrize("camera", ["fisheye", "unscented fisheye"])
def test_a_fisheye_up_to_a_hair_from_ninety_degrees(camera: str) -> None:
    scene = hard_scene(3, n=200)
    angle = torch.linspace(1.2, math.radians(89.7), 200)
    around = torch.linspace(0.0, 40.0, 200)
    scene.means = 2.0 * torch.stack([angle.sin() * around.cos(), angle.sin() * around.sin(), angle.cos()], -1)
    scene.viewmats = torch.eye(4)[None].clone()
    scene.Ks = torch.tensor([[[22.0, 0.0, 37.0], [0.0, 18.0, 26.0], [0.0, 0.0, 1.0]]])
    scene.scales *= 0.3
    assert_within_bounds(scene, camera)


def test_a_gaussian_that_straddles_the_near_plane_of_an_unscented_pinhole_is_left_out() -> None:
    spread = 0.1 * math.sqrt(3.0)
    scene = one_gaussian(mean=(0.0, 0.0, 0.5), scale=(0.05, 0.05, 0.48 / spread))
    inside = scene.render("RGB", with_ut=True)
    assert int(inside[2]["visibility"].sum()) == 1
    assert all(bool(torch.isfinite(g).all()) for g in gradients(scene, with_ut=True).values())
    scene.scales[0, 2] = 0.4901 / spread
    outside = scene.render("RGB", with_ut=True)
    assert int(outside[2]["visibility"].sum()) == 0
    assert float(outside[1].max()) == 0.0
    assert all(float(g.abs().max()) == 0.0 for g in gradients(scene, with_ut=True).values())


@pytest.mark.parametrize(("near_plane", "gradient"), [(0.01, 0.2), (0.5, 1e-3)])
def test_sigma_points_close_to_the_camera_equal_the_float64_reference(near_plane: float, gradient: float) -> None:
    scene = hard_scene(4, n=200)
    scene.scales[:, 2] = 3.0
    scene.scales[:, :2] = 0.05
    scene.quats[:, 1:] *= 0.05
    scene.opacities *= 0.05
    project = unscented_projector(pinhole_points, seen=lambda p: p[..., 2] >= near_plane)
    result = compare(scene, "RGB", project=project, with_ut=True, near_plane=near_plane)
    assert result.forward <= FORWARD_BOUND
    assert max(result.gradients.values()) <= two_roundings(gradient), result.gradients


def test_beyond_the_range_of_its_distortion_a_lens_sees_nothing() -> None:
    radial = (-0.3, 0.0, 0.0, 0.0, 0.0, 0.0)
    limit = pinhole_limit(radial)
    scene = hard_scene(5, n=200)
    scene.viewmats = torch.eye(4)[None].clone()
    tangent = torch.linspace(0.0, 3.0 * limit, 200)
    scene.means = 2.0 * torch.stack([tangent, torch.zeros(200), torch.ones(200)], -1)
    scene.scales = torch.tensor([0.05, 0.02, 0.002]).repeat(200, 1)
    scene.Ks = torch.tensor([[[40.0, 0.0, 20.0], [0.0, 40.0, 26.0], [0.0, 0.0, 1.0]]])
    options: dict[str, Any] = {"with_ut": True, "radial_coeffs": torch.tensor([radial])}
    visible = scene.render("RGB", **options)[2]["visibility"][0]
    assert not bool(visible[tangent > limit].any())
    assert bool(visible[(tangent < 0.99 * limit) & (scene.opacities > 0.01)].all())
    got = gradients(scene, **options)
    assert float(got["means"][tangent > limit].abs().max()) == 0.0
    result = compare(scene, "RGB", project=distorted_pinhole([*radial, *[0.0] * 6]), **options)
    assert result.forward <= FORWARD_BOUND
    assert max(result.gradients.values()) <= GRADIENT_BOUND, result.gradients


def test_a_rolling_shutter_on_a_camera_that_turns_by_twenty_degrees() -> None:
    scene = hard_scene(6, n=100)
    last = torch.from_numpy(se3_exp([0.2, -0.1, 0.1, 0.2, 0.25, 0.1])).float() @ scene.viewmats
    shutter = "ROLLING_TOP_TO_BOTTOM"
    project = unscented_projector(pinhole_points, shutter=shutter, last=last[0].double(), seen=before)
    options: dict[str, Any] = {"with_ut": True, "rolling_shutter": shutter, "viewmats_rs": last}
    result = compare(scene, "RGB", project=project, fixed=("viewmats", "Ks"), **options)
    assert result.forward <= FORWARD_BOUND
    assert max(result.gradients.values()) <= GRADIENT_BOUND, result.gradients


@pytest.mark.parametrize(
    ("size", "shutter"),
    [
        ((1, 1), "ROLLING_TOP_TO_BOTTOM"),
        ((40, 1), "ROLLING_BOTTOM_TO_TOP"),
        ((1, 40), "ROLLING_RIGHT_TO_LEFT"),
    ],
)
def test_a_rolling_shutter_of_a_single_line_reads_it_at_the_first_pose(size: tuple[int, int], shutter: str) -> None:
    scene = hard_scene(7, n=60)
    scene.width, scene.height = size
    scene.Ks = pinhole(*size, focal=60.0)
    last = torch.from_numpy(se3_exp([0.05, 0.0, 0.0, 0.0, 0.05, 0.0])).float() @ scene.viewmats
    # Their depth is that half-way, which may change the order.
    scene.colors = scene.colors[:1].repeat(60, 1)
    got = scene.render("RGB", with_ut=True, rolling_shutter=shutter, viewmats_rs=last)[0]
    want = scene.render("RGB", with_ut=True)[0]
    assert float((got - want).abs().max()) <= FORWARD_BOUND
    assert float((want - scene.backgrounds).abs().max()) > 1e-3  # type: ignore[operator]


@pytest.mark.parametrize("camera", CAMERAS)
def test_every_camera_ten_kilometres_from_the_origin(camera: str) -> None:
    scene = hard_scene(8, n=200)
    far = torch.tensor([7e3, -5e3, 5e3])
    scene.means = scene.means + far  # rounded to float32: both sides take the rounded means
    viewmats = scene.viewmats.double()
    viewmats[:, :3, 3] -= viewmats[:, :3, :3] @ far.double()
    if camera == "ortho":
        scene.Ks[:, :2, :2] *= 0.4
    project, options = CAMERAS[camera]
    _, _, meta = Scene(**{**vars(scene), "viewmats": viewmats}).render("RGB", packed=False, **options)
    exact = scene.to(torch.float64)
    want = project(exact.gaussians(), ReferenceView(viewmats[0], exact.Ks[0], scene.width, scene.height), 0.3)
    seen = meta["visibility"][0]
    assert int(seen.sum()) > 50
    near_image = (want.mean2d[seen].abs() < 1000).all(-1)
    assert float((meta["means2d"][0][seen] - want.mean2d[seen])[near_image].abs().max()) < 1e-3  # [px]


def test_transmittance_of_exactly_one_half_is_the_median() -> None:
    scene = one_gaussian(mean=(0.0, 0.0, 2.0), scale=(1e4, 1e4, 1.0), opacity=0.5)
    image, alpha, _ = scene.render("RGB+MD")
    assert float((alpha - 0.5).abs().max()) < 1e-6
    halved = alpha[..., 0] >= 0.5
    assert torch.equal(image[..., 3] == 2.0, halved)
