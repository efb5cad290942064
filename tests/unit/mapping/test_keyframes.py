"""Keyframes: which views are new, and images that stay registered when they are made smaller."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.frame import Frame
from splatbot.geometry import inverse, se3_exp
from splatbot.mapping.keyframes import is_keyframe, mapping_images, noise_share, smooth_depth
from tests.rgbd import CAMERA, small_config, wall_depth, wall_frame
from tests.unit.mapping.conftest import MakeKeyframe

CONFIG = small_config()
Array = NDArray[np.float64]


@pytest.mark.parametrize(
    ("twist", "new"),
    [
        ([0.0] * 6, False),
        ([0.039, 0, 0, 0, 0, 0], False),
        ([0.041, 0, 0, 0, 0, 0], True),
        ([0, 0, 0, 0, 0.069, 0], False),
        ([0, 0, 0, 0, 0.071, 0], True),
    ],
)
def test_a_view_is_new_when_it_is_far_or_turned_from_the_keyframe(
    twist: list[float], new: bool, make_keyframe: MakeKeyframe
) -> None:
    mapping = small_config(mapping__keyframe_translation=0.04, mapping__keyframe_rotation=0.07).mapping
    T = se3_exp([1.0, -0.5, 0.2, 0.3, 0.8, -0.1])
    assert is_keyframe(T @ se3_exp(twist), [make_keyframe(T)], mapping) is new


def test_a_view_near_any_keyframe_is_not_new_and_the_first_view_is(make_keyframe: MakeKeyframe) -> None:
    keyframes = [make_keyframe(se3_exp([x, 0, 0, 0, 0, 0])) for x in (0.0, 1.0, 2.0)]
    assert not is_keyframe(se3_exp([0.01, 0, 0, 0, 0, 0]), keyframes, CONFIG.mapping)
    assert is_keyframe(se3_exp([0.5, 0, 0, 0, 0, 0]), keyframes, CONFIG.mapping)
    assert is_keyframe(np.eye(4), [], CONFIG.mapping)


def test_matrices_are_those_the_rasterizer_takes(make_keyframe: MakeKeyframe) -> None:
    T = se3_exp([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    keyframe = make_keyframe(T)
    np.testing.assert_array_equal(keyframe.viewmat[0].numpy(), inverse(T))
    np.testing.assert_array_equal(keyframe.K[0].numpy(), CAMERA.K_corner)


def test_images_of_the_configured_width_do_not_change() -> None:
    frame = wall_frame(np.eye(4))
    camera, rgb, depth = mapping_images(frame, CONFIG.mapping, CONFIG.tracking)
    assert camera is CAMERA
    assert np.array_equal(rgb, frame.rgb)
    assert np.array_equal(depth, frame.depth)


@pytest.mark.parametrize("size", [(256, 192), (255, 191), (129, 97)])
def test_colour_depth_and_camera_stay_registered_when_halved(size: tuple[int, int]) -> None:
    """Colors encode the position of a pixel in the last 60 columns and rows, four levels a pixel: a block center."""
    width, height = size
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    ramps = 4 * np.stack([u - width + 60, v - height + 60], -1)
    rgb = np.concatenate([ramps.clip(0, 255), 0 * u[..., None]], -1).astype(np.uint8)
    frame = Frame(0.0, rgb, np.ones((height, width), np.float32), Camera(200.0, 200.0, 100.0, 90.0, width, height))
    camera, small, depth = mapping_images(frame, small_config(mapping__max_width=128).mapping, CONFIG.tracking)
    assert small.shape[:2] == depth.shape == (camera.height, camera.width)
    assert camera.width == width // 2
    x, y, _ = np.moveaxis(camera.backproject(depth).astype(np.float64), -1, 0)
    pixels = np.stack([200.0 * x + 100.0, 200.0 * y + 90.0], -1)  # where the full camera sees the same points
    expected = 4 * (pixels - [width - 60, height - 60])
    inside = expected > 4
    assert inside.mean() > 0.1
    np.testing.assert_allclose(small[..., :2][inside], expected[inside], atol=0.51)  # 8 bits


def test_depth_that_tracking_would_not_believe_is_not_fused() -> None:
    frame = wall_frame(np.eye(4))
    depth = frame.depth.copy()
    depth[10, 10], depth[20, 20] = 0.1, 9.0
    _, _, kept = mapping_images(replace(frame, depth=depth), CONFIG.mapping, CONFIG.tracking)
    assert kept[10, 10] == kept[20, 20] == 0.0
    assert (kept > 0).sum() == kept.size - 2


def _smoothed_by_hand(depth: Array) -> Array:
    """Apply the rule of :func:`smooth_depth` pixel by pixel, in float64."""
    out = np.zeros_like(depth)
    padded = np.pad(depth, 1)
    sigma = CONFIG.tracking.sensor.sigma_depth_floor + CONFIG.tracking.sensor.sigma_depth_quad * depth**2
    bends = [
        abs((depth[v, u - 1] + depth[v, u + 1]) / 2 - depth[v, u]) / sigma[v, u]
        for v in range(0, depth.shape[0], 4)
        for u in range(1, depth.shape[1] - 1)
        if depth[v, u - 1 : u + 2].min() > 0
    ]
    share = min(1.0, float(np.median(bends)) / (0.6745 * np.sqrt(1.5)))
    for v, u in zip(*np.nonzero(depth > 0), strict=True):
        z, some = depth[v, u], [depth[v, u]]
        noise = 3.7 * share * sigma[v, u]
        for dv, du in ((0, 1), (1, 0), (1, 1), (1, -1)):
            a, b = padded[v + 1 + dv, u + 1 + du], padded[v + 1 - dv, u + 1 - du]
            if (
                min(a, b) > 0
                and abs(a - b) < CONFIG.mapping.surface_depth_tolerance * z
                and abs((a + b) / 2 - z) < noise
            ):
                some += [a, b]
        out[v, u] = np.mean(some)
    return out


def test_smoothed_depth_is_the_mean_of_pixels_of_one_surface(rng: np.random.Generator) -> None:
    depth = np.where(np.arange(40) < 17, 1.0, 1.6) + 0.002 * rng.standard_normal((30, 40))
    depth[rng.random(depth.shape) < 0.2] = 0.0
    depth = depth.astype(np.float32).astype(np.float64)
    expected = _smoothed_by_hand(depth)
    found = smooth_depth(depth.astype(np.float32), CONFIG.mapping, CONFIG.tracking)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert (expected != depth).mean() > 0.5


def test_a_slanted_plane_stays_where_it_is_and_a_third_of_its_noise_is_left(rng: np.random.Generator) -> None:
    exact = wall_depth(CAMERA, np.eye(4), [0.6, 0.0, 0.8], 1.0)
    inside = np.s_[1:-1, 1:-1]
    even = smooth_depth(exact.astype(np.float32), CONFIG.mapping, CONFIG.tracking)
    np.testing.assert_allclose(even[inside], exact[inside], rtol=1e-3)
    sigma = CONFIG.tracking.sensor.sigma_depth_floor + CONFIG.tracking.sensor.sigma_depth_quad * exact**2
    noisy = (exact + sigma * rng.standard_normal(exact.shape)).astype(np.float32)
    off = ((smooth_depth(noisy, CONFIG.mapping, CONFIG.tracking) - even) / sigma)[inside]
    assert off.std() < 0.4
    assert abs(off.mean()) < 0.02


def test_shape_beyond_the_noise_of_an_image_is_kept(rng: np.random.Generator) -> None:
    tracking = CONFIG.tracking
    sigma = tracking.sensor.sigma_depth_floor + tracking.sensor.sigma_depth_quad
    exact = np.where(np.arange(400) % 40 == 20, 1.0 - sigma, 1.0) * np.ones((80, 1))  # ridges, one pixel wide
    noisy = (exact + 0.1 * sigma * rng.standard_normal(exact.shape)).astype(np.float32)
    assert noise_share(noisy, tracking) == pytest.approx(0.1, abs=0.03)
    found = smooth_depth(noisy, CONFIG.mapping, tracking)
    ridge = found[:, 20::40]
    assert abs(ridge.mean() - (1.0 - sigma)) < 0.02 * sigma
    assert (found - exact).std() < 0.6 * (noisy - exact).std()


def test_the_noise_of_depth_is_estimated_from_one_image(rng: np.random.Generator) -> None:
    tracking = CONFIG.tracking
    exact = wall_depth(CAMERA, np.eye(4), [0.6, 0.0, 0.8], 1.0)
    sigma = tracking.sensor.sigma_depth_floor + tracking.sensor.sigma_depth_quad * exact**2
    for share in (0.2, 0.5, 1.0, 2.0):
        noisy = (exact + share * sigma * rng.standard_normal(exact.shape)).astype(np.float32)
        noisy[rng.random(noisy.shape) < 0.3] = 0.0
        assert noise_share(noisy, tracking) == pytest.approx(min(share, 1.0), rel=0.1)
    assert noise_share(np.zeros((4, 4), np.float32), tracking) == 0.0
    assert noise_share(np.zeros((1, 1), np.float32), tracking) == 0.0


def test_pixels_without_depth_stay_without_and_do_not_count() -> None:
    depth = np.full((5, 5), 1.5, np.float32)
    depth[2, 2], depth[0, 0] = 0.0, np.nan
    found = smooth_depth(depth, CONFIG.mapping, CONFIG.tracking)
    np.testing.assert_array_equal(found, np.where(depth > 0, depth, 0.0))
    assert smooth_depth(np.zeros((1, 1), np.float32), CONFIG.mapping, CONFIG.tracking).tolist() == [[0.0]]
