"""Rendering without a display, and films of twins."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from splatbot.sim.video import Video
    from splatbot.sim.world import World

CAMERA = {"at": [1.5, -0.9, 0.9], "look_at": [0.35, 0.0, 0.25], "width": 640, "height": 480}
"""Camera of films of scenes that have none, in the frame of the robot's base."""


def draw_offscreen() -> None:
    """Select EGL for MuJoCo without a display; call it before any import of mujoco."""
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")


@contextmanager
def film(path: Path | None, world: World, seed: int) -> Iterator[Video | None]:
    """Yield a video of the scene's camera, which records as a callback of a twin; None without a path."""
    if path is None:
        yield None
        return
    from splatbot.sim.camera import TwinCamera
    from splatbot.sim.dressing import dressed
    from splatbot.sim.video import Video

    video = Video(path, TwinCamera(dressed(world), seed=seed))
    try:
        yield video
    finally:
        video.close()
