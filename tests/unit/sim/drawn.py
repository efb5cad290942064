"""Programs that render, in their own process, because MUJOCO_GL must be set before mujoco is imported."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest


def run_drawing(program: str, *words: str) -> list[str]:
    """Return the lines that a program prints; skip the test with the reason if MuJoCo cannot render."""
    env = {**os.environ, "MUJOCO_GL": "egl"}
    done = subprocess.run([sys.executable, "-c", program, *words], capture_output=True, text=True, env=env)
    if done.returncode != 0 and ("MuJoCo cannot draw here" in done.stderr or "OpenGL" in done.stderr):
        pytest.skip(f"MuJoCo cannot draw here: {done.stderr.strip().splitlines()[-1]}")
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()
