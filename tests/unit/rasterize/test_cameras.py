"""Cameras other than the plain pinhole: against the float64 reference, OpenCV and closed forms."""

from __future__ import annotations

from functools import partial
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from splatbot.errors import InputError
from splatbot.geometry import se3_exp
from splatbot.rasterize import rasterization
from splatbot.rasterize.cameras import (
    RollingShutterType,
    UnscentedTransformParameters,
    fisheye_limit,
    pinhole_limit,
)
from splatbot.rasterize.native import native
from splatbot.rasterize.reference import Projector, reference_rotations
from splatbot.rasterize.reference_cameras import LINES, fisheye_points, pinhole_points, unscented_projector
from tests.cameras import AFFINE, before, distorted_pinhole
from tests.scenes import (
    FORWARD_BOUND,
    GRADIENT_BOUND,
    Scene,
    compare,
    hard_scene,
    one_gaussian,
    relative_l2,
    two_roundings,
)

PINHOLE = (-0.28, 0.09, -0.01, 0.02, 0.01, 0.001, 1e-3, -2e-3, 1e-3, -5e-4, 8e-4, 3e-4)  # k1..k6, p1, p2, s1..s4
FISHEYE = (0.05, -0.02, 0.004, -0.001)
ROLLING = [name for name in RollingShutterType.__members__ if name != "GLOBAL"]


def distortion(views: int = 1) -> dict[str, Any]:
    """Return the native arguments of the distorted pinhole."""
    c = torch.tensor(PINHOLE).expand(views, -1)
    return {
        "with_ut": True,
        "radial_coeffs": c[:, :6],
        "tangential_coeffs": c[:, 6:8],
        "thin_prism_coeffs": c[:, 8:],
    }


def assert_equal(scene: Scene, mode: str, project: Projector, **options: Any) -> None:
    result = compare(scene, mode, project=project, **options)
    assert result.near_jumps <= 0.01 * result.pixels
    assert result.forward <= FORWARD_BOUND * (5.0 if "D" in mode else 1.0)
    assert max(result.gradients.values()) <= GRADIENT_BOUND, result.gradients


def wide_scene(seed: int) -> Scene:
    """Return Gaussians up to 80 degrees from the axis, for a fisheye."""
    scene = hard_scene(seed)
    scene.means[:, :2] *= 3.0
    scene.Ks[:, :2, :2] *= 0.45
    return scene


@pytest.mark.parametrize("mode", ["RGB", "RGB+ED"])
@pytest.mark.parametrize("seed", [0, 1])
def test_ortho_equals_the_float64_reference(seed: int, mode: str) -> None:
    scene = hard_scene(seed)
    scene.Ks[:, :2, :2] *= 0.4
    assert_equal(scene, mode, AFFINE["ortho"], camera_model="ortho")


@pytest.mark.parametrize("mode", ["RGB", "RGB+ED"])
@pytest.mark.parametrize("seed", [0, 1])
def test_fisheye_equals_the_float64_reference(seed: int, mode: str) -> None:
    assert_equal(wide_scene(seed), mode, AFFINE["fisheye"], camera_model="fisheye")


def test_a_fisheye_near_its_axis_equals_the_float64_reference() -> None:
    scene = hard_scene(2)
    scene.means[:, :2] *= 10 ** -torch.linspace(0.5, 8.0, 400)[:, None]
    scene.viewmats = torch.eye(4)[None].clone()
    scene.viewmats[:, 2, 3] = 2.5
    scene.opacities *= 0.1
    assert_equal(scene, "RGB", AFFINE["fisheye"], camera_model="fisheye")


@pytest.mark.parametrize("model", ["ortho", "fisheye"])
def test_several_views_through_another_camera_equal_the_reference(model: str) -> None:
    scene = hard_scene(3, n=200, views=3)
    scene.Ks[:, :2, :2] *= 0.45
    assert_equal(scene, "RGB", AFFINE[model], camera_model=model)


@pytest.mark.parametrize("mode", ["RGB", "RGB+ED"])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_unscented_transform_of_a_distorted_pinhole_equals_the_float64_reference(seed: int, mode: str) -> None:
    assert_equal(hard_scene(seed), mode, distorted_pinhole(PINHOLE), **distortion())


@pytest.mark.parametrize("mode", ["RGB", "RGB+ED"])
def test_the_unscented_transform_of_a_distorted_fisheye_equals_the_float64_reference(mode: str) -> None:
    exact = torch.tensor(FISHEYE).double()
    limit = fisheye_limit(exact.numpy())
    project = unscented_projector(
        partial(fisheye_points, coefficients=exact),
        seen=lambda p: torch.atan2(p[..., :2].norm(dim=-1), p[..., 2]) < limit,
    )
    options: dict[str, Any] = {"camera_model": "fisheye", "with_ut": True, "radial_coeffs": torch.tensor([FISHEYE])}
    assert_equal(wide_scene(0), mode, project, **options)


def test_the_unscented_transform_of_an_orthographic_camera_is_its_affine_projection() -> None:
    scene = hard_scene(1)
    scene.Ks[:, :2, :2] *= 0.4
    want = scene.render("RGB", camera_model="ortho")[0]
    got = scene.render("RGB", camera_model="ortho", with_ut=True)[0]
    assert float((got - want).abs().max()) <= FORWARD_BOUND


def test_other_sigma_points_equal_the_float64_reference() -> None:
    params = UnscentedTransformParameters(alpha=0.7, beta=1.0, kappa=0.5)
    project = unscented_projector(pinhole_points, alpha=0.7, beta=1.0, kappa=0.5, seen=before)
    assert_equal(hard_scene(4), "RGB", project, with_ut=True, ut_params=params)


def second_pose(viewmats: Tensor) -> Tensor:
    """Return the pose at the end of the readout: 4 degrees and 6 cm further."""
    motion = torch.from_numpy(se3_exp([0.04, -0.03, 0.03, 0.03, -0.05, 0.04])).float()
    return motion @ viewmats


@pytest.mark.parametrize("shutter", ROLLING)
def test_a_rolling_shutter_equals_the_float64_reference(shutter: str) -> None:
    scene = hard_scene(5, n=150)
    last = second_pose(scene.viewmats)
    project = unscented_projector(pinhole_points, shutter=shutter, last=last[0].double(), seen=before)
    options: dict[str, Any] = {"with_ut": True, "rolling_shutter": shutter, "viewmats_rs": last}
    assert_equal(scene, "RGB+ED", project, fixed=("viewmats", "Ks"), **options)


def test_a_distorted_fisheye_with_a_rolling_shutter_equals_the_float64_reference() -> None:
    scene = wide_scene(6)
    exact = torch.tensor(FISHEYE).double()
    last = second_pose(scene.viewmats)
    project = unscented_projector(
        partial(fisheye_points, coefficients=exact),
        shutter="ROLLING_TOP_TO_BOTTOM",
        last=last[0].double(),
        seen=lambda p: torch.atan2(p[..., :2].norm(dim=-1), p[..., 2]) < fisheye_limit(exact.numpy()),
    )
    options: dict[str, Any] = {"camera_model": "fisheye", "with_ut": True, "radial_coeffs": torch.tensor([FISHEYE])}
    options |= {"rolling_shutter": RollingShutterType.ROLLING_TOP_TO_BOTTOM, "viewmats_rs": last}
    assert_equal(scene, "RGB", project, fixed=("viewmats", "Ks"), **options)


def test_a_rolling_shutter_that_does_not_move_is_a_global_one() -> None:
    scene = hard_scene(7)
    want = scene.render("RGB", with_ut=True)[0]
    options: dict[str, Any] = {"rolling_shutter": "ROLLING_TOP_TO_BOTTOM", "viewmats_rs": scene.viewmats}
    assert float((scene.render("RGB", with_ut=True, **options)[0] - want).abs().max()) <= FORWARD_BOUND


def grid(points: int = 12, widest: float = 0.55) -> np.ndarray:
    """Return points (P, 3) before a camera, up to a tangent of ``widest`` from its axis."""
    x, y = np.meshgrid(np.linspace(-widest, widest, points), np.linspace(-widest, widest, points))
    z = 1.0 + 0.5 * np.sin(3.0 * x + 5.0 * y)
    return np.stack([x * z, y * z, z], -1).reshape(-1, 3)


def tiny_gaussians(points: np.ndarray) -> Scene:
    scene = one_gaussian(size=(640, 480))
    n = len(points)
    scene.means = torch.from_numpy(points).float()
    scene.quats, scene.scales = scene.quats.repeat(n, 1), torch.full((n, 3), 1e-5)
    scene.opacities, scene.colors = scene.opacities.repeat(n), scene.colors.repeat(n, 1)
    scene.Ks = torch.tensor([[[400.0, 0.0, 317.0], [0.0, 380.0, 245.0], [0.0, 0.0, 1.0]]])
    return scene


def test_a_distorted_pinhole_puts_points_where_opencv_does() -> None:
    points = grid()
    _, _, meta = tiny_gaussians(points).render("RGB", packed=False, **distortion())
    k1, k2, k3, k4, k5, k6, p1, p2, *s = PINHOLE
    K = np.array([[400.0, 0.0, 317.0], [0.0, 380.0, 245.0], [0.0, 0.0, 1.0]])
    want, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array([k1, k2, p1, p2, k3, k4, k5, k6, *s]))
    assert len(meta["visible_ids"][0]) == len(points)
    assert float(np.abs(meta["means2d"][0].numpy() - want[:, 0]).max()) < 1e-3  # [px]


def test_a_distorted_fisheye_puts_points_where_opencv_does() -> None:
    points = grid(widest=0.9)
    options: dict[str, Any] = {"camera_model": "fisheye", "with_ut": True, "radial_coeffs": torch.tensor([FISHEYE])}
    scene = tiny_gaussians(points)
    scene.Ks[:, :2, :2] *= 0.6
    _, _, meta = scene.render("RGB", packed=False, **options)
    K = scene.Ks[0].double().numpy()
    want, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), K, np.array(FISHEYE))
    assert len(meta["visible_ids"][0]) == len(points)
    assert float(np.abs(meta["means2d"][0].numpy() - want[:, 0]).max()) < 1e-3  # [px]


def test_the_affine_fisheye_puts_points_where_opencv_does() -> None:
    points = grid(widest=0.9)
    scene = tiny_gaussians(points)
    scene.Ks[:, :2, :2] *= 0.6
    _, _, meta = scene.render("RGB", packed=False, camera_model="fisheye")
    K = scene.Ks[0].double().numpy()
    want, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), K, np.zeros(4))
    assert float(np.abs(meta["means2d"][0].numpy() - want[:, 0]).max()) < 1e-3  # [px]


def test_the_unscented_transform_of_a_small_gaussian_is_the_affine_projection() -> None:
    scene = hard_scene(8)
    scene.scales *= 0.01
    scene.means[:, :2] *= 0.5
    want, got = (scene.render("RGB", packed=False, **options)[2] for options in ({}, {"with_ut": True}))
    ids = want["visible_ids"][0]
    assert torch.equal(got["visible_ids"][0], ids)
    assert float((got["means2d"] - want["means2d"]).abs().max()) < 5e-3  # [px]
    assert float((got["conics"][0, ids] / want["conics"][0, ids] - 1).abs()[:, ::2].max()) < 1e-2


def test_distortion_limits_are_where_the_radius_stops_growing() -> None:
    assert pinhole_limit([-0.3, 0, 0, 0, 0, 0]) == pytest.approx((1 / 0.9) ** 0.5)
    assert pinhole_limit([0.1, 0.2, 0, 0, 0, 0]) == 1e30
    assert fisheye_limit([0, 0, 0, 0]) == pytest.approx(np.pi)
    assert fisheye_limit([-0.3, 0, 0, 0]) == pytest.approx((1 / 0.9) ** 0.5)
    limit = pinhole_limit(PINHOLE[:6])
    tangents = torch.linspace(0.0, 0.999 * min(limit, 10.0), 1000, dtype=torch.float64)
    rays = torch.stack([tangents, torch.zeros_like(tangents), torch.ones_like(tangents)], -1)
    radial = torch.tensor([*PINHOLE[:6], *[0.0] * 6], dtype=torch.float64)
    assert float(pinhole_points(rays, torch.eye(3).double(), radial)[:, 0].diff().min()) > 0


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"camera_model": "ftheta"}, "camera_model"),
        ({"radial_coeffs": torch.zeros(1, 6)}, "radial_coeffs"),
        ({"with_ut": True, "radial_coeffs": torch.zeros(1, 4)}, "radial_coeffs"),
        ({"with_ut": True, "radial_coeffs": torch.full((1, 6), torch.nan)}, "radial_coeffs"),
        ({"with_ut": True, "radial_coeffs": torch.zeros(1, 6, requires_grad=True)}, "radial_coeffs"),
        ({"with_ut": True, "camera_model": "ortho", "radial_coeffs": torch.zeros(1, 6)}, "radial_coeffs"),
        ({"with_ut": True, "camera_model": "fisheye", "tangential_coeffs": torch.zeros(1, 2)}, "tangential_coeffs"),
        ({"with_ut": True, "rolling_shutter": "ROLLING_TOP_TO_BOTTOM"}, "viewmats_rs"),
        ({"with_ut": True, "rolling_shutter": "SIDEWAYS"}, "rolling_shutter"),
        ({"with_ut": True, "viewmats_rs": torch.eye(4)[None]}, "viewmats_rs"),
        ({"with_ut": True, "ut_params": UnscentedTransformParameters(alpha=0.0)}, "ut_params"),
        ({"with_ut": True, "depth_mode": "plane", "render_mode": "D"}, "depth_mode"),
        ({"with_ut": True, "with_eval3d": True}, "with_eval3d"),
    ],
)
def test_camera_options_that_do_not_fit_are_refused_by_name(options: dict[str, Any], field: str) -> None:
    scene = hard_scene(9, n=10)
    with pytest.raises(InputError) as caught:
        scene.render(**{"render_mode": "RGB", **options})
    assert caught.value.field == field


def along_rotations(poses: Tensor, gradient: Tensor) -> Tensor:
    """Return the tangential part (C, 6) of pose gradients (C, 4, 4): about the camera's axes and along them."""
    turned = gradient[:, :3, :3] @ poses[:, :3, :3].mT
    skew = turned - turned.mT
    return torch.cat([skew[:, [2, 0, 1], [1, 2, 0]], gradient[:, :3, 3]], -1)


@pytest.mark.parametrize("shutter", ROLLING)
@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
def test_both_poses_and_the_intrinsics_of_a_rolling_shutter_have_gradients(shutter: str, model: str) -> None:
    scene = hard_scene(9, n=120) if model == "pinhole" else wide_scene(9)
    found = {}
    for dtype in (torch.float64, torch.float32):
        leaves = scene.to(dtype, requires_grad=True)
        last = second_pose(scene.viewmats).to(dtype).requires_grad_()
        if dtype == torch.float64:
            points = pinhole_points if model == "pinhole" else fisheye_points
            seen = before if model == "pinhole" else None
            project = unscented_projector(points, shutter=shutter, last=last[0], seen=seen)
            image, _, meta = leaves.reference_leaves("RGB+D", project=project)
            weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
            weights = weights * (meta.margins > 2e-5)[..., None]
        else:
            options: dict[str, Any] = {"rolling_shutter": shutter, "viewmats_rs": last, "camera_model": model}
            image, _, _ = leaves.render("RGB+D", with_ut=True, **options)
        (image * weights.to(dtype)).sum().backward()
        assert leaves.viewmats.grad is not None
        assert last.grad is not None
        poses = [(leaves.viewmats.detach(), leaves.viewmats.grad), (last.detach(), last.grad)]
        found[dtype] = [leaves.Ks.grad, *(along_rotations(pose, grad) for pose, grad in poses)]
    for got, want in zip(found[torch.float32], found[torch.float64], strict=True):
        assert want is not None
        assert relative_l2(got, want) <= GRADIENT_BOUND


def test_a_pose_alone_may_ask_for_a_gradient_under_a_rolling_shutter() -> None:
    scene = hard_scene(9, n=10)
    scene.viewmats.requires_grad_()
    last = second_pose(scene.viewmats.detach())
    image, _, _ = scene.render(with_ut=True, rolling_shutter="ROLLING_LEFT_TO_RIGHT", viewmats_rs=last)
    image.sum().backward()
    assert scene.viewmats.grad is not None
    assert float(scene.viewmats.grad.abs().max()) > 0.0


@pytest.mark.parametrize("model", ["ortho", "fisheye"])
def test_covariances_antialiasing_and_harmonics_go_through_another_camera(model: str) -> None:
    scene = hard_scene(10, n=150, views=2)
    scene.Ks[:, :2, :2] *= 0.45
    scene.colors = 0.5 * torch.randn(150, 9, 3, generator=torch.Generator().manual_seed(0))
    M = reference_rotations(scene.quats) * scene.scales[:, None]
    scene.covars = (M @ M.mT).contiguous()
    options: dict[str, Any] = {"sh_degree": 2, "rasterize_mode": "antialiased"}
    result = compare(scene, "RGB", project=AFFINE[model], reference_extra=options, camera_model=model, **options)
    assert result.forward <= FORWARD_BOUND * 2
    assert "covars" in result.gradients
    assert max(result.gradients.values()) <= two_roundings(GRADIENT_BOUND), result.gradients


def test_antialiasing_goes_through_the_unscented_transform() -> None:
    scene = hard_scene(11, n=150)
    extra: dict[str, Any] = {"rasterize_mode": "antialiased"}
    result = compare(scene, "RGB", project=distorted_pinhole(PINHOLE), reference_extra=extra, **distortion(), **extra)
    assert result.forward <= FORWARD_BOUND * 2
    assert max(result.gradients.values()) <= GRADIENT_BOUND, result.gradients


def test_batches_of_scenes_go_through_cameras_of_their_own() -> None:
    scenes = [hard_scene(seed, n=60, views=2) for seed in (12, 13)]
    names = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks")
    together: dict[str, Any] = {name: torch.stack([getattr(scene, name) for scene in scenes]) for name in names}
    options = distortion(2)
    options["radial_coeffs"] = options["radial_coeffs"] * torch.tensor([[1.0], [0.5]])
    batched: dict[str, Any] = {k: v if k == "with_ut" else torch.stack([v, 0.8 * v]) for k, v in options.items()}
    image = rasterization(**together, width=75, height=53, **batched)[0]
    for i, scene in enumerate(scenes):
        scene.backgrounds = None
        own = {k: v if k == "with_ut" else v[i] for k, v in batched.items()}
        assert torch.equal(image[i], scene.render("RGB", **own)[0])


@pytest.mark.parametrize("isa", native().available_isas())
@pytest.mark.parametrize("model", ["affine fisheye", "unscented pinhole"])
def test_every_instruction_set_equals_the_reference_through_other_cameras(model: str, isa: str) -> None:
    native().set_isa(isa)
    try:
        if model == "affine fisheye":
            assert_equal(wide_scene(14), "RGB", AFFINE["fisheye"], camera_model="fisheye")
        else:
            assert_equal(hard_scene(14), "RGB", distorted_pinhole(PINHOLE), **distortion())
    finally:
        native().set_isa("")


def test_every_rolling_shutter_has_a_reference() -> None:
    assert set(LINES) == set(ROLLING)
