"""Tests of splatbot.sim.dressing."""

from __future__ import annotations

import pytest

from splatbot.sim.dressing import dressed
from splatbot.sim.scene import load_scene, make_scene
from splatbot.sim.world import build_world
from tests.unit.sim.drawn import run_drawing

_MASKS = """
import mujoco
import numpy as np
from splatbot.geometry import look_at
from splatbot.camera import Camera
from splatbot.sim.bodies_view import BodiesView
from splatbot.sim.dressing import dressed
from splatbot.sim.scene import load_scene
from splatbot.sim.world import build_world, robot_joints
plain = build_world(load_scene("%s"))
data = mujoco.MjData(plain.model)
data.qpos[robot_joints(plain.model, plain.robot)[0]] = plain.robot.home + 0.3
mujoco.mj_forward(plain.model, data)
camera = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
T = look_at(np.array([1.5, -1.2, 0.9]), np.array([0.3, 0.0, 0.4]))
masks = []
for world in (plain, dressed(plain)):
    view = BodiesView(world, camera, map_too=True)
    masks.append(view.robot(data, T) > 0.5)
    view.close()
print((masks[0] & masks[1]).sum() / (masks[0] | masks[1]).sum())
print(masks[0].sum())
"""


@pytest.mark.parametrize("name", ["mug_hanging", "soft_object"])
def test_the_robot_has_meshes_and_the_world_of_the_physics_stays(name: str) -> None:
    import mujoco

    plain = build_world(load_scene(name))
    before = plain.model.ngeom
    world = dressed(plain)
    assert (plain.model.ngeom, plain.for_views) == (before, False)
    assert (world.model.nq, world.model.nmocap) == (plain.model.nq, plain.model.nmocap)
    meshes = world.of_robot & (world.model.geom_type == int(mujoco.mjtGeom.mjGEOM_MESH))
    names = [*(f"link{k}" for k in range(8)), "finger1", "finger2"]
    assert set(world.model.geom_bodyid[meshes]) == {world.model.body(body).id for body in names}
    assert not world.model.geom_contype[meshes].any()


def test_the_meshes_are_seen_where_the_simulated_robot_is() -> None:
    both, pixels = run_drawing(_MASKS % "mug_hanging")
    assert float(both) > 0.65  # the collision geometry is wider than the meshes
    assert int(pixels) > 1000


def test_a_scene_without_a_robot_stays_as_it_is() -> None:
    world = build_world(make_scene({"name": "x", "robot": None, "objects": []}))
    assert dressed(world) is world
