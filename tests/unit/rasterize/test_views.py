"""Views of a map against geometry worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import CameraError, InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, quat_to_rotation, rotation_to_quat, so3_exp, transform_points
from splatbot.rasterize.views import CONSTANTS as VIEWS
from splatbot.rasterize.views import Mode, colorize, default_view, depth_limits, facing_normals, render_view, to_png

CAMERA = Camera(100, 100, 31.5, 23.5, 64, 48)


def _plane(T_world_plane: NDArray[np.float64], color: tuple[float, float, float] = (0.2, 0.6, 1.0)) -> GaussianModel:
    """Return a closed wall of flat Gaussians in the xy plane of a frame, 2 m square."""
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, 81), np.linspace(-1, 1, 81)))
    n = len(x)
    return GaussianModel.from_activated(
        means=transform_points(T_world_plane, np.stack([x, y, np.zeros(n)], -1)),
        quats=np.tile(rotation_to_quat(T_world_plane[:3, :3]), (n, 1)),
        scales=np.tile([0.03, 0.03, 1e-4], (n, 1)),
        opacities=np.full(n, 0.95),
        colors=np.tile(color, (n, 1)),
    )


def _pose(omega: tuple[float, float, float], t: tuple[float, float, float]) -> NDArray[np.float64]:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = so3_exp(omega), t
    return T


def test_a_wall_has_its_colour_its_depth_and_full_opacity() -> None:
    wall = _plane(_pose((0, 0, 0), (0, 0, 1.5)))
    centre = (slice(16, 32), slice(20, 44))
    np.testing.assert_allclose(render_view(wall, CAMERA, np.eye(4), "alpha")[centre], 1.0, atol=5e-3)
    np.testing.assert_allclose(render_view(wall, CAMERA, np.eye(4), "depth")[centre], 1.5, rtol=1e-3)
    rgb = render_view(wall, CAMERA, np.eye(4), "rgb")
    np.testing.assert_allclose(rgb[centre], np.broadcast_to([0.2, 0.6, 1.0], (16, 24, 3)), atol=5e-3)


@pytest.mark.parametrize("omega", [(0.0, 0.4, 0.0), (-0.5, 0.2, 0.9), (np.pi, 0.0, 0.0)])
def test_a_tilted_wall_has_its_normal_facing_the_camera(omega: tuple[float, float, float]) -> None:
    T = _pose(omega, (0, 0, 1.5))
    normals = render_view(_plane(T), CAMERA, np.eye(4), "normal")
    expected = T[:3, 2] * -np.sign(T[2, 2])
    np.testing.assert_allclose(normals[20:28, 28:36], np.broadcast_to(expected, (8, 8, 3)), atol=2e-3)


def test_moving_camera_and_map_together_leaves_every_view() -> None:
    together = _pose((0.3, -0.2, 0.5), (3.0, -2.0, 1.0))
    wall = _pose((0.2, 0.3, 0), (0, 0, 1.5))
    modes: tuple[Mode, ...] = ("rgb", "depth", "normal", "alpha")
    for mode in modes:
        here = render_view(_plane(wall), CAMERA, np.eye(4), mode)
        there = render_view(_plane(together @ wall), CAMERA, together, mode)
        # A float32 rounding may put a Gaussian on the other side of the blend's cut in a few pixels.
        assert np.quantile(np.abs(here - there), 0.999) < 2e-3


def test_where_nothing_is_there_is_background_and_neither_depth_nor_normal() -> None:
    nothing = GaussianModel.empty()
    grey = render_view(nothing, CAMERA, np.eye(4), "rgb", background=(0.5, 0.25, 0.0))
    np.testing.assert_array_equal(grey, np.broadcast_to(np.array([0.5, 0.25, 0.0], np.float32), (48, 64, 3)))
    assert not render_view(nothing, CAMERA, np.eye(4), "depth").any()
    assert not render_view(nothing, CAMERA, np.eye(4), "normal").any()
    assert not render_view(nothing, CAMERA, np.eye(4), "alpha").any()


def test_rendering_leaves_no_autograd_graph_and_does_not_touch_the_model() -> None:
    wall = _plane(_pose((0, 0, 0), (0, 0, 1.5)))
    wall.means.requires_grad_(True)
    before = wall.clone()
    render_view(wall, CAMERA, np.eye(4), "normal")
    assert wall.means.grad is None
    assert torch.equal(before.means, wall.means)


@pytest.mark.parametrize(
    ("T", "message"),
    [
        (np.eye(3), "T_world_camera"),
        (np.diag([2.0, 1, 1, 1]), "no rigid transform"),
        (np.diag([-1.0, 1, 1, 1]), "no rigid transform"),
        (np.full((4, 4), np.nan), "not finite"),
        (np.eye(4)[[0, 1, 2, 2]], "no rigid transform"),
    ],
)
def test_a_pose_that_is_none_is_refused(T: NDArray[np.float64], message: str) -> None:
    with pytest.raises(InputError, match=message):
        render_view(GaussianModel.empty(), CAMERA, T)


def test_a_camera_with_distortion_is_refused_instead_of_drawn_without() -> None:
    with pytest.raises(CameraError, match="distortion"):
        render_view(GaussianModel.empty(), Camera(1, 1, 0, 0, 4, 4, (0.1, 0, 0, 0)), np.eye(4))


def test_an_unknown_mode_is_answered_with_the_known_ones() -> None:
    with pytest.raises(InputError, match="rgb, depth, normal, alpha"):
        render_view(GaussianModel.empty(), CAMERA, np.eye(4), "xray")  # type: ignore[arg-type]


def test_normals_are_the_flattest_axis_turned_to_the_camera_for_any_rotation() -> None:
    rng = np.random.default_rng(0)
    n = 200
    model = GaussianModel.from_activated(
        means=rng.normal(size=(n, 3)) + np.array([0, 0, 4]),
        quats=rng.normal(size=(n, 4)),
        scales=rng.uniform(0.01, 0.1, (n, 3)),
        opacities=np.full(n, 0.5),
        colors=np.full((n, 3), 0.5),
    )
    T_camera_world = inverse(_pose((0.1, 0.2, -0.3), (0.5, 0, 0)))
    normals = facing_normals(model, T_camera_world).double().numpy()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)
    points = transform_points(T_camera_world, model.means.double().numpy())
    assert (np.sum(normals * points, axis=1) <= 1e-6).all()
    # Along its normal each Gaussian is as thick as its least scale: nᵀ Σ n = s².
    R = T_camera_world[:3, :3] @ quat_to_rotation(model.quats.numpy())
    covariance = np.einsum("nij,nj,nkj->nik", R, model.scales.double().numpy() ** 2, R)
    thickness = np.sqrt(np.einsum("ni,nij,nj->n", normals, covariance, normals))
    np.testing.assert_allclose(thickness, model.scales.min(dim=1).values.numpy(), rtol=1e-4)


def _visible(model: GaussianModel, camera: Camera, T_world_camera: NDArray[np.float64]) -> float:
    points = transform_points(inverse(T_world_camera), model.means.double().numpy())
    ahead = points[points[:, 2] > 0]
    u, v = camera.project(ahead).T
    inside = (u >= -0.5) & (v >= -0.5) & (u <= camera.width - 0.5) & (v <= camera.height - 0.5)
    return float(inside.sum() / len(points))


@pytest.mark.parametrize("fov_deg", [30.0, 60.0, 100.0])
def test_the_default_view_shows_ninety_percent_and_is_no_farther_than_that_needs(fov_deg: float) -> None:
    rng = np.random.default_rng(4)
    means = rng.normal(size=(2000, 3)) * np.array([0.5, 0.3, 0.2]) + np.array([10, -5, 3])
    model = GaussianModel.from_activated(
        means=means,
        quats=np.tile([1.0, 0, 0, 0], (2000, 1)),
        scales=np.full((2000, 3), 0.01),
        opacities=np.full(2000, 0.7),
        colors=np.full((2000, 3), 0.5),
    )
    camera, pose = default_view(model, width=320, height=200, fov_deg=fov_deg)
    assert _visible(model, camera, pose) >= VIEWS.visible_share
    nearer = pose.copy()
    nearer[2, 3] += 0.02
    assert _visible(model, camera, nearer) < VIEWS.visible_share
    np.testing.assert_allclose(pose[:2, 3], means.mean(axis=0)[:2], atol=1e-4)


def test_a_faint_floater_does_not_draw_the_default_view_away() -> None:
    wall = _plane(_pose((0, 0, 0), (0, 0, 1.5)))
    floater = GaussianModel.from_activated(
        means=[[500.0, 0, 0]], quats=[[1, 0, 0, 0]], scales=[[0.1] * 3], opacities=[0.01], colors=[[1, 1, 1]]
    )
    _, alone = default_view(wall)
    _, with_floater = default_view(GaussianModel.concatenate([wall, floater]))
    np.testing.assert_allclose(with_floater, alone, atol=0.01)


def test_an_empty_map_has_a_default_view_too() -> None:
    camera, pose = default_view(GaussianModel.empty(), width=32, height=16)
    assert (camera.width, camera.height) == (32, 16)
    np.testing.assert_array_equal(pose, np.eye(4))


def test_depth_colours_run_from_red_near_to_blue_far_and_unknown_is_black() -> None:
    depth = np.array([[0.0, 0.5, 1.0, 1.5]], dtype=np.float32)
    image = colorize(depth, "depth", depth_range=(0.5, 1.5)).astype(int)
    assert not image[0, 0].any()
    assert image[0, 1, 0] > image[0, 1, 2]
    assert image[0, 3, 2] > image[0, 3, 0]


def test_depth_limits_ignore_what_is_unknown_and_the_rare_extremes() -> None:
    depth = np.linspace(1.0, 2.0, 1000, dtype=np.float32).reshape(20, 50)
    depth[0, 0], depth[0, 1] = 0.0, 90.0
    near, far = depth_limits(depth)
    assert (near, far) == pytest.approx((1.02, 1.98), abs=0.01)
    assert depth_limits(np.zeros((4, 4), np.float32)) == (0.0, 1.0)


def test_a_normal_towards_the_camera_is_light_blue_and_none_is_black() -> None:
    image = colorize(np.array([[[0, 0, -1], [0, 0, 0], [1, 0, 0]]], dtype=np.float32), "normal")
    np.testing.assert_array_equal(image[0], [[128, 128, 255], [0, 0, 0], [255, 128, 128]])


def test_a_png_decodes_to_the_colours_of_the_view() -> None:
    view = np.random.default_rng(0).random((7, 9, 3)).astype(np.float32)
    decoded = cv2.imdecode(np.frombuffer(to_png(view, "rgb"), np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    np.testing.assert_array_equal(decoded[..., ::-1], np.rint(view * 255).astype(np.uint8))
    grey = cv2.imdecode(np.frombuffer(to_png(view[..., 0], "alpha"), np.uint8), cv2.IMREAD_UNCHANGED)
    assert grey is not None
    assert grey.shape == (7, 9)


def test_a_map_with_harmonics_changes_its_colour_with_the_direction() -> None:
    model = GaussianModel.from_activated(
        means=[[0.0, 0.0, 0.0]], quats=[[1, 0, 0, 0]], scales=[[0.2] * 3], opacities=[0.99], colors=[[0.5, 0.5, 0.5]]
    )
    sh = torch.zeros(1, 4, 3)
    sh[0, 2, 0] = 0.5  # the term in z, of red
    model = replace(model, sh=sh)
    camera = Camera(100.0, 100.0, 31.5, 23.5, 64, 48)
    front, back = np.eye(4), np.diag([-1.0, 1.0, -1.0, 1.0])
    front[2, 3], back[2, 3] = -1.0, 1.0  # looking along +z and along -z
    expected = 0.48860251 * 0.5
    for pose, sign in ((front, 1.0), (back, -1.0)):
        red, green, _ = render_view(model, camera, pose)[24, 32] / render_view(model, camera, pose, "alpha")[24, 32]
        assert green == pytest.approx(0.5, abs=1e-3)
        assert red == pytest.approx(0.5 + sign * expected, abs=2e-3)
