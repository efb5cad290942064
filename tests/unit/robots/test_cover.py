"""Spheres around boxes and meshes."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from splatbot.errors import InputError
from splatbot.geometry import pose_from_quat
from splatbot.logs.shapes import lathe
from splatbot.robots.containment import uncovered
from splatbot.robots.cover import cover
from splatbot.robots.shapes import Box, Capsule, Mesh, winding_number

BOX = Box(2, pose_from_quat([0.1, -0.05, 0.3], [0.8, 0.2, 0.1, 0.5]), (0.12, 0.06, 0.2))


def _bottle() -> Mesh:
    mesh = lathe([(0, 0), (0.04, 0), (0.04, 0.12), (0.015, 0.16), (0.015, 0.2), (0, 0.2)])
    return Mesh(1, mesh.vertices, mesh.triangles.astype(np.int64))


@pytest.mark.long
@pytest.mark.parametrize("slack", [0.01, 0.02])
@pytest.mark.parametrize("shape", [BOX, _bottle()], ids=["box", "bottle"])
def test_every_point_of_the_surface_is_covered_and_none_reaches_beyond_the_slack(
    shape: Box | Mesh, slack: float
) -> None:
    spheres = cover([shape], slack)
    assert uncovered([shape], spheres) <= 0
    assert (spheres.radii - np.maximum(shape.depth(spheres.centers), 0) <= slack + 1e-6).all()
    assert len(spheres) < 120


def test_a_box_knows_how_deep_points_are() -> None:
    centre = BOX.T_link_box[:3, 3]
    np.testing.assert_allclose(BOX.depth(centre[None] + [[0, 0, 0]]), [0.03])
    assert BOX.depth(centre[None] + [[0.5, 0, 0]])[0] < 0


def test_a_cover_that_misses_a_part_is_found_out() -> None:
    capsule = Capsule(0, (0.0, 0, 0), (0.3, 0, 0), 0.05)
    spheres = cover([capsule], 0.01)
    fewer = type(spheres)(spheres.link[:-1], spheres.centers[:-1], spheres.radii[:-1])
    assert uncovered([capsule], fewer) > 0.02


def test_a_slack_of_zero_is_refused() -> None:
    with pytest.raises(InputError, match="slack"):
        cover([BOX], 0.0)


def test_the_winding_number_is_one_inside_and_zero_outside_of_a_mesh_with_a_crack(rng: np.random.Generator) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    points = rng.uniform(-0.2, 0.2, (500, 3))
    distance = np.linalg.norm(points, axis=1)
    points, distance = points[np.abs(distance - 0.1) > 0.01], distance[np.abs(distance - 0.1) > 0.01]
    whole = winding_number(ball.triangles, points)
    np.testing.assert_allclose(whole, distance < 0.1, atol=1e-4)
    cracked = winding_number(ball.triangles[5:], points)
    np.testing.assert_array_equal(cracked > 0.5, distance < 0.1)
