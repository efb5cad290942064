"""Image shear by a shutter that reads the lines one after the other."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.frame import Frame
from splatbot.geometry import Array
from splatbot.sim.effects.base import CameraMotionEffect, setting
from splatbot.sim.effects.warping import color_at, depth_at, flow, grid, motion_of_lines


@dataclass(frozen=True)
class RollingShutter(CameraMotionEffect, cost="two warps of depth and one of colour", observable="colors"):
    """Simulated rolling shutter: each line of colour and depth as seen at its readout time, from top to bottom.

    The stamp is that of the middle line. The frame is warped by its own depth and the camera motion, as in
    :class:`MotionBlur`, so any source with a known camera path works.

    Limits: surfaces hidden by an edge at the stamp take the colour of the edge. Pixels without depth count as
    infinitely far. Moving objects are not sheared by their own motion.

    Args:
        readout: time from the first line to the last [s].

    Raises:
        InputError: the time is out of range; on application, if the path is not known.
    """

    readout: float = setting(0.02, "give seconds >= 0", low=0)

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """Warp the frame line by line."""
        T_now_line = motion_of_lines(self.known_path(), frame.stamp, self.readout, frame.camera.height)
        depth, camera = frame.depth, frame.camera
        at = grid(*depth.shape)
        for _ in range(2):  # the second iteration uses the depth at the position that the first one found
            at = grid(*depth.shape) + flow(camera, depth_at(depth, at), T_now_line)
        seen = depth_at(depth, at)
        depth_then = seen + _depth_change(camera, seen, at, T_now_line)
        return replace(frame, rgb=color_at(frame.rgb, at), depth=np.where(seen > 0, np.maximum(depth_then, 0), 0))


def _depth_change(
    camera: Camera, depth: NDArray[np.float32], at: NDArray[np.float32], T_now_line: Array
) -> NDArray[np.float32]:
    """Compute the change of depth (H, W) [m] from now to each line (H, 4, 4) of points at pixels (H, W, 2) now."""
    R = T_now_line[:, :3, 2].T[..., None]  # third row of the inverse rotation of each line
    t = -np.einsum("hi,hi->h", T_now_line[:, :3, 2], T_now_line[:, :3, 3])[:, None]
    x, y = (at[..., 0] - camera.cx) / camera.fx, (at[..., 1] - camera.cy) / camera.fy
    return np.asarray(depth * (R[0] * x + R[1] * y + R[2] - 1.0) + t, dtype=np.float32)
