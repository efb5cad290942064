"""Fusion of depth images to one surface: it covers the measured surface and omits measurements of a single image."""

from __future__ import annotations

import numpy as np

from splatbot.evaluation.depth_fusion import DepthFusion
from splatbot.geometry import se3_exp
from tests.rgbd import CAMERA, wall_depth


def test_fused_depth_is_the_wall_at_its_place_and_leaves_strays_out() -> None:
    fusion, noise = DepthFusion(0.01, 10.0), np.random.default_rng(0)
    for k in range(8):
        T = se3_exp([0.02 * k, 0.0, 0.0, 0.0, 0.01 * k, 0.0])
        depth = wall_depth(CAMERA, T, (0.1, 0.0, 1.0), 1.5).astype(np.float32)
        depth += noise.normal(0, 0.004, depth.shape).astype(np.float32)
        depth[:10] = np.nan
        if k == 3:
            depth[50:53, 70:73] = 0.8
        depth[:, :6] = 12.0
        fusion.add(depth, CAMERA, T)
    normal = np.array([0.1, 0.0, 1.0])
    mesh = fusion.mesh()
    for points in (fusion.points(), np.asarray(mesh.vertices)):
        off = (points @ normal - 1.5) / np.linalg.norm(normal)
        assert len(points) > 2000
        assert abs(float(np.median(off))) < 1e-3
        assert float(np.abs(off).max()) < 0.05
    assert float(np.median(np.asarray(mesh.vertex_normals) @ normal)) < -0.95


def test_what_was_measured_twice_only_is_no_surface() -> None:
    fusion = DepthFusion(0.01, 5.0)
    for k in range(4):
        depth = np.full((120, 160), 1.503, np.float32)
        depth[:, 80:] = 1.503 if k < 2 else 0.0
        fusion.add(depth, CAMERA, np.eye(4))
    for points in (fusion.points(), np.asarray(fusion.mesh().vertices)):
        assert len(points) > 500
        assert points[:, 0].max() < 0.02


def test_every_vertex_of_a_surface_of_rough_round_depths_has_a_normal() -> None:
    """Distances that are 0 at voxels make triangles without area."""
    fusion = DepthFusion(0.004, 2.0)
    depth = np.random.default_rng(0).uniform(0.5, 0.7, (CAMERA.height, CAMERA.width)).round(3).astype(np.float32)
    for _ in range(4):
        fusion.add(depth, CAMERA, np.eye(4))
    mesh = fusion.mesh()
    normals = np.asarray(mesh.vertex_normals)
    assert len(normals) > 50_000
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-9)
    assert np.asarray(mesh.triangles).max() < len(normals)
