"""Distortion of a lens that is not calibrated."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.sim.effects.base import SensorEffect, setting
from splatbot.sim.effects.warping import color_at, depth_at

_ITERATIONS = 40


@dataclass(frozen=True)
class LensDistortion(
    SensorEffect, cost="one warp of colour and one of depth; the warp map is computed once", observable="colors"
):
    """Simulated radial and tangential distortion of colour and depth; the frame's camera stays the pinhole.

    The model is OpenCV's (Brown-Conrady), with coefficients k1, k2, p1, p2, k3. Each distorted pixel samples the ideal
    image at its undistorted position. Colour is interpolated, depth is interpolated except across edges. Beyond the
    border of the ideal image the border colour repeats and depth is missing.

    Args:
        k1, k2, p1, p2, k3: OpenCV's coefficients; k1 below 0 is barrel distortion.

    Raises:
        InputError: a coefficient is not finite; on application, if the image would fold over itself.
    """

    k1: float = setting(-0.05)
    k2: float = setting(0.0)
    p1: float = setting(0.0)
    p2: float = setting(0.0)
    k3: float = setting(0.0)

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """Distort the frame."""
        at = _undistorted(frame.camera, (self.k1, self.k2, self.p1, self.p2, self.k3))
        return replace(frame, rgb=color_at(frame.rgb, at), depth=depth_at(frame.depth, at))


@lru_cache(maxsize=2)
def _undistorted(camera: Camera, coefficients: tuple[float, ...]) -> NDArray[np.float32]:
    """Return for each pixel of the distorted image its position (H, W, 2) [px] in the ideal image."""
    k1, k2, p1, p2, k3 = coefficients
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
    distorted = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy])
    r = np.linspace(0.0, 1.5 * float(np.hypot(*distorted).max()), 200)
    if (1 + 3 * k1 * r**2 + 5 * k2 * r**4 + 7 * k3 * r**6 <= 0).any():
        raise InputError("folds the image over itself.", field="lens_distortion", hint="take smaller coefficients")
    x, y = distorted
    for _ in range(_ITERATIONS):  # fixed-point inversion, because the model maps ideal to distorted positions
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        tangential = np.stack([2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y])
        x, y = (distorted - tangential) / radial
    return np.stack([x * camera.fx + camera.cx, y * camera.fy + camera.cy], axis=-1).astype(np.float32)
