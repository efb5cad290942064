"""Drawing without a screen."""

from __future__ import annotations

import os
import sys


def draw_offscreen() -> None:
    """Have MuJoCo draw through EGL where there is no screen; to be called before anything imports mujoco."""
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")
