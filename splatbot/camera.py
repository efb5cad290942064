"""A camera: intrinsics, distortion and image size."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.errors import CameraError

_MIN_FIELD_DEG, _MAX_FIELD_DEG = 1.0, 170.0  # field of view of a camera that can be mapped


@dataclass(frozen=True)
class Camera:
    """Pinhole camera; axes as OpenCV (x right, y down, z forward).

    A point (x, y, z) [m] of the camera frame projects to u = fx·x/z + cx, v = fy·y/z + cy. Integer (u, v) is the
    centre of a pixel. ``distortion`` are OpenCV's (k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4[, τx, τy]]]]);
    empty when undistorted.

    With ``fisheye`` they are k1 to k4 of the equidistant model (Kannala and Brandt 2006). A ray at the angle θ to the
    axis is then at f·(θ + k1·θ³ + k2·θ⁵ + k3·θ⁷ + k4·θ⁹) from the principal point.

    Raises:
        CameraError: an intrinsic is not finite or not positive, or the coefficients are not finite or too few or many.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, ...] = ()
    fisheye: bool = False

    def __post_init__(self) -> None:
        for name in ("fx", "fy", "cx", "cy"):
            if not np.isfinite(getattr(self, name)):
                raise CameraError(f"is {getattr(self, name)}.", field=name, hint="give a finite value in pixels")
        for name in ("fx", "fy", "width", "height"):
            if getattr(self, name) <= 0:
                raise CameraError(f"is {getattr(self, name)}, must be positive.", field=name, hint="check the unit: px")
        if len(self.distortion) not in ((4,) if self.fisheye else (0, 4, 5, 8, 12, 14)):
            hint = "give 4: k1 to k4 of the fisheye" if self.fisheye else "OpenCV's 4, 5, 8, 12 or 14, or none"
            raise CameraError(f"has {len(self.distortion)} coefficients.", field="distortion", hint=hint)
        if not np.isfinite(self.distortion).all():
            raise CameraError("has values that are not finite.", field="distortion", hint="calibrate the camera again")

    def check_plausible(self) -> None:
        """Check that the intrinsics can be those of a recorded image.

        Raises:
            CameraError: the field of view is outside 1..170 degrees, or the principal point is far from the image.
        """
        for name, focal, length in (("fx", self.fx, self.width), ("fy", self.fy, self.height)):
            angle = float(np.degrees(2 * np.arctan(0.5 * length / focal)))
            if not _MIN_FIELD_DEG <= angle <= _MAX_FIELD_DEG:
                raise CameraError(
                    f"is {focal:.6g} px for {length} px, a field of view of {angle:.3g} degrees.",
                    field=name,
                    hint=f"give pixels; {_MIN_FIELD_DEG:g} to {_MAX_FIELD_DEG:g} degrees are taken",
                )
        for name, center, length in (("cx", self.cx, self.width), ("cy", self.cy, self.height)):
            if not -0.5 * length <= center <= 1.5 * length:
                raise CameraError(
                    f"is {center:.6g} px, far from the {length} px of the image.",
                    field=name,
                    hint="give the principal point in pixels of this image",
                )

    @property
    def pinhole(self) -> Camera:
        """Return the undistorted camera with the same intrinsic matrix and size."""
        return replace(self, distortion=(), fisheye=False)

    @property
    def K(self) -> NDArray[np.float64]:
        """Intrinsic matrix (3, 3) for pixel centres at integers (OpenCV's convention)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def K_corner(self) -> NDArray[np.float64]:
        """Intrinsic matrix (3, 3) for pixel centres at +0.5 (the rasterizer's and gsplat's convention)."""
        K = self.K
        K[:2, 2] += 0.5
        return K

    def resized(self, width: int, height: int) -> Camera:
        """Return the same camera with images of another size [px]; the scaling maps pixel areas, not pixel centres."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
            width=width,
            height=height,
        )

    def project(self, points_camera: ArrayLike) -> NDArray[np.float64]:
        """Project points (..., 3) [m] of the camera frame with z > 0 to pixels (..., 2); distortion is not applied."""
        p = np.asarray(points_camera, dtype=np.float64)
        return np.stack([self.fx * p[..., 0] / p[..., 2] + self.cx, self.fy * p[..., 1] / p[..., 2] + self.cy], -1)

    def backproject(self, depth: ArrayLike) -> NDArray[np.float32]:
        """Backproject to points (H, W, 3) [m] of the camera frame a depth image (H, W) [m]; depth 0 gives the origin.

        Raises:
            CameraError: the image is not of this camera's size.
        """
        z = np.asarray(depth, dtype=np.float32)
        if z.shape != (self.height, self.width):
            raise CameraError(
                f"depth is {z.shape}, the camera is {(self.height, self.width)}.",
                field="depth",
                hint="pass the image that belongs to the camera, or Camera.resized",
            )
        x = ((np.arange(self.width) - self.cx) / self.fx).astype(np.float32)
        y = ((np.arange(self.height) - self.cy) / self.fy).astype(np.float32)
        return np.stack([z * x[None, :], z * y[:, None], z], axis=-1)
