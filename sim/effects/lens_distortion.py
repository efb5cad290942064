"""A lens that bends straight lines, and that nobody calibrated."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.sim.effects.base import Observable
from splatbot.sim.effects.warping import color_at, depth_at

_ROUNDS = 40


@dataclass(frozen=True)
class LensDistortion:
    """OpenCV's radial and tangential distortion of colour and depth; the frame's camera remains the pinhole it claims.

    A distorted pixel shows what the ideal image shows at the undistorted place: colour between pixels, depth likewise,
    but not across edges. What lay outside the ideal image repeats its border and has no depth.

    Args:
        k1, k2, p1, p2, k3: OpenCV's coefficients; k1 below 0 is a barrel.
        why: who asked for it.

    Raises:
        InputError: a coefficient is not finite; when applied: the image would fold over itself.
    """

    k1: float = -0.05
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    why: str = "asked for"
    name: str = "lens_distortion"
    cost: ClassVar[str] = "a warp of colour and one of depth; where each pixel looks is found once"
    observable: ClassVar[Observable] = "colors"

    def __post_init__(self) -> None:
        for name in ("k1", "k2", "p1", "p2", "k3"):
            if not np.isfinite(getattr(self, name)):
                raise InputError(f"is {getattr(self, name)}.", field=name, hint="give a finite number")

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame as such a lens gives it."""
        at = _undistorted(frame.camera, (self.k1, self.k2, self.p1, self.p2, self.k3))
        return replace(frame, rgb=color_at(frame.rgb, at), depth=depth_at(frame.depth, at))


@lru_cache(maxsize=2)
def _undistorted(camera: Camera, coefficients: tuple[float, ...]) -> NDArray[np.float32]:
    """Where (H, W, 2) [px] in the ideal image the pixels of the distorted one look."""
    k1, k2, p1, p2, k3 = coefficients
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
    distorted = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy])
    r = np.linspace(0.0, 1.5 * float(np.hypot(*distorted).max()), 200)
    if (1 + 3 * k1 * r**2 + 5 * k2 * r**4 + 7 * k3 * r**6 <= 0).any():
        raise InputError("folds the image over itself.", field="lens_distortion", hint="take smaller coefficients")
    x, y = distorted
    for _ in range(_ROUNDS):  # the model is given from ideal to distorted places; a fixed point leads back
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        bent = np.stack([2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y])
        x, y = (distorted - bent) / radial
    return np.stack([x * camera.fx + camera.cx, y * camera.fy + camera.cy], axis=-1).astype(np.float32)
