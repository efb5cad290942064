"""How depth cameras err: noise that grows with distance, a finite step, and holes along edges."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.errors import InputError
from splatbot.frame import Frame


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
        z += self.strength * axial_sigma(z) * rng.standard_normal(z.shape)
        if self.step > 0:
            z = np.rint(z / self.step) * self.step
        z = np.maximum(z, self.step or np.finfo(np.float32).tiny)  # a measured depth is never "missing"
        return replace(frame, depth=np.where(frame.valid & ~lost, z, 0.0).astype(np.float32))

    def _edges(self, depth: NDArray[np.float32]) -> NDArray[np.bool_]:
        kernel = np.ones((2 * self.edge_reach + 1,) * 2, np.uint8)
        near = np.asarray(cv2.erode(np.where(depth > 0, depth, np.float32(np.inf)), kernel))
        far = np.asarray(cv2.dilate(depth, kernel))
        return np.asarray(far / (1.0 + self.edge_jump) > near, dtype=np.bool_)


def axial_sigma(depth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviation [m] of a depth [m] (Nguyen, Izadi, Lovell 2012, eq. 1; surfaces tilted by less than 60°)."""
    return 0.0012 + 0.0019 * (depth - 0.4) ** 2
