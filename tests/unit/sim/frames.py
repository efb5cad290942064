"""Frames for tests of effects."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from splatbot.camera import Camera
from splatbot.frame import Frame

CAMERA = Camera(200.0, 200.0, 99.5, 74.5, 200, 150)


def frame_at(depth: ArrayLike = 1.0, index: int = 0, *, rgb: ArrayLike = 90) -> Frame:
    """Return a frame of 200x150 pixels with this depth [m] and colour, at 30 Hz."""
    z = np.broadcast_to(np.asarray(depth, np.float32), (150, 200)).copy()
    color = np.broadcast_to(np.asarray(rgb, np.uint8), (150, 200, 3)).copy()
    return Frame(index / 30, color, z, CAMERA, index)
