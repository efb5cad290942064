"""Colours that smear because the camera moves while the shutter is open."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.geometry import Array, inverse, se3_exp, se3_log
from splatbot.trajectory import Trajectory

_STILL_PX = 0.1  # a smear that no pixel shows


@dataclass(frozen=True)
class MotionBlur:
    """The mean of sub-exposures, each the frame warped by where its own depth says the pixels would be.

    Warping instead of rendering every sub-exposure anew makes it work for any source that knows its path (a ray caster,
    the twin, a recording with ground truth), at the cost of one warp per sub-exposure. The frame's stamp is the middle
    of the exposure. The warp is right to first order in the motion; what a near edge hides at the stamp is smeared from
    the edge itself. Pixels without depth count as infinitely far. Depth is untouched, and objects that move on their
    own are not smeared by that. 8-bit values are averaged as they are, without a camera's response curve.

    Args:
        exposure: how long the shutter is open [s].
        samples: most sub-exposures; fewer where the longest smear [px] is shorter than that.
        why: who asked for it.
        path: how the camera moves.

    Raises:
        InputError: an argument is out of range; when applied: the path is not known.
    """

    exposure: float = 0.02
    samples: int = 32
    why: str = "asked for"
    name: str = "motion_blur"
    path: Trajectory | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite(self.exposure) and self.exposure >= 0):
            raise InputError(f"is {self.exposure}.", field="exposure", hint="give seconds >= 0")
        if self.samples < 2:
            raise InputError(f"is {self.samples}.", field="samples", hint="give at least 2")

    def along(self, path: Trajectory) -> MotionBlur:
        """The blur of a camera that moves along ``path``."""
        return replace(self, path=path)

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame with smeared colours."""
        if self.path is None:
            raise InputError("does not know how the camera moves.", field=self.name, hint="give it the path: along()")
        now = inverse(pose_at(self.path, frame.stamp))
        ends = [now @ pose_at(self.path, frame.stamp + side * self.exposure / 2) for side in (-1, 1)]
        flows = [_flow(frame.camera, frame.depth, T_now_then) for T_now_then in ends]
        longest = float(np.abs(flows[0]).max() + np.abs(flows[1]).max())
        if longest < _STILL_PX:
            return frame
        count = int(np.clip(np.ceil(longest) + 1, 2, self.samples))
        return replace(frame, rgb=_mean_along(frame.rgb, flows, count))


def pose_at(path: Trajectory, t: float) -> Array:
    """T_world_camera (4, 4) at ``t`` [s]: constant twist between neighbours, and on beyond the ends."""
    if len(path) == 1:
        return path.T_world_camera[0]
    i = int(np.clip(np.searchsorted(path.stamps, t, "right") - 1, 0, len(path) - 2))
    a, b = path.T_world_camera[i], path.T_world_camera[i + 1]
    share = (t - path.stamps[i]) / (path.stamps[i + 1] - path.stamps[i])
    return np.asarray(a @ se3_exp(share * se3_log(inverse(a) @ b)))


def _flow(camera: Camera, depth: NDArray[np.float32], T_now_then: Array) -> NDArray[np.float32]:
    """How far (H, W, 2) [px] from a pixel of the view then lies, in the view now, what it shows."""
    rays = camera.backproject(np.ones_like(depth))
    R, t = T_now_then[:3, :3].astype(np.float32), T_now_then[:3, 3].astype(np.float32)
    nearness = np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0)
    # x/z of R·ray·depth + t, divided by the depth so that infinitely far is a number
    x, y, z = (R[k, 0] * rays[..., 0] + R[k, 1] * rays[..., 1] + R[k, 2] + t[k] * nearness for k in range(3))
    z = np.maximum(z, np.float32(1e-3))  # what would be behind the camera goes out of the image
    u = (x / z - rays[..., 0]) * np.float32(camera.fx)
    v = (y / z - rays[..., 1]) * np.float32(camera.fy)
    return np.stack([u, v], axis=-1)


def _mean_along(rgb: NDArray[np.uint8], flows: list[NDArray[np.float32]], count: int) -> NDArray[np.uint8]:
    height, width = rgb.shape[:2]
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float32)
    total = np.zeros(rgb.shape, np.float32)
    for s in (np.arange(count) + 0.5) / count * 2 - 1:
        at = grid + np.float32(abs(s)) * flows[int(s > 0)]
        total += cv2.remap(rgb, at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.rint(total / count).astype(np.uint8)
