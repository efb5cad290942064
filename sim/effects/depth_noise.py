"""How depth cameras err: noise that grows with distance and tilt, a finite step, and holes along edges."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.sim.effects.base import Observable

_STEEPEST = np.radians(85.0)  # beyond, the fit of the noise has no data and soon no bound


@dataclass(frozen=True)
class DepthNoise:
    """Axial noise of structured-light and stereo cameras, quantisation and edge holes; colour is untouched.

    Args:
        strength: multiple of the published noise; 0 leaves quantisation and holes.
        step: the sensor's resolution [m]; 0 for none.
        edge_loss: share of the pixels near a depth edge that come back without depth, 0..1.
        edge_jump: what counts as an edge: a jump by this share of the nearer depth,
        edge_reach: within this many pixels.
        why: who asked for it.

    Raises:
        InputError: an argument is out of range.
    """

    strength: float = 1.0
    step: float = 0.001
    edge_loss: float = 0.5
    edge_jump: float = 0.03
    edge_reach: int = 2
    why: str = "asked for"
    name: str = "depth_noise"
    cost: ClassVar[str] = "a random number, a tilt and a rounding for each pixel"
    observable: ClassVar[Observable] = "depth"

    def __post_init__(self) -> None:
        for name in ("strength", "step", "edge_jump", "edge_reach"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise InputError(f"is {getattr(self, name)}.", field=name, hint="give a finite number >= 0")
        if not 0 <= self.edge_loss <= 1:
            raise InputError(f"is {self.edge_loss}.", field="edge_loss", hint="give a share in 0..1")

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """A frame with depth as a sensor would measure it; pixels without depth stay without."""
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
    """Standard deviation [m] of a depth [m] of a surface tilted away from the sensor by ``tilt`` [rad].

    Nguyen, Izadi, Lovell 2012, eq. 3: 0.0012 + 0.0019 (z - 0.4)² + 0.0001 / √z · θ² / (π/2 - θ)².
    """
    slant = (tilt / (np.pi / 2 - np.minimum(tilt, _STEEPEST))) ** 2
    return np.asarray(0.0012 + 0.0019 * (depth - 0.4) ** 2 + 0.0001 / np.sqrt(np.maximum(depth, 1e-3)) * slant)


def tilts(camera: Camera, depth: NDArray[np.float32]) -> NDArray[np.float64]:
    """Angle (H, W) [rad] between each pixel's ray and its surface's normal; 0 where there is no depth.

    The depth's slope is the lesser of those to both sides, so that an edge does not pass for a steep surface.
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
