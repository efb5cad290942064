"""Images that shear because their lines are read one after the other."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.geometry import Array, inverse
from splatbot.sim.effects.base import Observable
from splatbot.sim.effects.warping import color_at, depth_at, flow, grid, motion_during
from splatbot.trajectory import Trajectory


@dataclass(frozen=True)
class RollingShutter:
    """Each line of colour and depth as seen when it is read, from top to bottom; the stamp is that of the middle line.

    The frame is warped by its own depth and the camera's motion, as :class:`MotionBlur` does it, so any source that
    knows its path will do. What was hidden behind a near edge at the stamp shows the edge's colour instead, pixels
    without depth count as infinitely far, and things that move on their own do not shear.

    Args:
        readout: time from the first line to the last [s].
        why: who asked for it.
        path: how the camera moves.

    Raises:
        InputError: the time is out of range; when applied: the path is not known.
    """

    readout: float = 0.02
    why: str = "asked for"
    name: str = "rolling_shutter"
    path: Trajectory | None = None
    cost: ClassVar[str] = "two warps of depth and one of colour"
    observable: ClassVar[Observable] = "colors"

    def __post_init__(self) -> None:
        if not (np.isfinite(self.readout) and self.readout >= 0):
            raise InputError(f"is {self.readout}.", field="readout", hint="give seconds >= 0")

    def along(self, path: Trajectory) -> RollingShutter:
        """The shutter of a camera that moves along ``path``."""
        return replace(self, path=path)

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame as it is read, line by line."""
        ends = motion_during(self.path, frame.stamp, self.readout, effect=self.name)
        depth, camera = frame.depth, frame.camera
        at = grid(*depth.shape)
        for _ in range(2):  # by the depth of where it looks, which is known better the second time
            at = grid(*depth.shape) + _by_line([flow(camera, depth_at(depth, at), T) for T in ends])
        seen = depth_at(depth, at)
        when = seen + _by_line([_nearer(camera, seen, at, T) for T in ends])
        return replace(frame, rgb=color_at(frame.rgb, at), depth=np.where(seen > 0, np.maximum(when, 0), 0))


def _by_line(ends: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    """What (H, W[, K]) is at the first and at the last line's time, at each line's own."""
    first, last = ends
    share = np.linspace(-1.0, 1.0, len(first), dtype=np.float32).reshape(-1, *[1] * (first.ndim - 1))
    return np.where(share < 0, -share * first, share * last)


def _nearer(
    camera: Camera, depth: NDArray[np.float32], at: NDArray[np.float32], T_now_then: Array
) -> NDArray[np.float32]:
    """How much deeper (H, W) [m] points at places (H, W, 2) of the view now lie in the view then."""
    R, t = inverse(T_now_then)[2, :3], inverse(T_now_then)[2, 3]
    x, y = (at[..., 0] - camera.cx) / camera.fx, (at[..., 1] - camera.cy) / camera.fy
    return np.asarray(depth * (R[0] * x + R[1] * y + R[2] - 1.0) + t, dtype=np.float32)
