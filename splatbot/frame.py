"""One RGB-D observation."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import InputError


@dataclass(frozen=True)
class Frame:
    """A colour image and the depth registered to it.

    Args:
        stamp: time [s].
        rgb: (H, W, 3) uint8.
        depth: (H, W) float32 [m] along the optical axis; 0 is missing. NaN and infinity are taken as missing (ROS
            32FC1 convention).
        camera: intrinsics of both images; undistorted.
        index: position in the log.
        joints: joint positions (n,) [rad] at ``stamp``, where a robot told them.
        source: what the frame came from (for messages).

    Raises:
        InputError: sizes differ, a type is wrong or depth is negative.
    """

    stamp: float
    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    camera: Camera
    index: int = 0
    joints: NDArray[np.float64] | None = None
    source: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        where = self.source or f"frame {self.index}"
        size = (self.camera.height, self.camera.width)
        if self.rgb.dtype != np.uint8 or self.rgb.ndim != 3 or self.rgb.shape[2] != 3:
            raise InputError(
                f"is {self.rgb.dtype} {self.rgb.shape}.", file=where, field="rgb", hint="give (H, W, 3) uint8"
            )
        if self.depth.dtype != np.float32 or self.depth.ndim != 2:
            raise InputError(
                f"is {self.depth.dtype} {self.depth.shape}.",
                file=where,
                field="depth",
                hint="give (H, W) float32 in metres",
            )
        if self.rgb.shape[:2] != self.depth.shape:
            raise InputError(
                f"colour is {self.rgb.shape[:2]}, depth is {self.depth.shape} (rows, columns).",
                file=where,
                field="depth size",
                hint="register depth to colour, at the colour image's size",
            )
        if self.rgb.shape[:2] != size:
            raise InputError(
                f"images are {self.rgb.shape[:2]}, the intrinsics are for {size} (rows, columns).",
                file=where,
                field="image size",
                hint="correct width and height of the intrinsics, or resize the images",
            )
        if not np.isfinite(self.depth).all():
            object.__setattr__(self, "depth", np.nan_to_num(self.depth, nan=0.0, posinf=0.0, neginf=0.0))
        if (self.depth < 0).any():
            raise InputError(
                f"has negative values (least {self.depth.min():.4g} m).",
                file=where,
                field="depth",
                hint="depth is the distance along the optical axis in metres, 0 where missing",
            )

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Pixels (H, W) that have a depth."""
        return self.depth > 0
