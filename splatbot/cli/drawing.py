"""Rendering without a display."""

from __future__ import annotations

import os
import sys


def draw_offscreen() -> None:
    """Select EGL for MuJoCo without a display; call it before any import of mujoco."""
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")
