"""Surface from depth images by TSDF fusion with Open3D: a reference that is independent of the Gaussians."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.geometry import inverse
from splatbot.protocols import Array


@dataclass(frozen=True)
class FusionConstants:
    """Constants of fused depth."""

    min_weight: float = 3.0
    """Number of measurements [1] of a voxel that the extracted surface requires. A smaller one keeps noise of single
    frames."""
    truncation: float = 8.0
    """Truncation distance [voxels], Open3D's default. A larger one thickens thin parts."""
    blocks: int = 20_000
    """Initial capacity [blocks of 16³ voxels]. The hash table grows beyond it."""


CONSTANTS = FusionConstants()


class DepthFusion:
    """Truncated signed distance field (TSDF) with weighted averages along rays (Curless and Levoy 1996).

    Args:
        voxel: edge length [m].
        farthest: depth [m] from which measurements are ignored.
    """

    def __init__(self, voxel: float, farthest: float) -> None:
        import open3d as o3d

        single, kinds = o3d.core.SizeVector((1,)), (o3d.core.float32, o3d.core.float32)
        self._grid = o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight"), kinds, (single, single), voxel, 16, CONSTANTS.blocks
        )
        self._farthest = farthest

    def add(self, depth: NDArray[np.float32], camera: Camera, T_world_camera: Array) -> None:
        """Integrate one z-depth image (H, W) [m]; missing depth is 0 or not finite."""
        import open3d as o3d

        known = np.isfinite(depth) & (depth > 0) & (depth < self._farthest)
        if not known.any():  # Open3D takes it for an error
            return
        image = o3d.t.geometry.Image(o3d.core.Tensor.from_numpy(np.where(known, depth, 0).astype(np.float32)))
        K, T_camera_world = (o3d.core.Tensor.from_numpy(m) for m in (camera.K, inverse(T_world_camera)))
        blocks = self._grid.compute_unique_block_coordinates(image, K, T_camera_world, 1.0, self._farthest)
        self._grid.integrate(blocks, image, K, T_camera_world, 1.0, self._farthest, CONSTANTS.truncation)

    def points(self) -> Array:
        """Return the surface points (N, 3) [m, world] with at least ``CONSTANTS.min_weight`` measurements."""
        points: Array = self._grid.extract_point_cloud(CONSTANTS.min_weight).point.positions.numpy().astype(np.float64)
        return points

    def mesh(self) -> Any:
        """Return the same surface as an ``open3d.geometry.TriangleMesh`` with normals (marching cubes).

        Vertices whose triangles all have zero area have no normal and are left out.
        """
        mesh = self._grid.extract_triangle_mesh(CONSTANTS.min_weight).to_legacy()
        mesh.compute_vertex_normals()
        lengths = np.linalg.norm(np.asarray(mesh.vertex_normals), axis=1)
        mesh.remove_vertices_by_mask(~(lengths > 0.5))
        return mesh
