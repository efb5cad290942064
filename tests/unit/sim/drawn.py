"""Programs that draw: in a process of their own, as MUJOCO_GL must be set before mujoco is imported."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest


def run_drawing(program: str, *words: str) -> list[str]:
    """The lines that a program prints; the test is skipped, with the reason, where MuJoCo cannot draw."""
    env = {**os.environ, "MUJOCO_GL": "egl"}
    done = subprocess.run([sys.executable, "-c", program, *words], capture_output=True, text=True, env=env)
    if done.returncode != 0 and ("MuJoCo cannot draw here" in done.stderr or "OpenGL" in done.stderr):
        pytest.skip(f"MuJoCo cannot draw here: {done.stderr.strip().splitlines()[-1]}")
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()
