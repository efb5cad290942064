"""The twin's camera: its pose in MuJoCo, and its sensor effects."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.sim.camera import intrinsics, pose_of
from splatbot.sim.scene import CameraSection
from tests.unit.sim.drawn import run_drawing

pytest.importorskip("mujoco")

_DEPTH = """
import numpy as np
from splatbot.sim.scene import make_scene
from splatbot.sim.twin import Twin
from splatbot.sim.camera import TwinCamera, pose_of
ball = {"name": "ball", "shapes": [{"kind": "sphere", "radius": 0.1}], "at": [0.5, 0.2, 0.4]}
camera = {"at": [1.5, -0.5, 0.9], "look_at": [0.5, 0.2, 0.4], "sensor": %s}
scene = make_scene({"name": "x", "robot": None, "objects": [ball], "camera": camera})
twin = Twin(scene)
eye = TwinCamera(twin.world)
frame = eye.frame(twin.data, 0, 0.0)
middle = frame.depth[119:121, 159:161].mean()
print(float(middle), float(np.linalg.norm([1.0, 0.7, 0.5]) - 0.1), [r["name"] for r in eye.report()])
"""

_ANYWHERE = """
import numpy as np
from splatbot.camera import Camera
from splatbot.geometry import look_at
from splatbot.sim.scene import make_scene
from splatbot.sim.twin import Twin
from splatbot.sim.camera import TwinCamera
ball = {"name": "ball", "shapes": [{"kind": "sphere", "radius": 0.02}], "at": [0.5, 0.2, 0.4]}
scene = make_scene({"name": "x", "robot": None, "objects": [ball], "camera": {"at": [1, 0, 1], "look_at": [0, 0, 0]}})
twin = Twin(scene)
camera = Camera(310.0, 290.0, 140.0, 130.0, 320, 240)
eye = TwinCamera(twin.world, camera=camera)
T = look_at(np.array([-0.3, -0.6, 0.8]), np.array([0.45, 0.1, 0.35]))
alpha = eye.view(twin.data, T).alpha
v, u = np.nonzero(alpha)
w = alpha[v, u]
print(np.average(u, weights=w), np.average(v, weights=w), *camera.project((np.linalg.inv(T) @ [0.5, 0.2, 0.4, 1])[:3]))
"""

_AMONG_GAUSSIANS = """
from splatbot.bench.twin.composite import exact_map
found = exact_map(6, 60_000, width=320, seed=1)
print(*found.overlap)
print(*found.astray)
"""

_FILMED = """
from splatbot.bench.twin.composite import filmed_map
found = filmed_map(6, 40, width=240)
print(*found.overlap)
print(*found.plain_db)
print(*found.composite_db)
"""

_MOVED = """
import sys, numpy as np
from splatbot.gaussians import GaussianModel
from splatbot.geometry import look_at
from splatbot.sim.scene import make_scene
from splatbot.sim.twin import Twin
from splatbot.sim.camera import TwinCamera
rng = np.random.default_rng(0)
floor = np.stack([*rng.uniform(-0.6, 0.6, (2, 12000)), np.zeros(12000)], 1)
side = rng.uniform(-0.05, 0.05, (3000, 3))
side[np.arange(3000), rng.integers(0, 3, 3000)] = 0.05 * rng.choice([-1, 1], 3000)
box = side + [0.2, 0.0, 0.05]
means = np.concatenate([floor, box])
colors = np.where(means[:, 2:] > 0.02, [0.9, 0.1, 0.1], 0.2)  # lower, it is hardly distinguishable from the table
quats, scales = np.tile([1.0, 0, 0, 0], (15000, 1)), np.full((15000, 3), 0.005)
opacities = np.full(15000, 0.9)
model = GaussianModel.from_activated(means=means, quats=quats, scales=scales, opacities=opacities, colors=colors)
model.save(sys.argv[1])
camera = {"at": [0, 0, 1], "look_at": [1, 0, 0]}
gaussians = {"file": sys.argv[1], "movable": True}
twin = Twin(make_scene({"name": "x", "robot": None, "map": gaussians, "camera": camera}))
eye = TwinCamera(twin.world)
T = look_at(np.array([0.2, -0.8, 0.9]), np.array([0.2, 0.0, 0.05]))
movable = next(o.name for o in twin.world.scene.objects if o.movable)
start = twin.data.body("object/" + movable).xpos.copy()
for shift in (0.0, 0.15):
    twin.data.qpos[:3] = start + [shift, 0, 0]
    import mujoco
    mujoco.mj_kinematics(twin.world.model, twin.data)
    red = (eye.view(twin.data, T).rgb().astype(int) @ [1, -1, 0]) > 100
    v, u = np.nonzero(red)
    top = (np.linalg.inv(T) @ [0.2 + shift, 0.0, 0.05, 1])[:3]
    print(len(u), u.mean(), eye.camera.project(top)[0])
"""


_IDEAL = """
from splatbot.sim.effects.registry import EFFECTS, effect_class
from splatbot.sim.scene import load_scene, make_scene
from splatbot.sim.twin import Twin
from splatbot.sim.camera import TwinCamera
calls = []
for name in EFFECTS:
    kind = effect_class(name)
    def watched(self, frame, rng, really=kind.apply, name=name):
        calls.append(name)
        return really(self, frame, rng)
    kind.apply = watched
camera = {"at": [1.5, -0.5, 0.9], "look_at": [0.5, 0.2, 0.4], "width": 64, "height": 48}
for sensor, scene in (([], {}), (["color_noise"], {"effects": {"force": ["exposure"], "forbid": ["color_noise"]}})):
    twin = Twin(make_scene({"name": "x", "camera": camera | {"sensor": sensor}, **scene}))
    eye = TwinCamera(twin.world)
    for i in range(3):
        eye.frame(twin.data, i, 0.1 * i)
    eye.close()
    on = [d.name for d in twin.world.decisions if d.on]
    print(sorted(calls), [(row["name"], row["frames"]) for row in eye.report()], on)
    calls.clear()
"""

_LATE = """
import numpy as np
from splatbot.sim.scene import make_scene
from splatbot.sim.twin import Twin
from splatbot.sim.camera import TwinCamera
camera = {"at": [1.5, -0.5, 0.9], "look_at": [0.4, 0.0, 0.4], "width": 64, "height": 48}
twins = [Twin(make_scene({"name": "x", "camera": camera | {"sensor": s}})) for s in ([], ["latency:delay=0.15"])]
prompt, late = (TwinCamera(twin.world) for twin in twins)
home = np.array(twins[0].world.robot.home)
taken = []
for i in range(5):
    q = home + 0.1 * i
    for twin in twins:
        twin.reset(q)
    taken.append(prompt.frame(twins[0].data, i, 0.1 * i))
    frame = late.frame(twins[1].data, i, 0.1 * i)
    if frame is None:
        print(i, None)
    else:
        old = (frame.rgb == taken[i - 2].rgb).all()
        print(i, frame.index, f"{frame.stamp:.2f}", bool(old), bool(np.allclose(frame.joints, q)))
"""


def _run(sensor: str) -> str:
    return run_drawing(_DEPTH % sensor)[0]


def test_depth_is_that_of_the_scene_along_the_optical_axis() -> None:
    measured, true, *_ = _run("[]").split()
    assert float(measured) == pytest.approx(float(true), abs=1e-3)


@pytest.mark.long
def test_the_sensors_effects_are_on_the_account_and_change_the_depth() -> None:
    ideal, *_ = _run("[]").split()
    noisy, _, *names = _run('["depth_noise:strength=5"]').split()
    assert "".join(names) == "['depth_noise']"
    assert noisy != ideal


@pytest.mark.long
def test_what_no_one_asked_the_sensor_for_is_never_called() -> None:
    ideal, chosen = run_drawing(_IDEAL)
    assert ideal == "[] [] []"
    assert chosen == "['exposure', 'exposure', 'exposure'] [('exposure', 3)] ['exposure']"


@pytest.mark.long
def test_a_late_frame_shows_the_past_with_the_joints_of_the_present() -> None:
    """Taken every 0.1 s and 0.15 s on the way: each is handed over at the second call after its own."""
    lines = run_drawing(_LATE)
    assert lines[:2] == ["0 None", "1 None"]
    assert lines[2:] == [f"{i} {i - 2} {0.1 * (i - 2) + 0.15:.2f} True True" for i in (2, 3, 4)]


@pytest.mark.long
def test_any_pinhole_anywhere_shows_a_ball_where_it_projects_to() -> None:
    u, v, true_u, true_v = map(float, run_drawing(_ANYWHERE)[0].split())
    assert u == pytest.approx(true_u, abs=0.2)
    assert v == pytest.approx(true_v, abs=0.2)


@pytest.mark.long
def test_a_robot_among_gaussians_is_in_front_exactly_where_it_is_nearer() -> None:
    """Against MuJoCo's segmentation of the true shapes; a wrong pixel lies on an outline, which is soft in a map."""
    overlap, astray = (np.array(line.split(), float) for line in run_drawing(_AMONG_GAUSSIANS))
    assert len(overlap) == 6
    assert np.median(overlap) > 0.99
    assert overlap.min() > 0.98
    assert astray.max() < 4.0


@pytest.mark.long
def test_where_no_body_is_the_picture_is_as_good_as_the_maps_alone() -> None:
    """A map of a noisy film, seen from where frames were taken that it was not given."""
    overlap, plain, composite = (np.array(line.split(), float) for line in run_drawing(_FILMED))
    assert len(overlap) == 6
    assert overlap.min() > 0.98
    assert plain.min() > 20.0
    assert np.abs(plain - composite).max() < 0.1


@pytest.mark.long
def test_the_gaussians_of_a_movable_object_move_with_it(tmp_path: Path) -> None:
    for line in run_drawing(_MOVED, str(tmp_path / "map.ply")):
        count, at, true = map(float, line.split())
        assert count > 300
        assert at == pytest.approx(true, abs=4.0)


def test_the_camera_looks_at_its_target_with_y_down() -> None:
    T = pose_of(CameraSection(at=(1.0, 2.0, 3.0), look_at=(1.0, 5.0, 3.0)))
    np.testing.assert_allclose(T[:3, :3], [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-12)
    with pytest.raises(InputError, match="straight up or down"):
        pose_of(CameraSection(at=(0, 0, 1), look_at=(0, 0, 0)))


def test_the_field_of_view_is_the_scenes() -> None:
    camera = intrinsics(CameraSection(at=(0, 0, 1), look_at=(1, 0, 1), width=640, height=480, fov_y=0.8))
    assert 2 * np.arctan(240 / camera.fy) == pytest.approx(0.8)
    assert (camera.cx, camera.cy) == (319.5, 239.5)
