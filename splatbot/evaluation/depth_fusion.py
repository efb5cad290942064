"""Depth images fused by Open3D into truncated signed distances: a surface that owes nothing to the Gaussians."""

from __future__ import annotations

from typing import Any

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.geometry import inverse
from splatbot.protocols import Array

SEEN = 3.0  # measurements that a voxel of the surface takes
_TRUNCATION = 8.0  # voxels; Open3D's own
_BLOCKS = 20_000  # of 16 voxels a side; the table of them grows


class DepthFusion:
    """Weighted averages of signed distances along rays (Curless and Levoy 1996), by Open3D's voxel blocks.

    Args:
        voxel: [m].
        farthest: depth [m] from which on nothing counts.
    """

    def __init__(self, voxel: float, farthest: float) -> None:
        single, kinds = o3d.core.SizeVector((1,)), (o3d.core.float32, o3d.core.float32)
        self._grid = o3d.t.geometry.VoxelBlockGrid(("tsdf", "weight"), kinds, (single, single), voxel, 16, _BLOCKS)
        self._farthest = farthest

    def add(self, depth: NDArray[np.float32], camera: Camera, T_world_camera: Array) -> None:
        """Take in one image (H, W) [m] of z-depth; missing depth is 0 or not finite."""
        known = np.isfinite(depth) & (depth < self._farthest)
        image = o3d.t.geometry.Image(o3d.core.Tensor.from_numpy(np.where(known, depth, 0).astype(np.float32)))
        K, T_camera_world = (o3d.core.Tensor.from_numpy(m) for m in (camera.K, inverse(T_world_camera)))
        blocks = self._grid.compute_unique_block_coordinates(image, K, T_camera_world, 1.0, self._farthest)
        self._grid.integrate(blocks, image, K, T_camera_world, 1.0, self._farthest, _TRUNCATION)

    def points(self) -> Array:
        """The surface as points (N, 3) [m, world] that were measured :data:`SEEN` times or more."""
        points: Array = self._grid.extract_point_cloud(SEEN).point.positions.numpy().astype(np.float64)
        return points

    def mesh(self) -> Any:
        """The same surface as an ``open3d.geometry.TriangleMesh`` with normals (marching cubes).

        Vertices whose triangles have no area, as where a distance is 0 at a voxel, have no normal and are left out.
        """
        mesh = self._grid.extract_triangle_mesh(SEEN).to_legacy()
        mesh.compute_vertex_normals()
        lengths = np.linalg.norm(np.asarray(mesh.vertex_normals), axis=1)
        mesh.remove_vertices_by_mask(~(lengths > 0.5))
        return mesh
