"""Errors of depth cameras: noise that grows with distance and tilt, quantization, and holes along edges."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.frame import Frame
from splatbot.sim.effects.base import SensorEffect, setting

_MAX_TILT = np.radians(85.0)  # [rad] the fit of the noise has no data beyond, and diverges


@dataclass(frozen=True)
class DepthNoise(SensorEffect, cost="a random number, a tilt and a rounding for each pixel", observable="depth"):
    """Simulated axial noise of depth cameras, quantization and edge holes; colour is unchanged.

    The standard deviation is that of :func:`axial_sigma` (Nguyen, Izadi, Lovell 2012, eq. 3), for structured-light and
    stereo cameras.

    Args:
        strength: factor of the published standard deviation; 0 leaves quantization and holes.
        step: quantization step [m]; 0 for none.
        edge_loss: fraction of the pixels near a depth edge that lose their depth, 0..1.
        edge_jump: relative depth step that counts as an edge.
        edge_reach: distance [px] from an edge within which depth is lost.

    Raises:
        InputError: an argument is out of range.
    """

    strength: float = setting(1.0, "give a finite number >= 0", low=0)
    step: float = setting(0.001, "give a finite number >= 0", low=0)
    edge_loss: float = setting(0.5, "give a share in 0..1", low=0, high=1)
    edge_jump: float = setting(0.03, "give a finite number >= 0", low=0)
    edge_reach: int = setting(2, "give a finite number >= 0", low=0)

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """Add noise to the depth; pixels without depth stay without."""
        z = frame.depth.astype(np.float64)
        lost = self._edges(frame.depth) & (rng.random(z.shape) < self.edge_loss)
        z += self.strength * axial_sigma(z, tilts(frame.camera, frame.depth)) * rng.standard_normal(z.shape)
        if self.step > 0:
            z = np.rint(z / self.step) * self.step
        z = np.maximum(z, self.step or np.finfo(np.float32).tiny)  # a measured depth is never "missing"
        return replace(frame, depth=np.where(frame.valid & ~lost, z, 0.0).astype(np.float32))

    def _edges(self, depth: NDArray[np.float32]) -> NDArray[np.bool_]:
        kernel = np.ones((2 * self.edge_reach + 1,) * 2, np.uint8)
        near = np.asarray(cv2.erode(np.where(depth > 0, depth, np.float32(np.inf)), kernel))
        far = np.asarray(cv2.dilate(depth, kernel))
        return np.asarray(far / (1.0 + self.edge_jump) > near, dtype=np.bool_)


def axial_sigma(depth: NDArray[np.float64], tilt: NDArray[np.float64] | float = 0.0) -> NDArray[np.float64]:
    """Compute the standard deviation [m] of depth [m] on a surface tilted away from the sensor by ``tilt`` [rad].

    Nguyen, Izadi, Lovell 2012, eq. 3: 0.0012 + 0.0019 (z - 0.4)² + 0.0001 / √z · θ² / (π/2 - θ)².
    """
    slant = (tilt / (np.pi / 2 - np.minimum(tilt, _MAX_TILT))) ** 2
    return np.asarray(0.0012 + 0.0019 * (depth - 0.4) ** 2 + 0.0001 / np.sqrt(np.maximum(depth, 1e-3)) * slant)


def tilts(camera: Camera, depth: NDArray[np.float32]) -> NDArray[np.float64]:
    """Compute the angle (H, W) [rad] between each pixel's ray and its surface normal; 0 without depth.

    The depth slope is the smaller of the two one-sided slopes, so that a depth edge does not count as a steep surface.
    """
    z = depth.astype(np.float64)
    across, down = (_slope(z, axis) for axis in (1, 0))
    u, v = np.arange(camera.width) - camera.cx, (np.arange(camera.height) - camera.cy)[:, None]
    normal = np.stack(
        [-across * camera.fx, -down * camera.fy, z + u * across + v * down]
    )  # its product with the ray: z
    length = np.linalg.norm(normal, axis=0) * np.sqrt(1.0 + (u / camera.fx) ** 2 + (v / camera.fy) ** 2)
    cosine = np.divide(z, length, out=np.ones_like(z), where=(depth > 0) & (length > 0))
    return np.asarray(np.arccos(np.clip(cosine, 0.0, 1.0)))


def _slope(z: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """Change of depth (H, W) to the next pixel, on the side where it changes less."""
    step = np.diff(z, axis=axis)
    known = np.minimum(*(np.delete(z, end, axis) for end in (0, -1))) > 0
    step = np.where(known, step, np.inf)
    edge = np.full_like(np.take(z, [0], axis), np.inf)
    ahead, behind = np.concatenate([step, edge], axis), np.concatenate([edge, step], axis)
    least = np.where(np.abs(ahead) < np.abs(behind), ahead, behind)
    return np.where(np.isfinite(least), least, 0.0)
