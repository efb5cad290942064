"""Audit of a collision field on synthetic logs, against exact shapes and brute-force distances."""

from __future__ import annotations

from functools import cache

import numpy as np
import open3d as o3d
import pytest

from splatbot.collision import GaussianCollisionField
from splatbot.collision.audit import CONSTANTS, SurfaceAudit, audit_surfaces
from splatbot.collision.confirmed import ConfirmedSpace, find_confirmed
from splatbot.collision.visibility import DepthView
from splatbot.errors import InputError
from splatbot.geometry import transform_points
from splatbot.logs import open_log
from splatbot.logs.synthetic import SyntheticLog
from splatbot.protocols import Array
from tests.unit.collision.oracle import gaussians

SIGMA = 0.003  # [m] of the balls that represent the map; their surface is at 2 σ
CARTON = np.array([[-0.33, -0.06, 0.01], [-0.11, 0.16, 0.14]])  # [m] box around the carton, above the table


@cache
def _log_views(scene: str = "tabletop", frames: int = 10) -> tuple[DepthView, ...]:
    log = open_log(f"synthetic:{scene}?frames={frames}&width=160&height=120&rate=3")
    assert log.ground_truth is not None
    return tuple((log[i].depth, log.camera, log.ground_truth.T_world_camera[i]) for i in range(len(log)))


@cache
def _space() -> ConfirmedSpace:
    return find_confirmed(_log_views(), floor=0.001, quad=0.002)


@cache
def _surface() -> Array:
    """Return every pixel of every view as a point [m, world]."""
    points = []
    for depth, camera, T in _log_views():
        v, u = np.nonzero(depth)
        z = depth[v, u].astype(np.float64)
        points.append(transform_points(T, np.c_[(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z]))
    found: Array = np.concatenate(points)
    return found


def _inside(points: Array, box: Array = CARTON) -> np.ndarray:
    return ((points > box[0]) & (points < box[1])).all(axis=1)


def _audit(balls: Array, space: ConfirmedSpace | None = None) -> SurfaceAudit:
    return audit_surfaces(GaussianCollisionField(gaussians(balls, SIGMA)), space or _space())


def _true_distance(points: Array) -> Array:
    log = open_log("synthetic:tabletop?frames=1")
    assert isinstance(log, SyntheticLog)
    shapes = o3d.t.geometry.RaycastingScene()
    for surface in log.scene.surfaces:
        shapes.add_triangles(
            o3d.core.Tensor.from_numpy(surface.mesh.vertices.astype(np.float32)),
            o3d.core.Tensor.from_numpy(surface.mesh.triangles.astype(np.uint32)),
        )
    return np.asarray(shapes.compute_distance(o3d.core.Tensor.from_numpy(points.astype(np.float32))).numpy())


def test_confirmed_surface_lies_on_the_true_shapes_and_confirmed_free_space_does_not() -> None:
    space = _space()
    assert len(space.surface) > 0.3 * space.proposed
    assert _true_distance(space.surface).max() < 1e-4
    assert len(space.free) > 1000
    assert _true_distance(space.free).min() > 0.001


def test_a_map_of_the_true_surface_is_clean() -> None:
    audit = _audit(_surface())
    assert audit.missed_share() == 0.0
    assert audit.holes() == []
    assert audit.false_hit_share < 1e-3
    assert _true_distance(audit.space.free[audit.free_hit]).max() <= 2 * SIGMA  # within the balls, at edges


def test_a_removed_surface_is_found_as_a_hole_at_its_place_with_its_size() -> None:
    kept = _surface()[~_inside(_surface())]
    audit = _audit(kept)
    expected = np.sqrt(((audit.space.surface[:, None, :] - _nearest(kept, audit.space.surface)) ** 2).sum(-1)).min(1)
    expected = np.clip(expected - 2 * SIGMA, 0.0, CONSTANTS.max_distance)
    np.testing.assert_allclose(audit.distance, expected, atol=2e-5)
    assert _inside(audit.space.surface[audit.missed], CARTON + np.array([[-0.01], [0.01]])).all()
    hole = audit.holes()[0]
    assert _inside(hole.center[None])[0]
    assert 0.15 < hole.size[0] < 0.25  # the carton is 16 x 10 x 12 cm
    assert hole.depth == pytest.approx(expected.max(), abs=2e-5)


def test_a_hole_of_three_centimetres_in_the_table_is_found() -> None:
    hole = np.linalg.norm(_surface() - [0.1, -0.25, 0.0], axis=1) < 0.035
    found = _audit(_surface()[~hole]).holes()
    assert len(found) == 1
    assert np.linalg.norm(found[0].center - [0.1, -0.25, 0.0]) < 0.01


def test_a_floater_in_free_space_is_a_false_hit() -> None:
    floater = np.array([[0.0, -0.3, 0.2]])
    radius = 0.06
    field = GaussianCollisionField(gaussians(floater, radius / 2))
    audit = audit_surfaces(field, _space())
    inside = np.linalg.norm(audit.space.free - floater, axis=1) <= radius
    assert inside.sum() > 10
    np.testing.assert_array_equal(audit.free_hit, inside)


def test_what_most_frames_saw_through_is_not_confirmed() -> None:
    space = find_confirmed(_log_views("tabletop_removed", 20), floor=0.001, quad=0.002)  # the carton vanishes after 2 s
    assert _inside(_space().surface).sum() > 100
    assert _inside(space.surface).sum() == 0


def test_noise_beyond_the_sensor_model_is_not_confirmed_but_noise_within_it_is() -> None:
    rng = np.random.default_rng(0)
    for scale, low, high in ((1.0, 0.5, 1.0), (30.0, 0.0, 0.1)):
        noisy = [
            ((d + scale * (0.001 + 0.002 * d**2) * rng.standard_normal(d.shape)).astype(np.float32), c, T)
            for d, c, T in _log_views()
        ]
        space = find_confirmed(noisy, floor=0.001, quad=0.002)
        share = len(space.surface) / len(_space().surface)
        assert low <= share <= high, (scale, share)


def test_views_without_depth_give_an_empty_audit_and_a_wrong_size_is_an_error() -> None:
    depth, camera, T = _log_views()[0]
    empty = find_confirmed([(np.zeros_like(depth), camera, T)] * 4, floor=0.001, quad=0.002)
    audit = _audit(_surface()[:10], empty)
    assert np.isnan(audit.missed_share())
    assert np.isnan(audit.false_hit_share)
    assert audit.holes() == []
    with pytest.raises(InputError, match="depth"):
        find_confirmed([(depth[:-1], camera, T)], floor=0.001, quad=0.002)


def _nearest(cloud: Array, queries: Array) -> Array:
    """Return the eight nearest points (Q, 8, 3) of a cloud by a k-d tree."""
    search = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor.from_numpy(cloud))
    search.knn_index()
    index, _ = search.knn_search(o3d.core.Tensor.from_numpy(queries), 8)
    found: Array = cloud[index.numpy()]
    return found
