"""The twin's camera: where MuJoCo puts it, and what its sensor does."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.sim.camera import intrinsics, pose_of
from splatbot.sim.scene import CameraSection

pytest.importorskip("mujoco")

_DEPTH = """
import numpy as np
from splatbot.sim.scene import make_scene
from splatbot.sim.twin import Twin
from splatbot.sim.camera import TwinCamera, pose_of
from splatbot.errors import NativeError
ball = {"name": "ball", "shapes": [{"kind": "sphere", "radius": 0.1}], "at": [0.5, 0.2, 0.4]}
camera = {"at": [1.5, -0.5, 0.9], "look_at": [0.5, 0.2, 0.4], "sensor": %s}
scene = make_scene({"name": "x", "robot": None, "objects": [ball], "camera": camera})
twin = Twin(scene)
try:
    eye = TwinCamera(twin.world)
except NativeError as error:
    print("cannot draw", error); raise SystemExit
frame = eye.frame(twin.data, 0, 0.0)
middle = frame.depth[119:121, 159:161].mean()
print(float(middle), float(np.linalg.norm([1.0, 0.7, 0.5]) - 0.1), [r["name"] for r in eye.report()])
"""


def _run(sensor: str) -> str:
    env = {**os.environ, "MUJOCO_GL": "egl"}
    done = subprocess.run([sys.executable, "-c", _DEPTH % sensor], capture_output=True, text=True, env=env)
    if done.returncode != 0 and "OpenGL" in done.stderr:
        pytest.skip("MuJoCo cannot draw here")
    assert done.returncode == 0, done.stderr
    if done.stdout.startswith("cannot draw"):
        pytest.skip(done.stdout)
    return done.stdout


def test_depth_is_that_of_the_scene_along_the_optical_axis() -> None:
    measured, true, *_ = _run("[]").split()
    assert float(measured) == pytest.approx(float(true), abs=1e-3)


def test_the_sensors_effects_are_on_the_account_and_change_the_depth() -> None:
    ideal, *_ = _run("[]").split()
    noisy, _, *names = _run('["depth_noise:strength=5"]').split()
    assert "".join(names) == "['depth_noise']"
    assert noisy != ideal


def test_the_camera_looks_where_it_is_told_with_y_down() -> None:
    T = pose_of(CameraSection(at=(1.0, 2.0, 3.0), look_at=(1.0, 5.0, 3.0)))
    np.testing.assert_allclose(T[:3, :3], [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-12)
    with pytest.raises(InputError, match="straight up or down"):
        pose_of(CameraSection(at=(0, 0, 1), look_at=(0, 0, 0)))


def test_the_field_of_view_is_the_scenes() -> None:
    camera = intrinsics(CameraSection(at=(0, 0, 1), look_at=(1, 0, 1), width=640, height=480, fov_y=0.8))
    assert 2 * np.arctan(240 / camera.fy) == pytest.approx(0.8)
    assert (camera.cx, camera.cy) == (319.5, 239.5)
