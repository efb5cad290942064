"""Robots in pictures: silhouette and depth by closed form, occlusion by the map, meshes within the certified body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatbot.camera import Camera
from splatbot.geometry import look_at, transform_points
from splatbot.protocols import Array, LinkSpheres
from splatbot.report.robot_drawing import CONSTANTS, DrawnPart, draw_robot, sphere_parts
from splatbot.robots.appearance import appearance
from splatbot.robots.arms import ARMS
from splatbot.robots.store import load_robot

CAMERA = Camera(150.0, 150.0, 79.5, 59.5, 160, 120)
T_CAMERA = look_at(np.array([0.0, -1.0, 0.5]), np.zeros(3))
RADIUS = 0.2


def ball(radius: float = RADIUS) -> list[DrawnPart]:
    """Return a fine ball of 40,000 triangles about the origin of link 0."""
    turn, rise = np.meshgrid(np.linspace(0, 2 * np.pi, 201), np.linspace(0, np.pi, 101))
    grid = radius * np.stack([np.sin(rise) * np.cos(turn), np.sin(rise) * np.sin(turn), np.cos(rise)], axis=-1)
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    triangles = np.concatenate(
        [np.stack([a, b, c], axis=2).reshape(-1, 3, 3), np.stack([a, c, d], axis=2).reshape(-1, 3, 3)]
    )
    return [DrawnPart(0, triangles, (1.0, 1.0, 1.0))]


def ball_depth() -> Array:
    """Return the exact depth (H, W) of the ball, inf outside: the smaller root of |o + z d|² = r²."""
    u, v = np.meshgrid(np.arange(160), np.arange(120))
    local = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)
    d, o = local @ T_CAMERA[:3, :3].T, T_CAMERA[:3, 3]
    a, b, c = (d * d).sum(axis=-1), d @ o, o @ o - RADIUS**2
    root = b * b - a * c
    return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0.0))) / a, np.inf)


def blank(value: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros((120, 160, 3), np.float32), np.full((120, 160), value, np.float32)


def test_silhouette_and_depth_equal_the_closed_form() -> None:
    view, depth = blank()
    draw_robot(view, depth, CAMERA, T_CAMERA, ball(), np.eye(4)[None])
    exact = ball_depth()
    inside = np.isfinite(exact)
    covered = view.max(axis=2) > 0
    assert (covered & ~inside).sum() < 0.05 * inside.sum()  # pixels at the edge are covered in part
    assert (covered[inside]).mean() > 0.99
    np.testing.assert_allclose(depth[5:-5][covered[5:-5] & inside[5:-5]].min(), exact[inside].min(), atol=2e-3)
    core = inside & (exact < 1.05)
    assert np.abs(depth[core] - exact[core]).max() < 0.02  # nearest of four rays
    assert view.min() >= 0.0
    assert view.max() <= 1.0


def test_a_nearer_surface_of_the_map_hides_the_robot_and_a_farther_one_does_not() -> None:
    for wall, hidden in ((0.5, True), (3.0, False)):
        view, depth = blank(wall)
        draw_robot(view, depth, CAMERA, T_CAMERA, ball(), np.eye(4)[None])
        assert (view.max() == 0.0) == hidden
        assert (depth == np.float32(wall)).all() == hidden


def test_a_transparent_robot_lets_the_map_through_and_hides_nothing() -> None:
    view, depth = blank(3.0)
    view[:] = 0.5
    draw_robot(view, depth, CAMERA, T_CAMERA, ball(), np.eye(4)[None], tint=(1.0, 0.0, 0.0), opacity=0.25)
    assert (depth == 3.0).all()
    inside = ball_depth() < 1.0
    assert view[inside].min() >= 0.75 * 0.5
    assert (view[inside][:, 0] > view[inside][:, 1]).all()  # the tint is red
    assert (view[:2] == 0.5).all()


def test_links_move_by_their_poses() -> None:
    T = np.eye(4)
    T[0, 3] = 10.0
    view, depth = blank()
    draw_robot(view, depth, CAMERA, T_CAMERA, ball(), T[None])
    assert view.max() == 0.0
    assert CONSTANTS.samples >= 2


@pytest.mark.long
@pytest.mark.parametrize("name", [*("panda", *ARMS), "panda-2f85", "panda-2f140", "ur5e-panda_hand", "ur5e-2f85"])
@pytest.mark.parametrize("opening", [0.03])
def test_drawn_meshes_lie_in_the_certified_body(name: str, opening: float) -> None:
    robot = load_robot(name)
    spheres = robot.spheres(opening if robot.gripper else None)
    parts = appearance(robot, opening)
    assert {part.link for part in parts} == set(spheres.link.tolist())
    T = robot.fk(robot.home)
    centers = np.einsum("sij,sj->si", T[spheres.link, :3, :3], spheres.centers) + T[spheres.link, :3, 3]
    for part in parts:
        corners = transform_points(T[part.link], part.triangles.reshape(-1, 3))
        out = (np.linalg.norm(corners[:, None] - centers[None], axis=2) - spheres.radii).min(axis=1)
        assert out.max() < 1.5e-3  # simplified meshes move corners by a millimetre


def test_robots_without_shapes_show_their_spheres() -> None:
    robot = replace(load_robot("ur5e"), visual=())
    spheres, parts = robot.spheres(), appearance(robot)
    assert len(parts) == len(spheres.radii)
    for part, center, radius in list(zip(parts, spheres.centers, spheres.radii, strict=True))[::40]:
        np.testing.assert_allclose(np.linalg.norm(part.triangles - center, axis=2), radius, rtol=1e-6)


def test_another_arm_with_the_name_of_a_panda_is_not_drawn_as_one() -> None:
    robot = load_robot("ur5e")
    assert len(appearance(replace(robot, name="panda"))) == len(appearance(robot))
    assert len(appearance(replace(robot, name="panda-lab"))) == len(appearance(robot))


def test_a_sphere_of_a_link_with_a_margin_has_the_silhouette_of_the_larger_sphere() -> None:
    spheres = LinkSpheres(
        np.array([0, 1], np.int32), np.array([[0.0, 0.0, 5.0], [0.0, 0.0, 0.0]]), np.array([9.0, 0.17])
    )
    (part,) = sphere_parts(spheres, 1, 0.03, (1.0, 1.0, 1.0))
    assert part.link == 1
    reach = np.linalg.norm(part.triangles, axis=-1)
    np.testing.assert_allclose(reach, RADIUS, atol=1e-9)
    view, depth = blank()
    draw_robot(view, depth, CAMERA, T_CAMERA, [part], np.stack([np.eye(4)] * 2), opacity=0.5)
    inside = np.isfinite(ball_depth())
    covered = view.max(axis=2) > 0
    assert (covered ^ inside).sum() < 0.06 * inside.sum()  # pixels at the edge, and flat triangles
    assert depth.max() == 0.0  # a transparent shell hides nothing
