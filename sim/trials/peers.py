"""Two other stacks on the same frames and poses: a mesh of fused depth, and a point cloud in an octree."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from splatbot.collision.fcl_models import fcl_mesh, fcl_octree, octomap_bytes
from splatbot.collision.visibility import measured_depths
from splatbot.evaluation.depth_fusion import DepthFusion
from splatbot.grasping.affordance import Target
from splatbot.grasping.pick_planner import PickPlanner
from splatbot.grasping.sampler import GraspSampler
from splatbot.protocols import Array
from splatbot.robots.panda import panda
from splatbot.segmentation import segment
from splatbot.sim.scan import discs
from splatbot.sim.trials.look import FARTHEST, Look, usable_depth
from splatbot.sim.trials.solid import SolidPickPlanner, SolidReach, SolidWorld
from splatbot.sim.trials.stacks import OPTIONS, Knowledge

VOXEL = 0.004  # [m] of the mesh's distances and of the cloud
LEAF = 0.01  # [m] of the octree
_OUT = 0.5  # [m] from a surface to whom it faces
_GREY = 0.6  # of the mesh, whose colours nobody asks for
_THROUGH = 0.03  # [m] that a frame must see behind a point to have seen through it
_NORMALS = 0.012, 24  # [m] around a point, and points, that its normal is fitted to
_FEW = 3  # neighbours without which a point is a stray
_NODE, _LEAF_NODE = 256, 16  # bytes of FCL's BVNode<OBBRSS>, as measured, and of OctoMap's OcTreeNode
_SINGLE = 2  # float64 over float32, in which coordinates could be kept


class MeshStack:
    """Truncated signed distances, marching cubes, and python-fcl on the triangles."""

    name = "mesh"

    def learn(self, look: Look) -> Knowledge:
        """See :class:`splatbot.sim.trials.stacks.Stack`."""
        begin = time.perf_counter()
        fusion = DepthFusion(VOXEL, FARTHEST)
        for view in look.views:
            fusion.add(*view)
        mesh = fusion.mesh()
        vertices, triangles = np.asarray(mesh.vertices), np.asarray(mesh.triangles)
        normals = np.asarray(mesh.vertex_normals)

        def around(rows: NDArray[np.int64]) -> Any:
            own = np.zeros(len(vertices), np.bool_)
            own[rows] = True
            return fcl_mesh(vertices, triangles[~own[triangles].any(axis=1)])

        world = SolidWorld(vertices, fcl_mesh(vertices, triangles), around)
        size = vertices.nbytes // _SINGLE + triangles.nbytes + 2 * len(triangles) * _NODE
        return _known(look, vertices, normals, np.full_like(vertices, _GREY), world, size, begin)


class CloudStack:
    """Points with normals, and python-fcl on an octree of them."""

    name = "cloud"

    def learn(self, look: Look) -> Knowledge:
        """See :class:`splatbot.sim.trials.stacks.Stack`."""
        begin = time.perf_counter()
        cloud = _cloud(look)
        points, normals, colors = (np.asarray(x) for x in (cloud.points, cloud.normals, cloud.colors))

        def around(rows: NDArray[np.int64]) -> Any:
            return fcl_octree(np.delete(points, rows, axis=0), LEAF)

        world = SolidWorld(points, fcl_octree(points, LEAF), around)
        voxels = len(np.unique(np.floor(points / LEAF).astype(np.int64), axis=0))
        nodes = voxels + len(octomap_bytes(points, LEAF)) // 2  # of which each inner one is two bytes
        size = (points.nbytes + normals.nbytes) // _SINGLE + nodes * _LEAF_NODE
        return _known(look, points, normals, colors, world, size, begin)


def _known(
    look: Look, points: Array, normals: Array, colors: Array, world: SolidWorld, size: int, begin: float
) -> Knowledge:
    """The surface as discs for segmentation and grasps; the world for the arm."""
    scene = segment(discs(points, normals, colors, VOXEL), look.T_world_base, cut=False)
    robot = panda()

    def towards(target: Target) -> tuple[GraspSampler, PickPlanner]:
        reach = SolidReach(robot, scene.T_world_base, world, target.rows)
        observers = points + _OUT * normals
        sampler = GraspSampler(
            scene, robot, observers=observers, views=look.views, make_reach=lambda around, whole: reach
        )
        return sampler, SolidPickPlanner(sampler, target, OPTIONS, world)

    return Knowledge(scene, towards, size, time.perf_counter() - begin)


def _cloud(look: Look) -> Any:
    """Averaged over voxels, without strays and without what later frames see through."""
    whole = o3d.geometry.PointCloud()
    for frame, T in look.tracked:
        depth = usable_depth(frame)
        part = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(frame.camera.backproject(depth)[depth > 0]))
        part.colors = o3d.utility.Vector3dVector(frame.rgb[depth > 0] / 255.0)
        part.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(*_NORMALS))
        part.orient_normals_towards_camera_location(np.zeros(3))
        part.transform(T)
        whole += part
    cloud = whole.voxel_down_sample(VOXEL)
    cloud.normalize_normals()
    cloud, _ = cloud.remove_radius_outlier(_FEW, 2 * VOXEL)
    points = np.asarray(cloud.points)
    votes = np.zeros(len(points))
    for frame, T in look.tracked:
        rows, measured, z = measured_depths(points, usable_depth(frame), frame.camera, T)
        votes[rows[measured > z + _THROUGH]] -= 1
        votes[rows[np.abs(measured - z) <= _THROUGH]] += 1
    return cloud.select_by_index(np.flatnonzero(votes >= 0).tolist())
