"""Camera: conventions, resizing, and invalid inputs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from splatbot.camera import Camera
from splatbot.errors import CameraError

CAMERA = Camera(500.0, 510.0, 320.3, 241.7, 640, 480)


def test_projection_equals_opencv(rng: np.random.Generator) -> None:
    points = rng.uniform([-1, -1, 0.5], [1, 1, 3], (50, 3))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), CAMERA.K, np.zeros(5))
    np.testing.assert_allclose(CAMERA.project(points), expected[:, 0], atol=1e-10)


def test_backprojection_inverts_projection(rng: np.random.Generator) -> None:
    depth = rng.uniform(0.5, 3, (480, 640)).astype(np.float32)
    points = CAMERA.backproject(depth)
    v, u = np.mgrid[0:480, 0:640]
    assert points.dtype == np.float32
    np.testing.assert_allclose(CAMERA.project(points), np.stack([u, v], -1), atol=1e-3)
    assert np.array_equal(points[..., 2], depth)


def test_pixels_without_depth_give_the_origin() -> None:
    assert not CAMERA.backproject(np.zeros((480, 640))).any()


def test_an_image_of_another_size_is_refused() -> None:
    with pytest.raises(CameraError) as caught:
        CAMERA.backproject(np.zeros((240, 320)))
    assert caught.value.field == "depth"


def test_the_corner_convention_differs_by_half_a_pixel() -> None:
    difference = CAMERA.K_corner - CAMERA.K
    assert difference[:2, 2].tolist() == [0.5, 0.5]
    assert np.count_nonzero(difference) == 2


def test_resizing_keeps_the_rays_of_pixel_areas() -> None:
    half = CAMERA.resized(320, 240)
    # The outer corners of the image see the same rays at any resolution.
    for x, y in ((0.0, 0.0), (1.0, 1.0), (0.25, 0.8)):
        big = ((x * 640 - 0.5 - CAMERA.cx) / CAMERA.fx, (y * 480 - 0.5 - CAMERA.cy) / CAMERA.fy)
        small = ((x * 320 - 0.5 - half.cx) / half.fx, (y * 240 - 0.5 - half.cy) / half.fy)
        assert small == pytest.approx(big, abs=1e-14)
    back = half.resized(640, 480)
    np.testing.assert_allclose(back.K, CAMERA.K, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"fx": 0.0}, "fx"),
        ({"fy": -1.0}, "fy"),
        ({"cx": float("nan")}, "cx"),
        ({"fx": float("inf")}, "fx"),
        ({"width": 0}, "width"),
        ({"height": -480}, "height"),
        ({"distortion": (0.1, 0.2, 0.3)}, "distortion"),
    ],
)
def test_senseless_intrinsics_are_named(change: dict[str, Any], field: str) -> None:
    with pytest.raises(CameraError) as caught:
        replace(CAMERA, **change)
    assert caught.value.field == field
    assert caught.value.hint
