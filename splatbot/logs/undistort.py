"""Images of a distorted camera to those of the pinhole camera with the same intrinsic matrix."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import CameraError

Pixels = NDArray[np.float32]

SourcePixels = Callable[[Camera], tuple[Pixels, Pixels]]
"""Returns the pixels (H, W) u and v of the image of a distorted camera for those of its pinhole camera."""

_MAX_SIDE = 16_384  # [px] of an image; OpenCV cannot resample sides above 32767
_MAX_PIXELS = 2**24
_LEAST_SHOWN = 0.25  # share of the pinhole image that a plausible lens shows
_RADII = 4096  # samples between the axis and the corner of an image
_ANGLES = 4096  # samples of the angle to the axis, up to π


class Undistorter:
    """Resamples colour bilinearly and depth to the nearest pixel, since depths across an edge must not be averaged.

    Pixels outside of the recorded image repeat the colour of the border, since black would be an edge for tracking.
    They have no depth, and neither have the other pixels that the lens does not show; see :func:`unseen`.

    Args:
        camera: distorted camera, also a fisheye.
        source: lens model. If None, it is :func:`source_pixels`: OpenCV's models, as :class:`Camera` describes them.

    Raises:
        CameraError: its images are too large.

    Attributes:
        camera: pinhole camera of the resampled images.
        unseen: pixels (H, W) of its images that the recorded image does not show.
    """

    def __init__(self, camera: Camera, source: SourcePixels | None = None) -> None:
        check_size(camera)
        self.camera = camera.pinhole
        self._map = (source or source_pixels)(camera)
        self.unseen = unseen(camera, self._map)

    def color(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Resample an image (H, W, 3) of the distorted camera to ``camera``."""
        out = cv2.remap(rgb, *self._map, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(out, dtype=np.uint8)

    def mask(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Resample a mask (H, W) of the distorted camera to ``camera``; pixels in ``unseen`` are False."""
        out = cv2.remap(mask.astype(np.uint8), *self._map, cv2.INTER_NEAREST, borderValue=0)
        return np.asarray((out > 0) & ~self.unseen)

    def depth(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Resample depth (H, W) [m] along the optical axis of the distorted camera to ``camera``."""
        out = cv2.remap(depth, *self._map, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        return np.where(self.unseen, np.float32(0), np.asarray(out, np.float32))


def check_size(camera: Camera) -> None:
    """Check that images of a camera can be resampled, before anything is allocated.

    Raises:
        CameraError: they have more than 16 megapixels, or a side is too long.
    """
    if max(camera.width, camera.height) > _MAX_SIDE or camera.width * camera.height > _MAX_PIXELS:
        hint = "give images of up to 16 megapixels"
        raise CameraError(f"is {camera.width}x{camera.height}.", field="image size", hint=hint)


def check_lens(camera: Camera) -> None:
    """Check that a pinhole image can show most of the view of a distorted camera.

    Raises:
        CameraError: a fisheye sees 180 degrees or more across its width or height, or the lens maps several rays to
            the pixels of most of the image.
    """
    if camera.fisheye:
        for side, angle in zip(("width", "height"), np.degrees(_fisheye_fields(camera)), strict=True):
            if angle >= 180.0:
                hint = "crop the images below 180 degrees, with width, height, cx and cy, or publish rectified images"
                raise CameraError(f"sees {angle:.0f} degrees across its {side}.", field="distortion", hint=hint)
    if camera.distortion:
        corner = float(np.hypot(*np.abs(_borders(camera)).max(axis=1)))
        shown = valid_radius(camera, corner) / corner
        if shown**2 < _LEAST_SHOWN:
            hint = "check the order of the coefficients and the model, and calibrate the camera again"
            raise CameraError(f"folds the image at {shown:.1%} of its radius.", field="distortion", hint=hint)


def source_pixels(camera: Camera) -> tuple[Pixels, Pixels]:
    """Return the pixels (H, W) u and v of the recorded image for those of the pinhole camera."""
    undistort = cv2.fisheye.initUndistortRectifyMap if camera.fisheye else cv2.initUndistortRectifyMap
    size, coefficients = (camera.width, camera.height), np.array(camera.distortion)
    u, v = undistort(camera.K, coefficients, np.eye(3), camera.K, size, cv2.CV_32FC1)
    return np.asarray(u, np.float32), np.asarray(v, np.float32)


def modified_source_pixels(camera: Camera) -> tuple[Pixels, Pixels]:
    """Return the pixels (H, W) u and v of an image with librealsense's modified Brown-Conrady lens.

    It differs from OpenCV's model in its tangential terms: they are those of the radially distorted point.
    ``rs2_project_point_to_pixel`` of librealsense defines it, for "inverse Brown-Conrady", too.

    Args:
        camera: with the coefficients k1, k2, p1, p2, k3.

    Raises:
        CameraError: it has another number of coefficients.
    """
    if len(camera.distortion) != 5:
        hint = "record it again, or give a camera file"
        raise CameraError(f"has {len(camera.distortion)} coefficients, not 5.", field="distortion", hint=hint)
    k1, k2, p1, p2, k3 = camera.distortion
    x = ((np.arange(camera.width) - camera.cx) / camera.fx)[None, :]
    y = ((np.arange(camera.height) - camera.cy) / camera.fy)[:, None]
    square = x**2 + y**2
    radial = np.polyval([k3, k2, k1, 1.0], square)
    x, y = x * radial, y * radial
    u = camera.cx + camera.fx * (x + 2 * p1 * x * y + p2 * (square + 2 * x**2))
    v = camera.cy + camera.fy * (y + 2 * p2 * x * y + p1 * (square + 2 * y**2))
    return u.astype(np.float32), v.astype(np.float32)


def unseen(camera: Camera, source: tuple[Pixels, Pixels]) -> NDArray[np.bool_]:
    """Return the pixels (H, W) of the pinhole camera that a recorded image does not show.

    The source of these pixels is outside of the image, or their ray is beyond the radius up to which the distorted
    radius grows. There the model maps a second ray to a pixel that shows another one.

    Args:
        camera: distorted camera.
        source: of :func:`source_pixels`.
    """
    (u, v), width, height = source, camera.width, camera.height
    inside = (u >= -0.5) & (u <= width - 0.5) & (v >= -0.5) & (v <= height - 0.5)
    x, y = (np.arange(width) - camera.cx) / camera.fx, (np.arange(height) - camera.cy) / camera.fy
    radius = np.hypot(x[None, :], y[:, None])
    return np.asarray(~inside | (radius > valid_radius(camera, float(radius.max()))))


def valid_radius(camera: Camera, largest: float) -> float:
    """Return the radius, in focal lengths, up to which the distorted radius grows; at most ``largest``."""
    radii = np.linspace(0.0, largest, _RADII)
    with np.errstate(all="ignore"):
        grows = np.diff(_distorted_radius(camera, radii)) > 0  # False for NaN
    return largest if grows.all() else float(radii[np.argmin(grows)])


def _distorted_radius(camera: Camera, r: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distort radii (N,) in focal lengths; terms that depend on the direction are left out."""
    if camera.fisheye:
        return _fisheye_radius(camera, np.arctan(r))
    k1, k2, _, _, k3, k4, k5, k6 = (*camera.distortion[:8], *[0.0] * (8 - len(camera.distortion)))
    return np.asarray(r * np.polyval([k3, k2, k1, 1.0], r**2) / np.polyval([k6, k5, k4, 1.0], r**2))


def _fisheye_radius(camera: Camera, theta: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distances (N,) from the principal point, in focal lengths, of rays at angles θ (N,) to the axis."""
    return np.asarray(theta * np.polyval([*camera.distortion[::-1], 1.0], theta**2))


def _fisheye_fields(camera: Camera) -> NDArray[np.float64]:
    """Return the angles (2,) [rad] between the rays at opposite borders: across the width, and the height."""
    theta = np.linspace(0.0, np.pi, _ANGLES)
    with np.errstate(all="ignore"):
        radius = _fisheye_radius(camera, theta)
        grows = np.diff(radius) > 0  # False for NaN
    count = len(theta) if grows.all() else int(np.argmin(grows)) + 1
    borders = _borders(camera)
    angles = np.sign(borders) * np.interp(np.abs(borders), radius[:count], theta[:count])
    return np.asarray(angles.sum(axis=1), np.float64)


def _borders(camera: Camera) -> NDArray[np.float64]:
    """Return the distances (2, 2) of left and right, top and bottom from the principal point, in focal lengths."""
    x = np.array([camera.cx + 0.5, camera.width - 0.5 - camera.cx]) / camera.fx
    y = np.array([camera.cy + 0.5, camera.height - 0.5 - camera.cy]) / camera.fy
    return np.stack([x, y])
