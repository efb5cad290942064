"""The surface of a map as a triangle mesh, from its rendered depth and normals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil, log2
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.evaluation.depth_fusion import DepthFusion
from splatbot.gaussians import GaussianModel
from splatbot.gaussians.surfels import holds_surfels
from splatbot.geometry import inverse, transform_points
from splatbot.rasterize.maps import render_map
from splatbot.rasterize.views import CONSTANTS as VIEW_CONSTANTS
from splatbot.rasterize.views import render_view

Array = NDArray[np.float64]
View = tuple[Camera, Array]
"""A pinhole camera and its pose T_world_camera (4, 4)."""

ShowDepth = Callable[[GaussianModel, Camera, Array], NDArray[np.float32]]
"""Renders the depth (H, W) [m] of a view, 0 for none."""

MeshMethod = Literal["depth", "median", "poisson"]
METHODS: tuple[MeshMethod, ...] = ("depth", "median", "poisson")


@dataclass(frozen=True)
class MeshConstants:
    """Constants of meshes.

    Args:
        farthest: [m] depth from which a view does not count.
        most_points: largest number of points of the Poisson reconstruction.
        most_levels: largest depth of its octree; more have no finer surface and take minutes.
        support: [cells] the surface ends at this distance from all points, where Poisson only closes holes.
    """

    farthest: float = 5.0
    most_points: int = 1_000_000
    most_levels: int = 9
    support: float = 2.0


CONSTANTS = MeshConstants()


def map_mesh(model: GaussianModel, views: Sequence[View], voxel: float, method: MeshMethod | None = None) -> Any:
    """Return the surface that views of a map show as an ``open3d.geometry.TriangleMesh`` with normals [m, world].

    Args:
        model: the map.
        views: cameras and poses.
        voxel: edge length of the cells [m].
        method: "depth" fuses the expected depth of the views (TSDF, marching cubes). "median" fuses the depth at which
            half of the light is left, which a faint background does not change; surfels alone have it. "poisson" is
            the screened Poisson reconstruction (Kazhdan and Hoppe 2013) of the rendered points and normals. If None,
            median depth of surfels, and expected depth of other maps.

    Raises:
        InputError: the views show no surface, or the method does not fit the map.
    """
    surfels = holds_surfels(model)
    if method not in (None, *METHODS):
        raise InputError(f"is {method!r}.", field="method", hint=f"one of {', '.join(METHODS)}")
    if method == "median" and not surfels:
        hint = "use depth or poisson, or train with --surfels"
        raise InputError("median depth is that of surfels, and the map has none.", field="method", hint=hint)
    show = _median_depth if surfels and method != "depth" else _expected_depth
    return _poisson(model, views, voxel, show) if method == "poisson" else _fused(model, views, voxel, show)


def _fused(model: GaussianModel, views: Sequence[View], voxel: float, show: ShowDepth) -> Any:
    fusion = DepthFusion(voxel, CONSTANTS.farthest)
    for camera, T_world_camera in views:
        fusion.add(show(model, camera, T_world_camera), camera, T_world_camera)
    try:
        return fusion.mesh()
    except RuntimeError as error:  # of Open3D, for an empty surface
        raise _no_surface() from error


def _expected_depth(model: GaussianModel, camera: Camera, T_world_camera: Array) -> NDArray[np.float32]:
    return render_view(model, camera, T_world_camera, "depth")


def _median_depth(model: GaussianModel, camera: Camera, T_world_camera: Array) -> NDArray[np.float32]:
    """Return the median depth (H, W) [m] of surfels, 0 where the view has too little alpha."""
    viewmat, K = torch.from_numpy(inverse(T_world_camera)), torch.from_numpy(camera.K_corner)
    with torch.no_grad():
        render = render_map(model, viewmat, K, camera.width, camera.height)
    assert render.surfels is not None
    return (render.surfels.median * (render.alpha >= VIEW_CONSTANTS.min_alpha))[..., 0].numpy()


def _poisson(model: GaussianModel, views: Sequence[View], voxel: float, show: ShowDepth) -> Any:
    import open3d as o3d

    cloud = _cloud(model, views, voxel, show)
    points = np.asarray(cloud.points)
    if len(points) < 4:
        raise _no_surface()
    side = 1.1 * float(np.ptp(points, axis=0).max())  # of Open3D's octree
    levels = min(CONSTANTS.most_levels, max(1, ceil(log2(max(side / voxel, 2.0)))))
    mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=levels, scale=1.1)
    away = cKDTree(points).query(np.asarray(mesh.vertices))[0]
    mesh.remove_vertices_by_mask(away > CONSTANTS.support * max(voxel, side / 2**levels))
    mesh.compute_vertex_normals()
    return mesh


def _cloud(model: GaussianModel, views: Sequence[View], voxel: float, show: ShowDepth) -> Any:
    """Return the rendered points of all views with their normals [m, world], one in a voxel."""
    import open3d as o3d

    points, normals = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for camera, T in views:
        depth = show(model, camera, T)
        normal = render_view(model, camera, T, "normal")
        known = (depth > 0) & (depth < CONSTANTS.farthest) & (np.abs(normal).sum(axis=-1) > 0)
        step = max(1, ceil(known.sum() * len(views) / CONSTANTS.most_points))
        rows = np.flatnonzero(known)[::step]
        points.append(transform_points(T, camera.backproject(depth).reshape(-1, 3)[rows].astype(np.float64)))
        normals.append(normal.reshape(-1, 3)[rows].astype(np.float64) @ T[:3, :3].T)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.concatenate(points)))
    cloud.normals = o3d.utility.Vector3dVector(np.concatenate(normals))
    return cloud.voxel_down_sample(voxel)


def _no_surface() -> InputError:
    hint = "map more frames of it, or give a larger --voxel"
    return InputError("has no surface that three views share.", field="mesh", hint=hint)
