"""Undistortion against closed forms in float64 and a ray-traced scene."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import CameraError
from splatbot.logs.undistort import Undistorter, check_lens, modified_source_pixels, source_pixels
from splatbot.protocols import Array
from tests.lenses import FISHEYE, fisheye_pixels, fisheye_rays, pinhole_rays, shelf

THIN = (0.1, -0.05, 0.002, -0.001, 0.01, 0.2, -0.04, 0.003, 0.004, -0.002, 0.003, 0.001)


def test_the_pixels_of_a_fisheye_are_those_of_its_polynomial() -> None:
    want = fisheye_pixels(FISHEYE, pinhole_rays(FISHEYE.pinhole))
    np.testing.assert_allclose(np.stack(source_pixels(FISHEYE), -1), want, atol=1e-3)


@pytest.mark.parametrize("lens", [THIN, (*THIN, 0.01, -0.02)], ids=["12", "14"])
def test_thin_prisms_and_tilted_sensors_are_undone_as_opencv_projects_them(lens: tuple[float, ...]) -> None:
    camera = Camera(120.0, 118.0, 81.0, 58.5, 160, 120, lens)
    rays = pinhole_rays(camera.pinhole).reshape(-1, 3)
    want = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.K, np.array(lens))[0].reshape(120, 160, 2)
    found = np.stack(source_pixels(camera), -1)
    np.testing.assert_allclose(found, want, atol=1e-3)
    plain = np.stack(source_pixels(Camera(120.0, 118.0, 81.0, 58.5, 160, 120, lens[:8])), -1)
    assert np.abs(found - plain).max() > 0.3  # the last coefficients count


def test_the_tangential_terms_of_librealsense_are_those_of_the_radially_distorted_point() -> None:
    k1, k2, p1, p2, k3 = lens = (0.3, -0.2, 0.02, -0.015, 0.05)
    camera = Camera(120.0, 118.0, 81.0, 58.5, 160, 120, lens)
    u, v = modified_source_pixels(camera)
    for row, column in ((0, 0), (119, 3), (58, 159), (17, 120)):
        x, y = (column - 81.0) / 120.0, (row - 58.5) / 118.0
        r2 = x * x + y * y
        f = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        want = 81.0 + 120.0 * (f * x + 2 * p1 * f * x * f * y + p2 * (r2 + 2 * f * x * f * x))
        assert u[row, column] == pytest.approx(want, abs=1e-4)
        want = 58.5 + 118.0 * (f * y + 2 * p2 * f * x * f * y + p1 * (r2 + 2 * f * y * f * y))
        assert v[row, column] == pytest.approx(want, abs=1e-4)
    radial = Camera(120.0, 118.0, 81.0, 58.5, 160, 120, (k1, k2, 0.0, 0.0, k3))
    np.testing.assert_allclose(modified_source_pixels(radial), source_pixels(radial), atol=1e-3)
    with pytest.raises(CameraError, match="distortion: has 4 coefficients, not 5"):
        modified_source_pixels(replace(radial, distortion=(k1, k2, 0.0, 0.0)))


def test_a_ray_traced_fisheye_becomes_the_ray_traced_pinhole_and_no_depth_is_between_two_surfaces() -> None:
    rgb, depth, _ = shelf(fisheye_rays(FISHEYE))
    lens = Undistorter(FISHEYE)
    found, z = lens.color(rgb), lens.depth(depth.astype(np.float32))
    want, exact, near = shelf(pinhole_rays(lens.camera))
    shown = z > 0
    assert shown[1:-1, 1:-1].mean() > 0.99
    edge = cv2.dilate(near.astype(np.uint8), np.ones((7, 7))) != cv2.erode(near.astype(np.uint8), np.ones((7, 7)))
    assert 0.02 < edge.mean() < 0.4
    smooth = shown & ~edge
    np.testing.assert_allclose(found[smooth].astype(int), want[smooth], atol=3)
    np.testing.assert_allclose(z[smooth], exact[smooth], atol=0.01)
    assert np.minimum(np.abs(z - 1.0), np.abs(z - 2.0))[shown].max() < 1e-6  # the shelf is 1 m away, the wall 2 m


def test_missing_depth_stays_missing_and_takes_no_value_from_its_neighbours() -> None:
    depth = np.ones((FISHEYE.height, FISHEYE.width), np.float32)
    depth[::2, ::2] = 0
    z = Undistorter(FISHEYE).depth(depth)
    assert set(np.unique(z)) == {0.0, 1.0}
    assert 0.1 < (z == 0).mean() < 0.5


def test_beyond_the_fold_of_a_lens_there_is_no_depth_and_nothing_to_track() -> None:
    camera = Camera(60.0, 60.0, 79.5, 59.5, 160, 120, (-0.5, 0.0, 0.0, 0.0))
    v, u = np.mgrid[:120, :160]
    distance = np.hypot(u - 79.5, v - 59.5) / 60
    fold = np.sqrt(1 / 1.5)  # the root of 1 + 3 k1 r²
    lens = Undistorter(camera)
    usable: NDArray[np.bool_] = lens.depth(np.ones((120, 160), np.float32)) > 0
    np.testing.assert_array_equal(usable[distance > fold + 0.01], False)
    assert usable[distance < fold - 0.01].all()
    np.testing.assert_array_equal(lens.mask(np.ones((120, 160), np.bool_)), usable)


def theta(camera: Camera, radius: float) -> float:
    """Return the angle of a ray by bisection, in float64."""
    low, high = 0.0, np.pi
    for _ in range(60):
        middle = (low + high) / 2
        k = np.array([1.0, *camera.distortion])
        low, high = (middle, high) if (k * middle ** np.arange(1, 10, 2)).sum() < radius else (low, middle)
    return low


@pytest.mark.parametrize("focal", [40.0, 45.0, 50.0, 55.0])
def test_a_fisheye_that_sees_180_degrees_is_refused_and_one_below_is_not(focal: float) -> None:
    camera = Camera(focal, focal, 79.5, 59.5, 160, 120, (0.02, -0.005, 0.001, 0.0), fisheye=True)
    angle = np.degrees(theta(camera, 80.0 / focal) * 2)
    if angle < 180:
        check_lens(camera)
        return
    with pytest.raises(CameraError, match=f"sees {angle:.0f} degrees across its width") as caught:
        check_lens(camera)
    assert "crop the images" in str(caught.value.hint)


def test_the_angles_of_both_borders_count_when_the_principal_point_is_not_in_the_middle() -> None:
    assert 2 * 80.0 / 60.0 < np.pi < 159.5 / 50.0 + 1.0 / 50.0
    check_lens(Camera(60.0, 60.0, 79.5, 59.5, 160, 120, (1e-9, 0.0, 0.0, 0.0), fisheye=True))
    with pytest.raises(CameraError, match=r"sees 18[0-9] degrees across its width"):
        check_lens(Camera(50.0, 50.0, 0.5, 59.5, 160, 120, (1e-9, 0.0, 0.0, 0.0), fisheye=True))


@pytest.mark.parametrize("lens", [(-3.0, 0.0, 0.0, 0.0), (1e300, -1e300, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, -1e200)])
def test_a_lens_that_folds_most_of_the_image_is_refused(lens: Array) -> None:
    camera = Camera(60.0, 60.0, 79.5, 59.5, 160, 120, tuple(lens))
    with pytest.raises(CameraError, match="folds the image") as caught:
        check_lens(camera)
    assert "order of the coefficients" in str(caught.value.hint)


def test_a_huge_image_is_refused_before_anything_is_allocated() -> None:
    with pytest.raises(CameraError, match="image size: is 400000x300000"):
        Undistorter(Camera(1e5, 1e5, 2e5, 1.5e5, 400_000, 300_000, (0.1, 0.0, 0.0, 0.0), fisheye=True))
