"""A depth camera that differs from the colour camera in time, direction and distance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from splatbot.frame import Frame
from splatbot.geometry import inverse
from splatbot.sim.effects.base import CameraMotionEffect, setting
from splatbot.sim.effects.warping import depth_at, flow, grid, pose_at


@dataclass(frozen=True)
class DepthCamera(CameraMotionEffect, cost="two warps of depth", observable="depth"):
    """Simulated depth image of another time, shifted on the colour image, with a constant error of distance.

    Depth is warped to the camera pose of the later time by itself, as in :class:`RollingShutter`; colour is unchanged.

    Args:
        delay: time by which depth is later than colour [s].
        right: shift of depth to the right of its colour [px].
        down: shift of depth below its colour [px].
        bias: error of the distance: a measured depth is smaller by this [m].

    Raises:
        InputError: a setting is out of range; on application, if there is a delay and the path is not known.
    """

    delay: float = setting(0.0, "give seconds in -0.2..0.2", low=-0.2, high=0.2)
    right: float = setting(0.0)
    down: float = setting(0.0)
    bias: float = setting(0.0)

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """Warp and shift the depth of the frame."""
        depth, at = frame.depth, grid(*frame.depth.shape)
        if self.delay:
            path = self.known_path()
            T_now_then = inverse(pose_at(path, frame.stamp)) @ pose_at(path, frame.stamp + self.delay)
            for _ in range(2):
                at = grid(*depth.shape) + flow(frame.camera, depth_at(depth, at), T_now_then)
            seen = depth_at(depth, at)
            x, y = (at[..., 0] - frame.camera.cx) / frame.camera.fx, (at[..., 1] - frame.camera.cy) / frame.camera.fy
            R, t = inverse(T_now_then)[2, :3], inverse(T_now_then)[2, 3]
            depth = np.where(seen > 0, seen * (R[0] * x + R[1] * y + R[2]) + t, 0).astype(np.float32)
        if self.right or self.down:
            depth = depth_at(depth, grid(*depth.shape) - np.array([self.right, self.down], np.float32))
        return replace(frame, depth=np.where(depth > 0, np.maximum(depth - np.float32(self.bias), 0), np.float32(0)))
