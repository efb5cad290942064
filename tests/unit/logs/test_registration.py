"""Colour of another camera at the pixels of the depth camera, against exact projections."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.camera import Camera
from splatbot.errors import CameraError, LogError
from splatbot.geometry import se3_exp, transform_points
from splatbot.logs.registration import ColorRegistration

DEPTH = Camera(60.0, 61.0, 31.5, 23.5, 64, 48)
COLOR = Camera(130.0, 131.0, 66.0, 47.0, 132, 96)
T_COLOR_DEPTH = se3_exp([0.05, -0.02, 0.01, 0.02, -0.03, 0.01])


def ramp(camera: Camera) -> np.ndarray:
    """Return an image whose red and green grow linearly with the column and row."""
    v, u = np.mgrid[: camera.height, : camera.width]
    return np.stack([u, 2 * v, np.full_like(u, 7)], axis=-1).astype(np.uint8)


def test_each_depth_pixel_takes_the_colour_of_its_exact_projection() -> None:
    z = np.random.default_rng(0).uniform(0.5, 3.0, (48, 64)).astype(np.float32)
    rgb, depth = ColorRegistration(COLOR, DEPTH, T_COLOR_DEPTH).register(ramp(COLOR), z, "frame")
    uv = COLOR.project(transform_points(T_COLOR_DEPTH, DEPTH.backproject(z)))
    # Inside by 3 pixels: reduction by areas and interpolation keep linear ramps there.
    inside = ((uv > 3) & (uv < np.array([COLOR.width, COLOR.height]) - 4)).all(-1)
    assert inside.mean() > 0.7
    np.testing.assert_allclose(rgb[inside][:, :2], uv[inside] * [1, 2], atol=1.6)
    np.testing.assert_array_equal(depth[inside], z[inside])


def test_pixels_without_depth_take_the_colour_of_the_point_at_infinity() -> None:
    registration = ColorRegistration(COLOR, DEPTH, T_COLOR_DEPTH)
    missing, _ = registration.register(ramp(COLOR), np.zeros((48, 64), np.float32), "frame")
    far, _ = registration.register(ramp(COLOR), np.full((48, 64), 1e7, np.float32), "frame")
    np.testing.assert_array_equal(missing, far)


def test_the_same_camera_returns_the_image_bit_for_bit() -> None:
    rgb = np.random.default_rng(1).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    z = np.linspace(0, 2, 48 * 64, dtype=np.float32).reshape(48, 64)
    color, depth = ColorRegistration(DEPTH, DEPTH).register(rgb, z, "frame")
    np.testing.assert_array_equal(color, rgb)
    np.testing.assert_array_equal(depth, z)


def test_a_larger_image_of_the_same_view_is_averaged_over_areas() -> None:
    fine = DEPTH.resized(256, 192)
    noise = np.random.default_rng(2).integers(0, 256, (192, 256, 3), dtype=np.uint8)
    color, _ = ColorRegistration(fine, DEPTH).register(noise, np.ones((48, 64), np.float32), "frame")
    means = noise.reshape(48, 4, 64, 4, 3).astype(np.float64).mean(axis=(1, 3))
    np.testing.assert_allclose(color, means, atol=0.51)


def test_depth_outside_of_the_colour_image_or_behind_its_camera_is_dropped() -> None:
    T = np.eye(4)
    T[0, 3] = 0.5
    z = np.ones((48, 64), np.float32)
    _, depth = ColorRegistration(DEPTH, DEPTH, T).register(ramp(DEPTH), z, "frame")
    np.testing.assert_array_equal(depth > 0, np.arange(64)[None, :].repeat(48, 0) + 30 <= 63.5)
    turned = np.diag([-1.0, 1.0, -1.0, 1.0])
    _, depth = ColorRegistration(DEPTH, DEPTH, turned).register(ramp(DEPTH), z, "frame")
    assert not depth.any()


@pytest.mark.parametrize(("rgb", "depth", "field"), [((4, 4), (48, 64), "colour"), ((96, 132), (4, 4), "depth")])
def test_an_image_of_another_size_is_refused(rgb: tuple[int, int], depth: tuple[int, int], field: str) -> None:
    with pytest.raises(LogError, match=f"a.png: {field} size"):
        ColorRegistration(COLOR, DEPTH).register(np.zeros((*rgb, 3), np.uint8), np.ones(depth, np.float32), "a.png")


@pytest.mark.parametrize("size", [(2**31 - 1, 2**31 - 1), (1, 2**20), (16_000, 16_000)])
def test_a_huge_camera_is_refused_before_anything_is_allocated(size: tuple[int, int]) -> None:
    with pytest.raises(CameraError, match="image size"):
        ColorRegistration(COLOR, Camera(60.0, 60.0, 30.0, 20.0, *size))
