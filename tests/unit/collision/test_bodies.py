"""Capsules, boxes, grids, probability and unknown space, against sampling, closed forms and each other."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatbot.camera import Camera
from splatbot.collision import (
    GaussianCollisionField,
    boxes_in_collision,
    capsules_in_collision,
    collision_probability,
    esdf,
    find_unknown,
)
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import quat_to_rotation
from tests.unit.collision.oracle import gaussians, random_gaussians


def test_capsules_that_a_dense_row_of_spheres_finds_hit_are_hit_and_few_others() -> None:
    rng = np.random.default_rng(0)
    field = GaussianCollisionField(random_gaussians(3000, rng, most=0.03))
    a = rng.uniform(-1, 1, (400, 3))
    b = a + rng.normal(0, 0.2, (400, 3))
    r = rng.uniform(0, 0.05, 400)
    answer = capsules_in_collision(field, a, b, r)
    t = np.linspace(0, 1, 400)[:, None]
    room = np.array([field.clearance(p + t * (q - p)).distance.min() - s for p, q, s in zip(a, b, r, strict=True)])
    assert answer[room <= 0].all()
    assert not answer[room > 3e-3].any()
    assert 0.1 < answer.mean() < 0.9


def test_boxes_that_hold_a_point_of_an_ellipsoid_are_hit_and_those_apart_are_not() -> None:
    rng = np.random.default_rng(1)
    field = GaussianCollisionField(random_gaussians(3000, rng, most=0.03))
    centers, quats = rng.uniform(-1, 1, (60, 3)), rng.normal(size=(60, 4))
    sizes = rng.uniform(0.01, 0.15, (60, 3))
    answer = boxes_in_collision(field, centers, quats, sizes, tolerance=2e-3)
    R = quat_to_rotation(quats)
    u = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 21)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    for k in range(60):
        points = centers[k] + (u * sizes[k]) @ R[k].T
        room = field.clearance(points).distance.min()
        if room <= 0:
            assert answer[k]
        elif room > 0.5 * np.linalg.norm(sizes[k] / 20) + 2e-3:
            assert not answer[k]
    assert 0.1 < answer.mean() < 0.9


def test_bodies_against_an_empty_map_and_no_bodies() -> None:
    empty = GaussianCollisionField(GaussianModel.empty())
    assert not capsules_in_collision(empty, [[0.0, 0, 0]], [[1.0, 0, 0]], 0.1).any()
    assert boxes_in_collision(empty, np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 3))).shape == (0,)


def test_bodies_that_make_no_sense_are_named() -> None:
    field = GaussianCollisionField(gaussians([0, 0, 0], 0.1))
    with pytest.raises(InputError, match="end: has 2 rows"):
        capsules_in_collision(field, np.zeros((1, 3)), np.zeros((2, 3)), 0.1)
    with pytest.raises(InputError, match="radius"):
        capsules_in_collision(field, np.zeros((1, 3)), np.zeros((1, 3)), -0.1)
    with pytest.raises(InputError, match="quaternion zero"):
        boxes_in_collision(field, np.zeros((1, 3)), np.zeros((1, 4)), np.ones((1, 3)))


def test_a_grid_holds_the_fields_own_answers() -> None:
    rng = np.random.default_rng(2)
    field = GaussianCollisionField(random_gaussians(200, rng))
    grid = esdf(field, [[-0.5, -0.4, -0.3], [0.5, 0.4, 0.3]], 0.05, cut=0.2)
    assert grid.distance.shape == (20, 16, 12)
    answer = field.clearance(grid.centers().reshape(-1, 3), cut=0.2)
    np.testing.assert_allclose(grid.distance.ravel(), np.minimum(answer.distance, 0.2), atol=1e-7)
    np.testing.assert_allclose(grid.gradient.reshape(-1, 3), answer.gradient, atol=1e-6)
    with pytest.raises(InputError, match="voxel"):
        esdf(field, [[-5, -5, -5], [5, 5, 5]], 0.001)


def test_probability_of_one_gaussian_is_exact_and_bounds_hold_by_simulation() -> None:
    one = GaussianCollisionField(gaussians([0.0, 0, 0], 0.05))
    answer = collision_probability(one, [[0.13, 0, 0, 0.02], [0.12, 0, 0, 0.02], [0.5, 0, 0, 0.02]], 0.01)
    np.testing.assert_allclose(answer.upper[:2], [0.158655, 0.5], atol=1e-4)
    np.testing.assert_allclose(answer.lower[:2], answer.upper[:2], atol=1e-12)
    assert answer.upper[2] < 1e-12
    rng = np.random.default_rng(3)
    wall = np.c_[np.zeros(30), rng.uniform(-0.2, 0.2, (30, 2))]
    model, sigma = gaussians(wall, 0.02), rng.uniform(0.005, 0.02, 30)
    sphere = np.array([[0.09, 0.0, 0.0, 0.03]])
    bounds = collision_probability(GaussianCollisionField(model), sphere, sigma)
    hits = 0
    for _ in range(400):
        moved = model.clone()
        moved.means += torch.from_numpy(rng.normal(size=(30, 3)) * sigma[:, None]).float()
        hits += bool(GaussianCollisionField(moved).in_collision(sphere)[0])
    assert bounds.lower[0] * 0.7 <= hits / 400 <= bounds.upper[0] * 1.1 + 0.03
    with pytest.raises(InputError, match="sigma"):
        collision_probability(one, sphere, -1.0)


def test_space_is_suspect_where_a_third_of_the_views_lack_depth_and_not_under_a_mask() -> None:
    camera, box = Camera(100.0, 100.0, 49.5, 49.5, 100, 100), [[-0.1, -0.1, 0.5], [0.1, 0.1, 0.7]]
    wall, hole, masked = (np.full((100, 100), 1.0, np.float32) for _ in range(3))
    hole[20:80, 20:80] = 0.0
    masked[20:80, 20:80] = np.nan
    near = np.full((100, 100), 0.53, np.float32)  # sees a surface in the first voxels
    T = np.eye(4)

    def suspect(*images: np.ndarray) -> bool:
        return bool(find_unknown(box, 0.05, [(image, camera, T) for image in images]).suspect[2, 2, 0])

    assert suspect(hole, hole)
    assert not suspect(hole)  # one view is chance
    assert not suspect(masked, masked, masked)  # the robot covers the view: it did not look
    edge = masked.copy()
    edge[20:80, 60:80] = 0.0  # a shadow next to the robot
    assert not suspect(edge, edge)
    assert not suspect(hole, hole, wall)  # another view saw through it
    assert suspect(hole, hole, *[near] * 4)
    assert not suspect(hole, hole, *[near] * 5)  # too few of the views


def test_what_a_wall_hides_is_unknown_and_blocks_only_if_it_is_to() -> None:
    camera = Camera(100.0, 100.0, 49.5, 49.5, 100, 100)
    depth = np.full((100, 100), 1.0, np.float32)  # a wall 1 m before the camera
    space = find_unknown([[-0.3, -0.3, 0.2], [0.3, 0.3, 1.6]], 0.05, [(depth, camera, np.eye(4))])
    seen, hidden = np.array([[0.0, 0, 0.6]]), np.array([[0.0, 0, 1.3]])
    assert not space.at(seen)[0]
    assert space.at(hidden)[0]
    assert space.at([[9.0, 9, 9]])[0]
    wall = gaussians([0, 0, 1.0], (0.5, 0.5, 0.002))
    free, occupied = (
        GaussianCollisionField(wall),
        GaussianCollisionField(GaussianModel.concatenate([wall, space.solids()])),
    )
    beyond = np.array([[0.025, 0.025, 1.03, 0.02], [0.0, 0, 1.3, 0.05]])
    assert not free.in_collision(beyond).any()
    np.testing.assert_array_equal(occupied.in_collision(beyond), [True, False])
    assert GaussianCollisionField(space.solids(rim=False)).in_collision(beyond).all()
    assert not occupied.in_collision(np.c_[seen, [[0.1]]])[0]
