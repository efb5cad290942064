"""A look from the wrist against true motions of round and flat-sided targets in MuJoCo, and the views it refuses."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from splatbot.collision.visibility import DepthView
from splatbot.errors import InputError
from splatbot.geometry import inverse, look_at, se3_exp, transform_points
from splatbot.grasping.hands import Hands
from splatbot.grasping.look import CONSTANTS, in_the_way, relocate, share_gone, unexplained
from splatbot.grasping.moved_target import moved_rows, moved_sampler, with_obstacles
from splatbot.protocols import Array
from splatbot.sim.rays import cast, pixel_rays
from splatbot.sim.scene import make_scene
from splatbot.sim.twin import Twin
from splatbot.sim.wrist_camera import TwinWristCamera
from tests.unit.grasping.test_pick import CARTON, sampler, scene, target, twin

EYE = np.array([0.28, 0.02, 0.32])


def moved(name: str, x: float, y: float, degrees: float) -> tuple[Twin, Array]:
    """Return the twin with one object moved, and the true motion of that object."""
    world = twin()
    joint = world.data.joint(int(world.world.model.body(f"object/{name}").jntadr[0]))
    mujoco.mj_forward(world.world.model, world.data)
    before = pose(world, name)
    joint.qpos[:2] += [x, y]
    half = np.radians(degrees) / 2
    turned = np.zeros(4)
    mujoco.mju_mulQuat(turned, np.array([np.cos(half), 0.0, 0.0, np.sin(half)]), np.array(joint.qpos[3:]))
    joint.qpos[3:] = turned
    mujoco.mj_forward(world.world.model, world.data)
    return world, pose(world, name) @ inverse(before)


def pose(world: Twin, name: str) -> Array:
    T, body = np.eye(4), world.data.body(f"object/{name}")
    T[:3, :3], T[:3, 3] = np.array(body.xmat).reshape(3, 3), body.xpos
    return T


def view(world: Twin, middle: Array, noise: float = 1e-3) -> DepthView:
    camera = TwinWristCamera(world).camera
    T = look_at(EYE, middle)
    geoms, depth = cast(world.world.model, world.data, pixel_rays(camera), T, 1.5)
    seen = (depth > 0) & ~world.world.of_robot[geoms]
    noisy = depth + noise * np.random.default_rng(0).standard_normal(depth.shape)
    return np.where(seen, noisy, 0.0).astype(np.float32), camera, T


@pytest.mark.parametrize("name", ["carton", "can", "ball"])
@pytest.mark.parametrize(("x", "y", "degrees"), [(0.03, 0.0, 0.0), (-0.02, 0.03, 8.0), (0.0, -0.04, -12.0)])
def test_the_motion_of_a_target_is_found_to_millimetres(name: str, x: float, y: float, degrees: float) -> None:
    world, T_true = moved(name, x, y, degrees)
    surface = sampler().surface(target(name))
    found = relocate(scene(), surface, view(world, surface.center))
    assert not found.reason
    assert not found.still
    at = surface.center
    if name == "carton":  # a box has an angle: each of its points is where the true motion puts it
        at = surface.points[surface.observed]
    away = np.linalg.norm(transform_points(found.T_now_before, at) - transform_points(T_true, at), axis=-1)
    assert np.max(away) < 0.005
    assert found.shift == pytest.approx(np.hypot(x, y), abs=0.004)


@pytest.mark.parametrize("name", ["carton", "can", "ball"])
def test_a_target_in_its_place_is_not_corrected(name: str) -> None:
    world, _ = moved(name, 0.0, 0.0, 0.0)
    surface = sampler().surface(target(name))
    found = relocate(scene(), surface, view(world, surface.center))
    assert found.still
    assert (found.shift, found.reason) == (0.0, "")
    assert found.share > 0.9


def test_a_target_that_is_far_away_or_another_is_not_found() -> None:
    surface = sampler().surface(target("carton"))
    gone, _ = moved("carton", 0.0, 0.25, 0.0)
    assert relocate(scene(), surface, view(gone, surface.center)).reason
    away, _ = moved("carton", 0.08, 0.0, 0.0)
    found = relocate(scene(), surface, view(away, surface.center))
    assert found.reason
    assert found.still  # nothing is corrected by a result that is refused
    blank = view(away, surface.center)
    found = relocate(scene(), surface, (np.zeros_like(blank[0]), *blank[1:]))
    assert found.reason == "the image does not show it"


def test_depth_between_hand_and_grasp_is_in_the_way_but_single_pixels_are_not() -> None:
    hand = sampler().hand
    T = np.eye(4)
    T[:3, :3] = np.diag([1.0, -1.0, -1.0])
    T[:3, 3] = [CARTON.center[0], CARTON.center[1], 0.4]
    world, _ = moved("carton", 0.0, 0.0, 0.0)
    free = view(world, np.array(CARTON.center))
    hands = Hands.one(T, 0.06)
    assert in_the_way(hands, hand, free, 0.1) == 0.0
    T_low = T.copy()
    T_low[2, 3] = 0.05  # the fingers reach into the carton, which is wider than they are open
    assert in_the_way(Hands.one(T_low, 0.02), hand, free, 0.1) > CONSTANTS.max_penetration
    depth, camera, T_world_camera = free
    flying = depth.copy()
    T[2, 3] = 0.2
    hands = Hands.one(T, 0.06)
    assert in_the_way(hands, hand, free, 0.05) == 0.0
    p = transform_points(inverse(T_world_camera), T[:3, 3] + np.array([0.0, 0.04, 0.0]))  # inside a finger
    u, v = round(camera.fx * p[0] / p[2] + camera.cx), round(camera.fy * p[1] / p[2] + camera.cy)
    flying[v, u] = p[2]
    assert in_the_way(hands, hand, (flying, camera, T_world_camera), 0.05) == 0.0
    flying[v - 2 : v + 3, u - 2 : u + 3] = p[2]
    assert in_the_way(hands, hand, (flying, camera, T_world_camera), 0.05) > CONSTANTS.max_penetration


def test_what_the_map_does_not_explain_becomes_balls_around_its_depth() -> None:
    center = sampler().surface(target("can")).center
    same, _ = moved("can", 0.0, 0.0, 0.0)
    assert len(unexplained(scene(), sampler().field, view(same, center))) <= 3  # edges at most
    there, _ = moved("ball", -0.17, -0.40, 0.0)  # next to the can, where the map is empty
    balls = unexplained(scene(), sampler().field, view(there, center))
    near = np.linalg.norm(balls[:, :3] - there.data.body("object/ball").xpos, axis=1)
    assert (near < 0.05).sum() > 20
    assert (near < 0.05).mean() > 0.9
    more = with_obstacles(sampler(), balls)
    assert len(more.scene.labels) == len(more.scene.model) == len(scene().model) + len(balls)
    assert sampler().field.clearance(balls[:, :3], cut=0.05).distance.min() > 0.0
    inside = more.field.clearance(balls[:, :3], cut=0.05).distance
    np.testing.assert_allclose(inside, -balls[:, 3], atol=2e-3)


def test_a_place_is_empty_once_the_object_is_lifted_and_unknown_where_it_is_hidden() -> None:
    surface = sampler().surface(target("can"))
    there, _ = moved("can", 0.0, 0.0, 0.0)
    share = share_gone(surface.points, view(there, surface.center))
    assert share is not None
    assert share < 0.2
    taken, _ = moved("can", 0.0, -0.4, 0.0)
    share = share_gone(surface.points, view(taken, surface.center))
    assert share is not None
    assert share > 0.8
    depth, camera, T = view(taken, surface.center)
    assert share_gone(surface.points, (np.full_like(depth, 0.1), camera, T)) is None


def test_moved_gaussians_are_where_the_motion_puts_them_and_the_others_stay() -> None:
    rows, T = target("can").rows, se3_exp([0.03, -0.01, 0.0, 0.0, 0.0, 0.4])
    before, now = scene().model, moved_rows(scene().model, target("can").rows, T)
    expected = transform_points(T, before.means.double().numpy()[rows])
    np.testing.assert_allclose(now.means.double().numpy()[rows], expected, atol=1e-6)
    others = np.delete(np.arange(len(before)), rows)
    np.testing.assert_array_equal(now.means.numpy()[others], before.means.numpy()[others])
    np.testing.assert_array_equal(now.quats.numpy()[others], before.quats.numpy()[others])
    field = moved_sampler(sampler(), rows, T).field
    middle = transform_points(T, np.array([[0.5, -0.2, 0.1]]))
    assert field.clearance(middle + np.array([0.0, 0.0, 0.2])).distance[0] < 0.2
    old = before.means.double().numpy()[rows]
    assert not np.allclose(now.means.double().numpy()[rows], old)


def test_the_wrist_camera_sees_the_scene_without_the_arm_and_says_what_it_needs() -> None:
    world = twin()
    world.reset()
    depth, camera, T = TwinWristCamera(world).look()
    points = transform_points(T, camera.backproject(depth)[depth > 0].astype(np.float64))
    assert points[:, 2].min() > -0.005  # table and objects, in the world
    assert (depth == 0).any()  # the hand, or out of range
    values: dict[str, Any] = {"name": "no arm", "robot": None, "objects": [
        {"name": "table", "shapes": [{"kind": "plane"}]}]}  # fmt: skip
    with pytest.raises(InputError, match="has no robot"):
        TwinWristCamera(Twin(make_scene(values)))
